//! The Newton matrix of a tree in space as products of vectors, and its elimination in O(n).
//!
//! For joint `i` on the path from `j` to the root (or `i = j`), all about the origin of the tree,
//!
//! ```text
//! K_ij = minus_i · upper_j      K_ji = plus_i · lower_j
//! ```
//!
//! with the vectors of [`generators`](crate::lagrangian::generators). Eliminating a leaf changes the matrix of
//! the others by a product of the same form: what is eliminated below a joint is summed in an 8 by 8 matrix
//! `A`. Up to three axes that are one below the other, such as those of a ball joint, are eliminated at once:
//!
//! ```text
//! D_ab = K_ab + minus_aᵀ A plus_b      U_b = upper_b + A plus_b      W_a = lower_a + Aᵀ minus_a
//! A_parent += A − U D⁻¹ Wᵀ
//! ```
//!
//! as in [`planar`](crate::kkt::planar), from the leaves to the root; the pivots are those of an elimination axis
//! by axis. A joint whose motion is prescribed is passed by: `A` goes on to its parent as it is. Where what acts on
//! bodies ends, at a body that it acts from, `A` goes on with the first block of its rows and columns alone, and so do
//! the flows of right-hand sides. Each step up the tree waits for the one before, so it counts how many there are. As
//! all sums are about one origin, the solution loses digits in long chains (up to 1e-11 of it in one of 64 hinges),
//! which the next correction makes good.

pub(crate) mod columns;
pub(crate) mod derivatives;
mod lines;
pub(crate) mod margins;
mod products;
#[cfg(test)]
mod tests;
mod vectors;

use std::hint::black_box;
use std::ops::Range;

use plantd_math::eights::{Eight, InEights, in_eights};
use plantd_math::tree_lu::SmallestPivot;
use plantd_math::unrolled;

use crate::kkt::space::lines::{InLine, Line, Lines, combined};
use crate::kkt::space::vectors::Vectors;
use crate::lagrangian::curvature::Curvature;
use crate::lagrangian::fields::Fields;
use crate::lagrangian::generators::{Generators, MatrixKind, Step};
use crate::lagrangian::turning::Weights;
use crate::model::mechanism::{Acting, Blocks, Model};
use crate::model::tree::{JointKind, Tree};

/// Axes that are eliminated at once, at most.
const WIDEST: usize = 3;

/// A matrix of the axes of a group, by rows.
type Square = [[f64; WIDEST]; WIDEST];

/// What is added to the second derivatives of the Lagrangian.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Added<'a> {
    /// On the diagonal, but for ball joints.
    pub(crate) diagonal: &'a [f64],
    pub(crate) balls: &'a [Weights],
    /// By what acts on bodies from the world, or from bodies above.
    pub(crate) fields: Option<&'a Fields>,
}

/// Axes one below the other that are eliminated at once.
#[derive(Clone, Debug)]
struct Group {
    axes: Range<usize>,
    kind: GroupKind,
    /// The coordinates of the axes.
    rows: Range<usize>,
    /// Where dynamic and prescribed coordinates of the axes, and of all that is below them, are.
    reach: [Range<usize>; 2],
    /// Whether what acts on bodies, which vectors have more blocks for, ends above the axes.
    is_end: bool,
}

/// What axes are eliminated together.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum GroupKind {
    /// Hinges, slides and screws.
    Single,
    /// Those of a ball joint, with its orientation.
    Ball(usize),
    /// Those of a joint whose motion is prescribed, of a ball joint with its orientation: they are not eliminated, and
    /// what is below them passes on to their parent as it is.
    Prescribed(Option<usize>),
}

/// Groups one below the other, with nothing beside them.
#[derive(Clone, Debug)]
struct Limb {
    /// The lowest first.
    groups: Range<usize>,
    /// Where the sums of the limbs are that hang from its lowest joint.
    carries: Option<usize>,
    hangs_from: Option<Fork>,
    /// Whether something acts across its joints. Where nothing does, all blocks of its vectors but the first would be
    /// zero: nobody writes or reads them.
    is_acted_on: bool,
}

/// Where limbs meet.
#[derive(Clone, Copy, Debug)]
struct Fork {
    place: usize,
    /// It is the first of the limbs to be eliminated.
    is_first: bool,
}

