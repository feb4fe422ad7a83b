//! The same code for wider registers.

/// Runs a block as it is compiled for processors with AVX2, where there is one, and as it is compiled for
/// all others elsewhere. The operations are the same, and so are the bits. What the block calls is compiled
/// with it where it is always inlined.
macro_rules! wide {
    ($body:block) => {
        $crate::math::simd::wide!(@run ["avx2" avx2] $body)
    };
    (@run [$($feature:tt $wider:ident)+] $body:block) => {{
        #[inline(always)]
        fn run<R>(block: impl FnOnce() -> R) -> R {
            $(
                #[cfg(target_arch = "x86_64")]
                #[target_feature(enable = $feature)]
                fn $wider<R>(block: impl FnOnce() -> R) -> R {
                    block()
                }
                #[cfg(target_arch = "x86_64")]
                if std::arch::is_x86_feature_detected!($feature)
                    && !$crate::math::simd::is_narrow()
                {
                    // SAFETY: the processor has the feature.
                    return unsafe { $wider(block) };
                }
            )+
            block()
        }
        run(#[inline(always)] move || $body)
    }};
}
pub(crate) use wide;

/// [`wide`] with AVX-512, too: for what works on whole [`Block`](crate::math::rows::Block)s.
macro_rules! widest {
    ($body:block) => {
        $crate::math::simd::wide!(@run ["avx512f" avx512 "avx2" avx2] $body)
    };
}
pub(crate) use widest;

/// Whether tests compare with the code for all processors.
#[cfg(not(test))]
#[inline(always)]
pub(crate) fn is_narrow() -> bool {
    false
}

#[cfg(test)]
pub(crate) use tests::{is_narrow, narrowly};

#[cfg(test)]
mod tests {
    use std::cell::Cell;

    thread_local! {
        static IS_NARROW: Cell<bool> = const { Cell::new(false) };
    }

    pub(crate) fn is_narrow() -> bool {
        IS_NARROW.get()
    }

    /// Runs the code for all processors.
    pub(crate) fn narrowly<R>(run: impl FnOnce() -> R) -> R {
        IS_NARROW.set(true);
        let result = run();
        IS_NARROW.set(false);
        result
    }
}
