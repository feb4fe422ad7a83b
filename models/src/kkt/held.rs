//! Limbs whose ends are held, such as legs on the ground, eliminated with the equations that hold them.
//!
//! As many equations as the last coordinates `l` of a chain say where the limb goes with the other coordinates that it
//! has to do with, its border `b`: those above, which carry it, and those that move the place where it is held, as the
//! platform of a parallel robot does. With the blocks `A1_l` and `A0_l` of the Jacobians,
//!
//! ```text
//! K y + A0ᵀ λ = r1                     G1 = A1_l⁻¹ A1_b      G0 = A0_l⁻¹ A0_b
//! A1 y        = r2                     E = K_lb − K_ll G1
//!
//! c = A1_l⁻¹ r2                        s = r_l − K_ll c
//! (K_bb − K_bl G1 − G0ᵀ E) y_b = r_b − K_bl c − G0ᵀ s
//! y_l = c − G1 y_b                     λ = A0_l⁻ᵀ (s − E y_b)
//! ```
//!
//! What is left is a matrix of the other coordinates, and no equation: the change of a limb stays among the rows of
//! its border. Where `A_l` is next to singular, as that of a straight leg, all equations are taken
//! together.

#[cfg(test)]
mod tests;

use plantd_math::eights::{Eight, InEights, in_eights};
use plantd_math::rows::{Block, LANES};
use plantd_math::spatial::Vec3;
use plantd_math::tree_lu::{SmallestPivot, TreeLu};

use crate::constraints::closure::Closure;
use crate::model::held::{Held, HeldLimb, Run};
use crate::model::mechanism::Model;

/// Equations of a limb, at most.
pub(crate) const MOST: usize = 6;
/// One over the largest entry of `A_l⁻¹`, in units in which the steepest equation has slope 1, from which on it is
/// taken.
const SOUND: f64 = 1e-3;

/// Rows and columns of a limb.
type Square<const N: usize> = [[f64; N]; N];

/// The factors of a limb with up to `N` equations; those that it does not have are `y = r2`.
#[derive(Clone, Debug)]
struct Factors<const N: usize> {
    /// `A0_l⁻¹` and `A1_l⁻¹`.
    inverses: [Square<N>; 2],
    /// `K_ll`.
    own: Square<N>,
    /// By the coordinates of the border, eight at a time.
    border: Vec<Border<N>>,
}

/// Rows of a limb, by eight coordinates of its border.
#[derive(Clone, Copy, Debug)]
struct Border<const N: usize> {
    /// `G0` and `G1`.
    start: [Block; N],
    end: [Block; N],
    /// `K_blᵀ` and `E`.
    upper: [Block; N],
    lower: [Block; N],
}

/// A limb, by what holds it.
#[derive(Clone, Debug)]
enum Limb {
    /// A point.
    Three(Box<Factors<3>>),
    /// Anything else.
    Six(Box<Factors<MOST>>),
}

/// The same for each kind of limb.
macro_rules! of_limb {
    ($limb:expr, $factors:ident => $result:expr) => {
        match $limb {
            Limb::Three($factors) => $result,
            Limb::Six($factors) => $result,
        }
    };
}

/// Limbs eliminated, and factors of the rest.
#[derive(Clone, Debug)]
pub(crate) struct HeldLimbs {
    limbs: Vec<Limb>,
    rest: TreeLu,
    /// What limbs with the same border make of its coordinates, in their rows and columns.
    sums: Vec<Block>,
}

/// The smallest pivots of an elimination.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Pivots {
    /// Of the coordinates that are left; none where a limb was not eliminated.
    pub(crate) rest: Option<SmallestPivot>,
    /// Of the equations.
    pub(crate) equations: f64,
}

impl HeldLimbs {
    pub(crate) fn new(held: &Held) -> Self {
        let most = held.limbs.iter().map(|limb| limb.border.len()).max().unwrap_or_default();
        let limb = |limb: &HeldLimb| match limb.equations.len() {
            3 => Limb::Three(Box::new(Factors::new(limb))),
            _ => Limb::Six(Box::new(Factors::new(limb))),
        };
        Self {
            limbs: held.limbs.iter().map(limb).collect(),
            rest: TreeLu::new(&held.rest),
            sums: vec![Block::ZERO; most * most.div_ceil(LANES)],
        }
    }

