//! Row operations on row-major matrices whose rows are padded to whole blocks.

/// Rows are padded to a multiple of this, and worked on in blocks of it.
pub(crate) const LANES: usize = 8;

/// The length of a padded row.
pub(crate) fn padded(width: usize) -> usize {
    width.next_multiple_of(LANES)
}

/// `target += Σ factor · source[row]`, over whole blocks of `target`; a block stays in registers while
/// all terms are added to it.
#[inline(always)]
pub(crate) fn add_rows(
    target: &mut [f64],
    source: &[f64],
    stride: usize,
    terms: impl Iterator<Item = (f64, usize)> + Clone,
) {
    let (blocks, _) = target.as_chunks_mut::<LANES>();
    for (b, block) in blocks.iter_mut().enumerate() {
        let mut sum = *block;
        for (factor, row) in terms.clone() {
            let entries = &source[row * stride + b * LANES..][..LANES];
            for (s, entry) in sum.iter_mut().zip(entries) {
                *s += factor * entry;
            }
        }
        *block = sum;
    }
}
