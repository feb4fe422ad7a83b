//! All stages, evaluated four or eight side by side, and corrected together.
//!
//! What belongs to the stages of a coordinate lies side by side, padded to whole [`LanesOf`]: number `i` of
//! coordinate `a` is entry `a·width + i`.

use std::array;

use plantd_math::dense_inverse::DenseInverse;
use plantd_math::norms::{larger, largest};
use plantd_math::scalar::{Compared, LanesOf, Scalar, Side, in_registers};
use plantd_math::spatial::three;
use plantd_math::trigonometry::without_turns;

use crate::integrator::collocation::balls::Balls;
use crate::integrator::collocation::closures::Closures;
use crate::integrator::collocation::hessian::Hessian;
use crate::integrator::collocation::masses::Masses;
use crate::integrator::collocation::middle::Middle;
use crate::integrator::collocation::slopes::Slopes;
use crate::integrator::midpoint::Midpoint;
use crate::integrator::newton::{CHORD_FLOOR, FLOOR, STALE};
use crate::integrator::report::{StepError, StepReport};
use crate::integrator::scheme::Tableau;
use crate::integrator::settings::Precision;
use crate::integrator::state::PreciseState;
use crate::integrator::workspace::{StepContext, Workspace};
use crate::lagrangian::forces;
use crate::lagrangian::mechanics::Mechanics;
use crate::model::mechanism::{Model, Spring, ball_of};

/// Rounds of corrections beyond which shorter steps are the better way.
const ROUNDS: u32 = 16;
/// A residual that falls by less than this from one round to the next falls too slowly.
const SLOW: f64 = 0.5;
/// The same with the mass matrices, whose rounds cost little, and how many in a row.
const SLUGGISH: f64 = 0.9;
const SLUGGISH_ROUNDS: u32 = 6;
/// Of a residual in units of the largest momentum, what is left to light bodies: rounds with the mass matrices do not
/// leave much less than they must, as rounds with the Jacobian do.
const OF_LIGHT_BODIES: f64 = 1e-2;
/// What a factorization costs, in rounds of corrections.
const PATIENCE: i32 = 3;

/// What corrects many stages, round after round, without their Jacobian.
#[derive(Clone, Debug)]
enum Alike<const N: usize> {
    Masses(Box<Masses<N>>),
    /// With constraints.
    Middle(Box<Middle>),
}

impl<const N: usize> Alike<N> {
    fn new(model: &Model, tableau: &Tableau, width: usize) -> Self {
        if model.dimensions.constraints > 0 {
            return Self::Middle(Box::new(Middle::new(model, tableau)));
        }
        Self::Masses(Box::new(Masses::new(model, width, tableau.nodes.len())))
    }
}

/// The stages, `N` of them side by side, and all memory that they need.
#[derive(Clone, Debug)]
pub(crate) struct System<const N: usize> {
    count: usize,
    /// The stages, padded.
    width: usize,
    /// Of each `N` stages; none if forces, or springs that are not linear, are to be evaluated, one stage after the
    /// other.
    mechanics: Vec<Mechanics<LanesOf<N>>>,
    /// Whole turns that configurations leave out, and configurations with them, of `N` stages.
    turns: Vec<f64>,
    positions: Vec<LanesOf<N>>,
    /// `μ_ij`, row after row, padded both ways.
    rows: Vec<LanesOf<N>>,
    /// `μ_ij`, column after column.
    columns: Vec<LanesOf<N>>,
    weights: Vec<f64>,
    nodes: Vec<f64>,
    /// The dynamic coordinates that are none of ball joints; and where they start, without whole turns, and what that
    /// has lost.
    plain: Vec<usize>,
    start: Vec<[f64; 2]>,
    /// Lengths of the stages `h b_i`, and their inverses.
    lengths: Vec<f64>,
    rates: Vec<f64>,
    /// `Y_i`, `P_i`, `L_v` and the forces of the inputs.
    increment: Vec<f64>,
    impulse: Vec<f64>,
    momentum: Vec<f64>,
    held: Vec<f64>,
    /// Configurations and velocities of each `N` stages, one coordinate after the other.
    q: Vec<LanesOf<N>>,
    velocity: Vec<LanesOf<N>>,
    l_q: Vec<LanesOf<N>>,
    l_v: Vec<LanesOf<N>>,
    pub(crate) balls: Option<Box<Balls<N>>>,
    pub(crate) closures: Option<Box<Closures<N>>>,
    /// `L_q + f` of each `N` stages, with ball joints.
    force: Vec<LanesOf<N>>,
    alike: Option<Alike<N>>,
    /// With ball joints, all derivatives.
    pub(crate) slopes: Option<Box<Slopes>>,
    hessian: Hessian,
    /// Derivatives of the residuals by all `Y`; entry `a·count + i` belongs to stage `i` of coordinate `a`. Made
    /// when it is first needed, like the other dense matrices.
    pub(crate) matrix: DenseInverse,
    residual: Vec<f64>,
}

