//! Where a plant starts: states from momenta, velocities, two configurations, or a guess; and the
//! velocity and energy that belong to a state.

use plantd_math::pivoted_lu::PivotedLu;
use plantd_math::rotation::Quaternion;
use plantd_math::spatial::three;
use plantd_scene::UnknownName;

use crate::constraints::closure::Closure;
use crate::constraints::projection::{Limits, Reached, project};
use crate::integrator::scheme::Scheme;
use crate::integrator::settings::{ForceSplit, HALVINGS_MAX, SUBSTEPS_MAX, Settings};
use crate::integrator::state::PreciseState;
use crate::integrator::workspace::Workspace;
use crate::kkt::system::{Factored, KktSystem};
use crate::lagrangian::energy::{Energy, energy};
use crate::model::manifold::orientations;
use crate::model::mechanism::{Model, Violation};
use crate::plant::facade::Plant;
use crate::plant::settle::{SettleError, SettleRequest};

/// Trace of the rotation between two aligned frames. It is 3; where the equations hold otherwise, for
/// half turns about an axis and for cyclic exchanges of the axes, it is −1 or 0.
const ALIGNED: f64 = 2.0;
/// How a guess is projected onto the constraints.
const PROJECTION: Limits = Limits {
    corrections: 100,
    enough: 1.0,
    floor: 1e3,
    longest: 0.5,
    shortest: 0.0,
    round_off_is_fresh: false,
};

/// How a state is given.
#[derive(Clone, Debug, PartialEq)]
pub enum Initial {
    /// The scene's initial configuration, at rest.
    Scene,
    /// A named operating point, at rest with its input.
    OperatingPoint(String),
    /// Configuration `q` (nd + nk), momentum `p` (nd), velocity of prescribed coordinates `v` (nk).
    Momentum {
        /// Configuration.
        q: Vec<f64>,
        /// Momentum.
        p: Vec<f64>,
        /// Velocity of prescribed coordinates.
        v: Vec<f64>,
    },
    /// Configuration and velocity, both nd + nk: `p = M(q) v`.
    Velocity {
        /// Configuration.
        q: Vec<f64>,
        /// Velocity.
        v: Vec<f64>,
    },
    /// Two configurations one time step apart, no input forces: `p = D2 Ld(q0, q1) + F⁺`. The plant
    /// starts at the second.
    TwoConfigurations {
        /// One time step earlier.
        q0: Vec<f64>,
        /// At the start.
        q1: Vec<f64>,
    },
    /// The equilibrium that [`Model::settle`] finds from a guess, at rest with its inputs.
    Equilibrium {
        /// The guess.
        q: Vec<f64>,
        /// Coordinates that keep their value.
        hold: Vec<String>,
        /// Constant inputs; none means zero.
        inputs: Vec<f64>,
    },
    /// A guess that Newton's method projects onto the constraints; named coordinates and prescribed
    /// ones keep their value. The plant starts there at rest.
    Projection {
        /// The guess.
        q: Vec<f64>,
        /// Coordinates that keep their value.
        hold: Vec<String>,
    },
}

impl Model {
    /// Equations that the initial configuration violates.
    pub(crate) fn violations_at_start(&self) -> Vec<Violation> {
        if self.dimensions.constraints == 0 {
            return Vec::new();
        }
        let q: Vec<f64> = self.coordinates.iter().map(|c| c.initial).collect();
        let (mut closure, orientations) = (Closure::new(self), orientations(self, &q));
        let violated = closure.violated(self, &q, &orientations);
        let name = |c: usize| self.constraint_names[c].clone();
        violated.map(|(c, value)| Violation { constraint: name(c), value }).collect()
    }
}

impl Plant {
    /// Puts the plant into a state, step 0.
    pub fn initialize(&mut self, initial: &Initial) -> Result<(), InitialError> {
        let state = self.state_of(initial)?;
        let is_of_scene = match initial {
            Initial::Scene => true,
            Initial::OperatingPoint(name) => name == "initial",
            _ => false,
        };
        self.check_constraints(&state.q).map_err(|error| match error {
            InitialError::OffConstraint { constraint, violation } if is_of_scene => {
                InitialError::SceneIsGuess { constraint, violation }
            }
            error => error,
        })?;
        self.state = state;
        self.workspace.forget();
        Ok(())
    }

