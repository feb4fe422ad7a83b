//! The Newton matrix of a planar mechanism with loops, eliminated front by front: O(n) where loops hang
//! together like the rungs of a ladder.
//!
//! Bodies have twists `ξ` at the midpoint and `ω` at the end of the step, and take wrenches `φ` at the midpoint
//! and `ψ` at its start, all about their joints. In
//!
//! ```text
//! [ K   −A0ᵀ ] [x]   [b]
//! [ A1    0  ] [λ] = [c]
//! ```
//!
//! joint `j` adds `plus_j x_j` to `ξ` and `s_j x_j` to `ω` of what it carries; it feels `minus_j·φ + s_j·ψ`
//! ([`PlanarRecursion`](crate::kkt::planar::PlanarRecursion) is the same without loops). A closure measures `e·ω` of its two bodies and pushes them by
//! `ψ −= e λ`. What is eliminated is summed in a front, `[φ ψ 0] = A [ξ ω λ]`, with one row for each equation
//! that is still open; a pivot takes the product of a column and a row away from it.

mod column;

use plantd_math::eights::{Eight, InEights, in_eights};
use plantd_math::rows::{Block, LANES, padded};
use plantd_math::simd::widest;
use plantd_math::tree_lu::SmallestPivot;

use crate::constraints::in_plane::InPlane;
use crate::kkt::loops::column::Column;
use crate::kkt::planar::columns::Columns;
use crate::kkt::planar::{Diagonals, Method, dot3};
use crate::lagrangian::arrangement::Fours;
use crate::lagrangian::generators::MatrixKind;
use crate::lagrangian::planar::Joints;
use crate::lagrangian::plane::{Vec2, Vec3, cross};
use crate::model::loop_plan::{Above, BODY, Loops, Opened, Step};
use crate::model::planar_tree::PlanarJoint;

/// What a front stands for, and where it is.
#[derive(Clone, Copy, Debug)]
struct Shape {
    /// First entry, and first row among those of all fronts.
    entry: usize,
    row: usize,
    stride: usize,
}

/// A joint when it has been eliminated.
#[derive(Clone, Copy, Debug, Default)]
struct Pivot {
    minus: [f64; BODY],
    plus: [f64; BODY],
    inverse: f64,
    /// To the parent at the midpoint, the start and the end.
    edges: [Vec2; 3],
}

/// An equation when it has been eliminated.
#[derive(Clone, Copy, Debug, Default)]
struct Closed {
    equation: usize,
    row: usize,
    weight: f64,
    /// Its diagonal entry before the first equation that was eliminated with it.
    whole: f64,
    inverse: f64,
}

/// The KKT matrix of a mechanism with loops, factored front by front.
#[derive(Clone, Debug)]
pub(crate) struct Multifrontal {
    columns: Columns,
    fronts: Vec<f64>,
    factored: Factored,
    /// What passes through the rows of fronts, and multipliers, of one right-hand side.
    flows: Vec<f64>,
    sides: Vec<f64>,
    multipliers: Vec<f64>,
    /// Flows, sides and multipliers of a block of right-hand sides.
    block_flows: Vec<Block>,
    block_sides: Vec<Block>,
    block_multipliers: Vec<Block>,
    wrenches: Vec<[Block; 3]>,
}

/// The factors, with which right-hand sides are eliminated and substituted.
#[derive(Clone, Debug)]
struct Factored {
    shapes: Vec<Shape>,
    pivots: Vec<Pivot>,
    closed: Vec<Closed>,
    /// Column and row of each pivot, one after the other; the row is divided by the pivot.
    factors: Vec<f64>,
}

/// The pivots of a factorization.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Pivots {
    pub(crate) joints: SmallestPivot,
    /// The least that is left of the diagonal entry of an equation by those that are closed with it.
    pub(crate) equations: f64,
    /// The smallest pivot of an equation, relative to the steepest that its constraint gets.
    pub(crate) steepness: f64,
}