/// The Newton matrix of a tree in space, factored. Vectors have `B` blocks ([`Model::blocks`]).
#[derive(Clone, Debug)]
pub(crate) struct SpatialRecursion<const B: usize> {
    /// How many coordinates there are: as many as joints, or more.
    coordinates: usize,
    /// In the order of their elimination, as are groups.
    limbs: Vec<Limb>,
    groups: Vec<Group>,
    /// Of axes that have been eliminated, `U` and `D⁻¹ W` stand in the place of `upper` and `lower`.
    axes: Vec<Generators<Line<B>>>,
    /// `K` of each group by itself; once it is eliminated, `D⁻¹`.
    within: Vec<Square>,
    /// `A` where limbs meet. As trees are walked depth first, there are few, which stay in the nearest cache.
    sums: Vec<Kept<B>>,
    /// Flows of right-hand sides, and twists that belong to solutions.
    flows: Vec<Line<B>>,
}

/// `A` in memory, by rows.
type Kept<const B: usize> = [[Line<B>; 8]; B];

/// The recursion that a model needs.
#[derive(Clone, Debug)]
pub(crate) enum Spatial {
    One(SpatialRecursion<1>),
    Two(SpatialRecursion<2>),
    Three(SpatialRecursion<3>),
}

impl Spatial {
    pub(crate) fn new(model: &Model) -> Self {
        match model.blocks() {
            Blocks::One => Self::One(SpatialRecursion::new(model)),
            Blocks::Two => Self::Two(SpatialRecursion::new(model)),
            Blocks::Three => Self::Three(SpatialRecursion::new(model)),
        }
    }

    /// [`SpatialRecursion::factor`], with a step of this length.
    pub(crate) fn factor(
        &mut self,
        model: &Model,
        (curvature, added): (&Curvature, Added<'_>),
        time_step_s: f64,
        kind: MatrixKind,
    ) -> SmallestPivot {
        let vectors = Vectors { curvature, added, step: Step::new(time_step_s, kind) };
        match self {
            Self::One(recursion) => recursion.factor(model, vectors),
            Self::Two(recursion) => recursion.factor(model, vectors),
            Self::Three(recursion) => recursion.factor(model, vectors),
        }
    }

    /// Solves `K x = b` in place.
    pub(crate) fn solve(&mut self, x: &mut [f64]) {
        match self {
            Self::One(recursion) => recursion.solve(x),
            Self::Two(recursion) => recursion.solve(x),
            Self::Three(recursion) => recursion.solve(x),
        }
    }
}

/// `A` in registers, by rows.
#[derive(Clone, Copy)]
struct Sums<E, const B: usize> {
    rows: Lines<E, B>,
}

/// The same by rows and by columns. These are the rows turned, once for a group: to keep both is more work.
#[derive(Clone, Copy)]
struct Both<'a, E, const B: usize> {
    rows: &'a Lines<E, B>,
    columns: &'a Lines<E, B>,
}

impl<E: Eight, const B: usize> Sums<E, B> {
    #[inline(always)]
    fn zero() -> Self {
        Self { rows: const { [[InLine::ZERO; 8]; B] } }
    }

    /// The first blocks of what has more.
    #[inline(always)]
    fn of<const L: usize>(rows: &Kept<L>) -> Self {
        let mut sums = Self::zero();
        unrolled!(3, b < B, {
            unrolled!(8, k < 8, { sums.rows[b][k] = InLine::of(&rows[b][k]) });
        });
        sums
    }

    #[inline(always)]
    fn columns(&self) -> Lines<E, B> {
        let mut columns = const { [[InLine::ZERO; 8]; B] };
        unrolled!(3, b < B, {
            unrolled!(3, c < B, {
                let mut block = const { [E::ZERO; 8] };
                unrolled!(8, k < 8, { block[k] = self.rows[c][k].0[b] });
                let turned = E::transposed(block);
                unrolled!(8, k < 8, { columns[b][k].0[c] = turned[k] });
            });
        });
        columns
    }

