//! Products of matrices that fit a cache, kept in registers block by block.

/// Rows are padded to a multiple of this, so that no loop has a rest.
pub const LANES: usize = 8;

/// Numbers that begin on a cache line.
#[derive(Debug, Default)]
pub struct Scratch(Vec<f64>);

impl Scratch {
    /// Sees to room for `len` numbers; whether they keep their values is left open.
    pub fn reserve(&mut self, len: usize) {
        if self.0.len() < len + LANES {
            self.0.resize(len + LANES, 0.0);
        }
    }

    /// All of it.
    pub fn numbers(&mut self) -> &mut [f64] {
        let range = self.aligned();
        &mut self.0[range]
    }

    /// All of it, to read.
    pub fn read(&self) -> &[f64] {
        &self.0[self.aligned()]
    }

    fn aligned(&self) -> std::ops::Range<usize> {
        // No alignment (under an interpreter, say) costs time alone.
        let start = match self.0.as_ptr().align_offset(64) {
            offset if offset < LANES => offset,
            _ => 0,
        };
        start..self.0.len().saturating_sub(LANES - start).max(start)
    }
}

/// Copies the lower triangle of the first `count` rows and columns to the upper one.
#[inline(always)]
pub fn mirror_head(value: &mut [f64], n: usize, count: usize) {
    for first in (0..count).step_by(LANES) {
        let end = (first + LANES).min(count);
        if end - first == LANES {
            let (lower, upper) = value.split_at_mut(n * first);
            for col in (0..first).step_by(LANES) {
                transpose_block(&mut upper[col..], n, &lower[n * col + first..], n);
            }
        }
        for row in first..end {
            for col in if end - first == LANES { first } else { 0 }..row {
                value[n * row + col] = value[n * col + row];
            }
        }
    }
}

/// The transpose of a matrix, of which rows and columns are written. Strides are those of columns.
#[inline(always)]
pub fn transpose(
    (target, target_stride): (&mut [f64], usize),
    (source, source_stride): (&[f64], usize),
    (rows, cols): (usize, usize),
) {
    if rows.min(cols) < LANES {
        for (row, col) in (0..rows).flat_map(|row| (0..cols).map(move |col| (row, col))) {
            target[target_stride * col + row] = source[source_stride * row + col];
        }
        return;
    }
    // The last blocks overlap those before.
    let starts = |count: usize| (0..count).step_by(LANES).map(move |i| i.min(count - LANES));
    for row in starts(rows) {
        for col in starts(cols) {
            let target = &mut target[target_stride * col + row..];
            transpose_block(
                target,
                target_stride,
                &source[source_stride * row + col..],
                source_stride,
            );
        }
    }
}

/// The transpose of a block of [`LANES`] rows and columns.
#[inline(always)]
fn transpose_block(target: &mut [f64], target_stride: usize, source: &[f64], source_stride: usize) {
    const LAST: usize = LANES - 1;
    assert!(target.len() >= LAST * target_stride + LANES);
    assert!(source.len() >= LAST * source_stride + LANES);
    #[cfg(target_arch = "x86_64")]
    if std::arch::is_x86_feature_detected!("avx") {
        // SAFETY: the processor has AVX; the block is within the slices.
        unsafe { wide::transpose_avx(target, target_stride, source, source_stride) };
        return;
    }
    for (i, j) in (0..LANES).flat_map(|i| (0..LANES).map(move |j| (i, j))) {
        target[target_stride * i + j] = source[source_stride * j + i];
    }
}

/// What becomes of a product.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Into {
    /// `C = A Bᵀ`.
    Set,
    /// `C += A Bᵀ`, in blocks that reach the lower triangle.
    AddLower,
    /// `C −= A Bᵀ`, in blocks that reach the lower triangle.
    SubtractLower,
    /// `C = A Bᵀ`, in blocks that reach the lower triangle.
    SetLower,
}

