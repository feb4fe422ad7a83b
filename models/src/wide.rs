//! The same code for wider registers.

/// Defines methods that run the one after `=` as it is compiled for processors with AVX2, where there is
/// one, and as it is compiled for all others elsewhere. The operations are the same, and so are the bits;
/// the one for AVX2 gets the second name, and one for AVX-512 the third: for what works on whole [`Block`]s.
///
/// [`Block`]: crate::plant::rows::Block
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
    (@all [$($head:tt)*] $name:ident $portable:ident [$avx2:ident]
        [$($receiver:tt)+] $self:ident [$($argument:ident: $type:ty),*] [$($out:ty)?]) => {
        $($head)* fn $name($($receiver)+, $($argument: $type),*) $(-> $out)? {
            #[cfg(target_arch = "x86_64")]
            if std::arch::is_x86_feature_detected!("avx2") {
                // SAFETY: the processor has AVX2.
                return unsafe { $self.$avx2($($argument),*) };
            }
            $self.$portable($($argument),*)
        }

        #[cfg(target_arch = "x86_64")]
        #[target_feature(enable = "avx2")]
        fn $avx2($($receiver)+, $($argument: $type),*) $(-> $out)? {
            $self.$portable($($argument),*)
        }
    };
    (@all [$($head:tt)*] $name:ident $portable:ident [$avx2:ident $avx512:ident]
        [$($receiver:tt)+] $self:ident [$($argument:ident: $type:ty),*] [$($out:ty)?]) => {
        $($head)* fn $name($($receiver)+, $($argument: $type),*) $(-> $out)? {
            #[cfg(target_arch = "x86_64")]
            if std::arch::is_x86_feature_detected!("avx512f") {
                // SAFETY: the processor has AVX-512.
                return unsafe { $self.$avx512($($argument),*) };
            }
            #[cfg(target_arch = "x86_64")]
            if std::arch::is_x86_feature_detected!("avx2") {
                // SAFETY: the processor has AVX2.
                return unsafe { $self.$avx2($($argument),*) };
            }
            $self.$portable($($argument),*)
        }

        #[cfg(target_arch = "x86_64")]
        #[target_feature(enable = "avx512f")]
        fn $avx512($($receiver)+, $($argument: $type),*) $(-> $out)? {
            $self.$portable($($argument),*)
        }

        #[cfg(target_arch = "x86_64")]
        #[target_feature(enable = "avx2")]
        fn $avx2($($receiver)+, $($argument: $type),*) $(-> $out)? {
            $self.$portable($($argument),*)
        }
    };
}
pub(crate) use wide;
