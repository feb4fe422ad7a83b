//! Equalities as constraints.

use nalgebra::{Isometry3, Point3, Quaternion, Translation3, UnitQuaternion, Vector3};
use plantd_models::scene::{Axis, Constraint, CouplingTerm, Length, Point};
use roxmltree::Node;

use crate::mjcf::build::Build;
use crate::mjcf::frames::frame_at;
use crate::mjcf::settings::TINY;
use crate::mjcf::tendons::{Course, Tendons};
use crate::names::Names;
use crate::report::Kind;

/// A place that a constraint holds: a body, none for the world, and a pose in it.
type Place = (Option<usize>, Isometry3<f64>);

impl<'a> Build<'_, 'a, '_> {
    pub(super) fn constrain(&mut self, tendons: &Tendons<'a>) {
        let mut names = Names::new("constraint", &[]);
        for (node, ending) in self.elements("equality") {
            self.ending = ending;
            let settings = self.classes.settings(
                self.reader,
                node,
                self.classes.root(self.reader, node),
                "equality",
            );
            let is_active = settings.keyword(self.reader, "active", &["false", "true"]) != Some(0);
            if !is_active || !self.physics.has("equality") {
                self.reader.note(Kind::NoEffect, node, "an equality that is switched off");
                continue;
            }
            let tag = node.tag_name().name();
            let own = self.name_of(node, "");
            let mut name =
                |default: &str| names.add(if own.is_empty() { default } else { &own }, &[""]);
            let constraint =
                match tag {
                    "connect" => self.connect(node).map(|(a, b)| Constraint::PointToPoint {
                        name: name(tag),
                        a,
                        b,
                        axes: vec![Axis::X, Axis::Y, Axis::Z],
                    }),
                    "weld" => {
                        let name = name(tag);
                        self.weld(node, &name)
                    }
                    "joint" => self.couple_joints(node).map(|(terms, constant)| {
                        Constraint::Coupling { name: name(tag), terms, constant }
                    }),
                    "tendon" => {
                        let name = name(tag);
                        self.couple_tendons(node, name, tendons)
                    }
                    _ => continue,
                };
            if let Some(constraint) = constraint {
                self.reader.exact("equality as a constraint");
                let message = "an equality holds exactly here; in MuJoCo it is a stiff spring";
                self.reader.note(Kind::Approximated, node, message);
                self.draft.scene.constraints.push(constraint);
            }
        }
        self.ending.clear();
        self.draft.changed.append(&mut names.changed);
    }

    fn connect(&mut self, node: Node<'a, 'a>) -> Option<(Point, Point)> {
        let place =
            |(body, pose): Place, build: &Self| build.point(body, pose.translation.vector.into());
        if node.has_attribute("site1") || node.has_attribute("site2") {
            let [a, b] = [self.at_site(node, "site1")?, self.at_site(node, "site2")?];
            return Some((place(a, self), place(b, self)));
        }
        let [a, b] = [self.at_body(node, "body1")?, self.at_body(node, "body2")?];
        self.reader.required(node, "anchor");
        let anchor = Point3::from(self.reader.vector_or(node, "anchor", [0.0; 3]));
        let other = self.home(b).inverse() * self.home(a) * anchor;
        Some((self.point(a, anchor.coords.into()), self.point(b, other.coords.into())))
    }

    /// What `body1` or `body2` names; the latter is the world if not given.
    fn at_body(&mut self, node: Node<'a, 'a>, which: &str) -> Option<Option<usize>> {
        if which == "body2" && !node.has_attribute(which) {
            return Some(None);
        }
        self.find(node, which, "body", |build, name| match name {
            "world" => Some(None),
            _ => build.tree.body(name).map(Some),
        })
    }

    fn at_site(&mut self, node: Node<'a, 'a>, which: &str) -> Option<Place> {
        self.find(node, which, "site", |build, name| {
            build.tree.site(name).map(|site| (site.body, site.pose))
        })
    }

    fn weld(&mut self, node: Node<'a, 'a>, name: &str) -> Option<Constraint> {
        let [a, b]: [Place; 2] = if node.has_attribute("site1") || node.has_attribute("site2") {
            [self.at_site(node, "site1")?, self.at_site(node, "site2")?]
        } else {
            let [a, b] = [self.at_body(node, "body1")?, self.at_body(node, "body2")?];
            let anchor = Translation3::from(self.reader.vector_or(node, "anchor", [0.0; 3]));
            let given = self.reader.vector_or::<7>(node, "relpose", [0.0; 7]);
            let [x, y, z, w, i, j, k] = given;
            let turn = UnitQuaternion::try_new(Quaternion::new(w, i, j, k), TINY);
            let anchored = Isometry3::from(anchor);
            let first = match turn {
                Some(turn) => Isometry3::from_parts(Vector3::new(x, y, z).into(), turn),
                None => self.home(a).inverse() * self.home(b) * anchored,
            };
            [(a, first), (b, anchored)]
        };
        if self.reader.number_or(node, "torquescale", 1.0) == 0.0 {
            let [a, b] =
                [a, b].map(|(body, pose)| self.point(body, pose.translation.vector.into()));
            let axes = vec![Axis::X, Axis::Y, Axis::Z];
            return Some(Constraint::PointToPoint { name: name.to_owned(), a, b, axes });
        }
        let [a, b] = [(a, "a"), (b, "b")].map(|((body, pose), end)| {
            let parent = self.frame(body);
            if pose == Isometry3::identity() {
                return parent;
            }
            self.draft.frame(&format!("{name}_{end}"), frame_at(&parent, &pose))
        });
        Some(Constraint::Weld { name: name.to_owned(), a, b })
    }