/// A factor of a product, term by term.
#[derive(Clone, Copy, Debug)]
pub struct Operand<'a> {
    /// The numbers of all terms.
    pub numbers: &'a [f64],
    /// Where each term begins.
    pub terms: &'a [usize],
    /// From an entry of a term to the next.
    pub stride: usize,
}

impl Operand<'_> {
    /// Whether each term has so many entries.
    fn holds(&self, entries: usize) -> bool {
        let reach = self.stride * entries.saturating_sub(1) + usize::from(entries > 0);
        self.terms.iter().all(|start| start + reach <= self.numbers.len())
    }
}

/// `A Bᵀ` into `C`, whose columns are `stride` apart: `A` is rows × terms, with neighbouring rows
/// side by side, `B` is cols × terms, both rounded up to [`LANES`]. Lower triangles begin with row
/// and column `first`, a multiple of [`LANES`].
///
/// # Panics
/// If a slice is too short, or the operands differ in their number of terms.
pub fn product(
    c: &mut [f64],
    stride: usize,
    a: Operand<'_>,
    b: Operand<'_>,
    (rows, cols): (usize, usize),
    into: Into,
    first: usize,
) {
    let (rows, cols) = (rows.next_multiple_of(LANES), cols.next_multiple_of(LANES));
    assert!(first.is_multiple_of(LANES) && rows <= stride && c.len() >= stride * cols);
    assert!(a.stride == 1 && a.terms.len() == b.terms.len() && a.holds(rows) && b.holds(cols));
    let shape = Shape { a, b, stride, rows, cols, into, first };
    #[cfg(target_arch = "x86_64")]
    {
        if std::arch::is_x86_feature_detected!("avx512f") {
            // SAFETY: the processor has AVX-512; the slices are as long as the shape says.
            unsafe { wide::product_avx512(c, &shape) };
            return;
        }
        if std::arch::is_x86_feature_detected!("avx2") && std::arch::is_x86_feature_detected!("fma")
        {
            // SAFETY: the processor has AVX2 and FMA; the slices are as long as the shape says.
            unsafe { wide::product_avx2(c, &shape) };
            return;
        }
    }
    portable(c, &shape);
}

struct Shape<'a> {
    a: Operand<'a>,
    b: Operand<'a>,
    stride: usize,
    rows: usize,
    cols: usize,
    into: Into,
    first: usize,
}

impl Shape<'_> {
    /// The columns of `C` to compute, and the first row of each that is wanted.
    fn start(&self) -> usize {
        if self.into == Into::Set { 0 } else { self.first }
    }
    fn first_row(&self, col: usize) -> usize {
        if self.into == Into::Set { 0 } else { col }
    }
}

/// Blocks of 8 rows and 4 columns, for any processor.
fn portable(c: &mut [f64], shape: &Shape<'_>) {
    let Shape { a, b, stride, rows, cols, into, .. } = *shape;
    for col in (shape.start()..cols).step_by(4) {
        for row in (shape.first_row(col / LANES * LANES)..rows).step_by(LANES) {
            let mut sums = [[0.0; LANES]; 4];
            for (&left, &right) in a.terms.iter().zip(b.terms) {
                let left = &a.numbers[left + row..][..LANES];
                let right = b.numbers[right + b.stride * col..].iter().step_by(b.stride);
                for (sum, r) in sums.iter_mut().zip(right) {
                    for (sum, l) in sum.iter_mut().zip(left) {
                        *sum += l * r;
                    }
                }
            }
            for (j, sum) in sums.iter().enumerate() {
                let target = &mut c[stride * (col + j) + row..][..LANES];
                for (target, sum) in target.iter_mut().zip(sum) {
                    *target = match into {
                        Into::Set | Into::SetLower => *sum,
                        Into::AddLower => *target + sum,
                        Into::SubtractLower => *target - sum,
                    };
                }
            }
        }
    }
}