    fn state_of(&mut self, initial: &Initial) -> Result<PreciseState, InitialError> {
        let d = self.model.dimensions;
        let (n, nd) = (d.coordinates(), d.dynamic);
        let mut state = PreciseState::new(&self.model, self.period.scheme);
        match initial {
            Initial::Scene => {}
            Initial::OperatingPoint(name) => {
                let model = self.model.clone();
                let point = model.operating_points.iter().find(|point| point.name == *name);
                let known = model.operating_points.iter().map(|point| &point.name);
                let point = point.ok_or_else(|| InitialError::Unknown {
                    kind: "operating point",
                    name: UnknownName::among(name, known),
                })?;
                state.p = self.momentum_between(&point.q, &point.q, &point.u[..d.inputs]);
                state.q.copy_from_slice(&point.q);
            }
            Initial::Momentum { q, p, v } => {
                state.q = checked("q", q, n)?;
                state.p = checked("p", p, nd)?;
                state.v = checked("v", v, d.prescribed)?;
            }
            Initial::Velocity { q, v } => {
                state.q = checked("q", q, n)?;
                let v = checked("v", v, n)?;
                state.v.copy_from_slice(&v[nd..]);
                state.orient(&self.model);
                self.workspace.gradient_at(&self.model, &state, &v);
                state.p.copy_from_slice(&self.workspace.mid.l_v);
            }
            Initial::TwoConfigurations { q0, q1 } => {
                let q0 = checked("q0", q0, n)?;
                state.q = checked("q1", q1, n)?;
                state.p = self.momentum_between(&q0, &state.q, &vec![0.0; d.inputs]);
                state.v.copy_from_slice(&self.workspace.mid.velocity[nd..]);
            }
            Initial::Equilibrium { q, hold, inputs } => {
                let (q, hold, inputs) = (q.clone(), hold.clone(), inputs.clone());
                let rest = self.model.settle(&SettleRequest { q, hold, inputs })?;
                state.p = self.momentum_between(&rest.q, &rest.q, &rest.inputs);
                state.q = rest.q;
            }
            Initial::Projection { q, hold } => {
                let guess = checked("q", q, n)?;
                let moves = self
                    .model
                    .free_coordinates(hold)
                    .map_err(|name| InitialError::Unknown { kind: "coordinate", name })?;
                state.q = self.project(guess, &moves)?;
            }
        }
        state.orient(&self.model);
        Ok(state)
    }

    /// Lagrangian and forces at the midpoint of a step from `q0` to `q1`.
    pub(crate) fn evaluate_between(&mut self, q0: &[f64], q1: &[f64], inputs: &[f64]) {
        let (h, workspace) = (self.settings.time_step_s, &mut self.workspace);
        let change = self.model.difference(q0, q1);
        for i in 0..q0.len() {
            workspace.mid.q[i] = q0[i] + 0.5 * change[i];
            workspace.mid.angles[i] = workspace.mid.q[i];
            workspace.mid.velocity[i] = change[i] / h;
        }
        let turns = self.model.orientations.iter().map(|&i| three(&change, i));
        let orientations = orientations(&self.model, q0);
        for (o, turn) in turns.enumerate() {
            workspace.balls.start[o] = orientations[o];
            workspace.turn_by(o, turn);
        }
        workspace.mid.set_inputs(&self.model, inputs);
        workspace.mid.evaluate(&self.model);
    }

    /// `D2 Ld(q0, q1) + F⁺ = L_v + ½h L_q + (1 − a) h f`.
    fn momentum_between(&mut self, q0: &[f64], q1: &[f64], inputs: &[f64]) -> Vec<f64> {
        self.evaluate_between(q0, q1, inputs);
        let workspace = &mut self.workspace;
        let momentum = workspace.momentum_at_end(&self.model, &self.settings);
        workspace.mid.input_force.fill(0.0);
        workspace.mid.force.fill(0.0);
        momentum
    }

    fn check_constraints(&mut self, q: &[f64]) -> Result<(), InitialError> {
        let Workspace { constraints, balls, .. } = &mut self.workspace;
        let (closure, orientations) = (&mut constraints.end, &mut balls.end);
        for (orientation, &i) in orientations.iter_mut().zip(&self.model.orientations) {
            *orientation = Quaternion::exp(three(q, i)).matrix();
        }
        let first = closure.violated(&self.model, q, orientations).next();
        if let Some((c, violation)) = first {
            let constraint = self.model.constraint_names[c].clone();
            return Err(InitialError::OffConstraint { constraint, violation });
        }
        let (model, poses) = (&self.model, &closure.poses);
        for (constraint, name) in model.constraints.iter().zip(&model.constraint_names) {
            if constraint.has_empty_segment(&model.closure, poses) {
                let what = "a segment of its path has no length, and so no direction";
                return Err(InitialError::Degenerate { constraint: name.clone(), what });
            }
        }
        for alignment in &model.alignments {
            if alignment.trace(&model.closure, poses) < ALIGNED {
                let what = "its frames are aligned by other axes than their own; turn one of them";
                let constraint = alignment.name.clone();
                return Err(InitialError::Degenerate { constraint, what });
            }
        }
        Ok(())
    }