impl<const N: usize> System<N> {
    /// `by_masses`: for a solution with the mass matrices of the stages.
    pub(crate) fn new(model: &Model, tableau: &Tableau, by_masses: bool) -> Self {
        let d = model.dimensions;
        let has_balls = !model.orientations.is_empty();
        let count = tableau.nodes.len();
        let width = count.next_multiple_of(N);
        let groups = width / N;
        let mut springs = model.potentials.springs.iter();
        let is_simple = model.forces.is_none() && springs.all(Spring::is_linear);
        let padded = |numbers: &[f64]| {
            let mut numbers = numbers.to_vec();
            numbers.resize(width, 0.0);
            numbers
        };
        let coupling = |i: usize, j: usize| {
            if i < count && j < count { tableau.coupling[i * count + j] } else { 0.0 }
        };
        let several = |entry: &dyn Fn(usize) -> f64| LanesOf(array::from_fn(entry));
        let entries = (0..width).flat_map(|i| (0..width).step_by(N).map(move |j| (i, j)));
        let rows = entries.clone().map(|(i, j)| several(&|lane| coupling(i, j + lane))).collect();
        let columns = entries.map(|(j, i)| several(&|lane| coupling(i + lane, j))).collect();
        let is_plain = |a: &usize| ball_of(&model.orientations, *a).is_none();
        let plain: Vec<usize> = (0..d.dynamic).filter(is_plain).collect();
        let zeros = || vec![0.0; d.dynamic * width];
        let lanes = |count: usize| vec![LanesOf::ZERO; count];
        Self {
            count,
            width,
            mechanics: vec![Mechanics::new(model); if is_simple { groups } else { 0 }],
            turns: vec![0.0; d.coordinates()],
            positions: lanes(d.coordinates()),
            rows,
            columns,
            weights: padded(&tableau.weights),
            nodes: padded(&tableau.nodes),
            start: vec![[0.0; 2]; plain.len()],
            plain,
            lengths: vec![0.0; width],
            rates: vec![0.0; width],
            increment: zeros(),
            impulse: zeros(),
            momentum: zeros(),
            held: zeros(),
            q: lanes(groups * d.coordinates()),
            velocity: lanes(groups * d.coordinates()),
            l_q: lanes(groups * d.dynamic),
            l_v: lanes(groups * d.dynamic),
            balls: has_balls.then(|| Box::new(Balls::new(model, tableau))),
            closures: (d.constraints > 0).then(|| Box::new(Closures::new(model, tableau))),
            force: lanes(if has_balls { groups * d.dynamic } else { 0 }),
            alike: by_masses.then(|| Alike::new(model, tableau, width)),
            slopes: None,
            hessian: Hessian::default(),
            matrix: DenseInverse::new(0, 0),
            residual: vec![0.0; count * d.dynamic],
        }
    }

    /// Makes room for dense matrices.
    pub(crate) fn make_dense(&mut self, model: &Model, tableau: &Tableau) {
        if self.matrix.matrix.is_empty() {
            self.hessian = Hessian::new(model, self.width);
            self.matrix = DenseInverse::new(self.residual.len(), self.width - self.count);
            if let Some(closures) = &self.closures {
                self.matrix.reserve(closures.stride());
            }
            self.slopes = self.balls.as_ref().map(|_| Box::new(Slopes::new(model, tableau)));
        }
    }

    /// How many times `N` stages there are.
    fn groups(&self) -> usize {
        self.width / N
    }

    /// `Σ_j μ_ij x_j` for `N` stages `i`.
    #[inline(always)]
    fn coupled(columns: &[LanesOf<N>], groups: usize, g: usize, x: &[f64]) -> LanesOf<N> {
        let mut sum = LanesOf::ZERO;
        for (column, x) in columns.chunks_exact(groups).zip(x) {
            sum += column[g] * *x;
        }
        sum
    }

    /// Second derivatives at the stages, entry by entry, and how many numbers each has.
    pub(crate) fn hessian(&self) -> (&Hessian, usize) {
        (&self.hessian, self.width)
    }

    /// Places a workspace at a stage.
    pub(crate) fn place(&self, workspace: &mut Workspace, stage: usize) {
        let (n, lane) = (self.turns.len(), stage % N);
        let at = stage / N * n;
        for (a, (q, v)) in self.q[at..].iter().zip(&self.velocity[at..]).take(n).enumerate() {
            workspace.mid.angles[a] = q.0[lane];
            workspace.mid.q[a] = q.0[lane] + self.turns[a];
            workspace.mid.velocity[a] = v.0[lane];
        }
        if let Some(balls) = &self.balls {
            balls.place(workspace, stage);
        }
    }