    /// Factors with `K`, which is filled, and the Jacobians at the start and the end.
    #[inline(never)]
    pub(crate) fn factor(
        &mut self,
        model: &Model,
        held: &Held,
        matrix: &TreeLu,
        closures: [&Closure; 2],
        step: f64,
    ) -> Pivots {
        self.take_rest(held, matrix);
        let equations = in_eights(Eliminate { limbs: self, model, held, matrix, closures });
        let scale = 1.0 / step.abs();
        let is_sound = equations >= SOUND;
        let rest = is_sound.then(|| self.rest.factor(&held.rest, &held.inertia, scale));
        Pivots { rest, equations }
    }

    /// Solves in place: from `r1` and `r2` come `y` and `λ`.
    #[inline(never)]
    pub(crate) fn solve(&mut self, held: &Held, x: &mut [f64], lambda: &mut [f64]) {
        in_eights(Lift { limbs: self, held, x, lambda });
        self.rest.solve(&held.rest, x);
        in_eights(Lower { limbs: self, held, x, lambda });
    }

    /// [`Self::solve`] for right-hand sides side by side, row-major; `columns` and `stride` are whole blocks.
    #[inline(never)]
    pub(crate) fn solve_rows(
        &mut self,
        held: &Held,
        x: &mut [f64],
        lambda: &mut [f64],
        [stride, columns]: [usize; 2],
    ) {
        in_eights(PassRows::<true> { limbs: self, held, x, lambda, stride, columns });
        self.rest.solve_rows(&held.rest, x, stride, columns);
        in_eights(PassRows::<false> { limbs: self, held, x, lambda, stride, columns });
    }

    /// Takes the entries of `K` of which no coordinate is a limb's.
    fn take_rest(&mut self, held: &Held, matrix: &TreeLu) {
        let TreeLu { upper, lower, .. } = &mut self.rest;
        upper.fill(0.0);
        lower.fill(0.0);
        for &Run { from, to, len } in &held.kept {
            upper[to..to + len].copy_from_slice(&matrix.upper[from..from + len]);
            lower[to..to + len].copy_from_slice(&matrix.lower[from..from + len]);
        }
        for i in held.limbs.iter().flat_map(|limb| limb.coordinates.clone()) {
            upper[held.rest.start(i)] = 1.0;
        }
    }

    /// Adds what limbs make of their border, and begins anew.
    #[inline(always)]
    fn put_sums(&mut self, plan: &HeldLimb) {
        let width = plan.border.len().div_ceil(LANES);
        let mut places = plan.places.iter();
        for (d, i) in plan.border.iter().enumerate() {
            let row = &mut self.sums[d * width..][..width];
            for ((e, k), place) in plan.border.iter().enumerate().zip(&mut places) {
                let sum = row[e / LANES].0[e % LANES];
                let triangle = if k < i { &mut self.rest.lower } else { &mut self.rest.upper };
                triangle[*place] += sum;
            }
            row.fill(Block::ZERO);
        }
    }
}

/// The numbers of a list, and zeros; without a call to copy them.
#[inline(always)]
fn taken<const N: usize>(list: &[f64]) -> [f64; N] {
    if let Some(numbers) = list.first_chunk() {
        return *numbers;
    }
    let mut numbers = [0.0; N];
    for (k, number) in numbers.iter_mut().enumerate() {
        if let Some(from) = list.get(k) {
            *number = *from;
        }
    }
    numbers
}

/// The way back, as long as the list is.
#[inline(always)]
fn put<const N: usize>(numbers: [f64; N], list: &mut [f64]) {
    if let Some(to) = list.first_chunk_mut() {
        *to = numbers;
        return;
    }
    for (k, number) in numbers.into_iter().enumerate() {
        if let Some(to) = list.get_mut(k) {
            *to = number;
        }
    }
}