    /// The nearest configuration on the constraints, with the shortest corrections
    /// `dq = −Aᵀ (A Aᵀ)⁻¹ h`, `A` the columns that move.
    pub fn project(&self, mut q: Vec<f64>, moves: &[bool]) -> Result<Vec<f64>, InitialError> {
        let model = &self.model;
        let (n, nc) = (q.len(), model.dimensions.constraints);
        let mut closure = Closure::new(model);
        let mut normal = PivotedLu::new(&model.conditioning.weight, 0);
        let correction = |closure: &Closure| {
            let rows: Vec<&[f64]> = closure.jacobian.chunks(n).collect();
            for i in 0..nc {
                for j in 0..nc {
                    normal.matrix[i * nc + j] =
                        (0..n).filter(|k| moves[*k]).map(|k| rows[i][k] * rows[j][k]).sum();
                }
            }
            normal.factor();
            let mut weights = closure.value.clone();
            normal.solve(&mut weights);
            let along = |k: usize| (0..nc).map(|c| rows[c][k] * weights[c]).sum::<f64>();
            Some((0..n).map(|k| -if moves[k] { along(k) } else { 0.0 }).collect())
        };
        match project(model, &mut closure, &mut q, &PROJECTION, correction) {
            (Reached::Satisfied, _) => Ok(q),
            _ => {
                let (constraint, violation) = model.worst_equation(&closure);
                Err(InitialError::Projection { constraint, violation })
            }
        }
    }

    /// Velocity `q̇` (nd + nk) that belongs to the projected momentum (allocates).
    ///
    /// `M q̇ = p − Dhᵀ μ` on the dynamic rows, with `μ` such that `Dh q̇ = 0`.
    pub fn velocity(&mut self) -> Vec<f64> {
        let mut velocity = vec![0.0; self.model.dimensions.coordinates()];
        self.write_velocity(&mut velocity);
        velocity
    }

    /// Writes the velocity that belongs to the projected momentum, nd + nk entries; allocates nothing. Costs
    /// the factorization of a mass matrix, which is O(n) where that of a step is.
    pub fn write_velocity(&mut self, out: &mut [f64]) {
        let Self { workspace, model, settings, state, .. } = self;
        if !workspace.find_velocity_by_recursion(model, settings, state) {
            workspace.find_velocity(model, state);
        }
        let (dynamic, prescribed) = out.split_at_mut(self.workspace.residual.dynamics.len());
        dynamic.copy_from_slice(&self.workspace.residual.dynamics);
        prescribed.copy_from_slice(&self.state.v);
    }

    /// Energy of the state, with the projected momentum. Costs the factorization of a mass matrix;
    /// allocates nothing.
    pub fn energy(&mut self) -> Energy {
        self.workspace.find_velocity(&self.model, &self.state);
        // Prescribed coordinates have their velocity there already.
        let Workspace { mid, residual, .. } = &mut self.workspace;
        mid.velocity[..residual.dynamics.len()].copy_from_slice(&residual.dynamics);
        self.workspace.energy(&self.model, &self.state)
    }

    /// Takes over the state of another plant, of the same coordinates, inputs, constraints and settings, to
    /// the last bit: masses, lengths or gravity change between two steps. Refused, and nothing changed,
    /// where the state violates the constraints of this plant. Allocates nothing.
    pub fn go_on_from(&mut self, other: &Self) -> Result<(), InitialError> {
        let sizes = |plant: &Self| (plant.model.dimensions, plant.model.orientations.len());
        if sizes(self) != sizes(other) || self.settings != other.settings {
            let (expected, actual) = (self.state.q.len(), other.state.q.len());
            return Err(InitialError::Dimension { name: "state", expected, actual });
        }
        self.check_constraints(&other.state.q)?;
        self.state.copy_from(&other.state);
        self.workspace.forget();
        Ok(())
    }

