//! The maps of all ball joints of a step, four or eight side by side.

use std::ops::Range;

use plantd_math::rotation::{Chart, Quaternion, Turn};
use plantd_math::rows::Block;
use plantd_math::scalar::{Beside, Scalar, Wide};
use plantd_math::sided::{Composite, Sided};
use plantd_math::spatial::{Mat3, Vec3};

use crate::lagrangian::turning::Weights;

/// Does it for all of so many ball joints. A floating base has one: side by side with nothing it would take longer.
pub(crate) fn beside<T: Beside<f64>>(count: usize, task: T) -> T::Output {
    if count == 1 { f64::alone(task) } else { f64::beside(count, task) }
}

/// Those that are computed at once, of so many.
#[inline(always)]
fn groups<W: Wide<f64>>(count: usize) -> impl Iterator<Item = Range<usize>> {
    (0..count).step_by(W::COUNT).map(move |first| first..count.min(first + W::COUNT))
}

/// In memory.
#[inline(always)]
fn put<W: Wide<f64>, V: Composite<Block>>(wide: V::Of<W>, lanes: &mut V) {
    lanes.zip(wide, |to, number| number.store(to, 0));
}

/// Gives the matrices of so many ball joints, one after the other.
#[inline(always)]
fn each<W: Wide<f64>>(wide: &Mat3<W>, count: usize, mut take: impl FnMut(usize, Mat3)) {
    if count == 1 {
        return take(0, wide.map(|number| number.value()));
    }
    let mut lanes = Mat3([Vec3::<Block>::default(); 3]);
    put(*wide, &mut lanes);
    for lane in 0..count {
        take(lane, lanes.map(|block| block.0[lane]));
    }
}

/// Components of a list, by their first coordinates. Where it does not reach, as of what is prescribed, they are others,
/// by lane.
#[inline(always)]
fn collect<W: Wide<f64>>(
    coordinates: &[usize],
    list: &[f64],
    others: impl Fn(usize) -> Vec3,
) -> Vec3<W> {
    let three = |lane: usize, i: usize| match list.get(i..i + 3) {
        Some(numbers) => [numbers[0], numbers[1], numbers[2]],
        None => others(lane).0,
    };
    if let [one] = coordinates {
        // Nothing to be put together.
        return Vec3(one_of(three(0, *one)));
    }
    let mut lanes = Vec3::<Block>::default();
    for (lane, &i) in coordinates.iter().enumerate() {
        let three = three(lane, i);
        (0..3).for_each(|k| lanes.0[k].0[lane] = three[k]);
    }
    lanes.map(|numbers| W::load(numbers, 0))
}

/// The way back.
#[inline(always)]
fn scatter(coordinates: &[usize], lanes: &Vec3<Block>, list: &mut [f64]) {
    for (lane, &i) in coordinates.iter().enumerate() {
        if let Some(numbers) = list.get_mut(i..i + 3) {
            (0..3).for_each(|k| numbers[k] = lanes.0[k].0[lane]);
        }
    }
}

/// The same numbers in all lanes.
#[inline(always)]
fn one_of<W: Wide<f64>, const N: usize>(numbers: [f64; N]) -> [W; N] {
    let mut all = [W::ZERO; N];
    for (own, number) in all.iter_mut().zip(&numbers) {
        *own = W::of_one(number);
    }
    all
}

/// Four numbers of each.
#[inline(always)]
fn fours<W: Wide<f64>, T>(list: &[T], of: impl Fn(&T) -> [f64; 4]) -> [W; 4] {
    if let [one] = list {
        return one_of(of(one));
    }
    let mut lanes = [Block::ZERO; 4];
    for (lane, own) in list.iter().enumerate() {
        let four = of(own);
        (0..4).for_each(|k| lanes[k].0[lane] = four[k]);
    }
    let [a, b, c, d] = &lanes;
    [W::load(a, 0), W::load(b, 0), W::load(c, 0), W::load(d, 0)]
}

/// The way back.
#[inline(always)]
fn in_memory<W: Wide<f64>>(numbers: [W; 4]) -> [Block; 4] {
    let mut lanes = [Block::ZERO; 4];
    for (to, number) in lanes.iter_mut().zip(numbers) {
        number.store(to, 0);
    }
    lanes
}

/// Orientations as matrices, each by itself and side by side.
pub(crate) struct ToMatrices<'a> {
    pub(crate) orientations: &'a [Quaternion],
    pub(crate) matrices: &'a mut [Mat3],
    pub(crate) beside: &'a mut Sided<Mat3<Block>>,
}

impl Beside<f64> for ToMatrices<'_> {
    type Output = ();

    #[inline(always)]
    fn run<W: Wide<f64>>(self) {
        let Self { orientations, matrices, beside } = self;
        for range in groups::<W>(orientations.len()) {
            let (first, matrices) = (range.start, &mut matrices[range.clone()]);
            let orientation = Quaternion(fours::<W, _>(&orientations[range], |q| q.0));
            let all = orientation.matrix();
            beside.store::<f64, W>(first, all);
            each(&all, matrices.len(), |lane, matrix| matrices[lane] = matrix);
        }
    }
}

/// Turns by `ξ`, and orientations in the middle of them. What is prescribed keeps its turn.
pub(crate) struct ToMidpoint<'a> {
    pub(crate) coordinates: &'a [usize],
    /// `ξ`, in the place of dynamic coordinates.
    pub(crate) increment: &'a [f64],
    pub(crate) start: &'a Sided<Mat3<Block>>,
    pub(crate) turns: &'a mut Sided<Turn<Block>>,
    pub(crate) middle: &'a mut [Mat3],
}

