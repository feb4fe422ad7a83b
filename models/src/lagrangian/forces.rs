//! Forces that do not come from a potential.
//!
//! Inputs and damping of coordinates are `f = B u − C v`. All others are generalized forces
//! `f(q, v, u)` of points, joints and coordinates, with their derivatives.

pub(crate) mod coordinate;
pub(crate) mod linear_damper;
pub(crate) mod path;
pub(crate) mod point;
#[cfg(test)]
mod tests;
pub(crate) mod wrench;

use plantd_math::scalar::Scalar;

use crate::lagrangian::instant::Instant;
use crate::model::mechanism::{CoordinateInput, Forces, Mover, mover};

/// Writes the input forces of a step; they do not change within it.
#[inline(never)]
pub(crate) fn input_forces<S: Scalar>(inputs: &[CoordinateInput], u: &[S], force: &mut [S]) {
    input_forces_here(inputs, u, force);
}

/// The same in the code of the caller.
#[inline(always)]
pub(crate) fn input_forces_here<S: Scalar>(inputs: &[CoordinateInput], u: &[S], force: &mut [S]) {
    let (mut next, mut inputs) = (0, inputs.iter().peekable());
    // Most act on a coordinate of their own, one after the other: what is written is not read again.
    while let Some(input) = inputs.next_if(|input| input.coordinate >= next) {
        force[next..input.coordinate].fill(S::ZERO);
        force[input.coordinate] = S::ZERO + u[input.input] * input.gain;
        next = input.coordinate + 1;
    }
    force[next..].fill(S::ZERO);
    for input in inputs {
        force[input.coordinate] += u[input.input] * input.gain;
    }
}

/// `input − c v` of a coordinate.
#[inline(always)]
pub(crate) fn damped<S: Scalar>(input: S, v: S, c: f64) -> S {
    input - v * c
}

/// Writes `total = input − C v`.
#[inline(never)]
pub(crate) fn add_damping<S: Scalar>(
    damping: &[f64],
    velocity: &[S],
    input: &[S],
    total: &mut [S],
) {
    for (((total, input), c), v) in total.iter_mut().zip(input).zip(damping).zip(velocity) {
        *total = damped(*input, *v, *c);
    }
}

/// A generalized force `f(q, v, u)`.
pub(crate) trait GeneralizedForce {
    /// The coordinates that its derivatives couple with each other; those of joints on one path to the root
    /// are coupled anyway, and may be left out.
    fn couples(&self) -> Vec<usize>;