    #[inline(always)]
    fn plus(mut self, o: &Self) -> Self {
        unrolled!(3, b < B, {
            unrolled!(8, k < 8, { self.rows[b][k] = self.rows[b][k].plus(o.rows[b][k]) });
        });
        self
    }

    /// Leaves the first block alone.
    #[inline(always)]
    fn end(&mut self) {
        unrolled!(3, b < B, {
            unrolled!(8, k < 8, {
                let line = &mut self.rows[b][k];
                *line = if b == 0 { line.ended() } else { InLine::ZERO };
            });
        });
    }

    /// To the first blocks of what has more.
    #[inline(always)]
    fn put<const L: usize>(&self, rows: &mut Kept<L>) {
        unrolled!(3, b < B, {
            unrolled!(8, k < 8, { self.rows[b][k].put(&mut rows[b][k]) });
        });
    }
}

/// The inverse of a matrix by rows, and the pivots of its elimination from the last row to the first.
#[inline(always)]
fn inverse<const W: usize>(d: &[[f64; W]; W]) -> ([[f64; W]; W], [f64; W]) {
    let (mut inverse, mut pivots) = const { ([[0.0; W]; W], [0.0; W]) };
    match W {
        1 => {
            pivots[0] = d[0][0];
            inverse[0][0] = 1.0 / d[0][0];
        }
        2 => {
            let determinant = d[0][0] * d[1][1] - d[0][1] * d[1][0];
            let scale = 1.0 / determinant;
            inverse[0][0] = d[1][1] * scale;
            inverse[0][1] = -d[0][1] * scale;
            inverse[1][0] = -d[1][0] * scale;
            inverse[1][1] = d[0][0] * scale;
            pivots[0] = determinant / d[1][1];
            pivots[1] = d[1][1];
        }
        _ => {
            // The minor of entry `(a, b)`, with its sign.
            let minor = |a: usize, b: usize| {
                let [i, j] = [(a + 1) % 3, (a + 2) % 3];
                let [k, l] = [(b + 1) % 3, (b + 2) % 3];
                d[i][k] * d[j][l] - d[i][l] * d[j][k]
            };
            let first = minor(0, 0);
            let determinant = d[0][0] * first + d[0][1] * minor(0, 1) + d[0][2] * minor(0, 2);
            let scale = 1.0 / determinant;
            unrolled!(3, a < W, {
                unrolled!(3, b < W, { inverse[a][b] = minor(b, a) * scale });
            });
            pivots[0] = determinant / first;
            pivots[1] = first / d[2][2];
            pivots[2] = d[2][2];
        }
    }
    (inverse, pivots)
}

/// Limbs and groups in the order of their elimination, and how many places of sums there are.
fn limbs(tree: &Tree, nd: usize, acting: &[Acting]) -> (Vec<Limb>, Vec<Group>, usize) {
    let joints = &tree.joints[..];
    let mut children = vec![0; joints.len()];
    // Behind the last axis below each.
    let mut ends: Vec<usize> = (1..=joints.len()).collect();
    for (i, joint) in joints.iter().enumerate().rev() {
        let end = ends[i];
        if let Some(parent) = ends.get_mut(joint.parent) {
            *parent = end.max(*parent);
        }
    }
    // Forks on the way to each joint, which are the places of its own one: what is below a joint is done
    // with before the next one needs the place. Where elements begin to act, limbs meet, too.
    let is_acted_on = |i: usize| acting.get(i).is_some_and(|acting| acting.is_any());
    let (mut forks, mut is_fork) = (vec![0; joints.len()], vec![false; joints.len()]);
    for (i, joint) in joints.iter().enumerate() {
        if let Some(count) = children.get_mut(joint.parent) {
            *count += 1;
            is_fork[joint.parent] |= *count > 1 || is_acted_on(i) != is_acted_on(joint.parent);
        }
    }
    for (i, joint) in joints.iter().enumerate() {
        if let Some(is_fork) = is_fork.get(joint.parent) {
            forks[i] = forks[joint.parent] + usize::from(*is_fork);
        }
    }
    let (mut limbs, mut groups, mut seen) = (Vec::new(), Vec::new(), vec![false; joints.len()]);
    let mut end = joints.len();
    while end > 0 {
        let lowest = end - 1;
        let mut top = lowest;
        while joints[top].follows(top) && !is_fork[top - 1] {
            top -= 1;
        }
        let parent = joints[top].parent;
        let begin = groups.len();
        gather(tree, top..end, (nd, acting), &mut groups);
        for group in &mut groups[begin..] {
            for joint in &joints[group.axes.start..ends[lowest]] {
                let i = joint.coordinate;
                let reach = &mut group.reach[usize::from(i >= nd)];
                *reach = match reach.end {
                    0 => i..i + 1,
                    end => reach.start.min(i)..end.max(i + 1),
                };
            }
        }
        limbs.push(Limb {
            groups: begin..groups.len(),
            carries: is_fork[lowest].then_some(forks[lowest]),
            hangs_from: seen.get_mut(parent).map(|seen| Fork {
                place: forks[parent],
                is_first: !std::mem::replace(seen, true),
            }),
            is_acted_on: is_acted_on(lowest),
        });
        end = top;
    }
    (limbs, groups, forks.iter().max().map_or(0, |most| most + 1))
}

