//! The same code for wider registers.

/// Defines methods that run the one after `=` as it is compiled for processors with AVX2, where there is
/// one, and as it is compiled for all others elsewhere. The operations are the same, and so are the bits;
/// the one for AVX2 gets the second name, and one for AVX-512 the third: for what works on whole [`Block`]s.
///
/// [`Block`]: crate::math::rows::Block
macro_rules! wide {
    ($(
        $(#[$attribute:meta])*
        $visibility:vis fn $name:ident(
            $($receiver:ident)+ $(, $argument:ident: $type:ty)* $(,)?
        ) $(-> $out:ty)? = $portable:ident $(, $wider:ident)+;
    )*) => {$(
        wide!(@method [$(#[$attribute])* $visibility] $name $portable [$($wider)+]
            [$($receiver)+] [$($argument: $type),*] [$($out)?]);
    )*};
    (@method $head:tt $name:ident $portable:ident $wider:tt
        [mut $self:ident] $arguments:tt $out:tt) => {
        wide!(@all $head $name $portable $wider [&mut $self] $self $arguments $out);
    };
    (@method $head:tt $name:ident $portable:ident $wider:tt
        [$self:ident] $arguments:tt $out:tt) => {
        wide!(@all $head $name $portable $wider [&$self] $self $arguments $out);
    };
    (@all [$($head:tt)*] $name:ident $portable:ident [$avx2:ident $($avx512:ident)?]
        $receiver:tt $self:ident $arguments:tt $out:tt) => {
        wide!(@function [$($head)*] $name $receiver $arguments $out {
            $(wide!(@try "avx512f" $avx512 $self $arguments);)?
            wide!(@try "avx2" $avx2 $self $arguments);
            wide!(@call $portable $self $arguments)
        });
        $(wide!(@function [
            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = "avx512f")]
        ] $avx512 $receiver $arguments $out { wide!(@call $portable $self $arguments) });)?
        wide!(@function [
            #[cfg(target_arch = "x86_64")]
            #[target_feature(enable = "avx2")]
        ] $avx2 $receiver $arguments $out { wide!(@call $portable $self $arguments) });
    };
    (@function [$($head:tt)*] $name:ident [$($receiver:tt)+]
        [$($argument:ident: $type:ty),*] [$($out:ty)?] $body:block) => {
        $($head)* fn $name($($receiver)+, $($argument: $type),*) $(-> $out)? $body
    };
    (@try $feature:tt $wider:ident $self:ident $arguments:tt) => {
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!($feature) {
            // SAFETY: the processor has the feature.
            return unsafe { wide!(@call $wider $self $arguments) };
        }
    };
    (@call $function:ident $self:ident [$($argument:ident: $type:ty),*]) => {
        $self.$function($($argument),*)
    };
}
pub(crate) use wide;