    /// Replaces the velocities of ball joints at a stage by the rates of `η`.
    pub(crate) fn take_rates(&self, stage: usize, velocity: &mut [f64]) {
        let Some(balls) = &self.balls else { return };
        let (n, g) = (velocity.len(), stage / N);
        for (o, &c) in balls.coordinates.iter().enumerate() {
            let [_, rate] = balls.at(o, stage, &self.q[g * n..][..n]);
            velocity[c..c + 3].copy_from_slice(&rate.0);
        }
    }

    /// Takes velocities and forces, stage by stage, and what does not change within the step.
    pub(crate) fn begin(
        &mut self,
        at: StepContext<'_>,
        motion: &[f64],
        inputs: &[f64],
        Midpoint { turns_per_radian, input_force: force, .. }: &mut Midpoint,
    ) {
        let StepContext { model, settings, state, u } = at;
        let (d, h) = (model.dimensions, settings.time_step_s);
        let (nd, n, width) = (d.dynamic, d.coordinates(), self.width);
        for i in 0..self.count {
            let length = h * self.weights[i];
            (self.lengths[i], self.rates[i]) = (length, 1.0 / length);
            for a in 0..nd {
                self.increment[a * width + i] = length * motion[i * nd + a];
                self.impulse[a * width + i] = length * motion[(self.count + i) * nd + a];
            }
            if d.inputs > 0 {
                let inputs = &inputs[i * d.inputs..][..d.inputs];
                forces::input_forces(&model.coordinate_inputs, inputs, force);
                for (a, force) in force.iter().enumerate() {
                    self.held[a * width + i] = *force;
                }
            }
        }
        for (start, &a) in self.start.iter_mut().zip(&self.plain) {
            *start = without_turns(state.q[a], turns_per_radian[a]);
            self.turns[a] = state.q[a] - start[0];
        }
        if let Some(balls) = &mut self.balls {
            balls.begin(state, &mut self.increment);
        }
        if let Some(closures) = &mut self.closures {
            closures.begin(at, self.balls.as_ref().map_or(&[], |balls| balls.start()));
        }
        for k in 0..d.prescribed {
            let start = state.q[nd + k];
            let way = u[d.inputs + k] - start;
            for g in 0..self.groups() {
                let node = LanesOf::load(&self.nodes[g * N..]);
                self.q[g * n + nd + k] = node * way + start;
                self.velocity[g * n + nd + k] = LanesOf::constant(way / h);
            }
        }
    }

    /// Evaluates all stages; returns what the residuals are the sums of, at most.
    pub(crate) fn evaluate(
        &mut self,
        workspace: &mut Workspace,
        at: StepContext<'_>,
        inputs: &[f64],
    ) -> f64 {
        let StepContext { model, state, .. } = at;
        let (n, nd) = (model.dimensions.coordinates(), model.dimensions.dynamic);
        let mut magnitude = f64::MIN_POSITIVE;
        if let Some(balls) = &mut self.balls {
            balls.turn(&self.increment);
        }
        for g in 0..self.groups() {
            self.move_to(state, n, g);
            let first = g * N;
            if let Some(balls) = &mut self.balls {
                let place = [&mut self.q[g * n..][..n], &mut self.velocity[g * n..][..n]];
                balls.move_to(&self.increment, LanesOf::load(&self.rates[first..]), g, place);
            }
            if self.mechanics.is_empty() {
                for lane in 0..N.min(self.count - g * N) {
                    self.evaluate_alone(workspace, at, inputs, g * N + lane);
                }
            } else {
                let (q, velocity) = (&self.q[g * n..][..n], &self.velocity[g * n..][..n]);
                let own = g * nd..(g + 1) * nd;
                let derivatives = [&mut self.l_q[own.clone()], &mut self.l_v[own]];
                let orientations = self.balls.as_ref().map_or(&[][..], |b| b.orientations(g));
                self.mechanics[g].gradient(model, q, orientations, velocity, derivatives);
                if model.potentials.any {
                    self.add_springs(model, g);
                }
            }
            magnitude = magnitude.max(self.take_impulses(state, &model.damping, n, g));
            if let Some(balls) = &mut self.balls {
                let lengths = LanesOf::load(&self.lengths[first..]);
                let from = (&self.force[g * nd..][..nd], &self.l_v[g * nd..][..nd]);
                balls.take(lengths, g, from, [&mut self.impulse, &mut self.momentum]);
            }
        }
        if let Some(closures) = &mut self.closures {
            let balls = self.balls.as_deref_mut();
            magnitude += closures.evaluate(at, &self.increment, self.width, balls);
        }
        magnitude
    }