impl Beside<f64> for ToMidpoint<'_> {
    type Output = ();

    #[inline(always)]
    fn run<W: Wide<f64>>(self) {
        let Self { coordinates, increment, start, turns, middle } = self;
        for range in groups::<W>(coordinates.len()) {
            let (first, middle) = (range.start, &mut middle[range.clone()]);
            let before = |lane: usize| turns.get::<f64>(first + lane).xi;
            let own = Turn::new(collect::<W>(&coordinates[range], increment, before));
            turns.store::<f64, W>(first, own);
            let all = start.wide::<f64, W>(first).times(&own.half());
            each(&all, middle.len(), |lane, matrix| middle[lane] = matrix);
        }
    }
}

/// Momenta half-way, `Λ` of [collocation](crate::integrator::collocation::balls).
pub(crate) struct CarryOn<'a> {
    /// Where the momenta are, and what is below.
    pub(crate) coordinates: &'a [usize],
    pub(crate) places: &'a [usize],
    pub(crate) turns: &'a Sided<Turn<Block>>,
    /// At the start, and what they lost to rounding.
    pub(crate) momenta: [&'a [f64]; 2],
    /// `T`.
    pub(crate) total: &'a [f64],
    /// `Λ`.
    pub(crate) carried: &'a mut [f64],
}

impl Beside<f64> for CarryOn<'_> {
    type Output = ();

    #[inline(always)]
    fn run<W: Wide<f64>>(self) {
        let Self { coordinates, places, turns, momenta: [p, low], total, carried } = self;
        for range in groups::<W>(coordinates.len()) {
            let turn: Turn<W> = turns.wide::<f64, W>(range.start);
            let (coordinates, places) = (&coordinates[range.clone()], &places[range]);
            let p = collect(coordinates, p, |_| Vec3::ZERO);
            let low = collect(coordinates, low, |_| Vec3::ZERO);
            let total = collect(places, total, |_| Vec3::ZERO);
            let start = turn.torque_to_start(total).scaled(0.5) + low + p;
            let mut lanes = Vec3::default();
            put(Chart::new(turn.xi).dexp().apply(start), &mut lanes);
            scatter(places, &lanes, carried);
        }
    }
}

/// Weights of rows and columns.
pub(crate) struct Weigh<'a> {
    pub(crate) coordinates: &'a [usize],
    pub(crate) turns: &'a Sided<Turn<Block>>,
    pub(crate) momentum: &'a [f64],
    /// `L_q` and forces, which count `half` and `weight` in an impulse.
    pub(crate) torque: &'a [f64],
    pub(crate) force: &'a [f64],
    pub(crate) half: f64,
    pub(crate) weight: f64,
    pub(crate) weights: &'a mut [Weights],
}

impl Beside<f64> for Weigh<'_> {
    type Output = ();

    #[inline(always)]
    fn run<W: Wide<f64>>(self) {
        let Self { coordinates, turns, momentum, torque, force, half, weight, weights } = self;
        for range in groups::<W>(coordinates.len()) {
            let turn: Turn<W> = turns.wide::<f64, W>(range.start);
            let (coordinates, weights) = (&coordinates[range.clone()], &mut weights[range]);
            let of = |list: &[f64]| collect::<W>(coordinates, list, |_| Vec3::ZERO);
            let (momentum, torque, force) = (of(momentum), of(torque), of(force));
            let changes = turn.changes();
            let impulse = torque.scaled(half) + force.scaled(weight);
            let own = changes.of_torque(impulse).minus(&changes.of_momentum(momentum));
            let count = coordinates.len();
            each(&own, count, |lane, matrix| weights[lane].own = matrix);
            each(&turn.momentum_at_start(), count, |lane, matrix| weights[lane].momentum = matrix);
            each(&turn.torque_at_start(), count, |lane, matrix| weights[lane].torque = matrix);
            each(&turn.dexp_of_half(), count, |lane, matrix| weights[lane].column = matrix);
        }
    }
}

/// Turns orientations by `ξ`, with what rounding took from them, and writes their rotation vectors.
pub(crate) struct TurnOn<'a> {
    pub(crate) coordinates: &'a [usize],
    /// `ξ`, in the place of dynamic coordinates; what is prescribed does not turn.
    pub(crate) increment: &'a [f64],
    pub(crate) orientations: &'a mut [Quaternion],
    pub(crate) low: &'a mut [[f64; 4]],
    /// Dynamic coordinates.
    pub(crate) q: &'a mut [f64],
}

impl Beside<f64> for TurnOn<'_> {
    type Output = ();

    #[inline(always)]
    fn run<W: Wide<f64>>(self) {
        let Self { coordinates, increment, orientations, low, q } = self;
        for range in groups::<W>(coordinates.len()) {
            let (orientations, low) = (&mut orientations[range.clone()], &mut low[range.clone()]);
            let coordinates = &coordinates[range];
            let turn = collect::<W>(coordinates, increment, |_| Vec3::ZERO);
            let start = Quaternion(fours::<W, _>(orientations, |q| q.0));
            let (end, end_low) = start.turned(fours::<W, _>(low, |low| *low), turn);
            let mut vectors = Vec3::<Block>::default();
            put(end.log(), &mut vectors);
            let (end, end_low) = (in_memory(end.0), in_memory(end_low));
            for (lane, (orientation, low)) in orientations.iter_mut().zip(low).enumerate() {
                (0..4).for_each(|k| orientation.0[k] = end[k].0[lane]);
                (0..4).for_each(|k| low[k] = end_low[k].0[lane]);
            }
            scatter(coordinates, &vectors, q);
        }
    }
}