/// Products in wide registers.
#[cfg(target_arch = "x86_64")]
mod wide {
    use std::arch::x86_64::*;

    use super::{Into, LANES, Shape};

    /// # Safety
    /// Eight columns of eight entries are within each slice.
    #[inline]
    #[target_feature(enable = "avx")]
    pub(super) unsafe fn transpose_avx(
        target: &mut [f64],
        target_stride: usize,
        source: &[f64],
        source_stride: usize,
    ) {
        for (i, j) in [(0, 0), (0, 4), (4, 0), (4, 4)] {
            // SAFETY: rows up to i + 3 and columns up to j + 3 of the source are within the block.
            unsafe {
                let from = source.as_ptr().add(source_stride * j + i);
                let a = _mm256_loadu_pd(from);
                let b = _mm256_loadu_pd(from.add(source_stride));
                let c = _mm256_loadu_pd(from.add(2 * source_stride));
                let d = _mm256_loadu_pd(from.add(3 * source_stride));
                let (ab, cd) = (_mm256_unpacklo_pd(a, b), _mm256_unpacklo_pd(c, d));
                let (ab_next, cd_next) = (_mm256_unpackhi_pd(a, b), _mm256_unpackhi_pd(c, d));
                let to = target.as_mut_ptr().add(target_stride * i + j);
                let next = to.add(target_stride);
                _mm256_storeu_pd(to, _mm256_permute2f128_pd::<0x20>(ab, cd));
                _mm256_storeu_pd(next, _mm256_permute2f128_pd::<0x20>(ab_next, cd_next));
                let (to, next) = (to.add(2 * target_stride), next.add(2 * target_stride));
                _mm256_storeu_pd(to, _mm256_permute2f128_pd::<0x31>(ab, cd));
                _mm256_storeu_pd(next, _mm256_permute2f128_pd::<0x31>(ab_next, cd_next));
            }
        }
    }

    /// # Safety
    /// The slices are as long as the shape says.
    #[target_feature(enable = "avx512f")]
    pub(super) unsafe fn product_avx512(c: &mut [f64], shape: &Shape<'_>) {
        // Rows of A stay in the nearest cache while B passes by.
        let mut first = shape.start();
        while first < shape.rows {
            // Four vectors are two and two, not three and one.
            let left = (shape.rows - first) / LANES;
            let vectors = if left == 4 { 2 } else { left.min(3) };
            let end = first + LANES * vectors;
            for col in (shape.start()..shape.cols).step_by(8) {
                let row = shape.first_row(col).max(first);
                // SAFETY: all rows and columns of the block are within the shape.
                unsafe {
                    match end.saturating_sub(row) / LANES {
                        0 => break,
                        1 => block_avx512::<1>(c, shape, row, col),
                        2 => block_avx512::<2>(c, shape, row, col),
                        _ => block_avx512::<3>(c, shape, row, col),
                    }
                }
            }
            first = end;
        }
    }

    /// `8 V` rows and 8 columns.
    ///
    /// # Safety
    /// The block is within the shape, and the slices are as long as the shape says.
    #[target_feature(enable = "avx512f")]
    unsafe fn block_avx512<const V: usize>(
        c: &mut [f64],
        shape: &Shape<'_>,
        row: usize,
        col: usize,
    ) {
        let across = shape.b.stride;
        let mut sums = [[_mm512_setzero_pd(); V]; 8];
        // SAFETY: each term of A has `row + 8 V` entries, each of B `col + 8`; the last column of C
        // that is written is `col + 7 < cols`.
        unsafe {
            for (&left, &right) in shape.a.terms.iter().zip(shape.b.terms) {
                let left = shape.a.numbers.as_ptr().add(left + row);
                let right = shape.b.numbers.as_ptr().add(right + across * col);
                let mut l = [_mm512_setzero_pd(); V];
                for (v, l) in l.iter_mut().enumerate() {
                    *l = _mm512_loadu_pd(left.add(8 * v));
                }
                for (j, sum) in sums.iter_mut().enumerate() {
                    let r = _mm512_set1_pd(*right.add(across * j));
                    for v in 0..V {
                        sum[v] = _mm512_fmadd_pd(l[v], r, sum[v]);
                    }
                }
            }
            let target = c.as_mut_ptr().add(shape.stride * col + row);
            for (j, sum) in sums.iter().enumerate() {
                for (v, sum) in sum.iter().enumerate() {
                    let place = target.add(shape.stride * j + 8 * v);
                    let result = match shape.into {
                        Into::Set | Into::SetLower => *sum,
                        Into::AddLower => _mm512_add_pd(_mm512_loadu_pd(place), *sum),
                        Into::SubtractLower => _mm512_sub_pd(_mm512_loadu_pd(place), *sum),
                    };
                    _mm512_storeu_pd(place, result);
                }
            }
        }
    }