    /// Adds springs and armatures to the derivatives of `L` at `N` stages.
    fn add_springs(&mut self, model: &Model, g: usize) {
        let (n, nd) = (self.turns.len(), model.dimensions.dynamic);
        self.take_turns(g);
        let (poses, velocity) = (&self.mechanics[g].poses, &self.velocity[g * n..][..n]);
        model.add_spring_gradient(poses, &self.positions, &mut self.l_q[g * nd..][..nd]);
        model.armature.add_momentum(velocity, &mut self.l_v[g * nd..][..nd]);
    }

    /// Configurations of `N` stages with their whole turns.
    fn take_turns(&mut self, g: usize) {
        let from = self.q[g * self.turns.len()..].iter().zip(&self.turns);
        for (position, (q, turns)) in self.positions.iter_mut().zip(from) {
            *position = *q + *turns;
        }
    }

    /// Configurations and velocities of `N` stages, but of ball joints.
    pub(crate) fn move_to(&mut self, state: &PreciseState, n: usize, g: usize) {
        in_registers!(LanesOf<N>, {
            let (first, groups) = (g * N, self.groups());
            let rates = LanesOf::load(&self.rates[first..]);
            for (&a, [angle, rest]) in self.plain.iter().zip(&self.start) {
                let own = &self.increment[a * self.width..][..self.width];
                let more =
                    Self::coupled(&self.columns, groups, g, &own[..self.count]) + state.q_low[a];
                self.q[g * n + a] = more + *rest + *angle;
                self.velocity[g * n + a] = LanesOf::load(&own[first..]) * rates;
            }
        })
    }

    /// Impulses of `N` stages, from the derivatives of `L`.
    pub(crate) fn take_impulses(
        &mut self,
        state: &PreciseState,
        damping: &[f64],
        n: usize,
        g: usize,
    ) -> f64 {
        in_registers!(LanesOf<N>, {
            let first = g * N;
            let lengths = LanesOf::load(&self.lengths[first..]);
            let mut largest = [0.0; N];
            let nd = state.p.len();
            let derivatives = self.l_q[g * nd..][..nd].iter().zip(&self.l_v[g * nd..]);
            for (a, (l_q, l_v)) in derivatives.enumerate() {
                let at = a * self.width + first;
                let mut force = LanesOf::load(&self.held[at..]);
                if let Some(c) = damping.get(a) {
                    force -= self.velocity[g * n + a] * *c;
                }
                if let Some(sum) = self.force.get_mut(g * nd + a) {
                    *sum = *l_q + force;
                }
                let (by_position, by_force) = (*l_q * lengths, force * lengths);
                (by_position + by_force).store(&mut self.impulse[at..]);
                l_v.store(&mut self.momentum[at..]);
                let by_angle = by_position.abs() * (self.q[g * n + a].abs() + 1.0);
                let size = l_v.abs() + (by_angle + by_force.abs()) * 0.5 + state.p[a].abs();
                for (largest, size) in largest.iter_mut().zip(size.0) {
                    *largest = if size > *largest { size } else { *largest };
                }
            }
            largest.into_iter().fold(0.0, f64::max)
        })
    }

    /// Writes the residuals of all stages; returns the largest.
    pub(crate) fn find_residuals(&mut self, state: &PreciseState) -> f64 {
        let size = self.find_linear_residuals(state);
        if let Some(balls) = &mut self.balls {
            balls.find_residuals(state, [&self.impulse, &self.momentum], &mut self.residual);
        }
        if let Some(closures) = &self.closures {
            closures.add_pushes(&mut self.residual);
        }
        if self.balls.is_none() && self.closures.is_none() { size } else { largest(&self.residual) }
    }

    /// The largest residual and violation of a constraint, in units of round-off.
    fn sizes(&mut self, state: &PreciseState, magnitude: f64) -> [f64; 2] {
        let residual = self.find_residuals(state) / (f64::EPSILON * magnitude);
        let violation = self.closures.as_ref().map_or(0.0, |closures| closures.violation());
        [residual, violation]
    }

    /// The residuals but of ball joints, as if there were no constraints.
    fn find_linear_residuals(&mut self, state: &PreciseState) -> f64 {
        in_registers!(LanesOf<N>, {
            let (groups, mut sizes) = (self.groups(), [0.0; N]);
            for &a in &self.plain {
                let residual = &mut self.residual[a * self.count..][..self.count];
                let own = &self.impulse[a * self.width..][..self.width];
                for (g, residual) in residual.chunks_mut(N).enumerate() {
                    let first = g * N;
                    let sum = Self::coupled(&self.columns, groups, g, &own[..self.count]);
                    let momentum = LanesOf::load(&self.momentum[a * self.width + first..]);
                    let value = (-momentum + state.p[a] + sum) + state.p_low[a];
                    value.store_some(residual);
                    for (size, value) in sizes.iter_mut().zip(&*residual) {
                        *size = larger(*size, *value);
                    }
                }
            }
            sizes.into_iter().fold(0.0, larger)
        })
    }

