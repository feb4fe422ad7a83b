//! Loops of a few rounds, written out.
//!
//! What works on numbers side by side is inlined, so that a function may hold thousands of loops of two to eight
//! rounds. For compilers to unroll them, one after the other in functions of that size, took more than half of the
//! time in which the mechanics was compiled.

/// Statements for each number below a constant, up to three or eight of them, in their order.
///
/// ```
/// let mut sum = 0;
/// plantd_math::unrolled!(8, i < 5, { sum += i });
/// assert_eq!(sum, 10);
/// ```
#[macro_export]
macro_rules! unrolled {
    (3, $i:ident < $count:tt, $body:block) => {
        $crate::unrolled!(@ 3 $i $count $body 0 1 2)
    };
    (8, $i:ident < $count:tt, $body:block) => {
        $crate::unrolled!(@ 8 $i $count $body 0 1 2 3 4 5 6 7)
    };
    (@ $most:literal $i:ident $count:tt $body:block $($at:literal)*) => {
        const { assert!($count <= $most, "more rounds than are written out") };
        $(if $at < $count {
            let $i: usize = $at;
            $body
        })*
    };
}
pub use unrolled;