/// `Σ row · factor`.
#[inline(always)]
fn sum_of<E: Eight, const N: usize>(rows: &[E; N], factors: &[f64; N]) -> E {
    let mut sum = rows[0].scaled(factors[0]);
    for k in 1..N {
        sum = sum.plus(rows[k].scaled(factors[k]));
    }
    sum
}

#[inline(always)]
fn dot<const N: usize>(a: &[f64; N], b: &[f64; N]) -> f64 {
    let mut sum = a[0] * b[0];
    for k in 1..N {
        sum += a[k] * b[k];
    }
    sum
}

#[inline(always)]
fn loaded<E: Eight, const N: usize>(rows: &[Block; N]) -> [E; N] {
    let mut numbers = [E::ZERO; N];
    for k in 0..N {
        numbers[k] = E::of(&rows[k]);
    }
    numbers
}

/// The inverse of a matrix by rows, if it has one.
#[inline(always)]
fn inverse<const N: usize>(mut matrix: Square<N>) -> Option<Square<N>> {
    let mut inverse = [[0.0; N]; N];
    if N == 3 {
        let [a, b, c] = [0, 1, 2].map(|i| Vec3([matrix[i][0], matrix[i][1], matrix[i][2]]));
        let columns = [b.cross(c), c.cross(a), a.cross(b)];
        let determinant = a.dot(columns[0]);
        let scale = 1.0 / determinant;
        for (i, row) in inverse.iter_mut().enumerate() {
            for (entry, column) in row.iter_mut().zip(columns) {
                *entry = column[i] * scale;
            }
        }
        return (determinant != 0.0 && determinant.is_finite()).then_some(inverse);
    }
    for (i, row) in inverse.iter_mut().enumerate() {
        row[i] = 1.0;
    }
    for k in 0..N {
        let larger = |best: usize, i: usize| {
            if matrix[i][k].abs() > matrix[best][k].abs() { i } else { best }
        };
        let largest = (k..N).fold(k, larger);
        matrix.swap(k, largest);
        inverse.swap(k, largest);
        let pivot = matrix[k][k];
        if pivot == 0.0 || !pivot.is_finite() {
            return None;
        }
        let scale = 1.0 / pivot;
        matrix[k].iter_mut().chain(&mut inverse[k]).for_each(|entry| *entry *= scale);
        let (own, of_inverse) = (matrix[k], inverse[k]);
        for i in (0..N).filter(|i| *i != k) {
            let factor = matrix[i][k];
            for j in 0..N {
                matrix[i][j] -= factor * own[j];
                inverse[i][j] -= factor * of_inverse[j];
            }
        }
    }
    Some(inverse)
}

impl<const N: usize> Factors<N> {
    fn new(plan: &HeldLimb) -> Self {
        let rows = [Block::ZERO; N];
        let border = Border { start: rows, end: rows, upper: rows, lower: rows };
        Self {
            inverses: [[[0.0; N]; N]; 2],
            own: [[0.0; N]; N],
            border: vec![border; plan.border.len().div_ceil(LANES)],
        }
    }

    /// Finds `A_l⁻¹` at one of the ends; returns one over its largest entry, in units of the steepest equations.
    #[inline(always)]
    fn invert(&mut self, model: &Model, plan: &HeldLimb, closure: &Closure, end: usize) -> f64 {
        let n = model.dimensions.coordinates();
        let mut own = [[0.0; N]; N];
        for (k, row) in own.iter_mut().enumerate() {
            row[k] = 1.0;
        }
        for (row, c) in own.iter_mut().zip(plan.equations.clone()) {
            let entries = &closure.jacobian[c * n..][..n];
            let entries: [f64; N] = taken(&entries[plan.coordinates.clone()]);
            for (k, entry) in row.iter_mut().enumerate().take(plan.equations.len()) {
                *entry = entries[k];
            }
        }
        let Some(inverse) = inverse(own) else { return 0.0 };
        let mut largest = 1.0_f64;
        for (row, i) in inverse.iter().zip(plan.coordinates.clone()) {
            let (inertia, weights) =
                (model.conditioning.inertia[i], &model.conditioning.weight[plan.equations.clone()]);
            for (entry, weight) in row.iter().zip(weights) {
                let size = entry * entry * inertia / (weight * weight);
                largest = if size <= largest { largest } else { size };
            }
        }
        self.inverses[end] = inverse;
        1.0 / largest.sqrt()
    }