/// What pivots of joints and equations are compared with.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Scales<'a> {
    pub(crate) inertia: &'a [f64],
    /// Of each constraint.
    pub(crate) weight: &'a [f64],
}

/// The mechanism at a step.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Mechanism<'a> {
    pub(crate) loops: &'a Loops,
    pub(crate) joints: &'a [PlanarJoint],
    pub(crate) tree: &'a Joints<Fours>,
    pub(crate) start: &'a InPlane,
    pub(crate) end: &'a InPlane,
}

/// What a linearization adds to that of a tree.
pub(crate) struct Closures<'a> {
    /// `Dh(q[k+1])` and `Σ λ D²h(q[k])`, row-major.
    pub(crate) jacobian: &'a [f64],
    pub(crate) hessian: &'a [f64],
}

/// What is linearized, row-major with rows of whole blocks.
pub(crate) struct Derivatives<'a> {
    pub(crate) increment: &'a mut [f64],
    pub(crate) momentum: &'a mut [f64],
    pub(crate) multipliers: &'a mut [f64],
    pub(crate) stride: usize,
}

/// Adds the fronts that end at a step to its own.
#[inline(always)]
fn absorb(shapes: &[Shape], fronts: &mut [f64], step: &Step) {
    let into = shapes[step.front];
    for other in &step.absorbed {
        let from = shapes[other.front];
        for &(from_row, row) in &other.rows {
            for &(from_column, column) in &other.rows {
                let part = fronts[from.entry + from_row * from.stride + from_column];
                fronts[into.entry + row * into.stride + column] += part;
            }
        }
    }
}

/// The rows of a front that a step uses.
struct Front<'a> {
    entries: &'a mut [f64],
    stride: usize,
}

impl Front<'_> {
    #[inline(always)]
    fn row(&self, row: usize) -> &[f64] {
        &self.entries[row * self.stride..][..self.stride]
    }

    #[inline(always)]
    fn row_mut(&mut self, row: usize) -> &mut [f64] {
        &mut self.entries[row * self.stride..][..self.stride]
    }

    #[inline(always)]
    fn diagonal(&self, row: usize) -> f64 {
        self.entries[row * self.stride + row]
    }

    /// Row and column of an equation, from its wrenches at the start and at the end.
    #[inline(always)]
    fn open(&mut self, opened: &Opened, [start, end]: [&[Vec3; 2]; 2]) {
        for (body, (push, measure)) in opened.bodies.iter().zip(start.iter().zip(end)) {
            let Some(body) = body else { continue };
            for k in 0..3 {
                self.row_mut(opened.place)[body + 3 + k] = measure[k];
                self.row_mut(body + 3 + k)[opened.place] = -push[k];
            }
        }
    }

    /// Divides the row by the pivot, and takes `column · row` away.
    #[inline(always)]
    fn eliminate(&mut self, column: &[f64], row: &mut [f64], inverse: f64) {
        for entry in row.iter_mut() {
            *entry *= inverse;
        }
        for (to, factor) in self.entries.chunks_exact_mut(self.stride).zip(column) {
            add_row(to, -factor, row);
        }
    }

    /// Eliminates an equation; its row and column end as zeros.
    #[inline(always)]
    fn close(&mut self, closed: &Closed, [column, row]: [&mut [f64]; 2]) {
        let at = closed.row;
        for (entry, row) in column.iter_mut().zip(self.entries.chunks_exact(self.stride)) {
            *entry = row[at];
        }
        row.copy_from_slice(self.row(at));
        self.eliminate(column, row, closed.inverse);
        row[at] = 0.0;
        self.row_mut(at).fill(0.0);
        self.entries.chunks_exact_mut(self.stride).for_each(|row| row[at] = 0.0);
    }

    /// What is left of a joint goes to its parent; edges lead there at the midpoint, the start and the end.
    #[inline(always)]
    fn pass_on(&mut self, step: &Step, [mid, start, end]: [Vec2; 3]) {
        let (place, stride) = (step.place, self.stride);
        if step.above != Above::World {
            move_twists(self.entries, stride, place, [mid, end]);
            for (first, edge) in [(place, mid), (place + 3, start)] {
                let (to, from) = self.entries[first * stride..].split_at_mut(stride);
                let (x, y) = from.split_at(stride);
                add_row(to, edge[0], &y[..stride]);
                add_row(to, -edge[1], x);
            }
        }
        if let Above::At(other) = step.above {
            for row in self.entries.chunks_exact_mut(stride) {
                for k in 0..BODY {
                    row[other + k] += row[place + k];
                }
            }
            for k in 0..BODY {
                let (low, high) = (place.min(other) + k, place.max(other) + k);
                let (first, second) = self.entries.split_at_mut(high * stride);
                let (low, high) = (&mut first[low * stride..][..stride], &mut second[..stride]);
                let (to, from) = if other < place { (low, high) } else { (high, low) };
                add_row(to, 1.0, from);
            }
        }
        if step.above != Above::Here {
            self.entries[place * stride..][..BODY * stride].fill(0.0);
            self.entries.chunks_exact_mut(stride).for_each(|row| row[place..][..BODY].fill(0.0));
        }
    }
}