    /// Energy `T(q, v) + V(q)` at any configuration and velocity, both nd + nk, whether they satisfy
    /// the constraints or not (allocates).
    pub fn energy_at(&mut self, q: &[f64], v: &[f64]) -> Result<Energy, InitialError> {
        let n = self.model.dimensions.coordinates();
        let mut state = PreciseState::new(&self.model, self.period.scheme);
        state.q = checked("q", q, n)?;
        state.orient(&self.model);
        self.workspace.mid.velocity.copy_from_slice(&checked("v", v, n)?);
        let energy = self.workspace.energy(&self.model, &state);
        self.workspace.forget();
        Ok(energy)
    }
}

/// So many finite numbers.
pub(crate) fn checked(
    name: &'static str,
    values: &[f64],
    expected: usize,
) -> Result<Vec<f64>, InitialError> {
    if values.len() != expected {
        return Err(InitialError::Dimension { name, expected, actual: values.len() });
    }
    match values.iter().position(|value| !value.is_finite()) {
        Some(index) => Err(InitialError::NotFinite { name, index, value: values[index] }),
        None => Ok(values.to_vec()),
    }
}

impl Workspace {
    /// Energy at the configuration of a state and the velocity that is there.
    fn energy(&mut self, model: &Model, state: &PreciseState) -> Energy {
        self.gradient(model, state);
        let at = (&self.mid.mechanics.poses, &self.mid.mechanics.momenta);
        energy(model, at, &state.q, &self.mid.velocity)
    }

    /// Gradient of the Lagrangian without springs at any configuration and velocity.
    pub(crate) fn gradient_at(&mut self, model: &Model, state: &PreciseState, velocity: &[f64]) {
        self.mid.velocity.copy_from_slice(velocity);
        self.gradient(model, state);
    }

    /// Gradient of the Lagrangian without springs at any configuration, and at the velocity that is there.
    fn gradient(&mut self, model: &Model, state: &PreciseState) {
        self.balls.start_at(&state.orientations);
        self.mid.mechanics.poses.evaluate(&model.dynamics, &state.q, &self.balls.start);
        self.mid.mechanics.momenta.gradient(
            &model.dynamics,
            &self.mid.mechanics.poses,
            &self.mid.velocity,
            model.gravity,
            &mut self.mid.l_q,
            &mut self.mid.l_v,
        );
        model.armature.add_momentum(&self.mid.velocity, &mut self.mid.l_v);
    }

    /// Finds the velocity of the dynamic coordinates that belongs to a state, into `residual`; returns
    /// the reciprocal condition estimate of the mass matrix.
    pub(crate) fn find_velocity(&mut self, model: &Model, state: &PreciseState) -> f64 {
        let d = model.dimensions;
        // With only the prescribed coordinates moving, `L_v` is their share of the momentum.
        self.mid.velocity[..d.dynamic].fill(0.0);
        self.mid.velocity[d.dynamic..].copy_from_slice(&state.v);
        self.gradient(model, state);
        self.mid.mechanics.curvature.evaluate(
            &model.dynamics,
            &self.mid.mechanics.poses,
            &self.mid.mechanics.momenta,
        );
        self.kkt.factored.tree.make_room(&model.elimination);
        self.kkt.factored.tree.clear();
        self.mid.mechanics.curvature.fill_mass_matrix(&model.pairs, &mut self.kkt.factored.tree);
        let matrix = &mut self.kkt.factored.tree;
        model.armature.entries().for_each(|entry| entry.add_to(matrix, model, 1.0));
        let pivot =
            self.kkt.factored.tree.factor(&model.elimination, &model.conditioning.inertia, 1.0);
        for (i, r) in self.residual.dynamics.iter_mut().enumerate() {
            *r = state.p[i] - self.mid.l_v[i];
        }
        self.kkt.factored.tree.solve(&model.elimination, &mut self.residual.dynamics);
        if d.constraints > 0 {
            self.project_velocity(model, state);
        }
        pivot.relative
    }

    /// Takes the part of the velocity away that violates `Dh q̇ = 0`.
    fn project_velocity(&mut self, model: &Model, state: &PreciseState) {
        let n = model.dimensions.coordinates();
        self.prepare_start(model, state);
        let KktSystem { factored: Factored { tree, .. }, schur, .. } = &mut self.kkt;
        schur.respond_by_tree(model, tree, &self.constraints.start);
        schur.factor(model, &self.constraints.start);
        let rows = self.constraints.start.jacobian.chunks(n);
        for (rate, row) in self.residual.constraints.iter_mut().zip(rows) {
            let velocity = self.residual.dynamics.iter().chain(&state.v);
            *rate = row.iter().zip(velocity).map(|(entry, v)| entry * v).sum();
        }
        schur.lu.solve(&mut self.residual.constraints);
        schur.subtract_responses(&self.residual.constraints, &mut self.residual.dynamics);
    }
}