/// Groups of axes one below the other, the lowest first; as few as can be, and of like sizes.
fn gather(
    tree: &Tree,
    axes: Range<usize>,
    (nd, acting): (usize, &[Acting]),
    groups: &mut Vec<Group>,
) {
    let ends = |i: usize| acting.get(i) == Some(&Acting::Ends);
    let kind = |i: usize| {
        let joint = &tree.joints[i];
        let ball = matches!(joint.kind, JointKind::Ball(_)).then_some(joint.orientation);
        match ball {
            ball if joint.coordinate >= nd => GroupKind::Prescribed(ball),
            Some(ball) => GroupKind::Ball(ball),
            None => GroupKind::Single,
        }
    };
    let mut push = |axes: Range<usize>, kind| {
        let first = tree.joints[axes.start].coordinate;
        let rows = first..first + axes.len();
        let is_end = ends(axes.start);
        groups.push(Group { axes, kind, rows, reach: [0..0, 0..0], is_end });
    };
    let mut end = axes.end;
    while end > axes.start {
        let own = kind(end - 1);
        let start = match own {
            GroupKind::Ball(_) | GroupKind::Prescribed(Some(_)) => end - 3,
            GroupKind::Prescribed(None) => end - 1,
            GroupKind::Single => {
                let mut starts = (axes.start..end).rev();
                let top = |i: &usize| *i == axes.start || ends(*i) || kind(*i - 1) != own;
                starts.find(top).unwrap_or(axes.start)
            }
        };
        for left in (1..=(end - start).div_ceil(WIDEST)).rev() {
            let width = (end - start).div_ceil(left);
            push(end - width..end, own);
            end -= width;
        }
    }
}

impl<const B: usize> SpatialRecursion<B> {
    pub(crate) fn new(model: &Model) -> Self {
        let joints = model.dynamics.joints.len();
        let acting = model.acting.as_deref().unwrap_or_default();
        let (limbs, groups, places) = limbs(&model.dynamics, model.dimensions.dynamic, acting);
        Self {
            within: vec![[[0.0; WIDEST]; WIDEST]; groups.len()],
            coordinates: model.dimensions.coordinates(),
            limbs,
            groups,
            axes: vec![Generators::default(); joints],
            sums: vec![[[Line::ZERO; 8]; B]; places],
            flows: vec![Line::ZERO; places],
        }
    }

    /// Factors the matrix that belongs to the last second derivatives; dynamic joints are in the order of their
    /// coordinates. Each pivot is compared with the larger of its diagonal entry
    /// and the inertia of its row over the step. Of masses alone it is `−M/h`. About 600 flops an axis, or 2000 with
    /// two blocks and 4400 with three.
    #[inline(never)]
    fn factor(&mut self, model: &Model, vectors: Vectors<'_>) -> SmallestPivot {
        let inertia = &model.conditioning.inertia[..];
        in_eights(Factor { recursion: self, vectors, inertia })
    }

    /// Solves `K x = b` in place, about 65 flops an axis for each block.
    #[inline(never)]
    fn solve(&mut self, x: &mut [f64]) {
        in_eights(Solve { recursion: self, x });
    }
}