impl Multifrontal {
    pub(crate) fn new(loops: &Loops) -> Self {
        let (joints, equations) = (loops.in_closure.len(), loops.equations.len());
        let (mut shapes, mut entry, mut row) = (Vec::new(), 0, 0);
        for &rows in &loops.plan.fronts {
            let stride = padded(rows);
            shapes.push(Shape { entry, row, stride });
            entry += rows * stride;
            row += stride;
        }
        let factors = loops.plan.steps.iter();
        let factors = factors.map(|s| 2 * shapes[s.front].stride * (1 + s.closed.len())).sum();
        Self {
            columns: Columns::new(joints),
            fronts: vec![0.0; entry],
            factored: Factored {
                shapes,
                pivots: vec![Pivot::default(); joints],
                closed: vec![Closed::default(); equations],
                factors: vec![0.0; factors],
            },
            flows: vec![0.0; row],
            sides: vec![0.0; equations],
            multipliers: vec![0.0; equations],
            block_flows: vec![Block::ZERO; row],
            block_sides: vec![Block::ZERO; equations],
            block_multipliers: vec![Block::ZERO; equations],
            wrenches: vec![[Block::ZERO; 3]; joints + 1],
        }
    }

    /// Factors the matrix at the second derivatives of the tree. With fronts of `m` rows `4 m²` flops a
    /// joint and equation.
    #[inline(never)]
    pub(crate) fn factor(
        &mut self,
        at: Mechanism<'_>,
        diagonal: &[f64],
        scales: Scales<'_>,
        time_step_s: f64,
        kind: MatrixKind,
    ) -> Pivots {
        widest!({
            let Mechanism { loops, joints, tree, start, end } = at;
            let method = Method::new(time_step_s, kind);
            self.columns.step = time_step_s;
            self.fronts.fill(0.0);
            let mut pivots = Pivots { joints: SmallestPivot::NONE, equations: 1.0, steepness: 1.0 };
            let Factored { shapes, pivots: eliminated, closed, factors } = &mut self.factored;
            let (mut factors, mut closed) = (&mut factors[..], &mut closed[..]);
            for step in &loops.plan.steps {
                let (i, place) = (step.joint, step.place);
                absorb(shapes, &mut self.fronts, step);
                let Shape { entry, stride, .. } = shapes[step.front];
                let mut front =
                    Front { entries: &mut self.fronts[entry..][..step.rows * stride], stride };
                for opened in &step.opened {
                    front.open(
                        opened,
                        [start, end].map(|closures| &closures.wrenches[opened.equation]),
                    );
                }

                // D = K_jj + minusᵀ A plus,  U = upper + A plus,  W = lower + Aᵀ minus.
                let joint = &joints[i];
                let link = tree.link(i);
                let ([upper, lower], generator) = method.generator(&link, joint);
                let turn = joint.body.turn;
                let minus = six(generator.minus, [turn, start.slide[i][0], start.slide[i][1]]);
                let plus = six(generator.plus, [turn, end.slide[i][0], end.slide[i][1]]);
                let [column, row] = take_mut(&mut factors, stride);
                project(front.entries, stride, place, &plus, column);
                row.fill(0.0);
                for (k, factor) in minus.iter().enumerate() {
                    add_row(row, *factor, front.row(place + k));
                }
                let k_jj = dot3(generator.minus, upper) + diagonal[i];
                let a_plus =
                    column[place..].iter().zip(minus).map(|(a_plus, minus)| a_plus * minus);
                let pivot = k_jj + a_plus.sum::<f64>();
                pivots.joints.see(
                    i,
                    pivot,
                    k_jj.abs().max(scales.inertia[i] * method.inverse.abs()),
                );
                let inverse = 1.0 / pivot;
                for k in 0..3 {
                    column[place + k] += upper[k];
                    row[place + k] += lower[k];
                }
                // A −= U Wᵀ / D.
                front.eliminate(column, row, inverse);

                // Equations that are closed here, the steepest first.
                let closing = take_first(&mut closed, step.closed.len());
                for (closed, &(equation, row)) in closing.iter_mut().zip(&step.closed) {
                    let weight = scales.weight[loops.equations[equation].constraint];
                    *closed =
                        Closed { equation, row, weight, whole: front.diagonal(row), inverse: 0.0 };
                }
                for m in 0..closing.len() {
                    let size =
                        |k: usize| closing[k].weight.powi(2) * front.diagonal(closing[k].row).abs();
                    let largest = (m + 1..closing.len())
                        .fold(m, |a, b| if size(b) > size(a) { b } else { a });
                    let steepness = size(largest) / time_step_s.abs();
                    closing.swap(m, largest);
                    let closed = &mut closing[m];
                    let pivot = front.diagonal(closed.row);
                    // A NaN counts as zero.
                    pivots.equations = pivots.equations.min((pivot / closed.whole).abs().max(0.0));
                    pivots.steepness = pivots.steepness.min(steepness.max(0.0));
                    closed.inverse = 1.0 / pivot;
                    front.close(closed, take_mut(&mut factors, stride));
                }

                let edges = [link.edge, start.edge[i], end.edge[i]];
                front.pass_on(step, edges);
                eliminated[i] = Pivot { minus, plus, inverse, edges };
            }
            pivots
        })
    }

