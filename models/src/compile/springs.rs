//! Springs of a scene, resolved.

use plantd_math::spline::Spline;
use plantd_scene as scene;
use plantd_scene::{LinearTerm, Scene};

use crate::compile::scene::{Layout, Places, rotation};
use crate::model::mechanism::{
    CoordinateSpring, CoordinateStop, LinearSpring, OrientationSpring, PathLaw, PathSpring,
    PointSpring, Potentials, SplineSpring, Spring, Stop,
};
use crate::model::tree::Tree;

/// Depth of a stop at which its stiffness is whole, of its range, if the scene does not say.
const DEFAULT_TRANSITION: f64 = 0.01;

impl Layout {
    pub(super) fn potentials(&self, scene: &Scene, tree: &Tree, index: &[usize]) -> Potentials {
        let places = Places { layout: self, tree, index };
        let mut springs: Vec<Spring> =
            scene.springs.iter().filter_map(|spring| self.spring(spring, &places)).collect();
        springs.extend(scene.forces.iter().filter_map(|force| self.spring_of_servo(force)));
        springs.sort_by_key(Spring::kind);
        Potentials {
            any: !springs.is_empty(),
            couple_branches: springs.iter().any(Spring::couples_branches),
            springs,
        }
    }

    /// `None` for knots that determine no spline, which validation has refused.
    fn spring(&self, spring: &scene::Spring, places: &Places<'_>) -> Option<Spring> {
        Some(match spring {
            scene::Spring::TwoPoint { a, b, stiffness, rest_length } => {
                Spring::Point(PointSpring {
                    ends: places.between(self.attachment(a), self.attachment(b)),
                    stiffness: *stiffness,
                    rest_length: *rest_length,
                })
            }
            scene::Spring::Coordinate { coordinate, stiffness, rest } => {
                Spring::Coordinate(CoordinateSpring {
                    coordinate: self.index[coordinate],
                    stiffness: *stiffness,
                    rest: *rest,
                })
            }
            scene::Spring::Spline { coordinate, knots } => Spring::Spline(SplineSpring {
                coordinate: self.index[coordinate],
                force: Spline::new(knots)?,
            }),
            scene::Spring::Stop { coordinate, points, .. } => {
                let stop = self.stop(spring)?;
                match coordinate {
                    Some(name) => {
                        Spring::Stop(CoordinateStop { coordinate: self.index[name], stop })
                    }
                    None => Spring::Path(PathSpring {
                        segments: places.segments(points),
                        law: PathLaw::Stop(stop),
                    }),
                }
            }
            scene::Spring::Path { points, stiffness, rest_length } => Spring::Path(PathSpring {
                segments: places.segments(points),
                law: PathLaw::Spring { stiffness: *stiffness, rest_length: *rest_length },
            }),
            scene::Spring::LinearSpring { terms, stiffness, rest } => {
                Spring::Linear(LinearSpring {
                    terms: self.linear(terms),
                    stiffness: *stiffness,
                    rest: *rest,
                })
            }
            scene::Spring::Orientation { frame, stiffness, rest } => {
                let joint = places.index[self.frames[frame].joint - 2];
                Spring::Orientation(OrientationSpring {
                    joint,
                    coordinate: places.tree.joints[joint].coordinate,
                    stiffness: *stiffness,
                    back: rotation(rest.as_ref()).transpose(),
                })
            }
        })
    }

    /// What a stop of the scene says; `None` if it is none.
    pub(super) fn stop(&self, spring: &scene::Spring) -> Option<Stop> {
        let scene::Spring::Stop { coordinate, range, stiffness, damping, transition, .. } = spring
        else {
            return None;
        };
        let limits = || self.coordinates[self.index[coordinate.as_ref()?]].limits;
        let range = range.or_else(limits)?;
        Some(Stop {
            range,
            stiffness: stiffness.unwrap_or_default(),
            damping: damping.unwrap_or_default(),
            transition: transition.unwrap_or(DEFAULT_TRANSITION * (range[1] - range[0])),
        })
    }

    /// The spring `½ stiffness s²` of a servo.
    fn spring_of_servo(&self, force: &scene::Force) -> Option<Spring> {
        let scene::Force::Servo { coordinate, terms, stiffness, .. } = force else { return None };
        let (stiffness, rest) = (*stiffness, 0.0);
        (stiffness > 0.0).then(|| match coordinate {
            Some(name) => Spring::Coordinate(CoordinateSpring {
                coordinate: self.index[name],
                stiffness,
                rest,
            }),
            None => Spring::Linear(LinearSpring { terms: self.linear(terms), stiffness, rest }),
        })
    }

    /// Coordinates and factors of a sum.
    pub(super) fn linear(&self, terms: &[LinearTerm]) -> Vec<(usize, f64)> {
        terms.iter().map(|term| (self.index[&term.coordinate], term.coefficient)).collect()
    }
}