/// An elimination.
struct Factor<'a, const B: usize> {
    recursion: &'a mut SpatialRecursion<B>,
    vectors: Vectors<'a>,
    inertia: &'a [f64],
}

impl<const B: usize> InEights for Factor<'_, B> {
    type Output = SmallestPivot;

    #[inline(always)]
    fn run<E: Eight>(self) -> SmallestPivot {
        self.watched::<E>(&mut ())
    }
}

impl<const B: usize> Factor<'_, B> {
    #[inline(always)]
    fn watched<E: Eight>(self, watch: &mut impl Watch<E, B>) -> SmallestPivot {
        let Self { recursion, vectors, inertia } = self;
        recursion.generate::<E>(&vectors);
        let inverse = vectors.step.inverse.abs();
        recursion.eliminate::<E>(|axis| inertia[axis] * inverse, watch)
    }
}

/// Looks at groups before they are eliminated.
trait Watch<E, const B: usize> {
    /// At the generators of a group, of which `U` blocks are used, and at `A` where it is not zero.
    fn see<const U: usize>(
        &mut self,
        at: usize,
        group: &Group,
        axes: &[Generators<Line<B>>],
        sums: Option<Both<'_, E, U>>,
    );
}

/// Nobody looks.
impl<E, const B: usize> Watch<E, B> for () {
    #[inline(always)]
    fn see<const U: usize>(
        &mut self,
        _: usize,
        _: &Group,
        _: &[Generators<Line<B>>],
        _: Option<Both<'_, E, U>>,
    ) {
    }
}

impl<E: Eight, const B: usize> Generators<InLine<E, B>> {
    /// To memory.
    #[inline(always)]
    fn put_lines<const L: usize>(self, to: &mut Generators<Line<L>>) {
        self.minus.put(&mut to.minus);
        self.plus.put(&mut to.plus);
        self.upper.put(&mut to.upper);
        self.lower.put(&mut to.lower);
    }
}

impl<const B: usize> SpatialRecursion<B> {
    /// Writes the vectors of all axes, and `K` of each group.
    #[inline(always)]
    fn generate<E: Eight>(&mut self, vectors: &Vectors<'_>) {
        for limb in 0..self.limbs.len() {
            if B > 1 && self.limbs[limb].is_acted_on {
                self.generate_limb::<E, B>(limb, vectors);
            } else {
                self.generate_limb::<E, 1>(limb, vectors);
            }
        }
    }

    /// The same of a limb whose vectors have `U` blocks of use.
    #[inline(always)]
    fn generate_limb<E: Eight, const U: usize>(&mut self, limb: usize, vectors: &Vectors<'_>) {
        let (added, range) = (&vectors.added, self.limbs[limb].groups.clone());
        for (group, within) in self.groups[range.clone()].iter().zip(&mut self.within[range]) {
            let (range, first) = (group.axes.clone(), group.axes.start);
            let axes = &mut self.axes[range.clone()];
            match group.kind {
                GroupKind::Single => {}
                GroupKind::Ball(ball) => {
                    let (generators, own) = vectors.ball::<E, U>(first, &added.balls[ball]);
                    for (axis, own) in axes.iter_mut().zip(generators) {
                        own.put_lines(axis);
                    }
                    *within = own;
                    continue;
                }
                GroupKind::Prescribed(_) => continue,
            }
            for (i, axis) in range.zip(&mut *axes) {
                vectors.single::<E, U>(i).put_lines(axis);
            }
            let diagonal = &added.diagonal[group.rows.clone()];
            match *axes {
                [ref a] => write_within::<E, B, U, 1>([a], diagonal, within),
                [ref a, ref b] => write_within::<E, B, U, 2>([a, b], diagonal, within),
                [ref a, ref b, ref c] => write_within::<E, B, U, 3>([a, b, c], diagonal, within),
                _ => {}
            }
        }
    }

    /// From the leaves to the root.
    #[inline(always)]
    fn eliminate<E: Eight>(
        &mut self,
        inertia: impl Fn(usize) -> f64,
        watch: &mut impl Watch<E, B>,
    ) -> SmallestPivot {
        let mut smallest = SmallestPivot::NONE;
        for limb in 0..self.limbs.len() {
            if B > 1 && self.limbs[limb].is_acted_on {
                self.eliminate_limb::<E, B>(limb, &inertia, watch, &mut smallest);
            } else {
                self.eliminate_limb::<E, 1>(limb, &inertia, watch, &mut smallest);
            }
        }
        smallest
    }