    /// Solves for `x` and `λ` in place; `constraints` are all that the model has.
    #[inline(never)]
    pub(crate) fn solve(&mut self, loops: &Loops, x: &mut [f64], constraints: &mut [f64]) {
        widest!({
            for (side, equation) in self.sides.iter_mut().zip(&loops.equations) {
                *side = constraints[equation.constraint];
            }
            constraints.fill(0.0);
            let Self { factored, flows, sides, multipliers, .. } = self;
            factored.eliminate(loops, x, sides, multipliers, flows);
            factored.substitute(loops, x, multipliers, flows);
            for (multiplier, equation) in multipliers.iter().zip(&loops.equations) {
                constraints[equation.constraint] = *multiplier;
            }
        })
    }

    /// As without loops, with multipliers. About `8 m` flops for each joint or equation
    /// and column beside those of a tree.
    pub(crate) fn linearize(
        &mut self,
        at: Mechanism<'_>,
        diagonal: &Diagonals,
        closures: &Closures<'_>,
        out: Derivatives<'_>,
    ) {
        in_eights(Linearize { multifrontal: self, at, diagonal, closures, out });
    }

    /// Takes what turns constraints from a block of columns, turns that round, and fills their sides.
    #[inline(always)]
    fn add_closures<E: Eight>(&mut self, loops: &Loops, closures: &Closures<'_>, first: usize) {
        let n = self.columns.increment.len();
        let columns = first.min(n)..n.min(first + LANES);
        let Columns { increment, momentum, .. } = &mut self.columns;
        for (i, (x, p)) in increment.iter_mut().zip(momentum).enumerate() {
            let row = &closures.hessian[i * n..][columns.clone()];
            for (lane, value) in row.iter().enumerate() {
                x.0[lane] -= value;
                p.0[lane] -= value;
            }
            E::of(x).scaled(-1.0).put(x);
        }
        for (side, equation) in self.block_sides.iter_mut().zip(&loops.equations) {
            *side = Block::ZERO;
            let row = &closures.jacobian[equation.constraint * n..][columns.clone()];
            side.0.iter_mut().zip(row).for_each(|(to, from)| *to = -from);
        }
    }