    /// # Safety
    /// The slices are as long as the shape says.
    #[target_feature(enable = "avx2,fma")]
    pub(super) unsafe fn product_avx2(c: &mut [f64], shape: &Shape<'_>) {
        for col in (shape.start()..shape.cols).step_by(4) {
            let mut row = shape.first_row(col / LANES * LANES);
            while row < shape.rows {
                // Three vectors need all sixteen registers, and compilers run out of them. Rows come
                // in pairs of vectors.
                // SAFETY: all rows and columns of the block are within the shape.
                unsafe { block_avx2(c, shape, row, col) };
                row += LANES;
            }
        }
    }

    /// 8 rows and 4 columns.
    ///
    /// # Safety
    /// The block is within the shape, and the slices are as long as the shape says.
    #[target_feature(enable = "avx2,fma")]
    unsafe fn block_avx2(c: &mut [f64], shape: &Shape<'_>, row: usize, col: usize) {
        let across = shape.b.stride;
        let mut sums = [[_mm256_setzero_pd(); 2]; 4];
        // SAFETY: each term of A has `row + 8` entries, each of B `col + 4`; the last column of C
        // that is written is `col + 3 < cols`.
        unsafe {
            for (&left, &right) in shape.a.terms.iter().zip(shape.b.terms) {
                let left = shape.a.numbers.as_ptr().add(left + row);
                let right = shape.b.numbers.as_ptr().add(right + across * col);
                let mut l = [_mm256_setzero_pd(); 2];
                for (v, l) in l.iter_mut().enumerate() {
                    *l = _mm256_loadu_pd(left.add(4 * v));
                }
                for (j, sum) in sums.iter_mut().enumerate() {
                    let r = _mm256_set1_pd(*right.add(across * j));
                    for v in 0..2 {
                        sum[v] = _mm256_fmadd_pd(l[v], r, sum[v]);
                    }
                }
            }
            let target = c.as_mut_ptr().add(shape.stride * col + row);
            for (j, sum) in sums.iter().enumerate() {
                for (v, sum) in sum.iter().enumerate() {
                    let place = target.add(shape.stride * j + 4 * v);
                    let result = match shape.into {
                        Into::Set | Into::SetLower => *sum,
                        Into::AddLower => _mm256_add_pd(_mm256_loadu_pd(place), *sum),
                        Into::SubtractLower => _mm256_sub_pd(_mm256_loadu_pd(place), *sum),
                    };
                    _mm256_storeu_pd(place, result);
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn numbers(len: usize, seed: f64) -> Vec<f64> {
        (0..len).map(|i| (seed + 1.7 * i as f64).sin()).collect()
    }

    /// Each kernel that this processor has, against sums in the order of the formula.
    #[test]
    fn products_are_sums_of_products() {
        for (rows, cols, terms) in
            [(1_usize, 1_usize, 1), (8, 16, 3), (62, 80, 44), (80, 18, 7), (30, 30, 0)]
        {
            let stride = rows.max(cols).next_multiple_of(LANES);
            let numbers_of_a = numbers(stride * terms, 0.1);
            let numbers_of_b = numbers(stride * terms, 0.2);
            let columns: Vec<usize> = (0..terms).map(|term| stride * term).collect();
            let side_by_side: Vec<usize> = (0..terms).collect();
            let a = Operand { numbers: &numbers_of_a, terms: &columns, stride: 1 };
            let b = Operand { numbers: &numbers_of_b, terms: &columns, stride: 1 };
            let b_across = Operand { numbers: &numbers_of_b, terms: &side_by_side, stride: terms };
            for (into, first, b) in [
                (Into::Set, 0, b),
                (Into::Set, 0, b_across),
                (Into::SetLower, 0, b),
                (Into::AddLower, 0, b),
                (Into::SubtractLower, 0, b),
                (Into::SetLower, 8, b_across),
            ] {
                check(a, b, stride, (rows, cols), into, first);
            }
        }
    }

    #[test]
    fn transposes_and_mirrors_move_every_entry() {
        for (rows, cols) in [(18, 62), (8, 8), (3, 20), (9, 31)] {
            let source = numbers(rows * cols, 0.4);
            let mut target = vec![0.0; rows * cols];
            transpose((&mut target, rows), (&source, cols), (rows, cols));
            for (row, col) in (0..rows).flat_map(|row| (0..cols).map(move |col| (row, col))) {
                assert_eq!(target[rows * col + row], source[cols * row + col], "{row} {col}");
            }
        }
        for count in [0, 5, 8, 30, 62] {
            let n = count + 3;
            let before = numbers(n * n, 0.5);
            let mut value = before.clone();
            mirror_head(&mut value, n, count);
            for (row, col) in (0..n).flat_map(|row| (0..n).map(move |col| (row, col))) {
                let is_mirrored = row < col && col < count;
                let expected =
                    if is_mirrored { before[n * row + col] } else { before[n * col + row] };
                assert_eq!(value[n * col + row], expected, "{count}: {row} {col}");
            }
        }
    }

    fn check(
        a: Operand<'_>,
        b: Operand<'_>,
        stride: usize,
        (rows, cols): (usize, usize),
        into: Into,
        first: usize,
    ) {
        let before = numbers(stride * cols.next_multiple_of(LANES), 0.3);
        let (padded_rows, padded_cols) =
            (rows.next_multiple_of(LANES), cols.next_multiple_of(LANES));
        let shape = Shape { a, b, stride, rows: padded_rows, cols: padded_cols, into, first };
        let compare = |kernel: &str, c: &[f64]| {
            for (col, row) in (0..cols).flat_map(|col| (0..rows).map(move |row| (col, row))) {
                if into != Into::Set && (row < col || col < first) {
                    continue;
                }
                let terms = a.terms.iter().zip(b.terms);
                let sum: f64 =
                    terms.map(|(l, r)| a.numbers[l + row] * b.numbers[r + b.stride * col]).sum();
                let at = stride * col + row;
                let expected = match into {
                    Into::Set | Into::SetLower => sum,
                    Into::AddLower => before[at] + sum,
                    Into::SubtractLower => before[at] - sum,
                };
                assert!((c[at] - expected).abs() < 1e-13, "{kernel} {row} {col}");
            }
        };
        let mut c = before.clone();
        product(&mut c, stride, a, b, (rows, cols), into, first);
        compare("best", &c);
        let mut c = before.clone();
        portable(&mut c, &shape);
        compare("portable", &c);
        #[cfg(target_arch = "x86_64")]
        if std::arch::is_x86_feature_detected!("avx2") && std::arch::is_x86_feature_detected!("fma")
        {
            let mut c = before.clone();
            // SAFETY: the processor has both; the slices are as long as the shape says.
            unsafe { wide::product_avx2(&mut c, &shape) };
            compare("avx2", &c);
        }
    }
}
