//! Springs of a scene, resolved.

use crate::compile::scene::{Layout, Places};
use crate::math::spline::Spline;
use crate::model::mechanism::{
    CoordinateSpring, LinearSpring, PathSpring, PointSpring, Potentials, SplineSpring, Spring,
};
use crate::model::tree::Tree;
use crate::scene;
use crate::scene::Scene;
use crate::scene::linear_term::LinearTerm;

impl Layout {
    pub(super) fn potentials(&self, scene: &Scene, tree: &Tree, index: &[usize]) -> Potentials {
        let places = Places { layout: self, tree, index };
        let mut springs: Vec<Spring> =
            scene.springs.iter().filter_map(|spring| self.spring(spring, &places)).collect();
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
            scene::Spring::Stop { .. } => return None,
            scene::Spring::Path { points, stiffness, rest_length } => Spring::Path(PathSpring {
                segments: places.segments(points),
                stiffness: *stiffness,
                rest_length: *rest_length,
            }),
            scene::Spring::LinearSpring { terms, stiffness, rest } => {
                Spring::Linear(LinearSpring {
                    terms: self.linear(terms),
                    stiffness: *stiffness,
                    rest: *rest,
                })
            }
        })
    }

    /// Coordinates and factors of a sum.
    pub(super) fn linear(&self, terms: &[LinearTerm]) -> Vec<(usize, f64)> {
        terms.iter().map(|term| (self.index[&term.coordinate], term.coefficient)).collect()
    }
}