    /// From the leaves to the root: what multipliers take from the momentum.
    #[inline(always)]
    fn push_back<E: Eight>(&mut self, loops: &Loops, joints: &[PlanarJoint], start: &InPlane) {
        let add = |to: &mut Block, part: E| E::of(to).plus(part).put(to);
        for ((equation, wrenches), lambda) in
            loops.equations.iter().zip(&start.wrenches).zip(&self.block_multipliers)
        {
            let lambda = E::of(lambda);
            for (body, wrench) in equation.bodies.iter().zip(wrenches) {
                if let Some(body) = body {
                    for (to, part) in self.wrenches[body + 1].iter_mut().zip(wrench) {
                        add(to, lambda.scaled(-part));
                    }
                }
            }
        }
        for (i, joint) in joints.iter().enumerate().rev() {
            let [n, fx, fy] = std::mem::replace(&mut self.wrenches[i + 1], [Block::ZERO; 3]);
            let [n, fx, fy] = [E::of(&n), E::of(&fx), E::of(&fy)];
            let ([dx, dy], [ex, ey]) = (start.slide[i], start.edge[i]);
            let torque = n.scaled(joint.body.turn).plus(fx.scaled(dx)).plus(fy.scaled(dy));
            add(&mut self.columns.momentum[i], torque);
            let moved = n.plus(fy.scaled(ex)).plus(fx.scaled(-ey));
            for (to, part) in self.wrenches[joint.parent].iter_mut().zip([moved, fx, fy]) {
                add(to, part);
            }
        }
        self.wrenches[0] = [Block::ZERO; 3];
    }
}

struct Linearize<'a> {
    multifrontal: &'a mut Multifrontal,
    at: Mechanism<'a>,
    diagonal: &'a Diagonals,
    closures: &'a Closures<'a>,
    out: Derivatives<'a>,
}

impl InEights for Linearize<'_> {
    type Output = ();

    #[inline(always)]
    fn run<E: Eight>(self) {
        let Self { multifrontal: own, at, diagonal, closures, out } = self;
        let Mechanism { loops, joints, tree, start, .. } = at;
        let stride = out.stride;
        out.multipliers.fill(0.0);
        own.columns.find_slopes(tree, joints);
        for first in (0..stride).step_by(LANES) {
            own.columns.start::<E>(tree, joints, diagonal, first);
            own.add_closures::<E>(loops, closures, first);
            let Multifrontal { factored, block_sides: sides, block_flows: flows, .. } = own;
            let (x, multipliers) = (&mut own.columns.increment, &mut own.block_multipliers);
            factored.eliminate(loops, x, sides, multipliers, flows);
            factored.substitute(loops, x, multipliers, flows);
            own.columns.carry_down::<E>(joints, diagonal);
            own.columns.gather::<E>(joints);
            own.push_back::<E>(loops, joints, start);
            own.columns.write::<E>(out.increment, out.momentum, first, stride);
            for (value, equation) in own.block_multipliers.iter().zip(&loops.equations) {
                let row = &mut out.multipliers[equation.constraint * stride..][..stride];
                E::of(value).put_list(&mut row[first..][..LANES]);
            }
        }
    }
}