    /// `q₁ − ref₁ = Σ c_k (q₂ − ref₂)^k`, or `= c₀` where there is one joint.
    fn couple_joints(&mut self, node: Node<'a, 'a>) -> Option<(Vec<CouplingTerm>, f64)> {
        let polynomial = self.polynomial(node);
        let first = self.single(node, "joint1")?;
        let reference = self.tree.joints[first].reference;
        let own = CouplingTerm {
            coordinate: self.coordinates[first][0].clone(),
            coefficients: vec![1.0],
        };
        if !node.has_attribute("joint2") {
            return Some((vec![own], -reference - polynomial[0]));
        }
        let second = self.single(node, "joint2")?;
        let expanded = shifted(polynomial, self.tree.joints[second].reference);
        let mut coefficients: Vec<f64> = expanded[1..].iter().map(|c| -c).collect();
        while coefficients.last() == Some(&0.0) {
            coefficients.pop();
        }
        let mut terms = vec![own];
        if !coefficients.is_empty() {
            let coordinate = self.coordinates[second][0].clone();
            terms.push(CouplingTerm { coordinate, coefficients });
        }
        Some((terms, -reference - expanded[0]))
    }

    fn polynomial(&mut self, node: Node<'a, 'a>) -> [f64; 5] {
        let mut polynomial = [0.0, 1.0, 0.0, 0.0, 0.0];
        if let Some(text) = node.attribute("polycoef") {
            self.reader.first_numbers(node, "polycoef", text, &mut polynomial);
        }
        polynomial
    }

    fn single(&mut self, node: Node<'a, 'a>, which: &str) -> Option<usize> {
        let joint = self.find(node, which, "joint", |build, name| build.tree.joint(name))?;
        let is_single = self.tree.joints[joint].kind.is_single();
        if !is_single {
            self.reader.fail(node, format!("`{which}` of `joint` must be a hinge or a slide"));
        }
        is_single.then_some(joint)
    }

    /// `L₁ − L₁₀ = Σ c_k (L₂ − L₂₀)^k` with the lengths in the configuration of the file.
    fn couple_tendons(
        &mut self,
        node: Node<'a, 'a>,
        name: String,
        tendons: &Tendons<'a>,
    ) -> Option<Constraint> {
        let polynomial = self.polynomial(node);
        let course = |build: &mut Self, which: &str| {
            let tendon = build.find(node, which, "tendon", |_, name| tendons.named(name))?;
            tendon.course.as_ref()
        };
        let first = course(self, "tendon1")?;
        let start = self.length_at_home(first);
        let second = match node.has_attribute("tendon2") {
            true => Some(course(self, "tendon2")?),
            false => None,
        };
        let coupling = |term: &crate::mjcf::tendons::Term, factor: f64| CouplingTerm {
            coordinate: term.coordinate.clone(),
            coefficients: vec![term.coefficient * factor],
        };
        match (first, second) {
            (Course::Path(rope), None) => {
                let length = Length::Fixed(rope.path_length(start + polynomial[0]));
                Some(Constraint::PathLength { name, points: rope.points(), length })
            }
            (Course::Sum(terms), None) => {
                let terms = terms.iter().map(|term| coupling(term, 1.0)).collect();
                Some(Constraint::Coupling { name, terms, constant: -start - polynomial[0] })
            }
            (Course::Sum(terms), Some(Course::Sum(others))) if polynomial[2..] == [0.0; 3] => {
                let slope = polynomial[1];
                let mut all: Vec<_> = terms.iter().map(|term| coupling(term, 1.0)).collect();
                for other in others {
                    let mut term = coupling(other, -slope);
                    match all.iter_mut().find(|known| known.coordinate == term.coordinate) {
                        Some(known) => known.coefficients[0] += term.coefficients[0],
                        None => all.push(CouplingTerm {
                            coefficients: std::mem::take(&mut term.coefficients),
                            ..term
                        }),
                    }
                }
                all.retain(|term| term.coefficients[0] != 0.0);
                let constant = -start - polynomial[0] + slope * self.length_at_home(second?);
                Some(Constraint::Coupling { name, terms: all, constant })
            }
            _ => {
                let message =
                    "an equality of two tendons holds here for sums of joints, in proportion";
                self.reader.refuse(node, message);
                None
            }
        }
    }
}

/// The coefficients of `p(x − by)` in powers of `x`.
fn shifted(polynomial: [f64; 5], by: f64) -> [f64; 5] {
    // Horner's scheme: p = p (x − by) + c.
    let mut sum = [0.0; 5];
    for c in polynomial.into_iter().rev() {
        for i in (1..5).rev() {
            sum[i] = sum[i - 1] - by * sum[i];
        }
        sum[0] = c - by * sum[0];
    }
    sum
}

#[cfg(test)]
mod tests {
    use super::shifted;

    #[test]
    fn polynomials_move_along() {
        let polynomial = [0.3, -1.0, 2.0, 0.5, -0.7];
        let value = |c: [f64; 5], x: f64| c.iter().rev().fold(0.0, |sum, c| sum * x + c);
        for x in [-1.3, 0.0, 0.4, 2.0] {
            let (moved, direct) = (value(shifted(polynomial, 0.6), x), value(polynomial, x - 0.6));
            assert!((moved - direct).abs() < 1e-13, "{x}: {moved} {direct}");
        }
    }
}