    /// The same of a limb whose vectors have `U` blocks of use.
    #[inline(always)]
    fn eliminate_limb<E: Eight, const U: usize>(
        &mut self,
        limb: usize,
        inertia: &impl Fn(usize) -> f64,
        watch: &mut impl Watch<E, B>,
        smallest: &mut SmallestPivot,
    ) {
        let limb = &self.limbs[limb];
        let mut sums = match limb.carries {
            Some(place) => Sums::<E, U>::of(&self.sums[place]),
            None => Sums::zero(),
        };
        let mut carries = limb.carries.is_some();
        for at in limb.groups.clone() {
            let (group, within) = (&self.groups[at], &mut self.within[at]);
            let first = group.rows.start;
            let see = |axis: usize, pivot: f64, entry: f64| {
                smallest.see(first + axis, pivot, entry.abs().max(inertia(first + axis)));
            };
            let is_root = limb.hangs_from.is_none() && at + 1 == limb.groups.end;
            let axes = &self.axes[group.axes.clone()];
            let mut columns = None;
            let mut below = None;
            if carries {
                let columns = columns.insert(sums.columns());
                below = Some(Both { rows: &sums.rows, columns });
            }
            watch.see(at, group, axes, below);
            if !matches!(group.kind, GroupKind::Prescribed(_)) {
                let sums = (&mut sums, columns.as_ref());
                match &mut self.axes[group.axes.clone()] {
                    [a] => eliminate([a], within, sums, is_root, see),
                    [a, b] => eliminate([a, b], within, sums, is_root, see),
                    [a, b, c] => eliminate([a, b, c], within, sums, is_root, see),
                    _ => {}
                }
                carries = true;
            }
            if U > 1 && group.is_end {
                sums.end();
            }
        }
        if let Some(Fork { place, is_first }) = limb.hangs_from {
            let all = &mut self.sums[place];
            if !is_first {
                sums = sums.plus(&Sums::of(all));
            } else if U < B {
                *all = const { [[Line::ZERO; 8]; B] };
            }
            sums.put(all);
        }
    }
}

/// `K` of hinges, slides and screws one below the other.
#[inline(always)]
fn write_within<E: Eight, const B: usize, const U: usize, const W: usize>(
    axes: [&Generators<Line<B>>; W],
    diagonal: &[f64],
    within: &mut Square,
) {
    unrolled!(3, a < W, {
        let above = axes[a];
        let (minus, plus) = (InLine::<E, U>::of(&above.minus), InLine::<E, U>::of(&above.plus));
        within[a][a] = minus.dot(InLine::of(&above.upper)) + diagonal[a];
        unrolled!(3, b < W, {
            if b > a {
                within[a][b] = minus.dot(InLine::of(&axes[b].upper));
                within[b][a] = plus.dot(InLine::of(&axes[b].lower));
            }
        });
    });
}