    /// Takes the last correction, which `residual` holds, into the impulses, which were evaluated
    /// before it.
    pub(crate) fn correct_impulses(&mut self, n: usize) {
        in_registers!(LanesOf<N>, {
            let (count, width, groups) = (self.count, self.width, self.groups());
            let nd = self.increment.len() / width;
            for g in 0..groups {
                let first = g * N;
                let lengths = LanesOf::load(&self.lengths[first..]);
                for b in 0..nd {
                    let corrections = &self.residual[b * count..][..count];
                    let moved = Self::coupled(&self.columns, groups, g, corrections);
                    let own = LanesOf::load_some(&corrections[first..]);
                    for a in 0..nd {
                        let at = (a * n + b) * width + first;
                        let by_position = LanesOf::load(&self.hessian.qq[at..]) * moved * lengths;
                        let by_velocity = LanesOf::load(&self.hessian.qv[at..]) * own;
                        let impulse = &mut self.impulse[a * width + first..];
                        (LanesOf::load(impulse) - (by_position + by_velocity)).store(impulse);
                    }
                }
            }
        })
    }

    /// Derivatives of the residuals `R_i = p + Σ μ_ij P_j − L_v,i` by all `Y`:
    ///
    /// ```text
    /// ∂R_i/∂Y_k = Σ_j μ_ij h_j (L_qq + f_q)_j μ_jk + μ_ik ((L_qv + f_v)_k − (L_vq)_i) − δ_ik (L_vv)_i / h_i
    /// ```
    ///
    /// and what constraints make of it.
    pub(crate) fn fill_matrix(&mut self, at: StepContext<'_>) {
        let n = at.state.q.len();
        if self.balls.is_some() {
            self.fill_turned(at);
            return;
        }
        self.fill_stages(n);
        if let Some(closures) = &self.closures {
            closures.add_curvature(at.model, &mut self.matrix);
        }
    }

    fn fill_stages(&mut self, n: usize) {
        in_registers!(LanesOf<N>, {
            match self.groups() {
                1 => self.fill_groups::<1>(n),
                _ => self.fill_groups::<2>(n),
            }
        })
    }

    /// The same with ball joints, and all other derivatives of the step.
    fn fill_turned(&mut self, StepContext { model, settings, state, .. }: StepContext<'_>) {
        let (Some(balls), Some(slopes)) = (&self.balls, &mut self.slopes) else { return };
        let (nd, n, width, count) = (state.p.len(), state.q.len(), self.width, self.count);
        slopes.time_step_s = settings.time_step_s;
        let Hessian { qq, qv, vq, vv, qu, .. } = &self.hessian;
        let tables = slopes.second.iter_mut().zip([qq, qv, vq, vv]);
        for (to, from) in tables.chain([(&mut slopes.by_input, qu)]) {
            for (entry, numbers) in from.chunks_exact(width).enumerate() {
                let stages = to.chunks_exact_mut((from.len() / width).max(1)).take(count);
                stages.zip(numbers).for_each(|(stage, number)| stage[entry] = *number);
            }
        }
        for stage in 0..count {
            let (g, lane) = (stage / N, stage % N);
            for a in 0..nd {
                slopes.torque[stage * nd + a] = self.force[g * nd + a].0[lane];
                slopes.momentum[stage * nd + a] = self.l_v[g * nd + a].0[lane];
            }
            for (o, c) in balls.coordinates.iter().enumerate() {
                let [offset, rate] = balls.at(o, stage, &self.q[g * n..][..n]);
                slopes.offset[stage * nd + c..][..3].copy_from_slice(&offset.0);
                slopes.rate[stage * nd + c..][..3].copy_from_slice(&rate.0);
            }
        }
        for a in 0..nd {
            slopes.increment[a] = self.increment[a * width..][..count].iter().sum();
            slopes.start[a] = state.p[a] + state.p_low[a];
        }
        if let Some(closures) = &self.closures {
            closures.place(model, slopes);
            for (j, o) in
                (0..=count).flat_map(|j| (0..balls.coordinates.len()).map(move |o| (j, o)))
            {
                let at = (count + j) * nd + balls.coordinates[o];
                slopes.offset[at..at + 3].copy_from_slice(&balls.at_node(o, j).0);
            }
        }
        slopes.find();
        let rows = self.matrix.matrix.chunks_exact_mut(self.matrix.stride);
        for (to, from) in rows.zip(slopes.residual[0].chunks_exact((nd * count).max(1))) {
            to[..nd * count].copy_from_slice(from);
        }
    }