    /// Takes its part of `K` and of the Jacobians.
    #[inline(always)]
    fn take<E: Eight>(
        &mut self,
        model: &Model,
        plan: &HeldLimb,
        matrix: &TreeLu,
        [start, end]: [&Closure; 2],
    ) {
        let (n, count) = (model.dimensions.coordinates(), plan.above);
        let start_of = |i: usize| model.elimination.start(i);
        for (a, i) in plan.coordinates.clone().enumerate() {
            for b in 0..=a {
                self.own[a][b] = matrix.lower[start_of(i) + count + b];
                self.own[b][a] = matrix.upper[start_of(i) + count + b];
            }
        }
        for (border, (place, rows)) in
            plan.border.chunks(LANES).zip((0..).step_by(LANES).zip(&mut self.border))
        {
            let [mut by_start, mut by_end] = [[Block::ZERO; N]; 2];
            for (k, c) in plan.equations.clone().enumerate() {
                let entries = [start, end].map(|closure| &closure.jacobian[c * n..][..n]);
                for (lane, &i) in border.iter().enumerate() {
                    by_start[k].0[lane] = entries[0][i];
                    by_end[k].0[lane] = entries[1][i];
                }
            }
            for (k, i) in plan.coordinates.clone().enumerate() {
                // Of what moves the place where it is held alone, there is nothing.
                let slots = place.min(count)..count.min(place + LANES);
                let slots = start_of(i) + slots.start..start_of(i) + slots.end;
                rows.upper[k].0 = taken(&matrix.upper[slots.clone()]);
                rows.lower[k].0 = taken(&matrix.lower[slots]);
            }
            let (by_start, by_end) = (loaded::<E, N>(&by_start), loaded::<E, N>(&by_end));
            let mut goes = [E::ZERO; N];
            for (k, goes) in goes.iter_mut().enumerate() {
                sum_of(&by_start, &self.inverses[0][k]).put(&mut rows.start[k]);
                *goes = sum_of(&by_end, &self.inverses[1][k]);
                goes.put(&mut rows.end[k]);
            }
            for k in 0..N {
                let rest = E::of(&rows.lower[k]).minus(sum_of(&goes, &self.own[k]));
                rest.put(&mut rows.lower[k]);
            }
        }
    }

    /// Adds `−K_bl G1 − G0ᵀ E`.
    #[inline(always)]
    fn change<E: Eight>(&self, plan: &HeldLimb, sums: &mut [Block]) {
        let width = self.border.len();
        for (column, rows) in self.border.iter().enumerate() {
            let (end, lower) = (loaded::<E, N>(&rows.end), loaded::<E, N>(&rows.lower));
            for d in 0..plan.border.len() {
                let (from, lane) = (&self.border[d / LANES], d % LANES);
                let sum = &mut sums[d * width + column];
                let [mut by_end, mut by_lower] = [E::of(sum), E::ZERO];
                for k in 0..N {
                    by_end = by_end.minus(end[k].scaled(from.upper[k].0[lane]));
                    by_lower = by_lower.plus(lower[k].scaled(from.start[k].0[lane]));
                }
                by_end.minus(by_lower).put(sum);
            }
        }
    }

    /// `c` and `s` in place of right-hand sides, and what they give to those of the border.
    #[inline(always)]
    fn lift<E: Eight>(&self, own: &mut [f64], lambda: &mut [f64], flow: &mut [Block]) {
        let (right, mut s, mut c) = (taken(lambda), taken(own), [0.0; N]);
        for (c, inverse) in c.iter_mut().zip(&self.inverses[1]) {
            *c = dot(inverse, &right);
        }
        for (s, own) in s.iter_mut().zip(&self.own) {
            *s -= dot(own, &c);
        }
        for (rows, flow) in self.border.iter().zip(flow) {
            let upper = sum_of(&loaded::<E, N>(&rows.upper), &c);
            let start = sum_of(&loaded::<E, N>(&rows.start), &s);
            E::of(flow).plus(upper.plus(start)).put(flow);
        }
        put(c, lambda);
        put(s, own);
    }