/// Eliminates the axes of a group, with the columns of `A` where it is not zero; `see` takes an axis, its pivot, and
/// what stands in `K` in its place.
#[inline(always)]
fn eliminate<E: Eight, const B: usize, const U: usize, const W: usize>(
    axes: [&mut Generators<Line<B>>; W],
    within: &mut Square,
    (sums, columns): (&mut Sums<E, U>, Option<&Lines<E, U>>),
    is_root: bool,
    mut see: impl FnMut(usize, f64, f64),
) {
    let mut d = const { [[0.0; W]; W] };
    let [mut u, mut w] = const { [[InLine::<E, U>::ZERO; W]; 2] };
    unrolled!(3, a < W, {
        unrolled!(3, b < W, { d[a][b] = within[a][b] });
        u[a] = InLine::of(&axes[a].upper);
        w[a] = InLine::of(&axes[a].lower);
    });
    if let Some(columns) = columns {
        unrolled!(3, b < W, {
            let product = combined(columns, &axes[b].plus);
            u[b] = u[b].plus(product);
            w[b] = w[b].plus(combined(&sums.rows, &axes[b].minus));
            unrolled!(3, a < W, { d[a][b] += InLine::of(&axes[a].minus).dot(product) });
        });
    }
    let (inverse, pivots) = inverse(&d);
    unrolled!(3, after < W, {
        let a = W - 1 - after;
        see(a, pivots[a], within[a][a]);
    });
    let mut w_over_d = const { [InLine::<E, U>::ZERO; W] };
    unrolled!(3, a < W, {
        w_over_d[a] = w[0].scaled(inverse[a][0]);
        unrolled!(3, b < W, {
            if b > 0 {
                w_over_d[a] = w_over_d[a].plus(w[b].scaled(inverse[a][b]));
            }
            within[a][b] = inverse[a][b];
        });
        u[a].put(&mut axes[a].upper);
        w_over_d[a].put(&mut axes[a].lower);
    });
    if is_root {
        return;
    }
    // Number by number from memory, where compilers would take the registers apart.
    let axes: &[&mut Generators<Line<B>>; W] = black_box(&axes);
    unrolled!(3, b < U, {
        unrolled!(8, k < 8, {
            let row = &mut sums.rows[b][k];
            unrolled!(3, a < W, {
                *row = row.minus(w_over_d[a].scaled(axes[a].upper.0[b].0[k]));
            });
        });
    });
}

/// A solution.
struct Solve<'a, const B: usize> {
    recursion: &'a mut SpatialRecursion<B>,
    x: &'a mut [f64],
}

impl<const B: usize> InEights for Solve<'_, B> {
    type Output = ();

    #[inline(always)]
    fn run<E: Eight>(self) {
        let Self { recursion, x } = self;
        let SpatialRecursion { limbs, groups, axes, within, flows, .. } = recursion;
        let tree = Limbs { limbs, groups };
        tree.ascend::<E, B>(flows, &mut Lift { axes, within, x: &mut *x });
        tree.descend::<E, B>(flows, &mut Lower { axes, x });
    }
}

/// Limbs and their groups.
#[derive(Clone, Copy)]
struct Limbs<'a> {
    limbs: &'a [Limb],
    groups: &'a [Group],
}

/// What a group of axes makes of the flow that comes to it, from below or from above.
trait Passage<E> {
    fn pass<const U: usize>(
        &mut self,
        at: usize,
        group: &Group,
        flow: InLine<E, U>,
    ) -> InLine<E, U>;
}

impl Limbs<'_> {
    /// From the leaves to the root; `flows` are those where limbs meet.
    #[inline(always)]
    fn ascend<E: Eight, const B: usize>(
        self,
        flows: &mut [Line<B>],
        through: &mut impl Passage<E>,
    ) {
        for limb in self.limbs {
            if B > 1 && limb.is_acted_on {
                self.ascend_limb::<E, B, B>(limb, flows, through);
            } else {
                self.ascend_limb::<E, B, 1>(limb, flows, through);
            }
        }
    }

    /// From the root to the leaves.
    #[inline(always)]
    fn descend<E: Eight, const B: usize>(
        self,
        flows: &mut [Line<B>],
        through: &mut impl Passage<E>,
    ) {
        for limb in self.limbs.iter().rev() {
            if B > 1 && limb.is_acted_on {
                self.descend_limb::<E, B, B>(limb, flows, through);
            } else {
                self.descend_limb::<E, B, 1>(limb, flows, through);
            }
        }
    }

    /// Up a limb whose vectors have `U` blocks of use.
    #[inline(always)]
    fn ascend_limb<E: Eight, const B: usize, const U: usize>(
        self,
        limb: &Limb,
        flows: &mut [Line<B>],
        through: &mut impl Passage<E>,
    ) {
        let mut flow = match limb.carries {
            Some(place) => InLine::<E, U>::of(&flows[place]),
            None => InLine::ZERO,
        };
        for at in limb.groups.clone() {
            let group = &self.groups[at];
            flow = through.pass(at, group, flow);
            if U > 1 && group.is_end {
                flow = flow.ended();
            }
        }
        if let Some(Fork { place, is_first }) = limb.hangs_from {
            let all = &mut flows[place];
            if is_first {
                flow.put_alone(all);
            } else {
                flow.plus(InLine::of(all)).put(all);
            }
        }
    }

    /// Down a limb.
    #[inline(always)]
    fn descend_limb<E: Eight, const B: usize, const U: usize>(
        self,
        limb: &Limb,
        flows: &mut [Line<B>],
        through: &mut impl Passage<E>,
    ) {
        let mut flow = match limb.hangs_from {
            Some(fork) => InLine::<E, U>::of(&flows[fork.place]),
            None => InLine::ZERO,
        };
        for at in limb.groups.clone().rev() {
            let group = &self.groups[at];
            if U > 1 && group.is_end {
                flow = flow.ended();
            }
            flow = through.pass(at, group, flow);
        }
        if let Some(place) = limb.carries {
            flow.put(&mut flows[place]);
        }
    }
}

