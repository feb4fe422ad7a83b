//! Forces along a path: of inputs, of a damper, of the damper of a stop, and of dry friction.
//!
//! ```text
//! f_i = T L_i,  T = Σ g_k u_k − c(L) L̇,  L̇ = Σ L_k v_k
//! or, with friction, T = Σ g_k u_k − force tanh(L̇ / velocity), and c is its slope:
//! ∂f_i/∂q_j = T L_ij − L_i (c' L̇ L_j + c Σ_k L_kj v_k)    ∂f_i/∂v_j = −c L_i L_j    ∂f_i/∂u_k = g_k L_i
//! ```
//!
//! with `L` the sum of the lengths of the path's segments.

use plantd_math::scalar::Scalar;
use plantd_math::spatial::{Force, Vec3};

use crate::lagrangian::fields::{Field, Take, at_point, change_at_point};
use crate::lagrangian::forces::GeneralizedForce;
use crate::lagrangian::forces::linear_damper::{FRICTION_CURVE, friction};
use crate::lagrangian::instant::Instant;
use crate::lagrangian::ties::{Tie, Ties, tied_rows};
use crate::lagrangian::vectors::{Distance, moving_ends, steepness_of};
use crate::model::mechanism::{PathForce, PointPair, Resistance, Span, span};

/// A path in motion.
struct Moving<S> {
    /// `L̇`; nobody asks for that of a path without resistance.
    rate: S,
    /// `c` and `c'`.
    resistance: (S, S),
    /// `T`.
    tension: S,
}

impl PathForce {
    /// Its segments.
    fn segments<'a, S: Scalar>(
        &'a self,
        at: &Instant<'a, S>,
    ) -> impl Iterator<Item = Distance<'a, S>> + use<'a, S> {
        let (tree, poses) = (at.tree, at.poses);
        self.segments.iter().map(move |ends| Distance::new(ends, tree, poses))
    }

    fn moving<S: Scalar>(&self, at: &Instant<'_, S>) -> Moving<S> {
        let driven = self.inputs.iter().fold(S::ZERO, |sum, &(k, g)| sum + at.inputs[k] * g);
        if !self.resists() {
            return Moving { rate: S::ZERO, resistance: (S::ZERO, S::ZERO), tension: driven };
        }
        let (mut length, mut rate) = (S::ZERO, S::ZERO);
        for segment in self.segments(at) {
            length += segment.length;
            segment.for_each_derivative(|i, slope| rate += slope * at.velocity[i]);
        }
        let viscous = |resistance: (S, S)| (resistance.0 * rate, resistance);
        let (held, resistance) = match self.resistance {
            Resistance::Constant(c) => viscous((S::constant(c), S::ZERO)),
            Resistance::Stop(stop) => viscous(stop.resistance(length)),
            Resistance::Friction { force, velocity } => {
                let (held, slope) = friction(force, velocity, rate);
                (held, (slope, S::ZERO))
            }
        };
        Moving { rate, resistance, tension: driven - held }
    }

    /// Whether its tension changes with the length, or its rate.
    fn resists(&self) -> bool {
        !matches!(self.resistance, Resistance::Constant(0.0))
    }
}

/// Bounds of `|L̇|`, and of its first two derivatives along changes of coordinates and velocities.
#[derive(Clone, Copy, Debug)]
pub(super) struct RateBounds {
    pub(super) rate: f64,
    pub(super) faster: f64,
    pub(super) jerk: f64,
}

impl RateBounds {
    /// Of a path whose length is as steep as that.
    pub(super) fn new(
        segments: &[PointPair],
        [first, second, third]: [f64; 3],
        at: &Instant<'_>,
        [moved, faster]: [f64; 2],
    ) -> Self {
        let coordinates = segments.iter().flat_map(PointPair::coordinates);
        let speed: f64 = coordinates.map(|i| at.velocity[i].abs()).sum();
        Self {
            rate: first * speed,
            faster: moved * second * speed + faster * first,
            jerk: moved * (moved * third * speed + 2.0 * faster * second),
        }
    }
}

/// A bound of the second derivative of `T L_i`, of those of the length and of `T`, `T'` and `T''`.
pub(super) fn along(
    [first, second, third]: [f64; 3],
    [tension, change, curve]: [f64; 3],
    moved: f64,
) -> f64 {
    curve * first + moved * (2.0 * change * second + moved * tension * third)
}

impl Field for PathForce {
    fn span(&self) -> Option<Span> {
        span(&self.segments)
    }

    fn has_rates(&self) -> bool {
        self.resists()
    }