impl Factored {
    /// From the leaves to the root.
    #[inline(always)]
    fn eliminate<S: Column>(
        &self,
        loops: &Loops,
        x: &mut [S],
        sides: &[S],
        multipliers: &mut [S],
        flows: &mut [S],
    ) {
        flows.fill(S::ZERO);
        let (shapes, pivots) = (&self.shapes[..], &self.pivots[..]);
        let (mut factors, mut closed) = (&self.factors[..], &self.closed[..]);
        for step in &loops.plan.steps {
            let Shape { row: first, stride, .. } = shapes[step.front];
            for other in &step.absorbed {
                for &(from, to) in &other.rows {
                    let part = flows[shapes[other.front].row + from];
                    flows[first + to] = flows[first + to].plus(part);
                }
            }
            let flows = &mut flows[first..][..stride];
            let pivot = &pivots[step.joint];
            let mut right = x[step.joint];
            for (flow, minus) in flows[step.place..][..BODY].iter().zip(pivot.minus) {
                right = right.plus(flow.times(-minus));
            }
            let value = right.times(pivot.inverse);
            x[step.joint] = value;
            add_column(flows, value, take_factors(&mut factors, stride)[0]);
            for closed in take(&mut closed, step.closed.len()) {
                let right = sides[closed.equation].plus(flows[closed.row].times(-1.0));
                let value = right.times(closed.inverse);
                multipliers[closed.equation] = value;
                add_column(flows, value, take_factors(&mut factors, stride)[0]);
                flows[closed.row] = S::ZERO;
            }
            let place = step.place;
            if step.above == Above::World {
                flows[place..][..BODY].fill(S::ZERO);
                continue;
            }
            let [mid, start, _] = pivot.edges;
            for (first, [ex, ey]) in [(place, mid), (place + 3, start)] {
                let moved = flows[first + 2].times(ex).plus(flows[first + 1].times(-ey));
                flows[first] = flows[first].plus(moved);
            }
            if let Above::At(other) = step.above {
                for k in 0..BODY {
                    flows[other + k] = flows[other + k].plus(flows[place + k]);
                    flows[place + k] = S::ZERO;
                }
            }
        }
    }

    /// From the root to the leaves. What elimination has left in rows that are not open is met by zeros of the
    /// factors.
    #[inline(always)]
    fn substitute<S: Column>(
        &self,
        loops: &Loops,
        x: &mut [S],
        multipliers: &mut [S],
        flows: &mut [S],
    ) {
        let (shapes, pivots) = (&self.shapes[..], &self.pivots[..]);
        let (mut factors, mut closed) = (&self.factors[..], &self.closed[..]);
        for step in loops.plan.steps.iter().rev() {
            let Shape { row: first, stride, .. } = shapes[step.front];
            let (pivot, place) = (&pivots[step.joint], step.place);
            let (all, motions) = (&mut *flows, first..first + stride);
            let motions = &mut all[motions];
            match step.above {
                Above::World => motions[place..][..BODY].fill(S::ZERO),
                Above::Here => {}
                Above::At(other) => motions.copy_within(other..other + BODY, place),
            }
            let [mid, _, end] = pivot.edges;
            for (first, [ex, ey]) in [(place, mid), (place + 3, end)] {
                let turn = motions[first];
                motions[first + 1] = motions[first + 1].plus(turn.times(-ey));
                motions[first + 2] = motions[first + 2].plus(turn.times(ex));
            }
            for closed in take_last(&mut closed, step.closed.len()).iter().rev() {
                let row = take_last_factors(&mut factors, stride)[1];
                let value = multipliers[closed.equation].plus(S::sum(row, motions).times(-1.0));
                multipliers[closed.equation] = value;
                motions[closed.row] = value;
            }
            let row = take_last_factors(&mut factors, stride)[1];
            let value = x[step.joint].plus(S::sum(row, motions).times(-1.0));
            x[step.joint] = value;
            for (motion, plus) in motions[place..][..BODY].iter_mut().zip(pivot.plus) {
                *motion = motion.plus(value.times(plus));
            }
            for other in &step.absorbed {
                for &(to, from) in &other.rows {
                    all[shapes[other.front].row + to] = all[first + from];
                }
            }
        }
    }
}