    /// The solution, from `c`, `s` and that of the border.
    #[inline(always)]
    fn lower<E: Eight>(&self, own: &mut [f64], lambda: &mut [f64], border: &[Block]) {
        let (mut y, mut pushed) = (taken::<N>(lambda), taken::<N>(own));
        for (rows, border) in self.border.iter().zip(border) {
            let border = E::of(border);
            for k in 0..N {
                y[k] -= E::of(&rows.end[k]).dot(border);
                pushed[k] -= E::of(&rows.lower[k]).dot(border);
            }
        }
        put(y, own);
        let mut multipliers = [0.0; N];
        for (pushed, inverse) in pushed.iter().zip(&self.inverses[0]) {
            for (sum, entry) in multipliers.iter_mut().zip(inverse) {
                *sum += pushed * entry;
            }
        }
        put(multipliers, lambda);
    }

    /// [`Self::lift`] for eight right-hand sides; `x` has rows of all coordinates.
    #[inline(always)]
    fn lift_rows<E: Eight>(
        &self,
        plan: &HeldLimb,
        x: &mut [f64],
        lambda: &mut [f64],
        stride: usize,
    ) {
        let [mut c, mut s, mut right] = [[E::ZERO; N]; 3];
        for (k, i) in plan.coordinates.clone().enumerate() {
            right[k] = E::of_list(&lambda[k * stride..][..LANES]);
            s[k] = E::of_list(&x[i * stride..][..LANES]);
        }
        for (c, inverse) in c.iter_mut().zip(&self.inverses[1]) {
            *c = sum_of(&right, inverse);
        }
        for (s, own) in s.iter_mut().zip(&self.own) {
            *s = s.minus(sum_of(&c, own));
        }
        for (&i, d) in plan.border.iter().zip(0..) {
            let (rows, lane) = (&self.border[d / LANES], d % LANES);
            let target = &mut x[i * stride..][..LANES];
            let [mut upper, mut start] = [E::of_list(target), E::ZERO];
            for k in 0..N {
                upper = upper.minus(c[k].scaled(rows.upper[k].0[lane]));
                start = start.plus(s[k].scaled(rows.start[k].0[lane]));
            }
            upper.minus(start).put_list(target);
        }
        for (k, i) in plan.coordinates.clone().enumerate() {
            c[k].put_list(&mut lambda[k * stride..][..LANES]);
            s[k].put_list(&mut x[i * stride..][..LANES]);
        }
    }

    /// [`Self::lower`] for eight right-hand sides.
    #[inline(always)]
    fn lower_rows<E: Eight>(
        &self,
        plan: &HeldLimb,
        x: &mut [f64],
        lambda: &mut [f64],
        stride: usize,
    ) {
        let [mut y, mut pushed] = [[E::ZERO; N]; 2];
        for (k, i) in plan.coordinates.clone().enumerate() {
            y[k] = E::of_list(&lambda[k * stride..][..LANES]);
            pushed[k] = E::of_list(&x[i * stride..][..LANES]);
        }
        for (&i, d) in plan.border.iter().zip(0..) {
            let (rows, lane) = (&self.border[d / LANES], d % LANES);
            let at = E::of_list(&x[i * stride..][..LANES]);
            for k in 0..N {
                y[k] = y[k].minus(at.scaled(rows.end[k].0[lane]));
                pushed[k] = pushed[k].minus(at.scaled(rows.lower[k].0[lane]));
            }
        }
        for (k, i) in plan.coordinates.clone().enumerate() {
            y[k].put_list(&mut x[i * stride..][..LANES]);
            let mut sum = E::ZERO;
            for (pushed, inverse) in pushed.iter().zip(&self.inverses[0]) {
                sum = sum.plus(pushed.scaled(inverse[k]));
            }
            sum.put_list(&mut lambda[k * stride..][..LANES]);
        }
    }
}

/// What [`HeldLimbs::factor`] does with limbs; returns the smallest pivot of the equations.
struct Eliminate<'a> {
    limbs: &'a mut HeldLimbs,
    model: &'a Model,
    held: &'a Held,
    matrix: &'a TreeLu,
    closures: [&'a Closure; 2],
}