/// Eliminates right-hand sides on the way up.
struct Lift<'a, const B: usize> {
    axes: &'a [Generators<Line<B>>],
    within: &'a [Square],
    x: &'a mut [f64],
}

impl<E: Eight, const B: usize> Passage<E> for Lift<'_, B> {
    #[inline(always)]
    fn pass<const U: usize>(
        &mut self,
        at: usize,
        group: &Group,
        flow: InLine<E, U>,
    ) -> InLine<E, U> {
        let Group { axes, rows, kind, .. } = group;
        if matches!(kind, GroupKind::Prescribed(_)) {
            return flow;
        }
        let inverse = &self.within[at];
        match (&self.axes[axes.clone()], &mut self.x[rows.clone()]) {
            ([a], [x]) => lift([a], [x], inverse, flow),
            ([a, b], [x, y]) => lift([a, b], [x, y], inverse, flow),
            ([a, b, c], [x, y, z]) => lift([a, b, c], [x, y, z], inverse, flow),
            _ => flow,
        }
    }
}

/// Puts in what is above, on the way down.
struct Lower<'a, const B: usize> {
    axes: &'a [Generators<Line<B>>],
    x: &'a mut [f64],
}

impl<E: Eight, const B: usize> Passage<E> for Lower<'_, B> {
    #[inline(always)]
    fn pass<const U: usize>(
        &mut self,
        _: usize,
        group: &Group,
        flow: InLine<E, U>,
    ) -> InLine<E, U> {
        let Group { axes, rows, kind, .. } = group;
        if matches!(kind, GroupKind::Prescribed(_)) {
            return flow;
        }
        match (&self.axes[axes.clone()], &mut self.x[rows.clone()]) {
            ([a], [x]) => lower([a], [x], flow),
            ([a, b], [x, y]) => lower([a, b], [x, y], flow),
            ([a, b, c], [x, y, z]) => lower([a, b, c], [x, y, z], flow),
            _ => flow,
        }
    }
}

/// Eliminates the right-hand sides of a group: the flow above it, from the one below.
#[inline(always)]
fn lift<E: Eight, const B: usize, const U: usize, const W: usize>(
    axes: [&Generators<Line<B>>; W],
    x: [&mut f64; W],
    inverse: &Square,
    flow: InLine<E, U>,
) -> InLine<E, U> {
    let mut b = const { [0.0; W] };
    unrolled!(3, a < W, { b[a] = *x[a] - InLine::of(&axes[a].minus).dot(flow) });
    let mut next = flow;
    unrolled!(3, a < W, {
        let mut value = inverse[a][0] * b[0];
        unrolled!(3, c < W, {
            if c > 0 {
                value += inverse[a][c] * b[c];
            }
        });
        *x[a] = value;
        next = next.plus(InLine::of(&axes[a].upper).scaled(value));
    });
    next
}

/// The solution of a group and the flow below it, from the one above.
#[inline(always)]
fn lower<E: Eight, const B: usize, const U: usize, const W: usize>(
    axes: [&Generators<Line<B>>; W],
    x: [&mut f64; W],
    flow: InLine<E, U>,
) -> InLine<E, U> {
    let mut next = flow;
    unrolled!(3, a < W, {
        *x[a] -= InLine::of(&axes[a].lower).dot(flow);
        next = next.plus(InLine::of(&axes[a].plus).scaled(*x[a]));
    });
    next
}