/// Why a state was refused. The plant is as it was.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum InitialError {
    /// A vector has the wrong length.
    #[error("{name} has {actual} entries; {expected} are needed")]
    Dimension {
        /// Which vector.
        name: &'static str,
        /// Entries it must have.
        expected: usize,
        /// Entries it has.
        actual: usize,
    },
    /// A number is NaN or infinite.
    #[error("{name}[{index}] is {value}")]
    NotFinite {
        /// Which vector.
        name: &'static str,
        /// Index of the entry.
        index: usize,
        /// The entry.
        value: f64,
    },
    /// No operating point or coordinate of that name.
    #[error("there is no {kind} {name}")]
    Unknown {
        /// What was looked for.
        kind: &'static str,
        /// Its name.
        name: UnknownName,
    },
    /// The configuration violates a constraint by more than 1e-6 relative.
    #[error("constraint `{constraint}` is violated by {violation:e}")]
    OffConstraint {
        /// Name of the constraint equation.
        constraint: String,
        /// Its value `h(q)`.
        violation: f64,
    },
    /// The scene's initial configuration violates a constraint by more than that.
    #[error(
        "the scene's initial configuration is only a guess: it violates constraint `{constraint}` by {violation:e}; start at a configuration that satisfies the constraints, which a projection or settling finds"
    )]
    SceneIsGuess {
        /// Name of the constraint equation.
        constraint: String,
        /// Its value `h(q)`.
        violation: f64,
    },
    /// The configuration satisfies a constraint in a way in which it must not be used.
    #[error("constraint `{constraint}`: {what}")]
    Degenerate {
        /// Name of the constraint.
        constraint: String,
        /// What is wrong.
        what: &'static str,
    },
    /// The projection found no configuration that satisfies the constraints.
    #[error(
        "no configuration found near the guess; constraint `{constraint}` stays violated by {violation:e}"
    )]
    Projection {
        /// Name of the worst constraint equation.
        constraint: String,
        /// Its value `h(q)`.
        violation: f64,
    },
    /// No equilibrium was found.
    #[error(transparent)]
    Settle(#[from] SettleError),
    /// A whole number is out of range.
    #[error("{name} is {value}; it must be from {least} to {most}")]
    OutOfRange {
        /// Which setting.
        name: &'static str,
        /// Its value.
        value: u32,
        /// The least allowed.
        least: u32,
        /// The most allowed.
        most: u32,
    },
    /// There is no method of that order for the model and the other settings.
    #[error("order {order} {what}")]
    Order {
        /// The order.
        order: u32,
        /// Why there is none.
        what: &'static str,
    },
    /// A time step or an iteration limit is out of range.
    #[error("{name} is {value}; it must be finite and greater than zero")]
    Settings {
        /// Which setting.
        name: &'static str,
        /// Its value.
        value: f64,
    },
}

impl Settings {
    /// Checks every setting; finds the method that has the order for the model.
    pub(crate) fn check(&self, model: &Model) -> Result<Scheme, InitialError> {
        for (name, value) in [
            ("time_step_s", self.time_step_s),
            ("max_iterations", f64::from(self.max_iterations)),
            ("singular_below", self.singular_below),
        ] {
            if !(value.is_finite() && value > 0.0) {
                return Err(InitialError::Settings { name, value });
            }
        }
        let within = |name, value: u32, least: u32, most: u32| {
            if (least..=most).contains(&value) {
                Ok(())
            } else {
                Err(InitialError::OutOfRange { name, value, least, most })
            }
        };
        within("substeps", self.substeps, 1, SUBSTEPS_MAX)?;
        within("halvings", self.halvings, 0, HALVINGS_MAX)?;
        let order = |what| Err(InitialError::Order { order: self.order, what });
        let scheme = Scheme::of_order(self.order).or_else(order)?;
        if scheme != Scheme::Midpoint && self.force_split == ForceSplit::Paper {
            return order("needs the symmetric force split");
        }
        if model.turns_prescribed() && (self.substeps > 1 || scheme != Scheme::Midpoint) {
            return order(
                "and one substep alone are there for prescribed ball joints; use order 2",
            );
        }
        Ok(scheme)
    }
}