    /// Derivatives of `L` at one stage, with springs and forces.
    fn evaluate_alone(
        &mut self,
        workspace: &mut Workspace,
        at: StepContext<'_>,
        inputs: &[f64],
        stage: usize,
    ) {
        let model = at.model;
        let d = model.dimensions;
        if d.inputs > 0 {
            workspace.mid.set_inputs(model, &inputs[stage * d.inputs..][..d.inputs]);
        }
        self.place(workspace, stage);
        workspace.mid.evaluate(model);
        let (first, lane) = (stage / N * d.dynamic, stage % N);
        for a in 0..d.dynamic {
            // Forces count as a part of `L_q`; those of inputs and dampers are added to all stages.
            let damping = model.damping.get(a).map_or(0.0, |c| c * workspace.mid.velocity[a]);
            let others = workspace.mid.force[a] - (self.held[a * self.width + stage] - damping);
            self.l_q[first + a].0[lane] = workspace.mid.l_q[a] + others;
            self.l_v[first + a].0[lane] = workspace.mid.l_v[a];
        }
    }

    /// Corrects all stages by chord Newton; the Jacobian is renewed where that saves corrections. Not for ball joints
    /// with constraints.
    pub(super) fn correct(
        &mut self,
        workspace: &mut Workspace,
        at: StepContext<'_>,
        inputs: &[f64],
    ) -> Result<StepReport, StepError> {
        let StepContext { model, settings, state, .. } = at;
        let n = model.dimensions.coordinates();
        let enough = settings.precision.residual();
        let mut report = StepReport::default();
        let mut previous = f64::INFINITY;
        let mut fresh = false;
        for iteration in 1..=settings.max_iterations.min(ROUNDS) {
            report.iterations = iteration;
            let magnitude = self.evaluate(workspace, at, inputs);
            let [residual, violation] = self.sizes(state, magnitude);
            let size = larger(residual, violation);
            if !size.is_finite() {
                return Err(StepError::NotFinite { iterations: iteration });
            }
            let rate = size / previous;
            let floor = if fresh { FLOOR } else { CHORD_FLOOR };
            let left = match settings.precision {
                // What the correction will leave.
                Precision::Fast | Precision::Coarse if iteration > 1 => size * rate,
                _ => size,
            };
            let converged = left <= enough || (rate > SLOW && size <= floor);
            fresh = iteration == 1 || (!converged && size * rate.powi(PATIENCE) > enough);
            if fresh {
                self.differentiate(workspace, at, inputs);
                if let Some(closures) = &mut self.closures {
                    closures.curve(model, false);
                }
                self.fill_matrix(at);
                report.factorizations += 1;
                if !self.matrix.invert() {
                    return Err(StepError::NotConverged { iterations: iteration, residual: size });
                }
                if let Some(closures) = &mut self.closures {
                    closures.factor(at, &mut self.matrix, None)?;
                    closures.write(&mut report);
                    report.reciprocal_condition = workspace.kkt.estimates.matrix;
                }
            }
            match &mut self.closures {
                Some(closures) => closures.solve(model, &mut self.matrix, &mut self.residual),
                None => self.matrix.solve(&mut self.residual),
            }
            let corrections = self.residual.chunks_exact(self.count);
            for (own, corrections) in self.increment.chunks_exact_mut(self.width).zip(corrections) {
                own.iter_mut().zip(corrections).for_each(|(y, c)| *y -= c);
            }
            (report.residual, report.constraint_residual) = (residual, violation);
            if converged {
                if self.balls.is_none() {
                    self.correct_impulses(n);
                    if let Some(closures) = &mut self.closures {
                        closures.follow(model, &self.residual);
                    }
                } else if size > STALE {
                    self.evaluate(workspace, at, inputs);
                    self.find_residuals(state);
                }
                return Ok(report);
            }
            previous = size;
        }
        Err(StepError::NotConverged { iterations: report.iterations, residual: previous })
    }