#[inline(always)]
fn six([a, b, c]: Vec3, [d, e, f]: Vec3) -> [f64; BODY] {
    [a, b, c, d, e, f]
}

/// `to += factor · from`, over whole blocks.
#[inline(always)]
fn add_row(to: &mut [f64], factor: f64, from: &[f64]) {
    let from = from.as_chunks::<LANES>().0;
    for (to, from) in to.as_chunks_mut::<LANES>().0.iter_mut().zip(from) {
        let (mut sum, from) = (*to, *from);
        for (sum, from) in sum.iter_mut().zip(from) {
            *sum += factor * from;
        }
        *to = sum;
    }
}

/// `to += factor · column`, over whole blocks.
#[inline(always)]
fn add_column<S: Column>(to: &mut [S], factor: S, column: &[f64]) {
    let column = column.as_chunks::<LANES>().0;
    for (to, column) in to.as_chunks_mut::<LANES>().0.iter_mut().zip(column) {
        for (to, column) in to.iter_mut().zip(column) {
            *to = to.plus(factor.times(*column));
        }
    }
}

/// `column = front · plus`, for the columns of a body. Not part of any wider function: those would gather
/// single entries.
#[inline(never)]
fn project(front: &[f64], stride: usize, place: usize, plus: &[f64; BODY], column: &mut [f64]) {
    for (entry, row) in column.iter_mut().zip(front.chunks_exact(stride)) {
        let Some([a, b, c, d, e, f]) = row[place..].first_chunk::<BODY>() else { continue };
        *entry = ((a * plus[0] + b * plus[1]) + (c * plus[2] + d * plus[3]))
            + (e * plus[4] + f * plus[5]);
    }
}

/// Makes the twists in the columns of a body those of its parent, to which edges lead at the midpoint and at
/// the end. Narrow as [`project`].
#[inline(never)]
fn move_twists(front: &mut [f64], stride: usize, place: usize, [mid, end]: [Vec2; 2]) {
    for row in front.chunks_exact_mut(stride) {
        let Some(row) = row[place..].first_chunk_mut::<BODY>() else { continue };
        row[0] += cross(mid, [row[1], row[2]]);
        row[3] += cross(end, [row[4], row[5]]);
    }
}

/// Room for the column and the row of the next pivot.
#[inline(always)]
fn take_mut<'a>(factors: &mut &'a mut [f64], stride: usize) -> [&'a mut [f64]; 2] {
    take_first(factors, 2 * stride).split_at_mut(stride).into()
}

#[inline(always)]
fn take_first<'a, T>(list: &mut &'a mut [T], count: usize) -> &'a mut [T] {
    let (first, rest) = std::mem::take(list).split_at_mut(count);
    *list = rest;
    first
}

#[inline(always)]
fn take<'a, T>(list: &mut &'a [T], count: usize) -> &'a [T] {
    let (first, rest) = list.split_at(count);
    *list = rest;
    first
}

#[inline(always)]
fn take_last<'a, T>(list: &mut &'a [T], count: usize) -> &'a [T] {
    let (rest, last) = list.split_at(list.len() - count);
    *list = rest;
    last
}

/// Column and row of the next pivot.
#[inline(always)]
fn take_factors<'a>(factors: &mut &'a [f64], stride: usize) -> [&'a [f64]; 2] {
    take(factors, 2 * stride).split_at(stride).into()
}

#[inline(always)]
fn take_last_factors<'a>(factors: &mut &'a [f64], stride: usize) -> [&'a [f64]; 2] {
    take_last(factors, 2 * stride).split_at(stride).into()
}

#[cfg(test)]
mod tests;
