//! The same code for wider registers.

use std::sync::atomic::{AtomicU8, Ordering};

/// Runs a block as it is compiled for processors with AVX2, where there is one, and as it is compiled for
/// all others elsewhere. The operations are the same, and so are the bits. What the block calls is compiled
/// with it where it is always inlined.
#[macro_export]
macro_rules! wide {
    ($body:block) => {
        $crate::simd::wide!(@run [AVX2 "avx2" avx2] $body)
    };
    (@run [$($registers:ident $feature:tt $wider:ident)+] $body:block) => {{
        #[inline(always)]
        fn run<R>(block: impl FnOnce() -> R) -> R {
            $(
                #[cfg(target_arch = "x86_64")]
                #[target_feature(enable = $feature)]
                fn $wider<R>(block: impl FnOnce() -> R) -> R {
                    block()
                }
                #[cfg(target_arch = "x86_64")]
                if $crate::simd::has($crate::simd::$registers) {
                    // SAFETY: the processor has the feature.
                    return unsafe { $wider(block) };
                }
            )+
            block()
        }
        run(#[inline(always)] move || $body)
    }};
}

/// [`wide!`] with AVX-512, too: for what works on whole [`Block`](crate::rows::Block)s.
#[macro_export]
macro_rules! widest {
    ($body:block) => {
        $crate::simd::wide!(@run [AVX512 "avx512f" avx512 AVX2 "avx2" avx2] $body)
    };
}

pub use {wide, widest};

/// Runs a block as it is compiled for processors with AVX-512, and in no other way, where code for others would be
/// compiled for nothing.
///
/// # Panics
///
/// On an x86 processor without it: ask [`has`] before.
#[inline(always)]
pub(crate) fn in_avx512<R>(block: impl FnOnce() -> R) -> R {
    #[cfg(target_arch = "x86_64")]
    {
        #[target_feature(enable = "avx512f")]
        fn avx512<R>(block: impl FnOnce() -> R) -> R {
            block()
        }
        assert!(std::arch::is_x86_feature_detected!("avx512f"), "registers of eight numbers");
        // SAFETY: the processor has the feature.
        unsafe { avx512(block) }
    }
    #[cfg(not(target_arch = "x86_64"))]
    block()
}

/// Registers that every processor has.
pub const PORTABLE: u8 = 1;
/// Registers of four numbers: AVX2.
pub const AVX2: u8 = 2;
/// Registers of eight numbers: AVX-512.
pub const AVX512: u8 = 3;

/// The widest registers that blocks may use; 0 until the processor has been asked.
static REGISTERS: AtomicU8 = AtomicU8::new(0);

/// Whether blocks may use these registers: the processor has them, and it is not [`within`] fewer.
#[inline(always)]
pub fn has(registers: u8) -> bool {
    let widest = REGISTERS.load(Ordering::Relaxed);
    widest >= registers || (widest == 0 && ask_the_processor() >= registers)
}

#[cold]
fn ask_the_processor() -> u8 {
    #[cfg(target_arch = "x86_64")]
    let widest = if std::arch::is_x86_feature_detected!("avx512f") {
        AVX512
    } else if std::arch::is_x86_feature_detected!("avx2") {
        AVX2
    } else {
        PORTABLE
    };
    #[cfg(not(target_arch = "x86_64"))]
    let widest = PORTABLE;
    REGISTERS.store(widest, Ordering::Relaxed);
    widest
}

/// Runs the code for all processors, in all threads: for tests that compare it with the wider code.
pub fn narrowly<R>(run: impl FnOnce() -> R) -> R {
    within(PORTABLE, run)
}

/// Runs the code for processors with these registers, or fewer where this one has fewer, in all threads: for tests.
pub fn within<R>(registers: u8, run: impl FnOnce() -> R) -> R {
    let before = ask_the_processor();
    REGISTERS.store(before.min(registers), Ordering::Relaxed);
    let result = run();
    REGISTERS.store(before, Ordering::Relaxed);
    result
}