    /// Corrects all stages with the mass matrices of the guess, or, with constraints, with the system of its middle;
    /// `None` if few unknowns are not corrected that way. The error says that it takes too long.
    pub(super) fn correct_alike(
        &mut self,
        workspace: &mut Workspace,
        at: StepContext<'_>,
        inputs: &[f64],
    ) -> Option<Result<StepReport, StepError>> {
        let StepContext { settings, state, .. } = at;
        let mut alike = self.alike.take()?;
        let enough = settings.precision.residual();
        let mut report = StepReport::default();
        let (mut previous, mut moved_before, mut sluggish) = (f64::INFINITY, f64::INFINITY, 0);
        let mut is_solved = false;
        for iteration in 1..=settings.max_iterations {
            report.iterations = iteration;
            let magnitude = self.evaluate(workspace, at, inputs);
            let [residual, violation] = self.sizes(state, magnitude);
            let size = larger(residual, violation);
            if !size.is_finite() {
                break;
            }
            if iteration == 1 {
                report.factorizations = 1;
                if !self.factor_alike(&mut alike, workspace, at, inputs) {
                    break;
                }
            }
            let moved = self.correct_with(workspace, at.model, &mut alike, iteration == 1);
            (report.residual, report.constraint_residual) = (residual, violation);
            let is_enough = match settings.precision {
                Precision::Exact => size <= enough,
                Precision::Fast | Precision::Coarse => {
                    // What the correction leaves, of the increments or of the residual.
                    let unit = f64::EPSILON * largest(&self.increment);
                    let falls = |now: f64, before: f64| match before.is_finite() {
                        true => now * (now / before).min(1.0),
                        false => now,
                    };
                    falls(moved, moved_before) <= enough * unit
                        || falls(size, previous) <= enough * OF_LIGHT_BODIES
                }
            };
            moved_before = moved;
            if is_enough || (size > SLOW * previous && size <= CHORD_FLOOR) {
                if size > STALE {
                    self.evaluate(workspace, at, inputs);
                    self.find_residuals(state);
                }
                workspace.kkt.estimates.write(&mut report);
                is_solved = true;
                break;
            }
            sluggish = if size > SLUGGISH * previous { sluggish + 1 } else { 0 };
            if sluggish == SLUGGISH_ROUNDS {
                break;
            }
            previous = size;
        }
        self.alike = Some(alike);
        let failed = StepError::NotConverged { iterations: report.iterations, residual: previous };
        Some(if is_solved { Ok(report) } else { Err(failed) })
    }

    /// Factors what is alike in all rounds at the last evaluation; false if that is singular.
    fn factor_alike(
        &mut self,
        alike: &mut Alike<N>,
        workspace: &mut Workspace,
        at: StepContext<'_>,
        inputs: &[f64],
    ) -> bool {
        match alike {
            Alike::Masses(masses) => {
                self.factor_masses(masses, workspace, at, inputs);
                true
            }
            Alike::Middle(middle) => {
                let balls = self.balls.as_deref();
                middle.factor(workspace, at, (&self.increment, self.width), balls)
            }
        }
    }

    /// Factors the mass matrices at the last evaluation.
    fn factor_masses(
        &mut self,
        masses: &mut Masses<N>,
        workspace: &mut Workspace,
        at: StepContext<'_>,
        inputs: &[f64],
    ) {
        masses.clear();
        if self.mechanics.is_empty() {
            for stage in 0..self.count {
                self.evaluate_alone(workspace, at, inputs, stage);
                masses.take(at.model, &mut workspace.mid.mechanics, stage);
            }
        }
        for (g, mechanics) in self.mechanics.iter_mut().enumerate() {
            masses.take(at.model, mechanics, g * N);
        }
        masses.factor(at.model);
    }

    /// Corrects the increments, and the impulses of constraints; returns the largest change of an increment.
    fn correct_with(
        &mut self,
        workspace: &mut Workspace,
        model: &Model,
        alike: &mut Alike<N>,
        is_first: bool,
    ) -> f64 {
        let changes = match (alike, &mut self.closures) {
            (Alike::Middle(middle), Some(closures)) => {
                middle.correct(workspace, model, closures, &self.residual, is_first)
            }
            (Alike::Masses(masses), _) => {
                self.change_by_masses(model, masses, is_first);
                &self.residual
            }
            (Alike::Middle(_), None) => return 0.0,
        };
        let moved = largest(changes);
        let changes = changes.chunks_exact(self.count);
        for (own, changes) in self.increment.chunks_exact_mut(self.width).zip(changes) {
            own.iter_mut().zip(changes).for_each(|(y, change)| *y += change);
        }
        moved
    }

    /// From the residuals to changes of the increments, with the mass matrices.
    fn change_by_masses(&mut self, model: &Model, masses: &mut Masses<N>, is_first: bool) {
        for g in 0..self.groups() {
            let first = g * N;
            for (right, residual) in
                masses.right.iter_mut().zip(self.residual.chunks_exact(self.count))
            {
                *right = LanesOf::load_some(&residual[first..]);
            }
            if let Some(balls) = &self.balls {
                balls.change_axes(&mut masses.right, g, false);
            }
            masses.solve(model, g);
            if let Some(balls) = &self.balls {
                balls.change_axes(&mut masses.right, g, true);
            }
            let lengths = LanesOf::load(&self.lengths[first..]);
            for (own, velocity) in self.residual.chunks_exact_mut(self.count).zip(&masses.right) {
                let change = *velocity * lengths;
                change.store_some(&mut own[first..]);
            }
        }
        if is_first {
            masses.secants.forget();
        }
        masses.secants.improve(&mut self.residual);
    }