    fn exert(&self, at: &Instant<'_>, take: Take<'_>) {
        let Moving { rate, resistance: (c, by_length), tension } = self.moving(at);
        let ends = || moving_ends(&self.segments, at.tree, at.poses);
        // `L' = J · unit` and `L̇' = J̇ · unit + J · turned`.
        let (mut unit, mut turned) = (Force::default(), Force::default());
        for end in ends() {
            let velocity = at.twist(end.of).at(end.point);
            let relative = velocity - at.twist(end.base).at(end.base_point);
            let carried = Force { n: velocity.cross(end.along), f: Vec3::ZERO };
            unit = unit.plus(at_point(end.point, end.along));
            turned = turned.plus(at_point(end.point, end.turned(relative))).plus(carried);
        }
        for end in ends() {
            let force = end.along * tension;
            take(at_point(end.point, force), &|axis, axis_rate| {
                let moved = axis.at(end.point);
                let faster = axis_rate.dot(unit) + axis.dot(turned);
                let slacker = by_length * rate * axis.dot(unit) + c * faster;
                let changed = end.turned(moved) * tension - end.along * slacker;
                change_at_point([end.point, force], [moved, changed])
            });
        }
    }
}

impl Tie for PathForce {
    fn segments(&self) -> &[PointPair] {
        &self.segments
    }

    fn rows(&self) -> usize {
        tied_rows(&self.segments)
    }

    fn tie(&self, at: &Instant<'_>, out: &mut Ties) {
        let Moving { rate, resistance: (c, by_length), tension } = self.moving(at);
        let row = out.begin_row();
        for ends in &self.segments {
            let change =
                |longer: f64, faster: f64| [-(by_length * rate * longer + c * faster), -c * longer];
            out.add_segment(row, ends, at, tension, change);
        }
    }
}

impl GeneralizedForce for PathForce {
    fn couples(&self) -> Vec<usize> {
        self.segments.iter().flat_map(PointPair::coordinates).collect()
    }

    fn add<S: Scalar>(&self, at: &Instant<'_, S>, force: &mut [S]) {
        let tension = self.moving(at).tension;
        for segment in self.segments(at) {
            segment.for_each_derivative(|i, slope| {
                if let Some(entry) = force.get_mut(i) {
                    *entry += tension * slope;
                }
            });
        }
    }

    fn for_each_derivative<S: Scalar>(
        &self,
        at: &Instant<'_, S>,
        entry: &mut impl FnMut(usize, usize, S, S),
    ) {
        let Moving { rate, resistance: (c, by_length), tension } = self.moving(at);
        for segment in self.segments(at) {
            segment.for_each_second_derivative(|i, j, l_ij| entry(i, j, tension * l_ij, S::ZERO));
            if !self.resists() {
                continue;
            }
            segment.for_each_derivative(|i, l_i| {
                for other in self.segments(at) {
                    other.for_each_derivative(|j, l_j| {
                        let product = l_i * l_j;
                        entry(i, j, -(by_length * rate * product), -(c * product));
                    });
                    other.for_each_second_derivative(|k, j, l_kj| {
                        entry(i, j, -(c * l_i * l_kj * at.velocity[k]), S::ZERO);
                    });
                }
            });
        }
    }

    fn second_derivative(&self, at: &Instant<'_>, extent: [f64; 2]) -> f64 {
        let (length, [first, second, third]) = steepness_of(self.segments(at));
        let motion = RateBounds::new(&self.segments, [first, second, third], at, extent);
        let RateBounds { rate, faster, jerk } = motion;
        let driven = self.inputs.iter().map(|&(k, g)| at.inputs[k] * g).sum::<f64>().abs();
        let longer = first * extent[0];
        let [held, change, curve] = match self.resistance {
            Resistance::Constant(c) => [c * rate, c * faster, c * jerk],
            Resistance::Friction { force, velocity } => {
                let slope = force / velocity;
                let bent = FRICTION_CURVE * faster * faster / velocity;
                [force, slope * faster, slope * (jerk + bent)]
            }
            Resistance::Stop(stop) => {
                let [share, rising, bent] = stop.steepness(length).map(|w| w * stop.damping);
                let curved = bent * longer * longer + rising * second * extent[0].powi(2);
                let change = rising * longer * rate + share * faster;
                let curve = curved * rate + 2.0 * rising * longer * faster + share * jerk;
                [share * rate, change, curve]
            }
        };
        along([first, second, third], [driven + held, change, curve], extent[0])
    }

    fn for_each_input_derivative<S: Scalar>(
        &self,
        at: &Instant<'_, S>,
        entry: &mut impl FnMut(usize, usize, S),
    ) {
        for &(k, gain) in &self.inputs {
            for segment in self.segments(at) {
                segment.for_each_derivative(|i, slope| entry(i, k, slope * gain));
            }
        }
    }
}