    /// Adds it to `force` (dynamic coordinates).
    fn add<S: Scalar>(&self, at: &Instant<'_, S>, force: &mut [S]);

    /// Calls `entry(i, j, ∂f_i/∂q_j, ∂f_i/∂v_j)` for ordered pairs of coordinates, some of them more
    /// than once; the derivatives add up.
    fn for_each_derivative<S: Scalar>(
        &self,
        at: &Instant<'_, S>,
        entry: &mut impl FnMut(usize, usize, S, S),
    );

    /// A bound of the second derivative of `f_i` along changes of coordinates and of their velocities whose magnitudes
    /// sum up to `extent`, near an instant.
    fn second_derivative(&self, at: &Instant<'_>, extent: [f64; 2]) -> f64;

    /// Calls `entry(i, k, ∂f_i/∂u_k)` for coordinates and inputs, in the same order for every
    /// configuration; the derivatives add up. Most forces follow no input.
    fn for_each_input_derivative<S: Scalar>(
        &self,
        at: &Instant<'_, S>,
        entry: &mut impl FnMut(usize, usize, S),
    ) {
        let _ = (at, entry);
    }
}

/// The same expression of each force of each kind.
macro_rules! for_each_force {
    ($forces:expr, $force:ident => $value:expr) => {
        let Forces { wrenches, point_forces, coordinate_forces, linear_dampers, path_forces } =
            $forces;
        wrenches.iter().for_each(|$force| $value);
        point_forces.iter().for_each(|$force| $value);
        coordinate_forces.iter().for_each(|$force| $value);
        linear_dampers.iter().for_each(|$force| $value);
        path_forces.iter().for_each(|$force| $value);
    };
}

impl Forces {
    /// For each force, the coordinates that it couples with each other.
    pub(crate) fn couples(&self) -> Vec<Vec<usize>> {
        let mut all = Vec::new();
        for_each_force!(self, force => all.push(force.couples()));
        all
    }

    /// Whether some may couple coordinates that are not on one path to the root.
    pub(crate) fn couple_branches(&self) -> bool {
        self.couples().iter().any(|coordinates| coordinates.len() > 1)
    }

    /// Adds the generalized force to `force` (dynamic coordinates).
    #[inline(never)]
    pub(crate) fn add<S: Scalar>(&self, at: &Instant<'_, S>, force: &mut [S]) {
        for_each_force!(self, element => element.add(at, force));
    }

    /// Calls `entry(i, ∂f_i/∂q_i, ∂f_i/∂v_i)` for the forces on single coordinates, and those across one joint that is
    /// no ball joint.
    pub(crate) fn for_each_own_derivative<S: Scalar>(
        &self,
        at: &Instant<'_, S>,
        mut entry: impl FnMut(usize, S, S),
    ) {
        for force in self.coordinate_forces.iter().filter(|force| force.ball.is_none()) {
            force.for_each_derivative(at, &mut |i, _, by_q, by_v| entry(i, by_q, by_v));
        }
        self.for_each_derivative_across(at, |mover, i, _, by_q, by_v| {
            if let Mover::Axis(_) = mover {
                entry(i, by_q, by_v);
            }
        });
    }

    /// Calls `entry(joint, i, j, ∂f_i/∂q_j, ∂f_i/∂v_j)` for the forces between points that one joint alone moves.
    pub(crate) fn for_each_derivative_across<S: Scalar>(
        &self,
        at: &Instant<'_, S>,
        mut entry: impl FnMut(Mover, usize, usize, S, S),
    ) {
        for force in &self.point_forces {
            if let Some(joint) = force.ends.mover {
                force.for_each_derivative(at, &mut |i, j, q, v| entry(joint, i, j, q, v));
            }
        }
        for force in &self.path_forces {
            if let Some(joint) = mover(&force.segments) {
                force.for_each_derivative(at, &mut |i, j, q, v| entry(joint, i, j, q, v));
            }
        }
    }

    /// Calls `entry(orientation, component, ∂f/∂v)` for the forces on components of the velocities of ball joints.
    pub(crate) fn for_each_derivative_of_balls(
        &self,
        at: &Instant<'_>,
        mut entry: impl FnMut(usize, usize, f64),
    ) {
        for force in &self.coordinate_forces {
            if let Some((orientation, component)) = force.ball {
                force.for_each_derivative(at, &mut |_, _, _, by_v| {
                    entry(orientation, component, by_v);
                });
            }
        }
    }

    /// The sum of [`GeneralizedForce::second_derivative`] over all forces.
    pub(crate) fn second_derivative(&self, at: &Instant<'_>, extent: [f64; 2]) -> f64 {
        let mut sum = 0.0;
        for_each_force!(self, force => sum += force.second_derivative(at, extent));
        sum
    }

    /// [`GeneralizedForce::for_each_derivative`] of each force.
    #[inline(never)]
    pub(crate) fn for_each_derivative<S: Scalar>(
        &self,
        at: &Instant<'_, S>,
        mut entry: impl FnMut(usize, usize, S, S),
    ) {
        for_each_force!(self, force => force.for_each_derivative(at, &mut entry));
    }

    /// [`GeneralizedForce::for_each_input_derivative`] of each force.
    #[inline(never)]
    pub(crate) fn for_each_input_derivative<S: Scalar>(
        &self,
        at: &Instant<'_, S>,
        mut entry: impl FnMut(usize, usize, S),
    ) {
        for_each_force!(self, force => force.for_each_input_derivative(at, &mut entry));
    }
}