    /// Takes second derivatives at the last evaluation.
    pub(crate) fn differentiate(
        &mut self,
        workspace: &mut Workspace,
        at: StepContext<'_>,
        inputs: &[f64],
    ) {
        let model = at.model;
        self.hessian.clear(model);
        if self.mechanics.is_empty() {
            for stage in 0..self.count {
                self.evaluate_alone(workspace, at, inputs, stage);
                self.hessian.take(model, &mut workspace.mid.mechanics, stage);
                self.hessian.add_forces(model, workspace, stage);
            }
        }
        for g in 0..self.mechanics.len() {
            self.hessian.take(model, &mut self.mechanics[g], g * N);
            if model.potentials.any {
                self.take_turns(g);
                self.hessian.add_springs(model, &self.mechanics[g].poses, &self.positions, g * N);
            }
        }
    }

    #[inline(always)]
    fn fill_groups<const GROUPS: usize>(&mut self, n: usize) {
        let (count, width) = (self.count, GROUPS * N);
        let nd = self.increment.len() / width;
        let Self { hessian, matrix, rows, lengths, rates, .. } = self;
        let load = |numbers: &[f64]| -> [LanesOf<N>; GROUPS] {
            std::array::from_fn(|g| LanesOf::load(&numbers[g * N..]))
        };
        let lengths = load(lengths);
        let rows = rows.as_chunks::<GROUPS>().0;
        for a in 0..nd {
            for b in 0..nd {
                let at = (a * n + b) * width;
                let (qq, qv) = (load(&hessian.qq[at..]), load(&hessian.qv[at..]));
                let (vq, vv) = (&hessian.vq[at..][..count], &hessian.vv[at..][..count]);
                for (i, (row, vq)) in rows.iter().zip(vq).enumerate() {
                    let target = &mut matrix.matrix[(a * count + i) * matrix.stride + b * count..];
                    let mut sums = [LanesOf::ZERO; GROUPS];
                    for g in 0..GROUPS {
                        sums[g] = row[g] * (qv[g] - *vq);
                    }
                    for j in 0..GROUPS {
                        let weights = row[j] * (lengths[j] * qq[j]);
                        for (row, weight) in rows[j * N..].iter().zip(weights.0) {
                            for g in 0..GROUPS {
                                sums[g] += row[g] * weight;
                            }
                        }
                    }
                    for (g, sum) in sums.into_iter().enumerate() {
                        sum.store(&mut target[g * N..]);
                    }
                    target[i] -= rates[i] * vv[i];
                }
            }
        }
    }

    /// Writes velocities and forces, stage by stage, and their sums over the step, with those of constraints.
    pub(super) fn finish(
        &mut self,
        model: &Model,
        motion: &mut [f64],
        redundant: u32,
        [increment, impulse, multipliers]: [&mut [f64]; 3],
    ) -> Result<(), StepError> {
        let (count, width, nd) = (self.count, self.width, increment.len());
        if !(largest(&self.increment) <= std::f64::consts::PI) {
            for i in 0..count {
                let turns: Vec<f64> = (0..nd).map(|a| self.increment[a * width + i]).collect();
                model.check_turns(&turns)?;
            }
        }
        for a in 0..nd {
            let stages = a * width..a * width + count;
            let (turns, impulses) = (&self.increment[stages.clone()], &self.impulse[stages]);
            increment[a] = turns.iter().sum();
            impulse[a] = impulses.iter().sum();
            for i in 0..count {
                motion[i * nd + a] = self.rates[i] * turns[i];
                motion[(count + i) * nd + a] = self.rates[i] * impulses[i];
            }
        }
        if let Some(closures) = &mut self.closures {
            closures.finish(model, redundant, [impulse, multipliers]);
        }
        let Some(balls) = &self.balls else { return Ok(()) };
        balls.finish(impulse);
        for &c in &balls.coordinates {
            let turn = three(increment, c).norm();
            if !(turn <= std::f64::consts::PI) {
                let coordinate = model.coordinates[c].name.clone();
                return Err(StepError::TooFast { coordinate, increment: turn });
            }
            // Angular velocities are the same in any chart.
            for (i, a) in (0..count).flat_map(|i| (c..c + 3).map(move |a| (i, a))) {
                let (g, lane) = (i / N, i % N);
                motion[i * nd + a] = self.velocity[g * model.dimensions.coordinates() + a].0[lane];
            }
        }
        Ok(())
    }
}