impl InEights for Eliminate<'_> {
    type Output = f64;

    #[inline(always)]
    fn run<E: Eight>(self) -> f64 {
        let Self { limbs, model, held, matrix, closures } = self;
        limbs.sums.fill(Block::ZERO);
        let mut equations = 1.0_f64;
        for at in 0..held.limbs.len() {
            let (plan, sums) = (&held.limbs[at], &mut limbs.sums);
            of_limb!(&mut limbs.limbs[at], limb => {
                for (end, closure) in closures.into_iter().enumerate() {
                    equations = equations.min(limb.invert(model, plan, closure, end));
                }
                if equations < SOUND {
                    return equations;
                }
                limb.take::<E>(model, plan, matrix, closures);
                limb.change::<E>(plan, sums);
            });
            if plan.is_last {
                limbs.put_sums(plan);
            }
        }
        equations
    }
}

/// The first half of a solution.
struct Lift<'a> {
    limbs: &'a mut HeldLimbs,
    held: &'a Held,
    x: &'a mut [f64],
    lambda: &'a mut [f64],
}

impl InEights for Lift<'_> {
    type Output = ();

    #[inline(always)]
    fn run<E: Eight>(self) {
        let Self { limbs: HeldLimbs { limbs, sums, .. }, held, x, lambda } = self;
        for (plan, limb) in held.limbs.iter().zip(&*limbs) {
            let flow = &mut sums[..plan.border.len().div_ceil(LANES)];
            let (own, lambda) =
                (&mut x[plan.coordinates.clone()], &mut lambda[plan.equations.clone()]);
            if plan.is_first {
                flow.fill(Block::ZERO);
            }
            of_limb!(limb, limb => limb.lift::<E>(own, lambda, flow));
            if plan.is_last {
                for (border, flow) in plan.border.chunks(LANES).zip(&*flow) {
                    border.iter().zip(flow.0).for_each(|(&i, flow)| x[i] -= flow);
                }
            }
        }
    }
}

/// The second half.
struct Lower<'a> {
    limbs: &'a mut HeldLimbs,
    held: &'a Held,
    x: &'a mut [f64],
    lambda: &'a mut [f64],
}

impl InEights for Lower<'_> {
    type Output = ();

    #[inline(always)]
    fn run<E: Eight>(self) {
        let Self { limbs: HeldLimbs { limbs, sums, .. }, held, x, lambda } = self;
        for (plan, limb) in held.limbs.iter().zip(&*limbs) {
            let flow = &mut sums[..plan.border.len().div_ceil(LANES)];
            if plan.is_first {
                for (border, flow) in plan.border.chunks(LANES).zip(&mut *flow) {
                    *flow = Block::ZERO;
                    flow.0.iter_mut().zip(border).for_each(|(flow, &i)| *flow = x[i]);
                }
            }
            let (own, lambda) =
                (&mut x[plan.coordinates.clone()], &mut lambda[plan.equations.clone()]);
            of_limb!(limb, limb => limb.lower::<E>(own, lambda, flow));
        }
    }
}

/// One half of solutions side by side: `UP` to the borders, or down from their solution.
struct PassRows<'a, const UP: bool> {
    limbs: &'a HeldLimbs,
    held: &'a Held,
    x: &'a mut [f64],
    lambda: &'a mut [f64],
    stride: usize,
    columns: usize,
}

impl<const UP: bool> InEights for PassRows<'_, UP> {
    type Output = ();

    #[inline(always)]
    fn run<E: Eight>(self) {
        let Self { limbs, held, x, lambda, stride, columns } = self;
        for (plan, limb) in held.limbs.iter().zip(&limbs.limbs) {
            let lambda = &mut lambda[plan.equations.start * stride..];
            for column in (0..columns).step_by(LANES) {
                let (x, lambda) = (&mut x[column..], &mut lambda[column..]);
                of_limb!(limb, limb => if UP {
                    limb.lift_rows::<E>(plan, x, lambda, stride);
                } else {
                    limb.lower_rows::<E>(plan, x, lambda, stride);
                });
            }
        }
    }
}
