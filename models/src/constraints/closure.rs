//! Constraints at one end of a step: values, Jacobian and second derivatives.
//!
//! The equations are those of [`equations`](crate::constraints::equations). Second derivatives are summed up as
//! forces at the points, and couples on the directions, that joints carry.

use plantd_math::norms::larger;
use plantd_math::scalar::{Scalar, in_registers};
use plantd_math::spatial::{Mat3, Vec3, three};

use crate::constraints::bends::{Bend, Bends};
use crate::constraints::in_plane::InPlane;
use crate::lagrangian::kinematics::{Place, Poses};
use crate::lagrangian::vectors::{Distance, ProductAt, across};
use crate::model::mechanism::{
    ConstraintKind, Length, Model, PathJoint, PointDistance, PointPair, Product,
};
use crate::model::tree::{JointKind, Tree};

/// A configuration may violate a constraint by this fraction of the lengths involved.
const TOLERANCE: f64 = 1e-6;

/// What is known at a configuration.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Known {
    /// Values at most.
    Nothing,
    /// Wrenches of loops, too.
    Place,
    /// And the Jacobian.
    All,
}

/// The constraints at a configuration.
#[derive(Clone, Debug)]
pub(crate) struct Closure<S: Scalar = f64> {
    pub(crate) poses: Poses<S>,
    /// Values `h`, one per equation.
    pub(crate) value: Vec<S>,
    /// Round-off of each value: what `h` may be at an exact solution.
    pub(crate) round_off: Vec<S::Magnitude>,
    /// `Dh`, row-major, nc by nd + nk.
    pub(crate) jacobian: Vec<S>,
    /// Change of `h` by round-off of the coordinates, from the last Jacobian.
    coordinate_round_off: Vec<S::Magnitude>,
    /// What pulls at each joint, for second derivatives, and what they are made of.
    pulls: Vec<Pull<S>>,
    torques: Vec<Vec3<S>>,
    /// Of a distance, and of the vectors of a product, by the coordinates on the path between the ends.
    gradients: Vec<(usize, Vec3<S>)>,
    vectors: Vec<(usize, [Vec3<S>; 2])>,
    /// What is at the configuration of the last [`Closure::evaluate`].
    pub(crate) known: Known,
    /// Parts of the Jacobian as they were before they were turned, and where.
    unturned: Vec<(usize, Vec3<S>)>,
    /// In place of the Jacobian, where loops are eliminated in the plane.
    pub(crate) in_plane: Option<Box<InPlane>>,
}

/// `Σ |h_i q_i|`.
#[inline(always)]
fn moved<S: Scalar>(row: &[S], q: &[S]) -> S::Magnitude {
    let ((rows, row), (all, q)) = (row.as_chunks::<4>(), q.as_chunks::<4>());
    let product = |entry: S, q: S| (entry * q).magnitude();
    let mut sums = [S::Magnitude::ZERO; 4];
    for (row, q) in rows.iter().zip(all) {
        for (sum, (entry, q)) in sums.iter_mut().zip(row.iter().zip(q)) {
            *sum += product(*entry, *q);
        }
    }
    let [mut total, mut rest] = [S::Magnitude::ZERO; 2];
    sums.into_iter().for_each(|sum| total += sum);
    row.iter().zip(q).for_each(|(entry, q)| rest += product(*entry, *q));
    total + rest
}

/// A violation in units of its round-off.
#[inline(always)]
pub(crate) fn in_units(h: f64, round_off: f64) -> f64 {
    if h == 0.0 { 0.0 } else { h.abs() / round_off }
}

/// Adds what belongs to two coordinates, both ways, by what belongs to each.
#[inline(always)]
fn add_pairs<S: Scalar, G: Copy>(
    gradients: &[(usize, G)],
    n: usize,
    out: &mut [S],
    value: impl Fn(G, G) -> S,
) {
    for (k, &(i, row)) in gradients.iter().enumerate() {
        for &(j, column) in &gradients[..k] {
            let value = value(row, column);
            out[i * n + j] += value;
            out[j * n + i] += value;
        }
        out[i * n + i] += value(row, row);
    }
}

/// Multipliers as forces `f` at the points `p` that a joint carries. A direction `p` is turned, and not moved: the
/// products count alone.
#[derive(Clone, Copy, Debug)]
struct Pull<S> {
    is_there: bool,
    /// `Σ f`.
    force: Vec3<S>,
    /// `Σ p fᵀ`.
    product: Mat3<S>,
}

impl<S: Scalar> Pull<S> {
    const NONE: Self = Self { is_there: false, force: Vec3::ZERO, product: Mat3::ZERO };

    fn add(&mut self, other: &Self) {
        self.is_there |= other.is_there;
        self.force += other.force;
        for (column, other) in self.product.0.iter_mut().zip(other.product.0) {
            *column += other;
        }
    }
}

impl Closure {
    /// The equations that `q` violates by more than a millionth of the lengths involved, with their values
    /// `h(q)`. Leaves values and Jacobian at `q`.
    pub(crate) fn violated(
        &mut self,
        model: &Model,
        q: &[f64],
        orientations: &[Mat3],
    ) -> impl Iterator<Item = (usize, f64)> {
        self.evaluate(model, q, orientations);
        self.differentiate(model, q);
        // With the round-off of the coordinates, which the Jacobian tells.
        self.evaluate(model, q, orientations);
        let equations = self.value.iter().zip(&self.round_off).enumerate();
        equations.filter_map(|(c, (value, round_off))| {
            let is_satisfied = value.abs() <= round_off / f64::EPSILON * TOLERANCE;
            (!is_satisfied).then_some((c, *value))
        })
    }
}

impl<S: Scalar> Closure<S> {
    pub(crate) fn new(model: &Model) -> Self {
        let nc = model.constraints.len();
        let is_product = |kind: &ConstraintKind| matches!(kind, ConstraintKind::Product(_));
        let has_vectors = model.constraints.iter().any(|constraint| is_product(&constraint.kind));
        Self {
            poses: Poses::new(&model.closure),
            value: vec![S::ZERO; nc],
            round_off: vec![S::Magnitude::ZERO; nc],
            jacobian: vec![S::ZERO; nc * model.dimensions.coordinates()],
            coordinate_round_off: vec![S::Magnitude::ZERO; nc],
            pulls: vec![Pull::NONE; model.closure.joints.len()],
            torques: vec![Vec3::ZERO; model.closure.joints.len()],
            gradients: Vec::with_capacity(model.closure.joints.len()),
            vectors: Vec::with_capacity(if has_vectors { model.closure.joints.len() } else { 0 }),
            known: Known::Nothing,
            unturned: Vec::with_capacity(nc * model.orientations.len()),
            in_plane: model.loops.as_ref().map(|loops| Box::new(InPlane::new(loops))),
        }
    }

    /// Values at `q`, with the orientations of ball joints.
    #[inline(never)]
    pub(crate) fn evaluate(&mut self, model: &Model, q: &[S], orientations: &[Mat3<S>]) {
        self.known = Known::Nothing;
        self.poses.evaluate(&model.closure, q, orientations);
        in_registers!(S, {
            let at = Place { tree: &model.closure, poses: &self.poses, q };
            let mut c = 0;
            while let Some(constraint) = model.constraints.get(c) {
                let together = c..c + constraint.count();
                let magnitude = constraint.value(at, &mut self.value[together.clone()]);
                for c in together.clone() {
                    // Not less than what the smallest numbers are rounded by: some terms may all be zero.
                    self.round_off[c] =
                        magnitude * f64::EPSILON + self.coordinate_round_off[c] + f64::MIN_POSITIVE;
                }
                c = together.end;
            }
        })
    }

    /// Takes over how round-off of the coordinates changes the values, until the next Jacobian.
    pub(crate) fn expect_round_off_of(&mut self, other: &Closure) {
        let pairs = self.coordinate_round_off.iter_mut().zip(&other.coordinate_round_off);
        pairs.for_each(|(own, other)| *own = S::Magnitude::constant(*other));
    }

    /// Jacobian at the configuration of the last [`Closure::evaluate`].
    #[inline(never)]
    pub(crate) fn differentiate(&mut self, model: &Model, q: &[S]) {
        self.unturned.clear();
        in_registers!(S, {
            let n = model.dimensions.coordinates();
            let at = Place { tree: &model.closure, poses: &self.poses, q };
            self.jacobian.fill(S::ZERO);
            let mut c = 0;
            while let Some(constraint) = model.constraints.get(c) {
                constraint.differentiate(at, &mut self.jacobian[c * n..]);
                c += constraint.count();
            }
            let rows = self.jacobian.chunks_exact(n).zip(&mut self.coordinate_round_off);
            for (row, round_off) in rows {
                *round_off = moved(row, q) * f64::EPSILON;
            }
        })
    }

    /// `out_i −= Σ_c Dh[c, i] λ_c` for the dynamic coordinates.
    #[inline(never)]
    pub(crate) fn subtract_impulses(&self, model: &Model, multipliers: &[S], out: &mut [S]) {
        let n = model.dimensions.coordinates();
        for (row, lambda) in self.jacobian.chunks_exact(n.max(1)).zip(multipliers) {
            for (out, entry) in out.iter_mut().zip(row) {
                *out -= *entry * *lambda;
            }
        }
    }

    /// Writes `Σ_c λ_c D²h_c` at `q`, rows and columns over all coordinates, row-major.
    #[inline(never)]
    pub(crate) fn hessian(&mut self, model: &Model, q: &[S], multipliers: &[S], out: &mut [S]) {
        let n = model.dimensions.coordinates();
        out.fill(S::ZERO);
        self.pulls.fill(Pull::NONE);
        let (mut are_pulled, mut c) = (false, 0);
        while let Some(constraint) = model.constraints.get(c) {
            let lambda = multipliers[c];
            match &constraint.kind {
                ConstraintKind::Axis(equation) => {
                    self.pull(model, &equation.points, equation.force(&multipliers[c..]));
                    are_pulled = true;
                }
                ConstraintKind::Distance(PointDistance { points, length })
                    if points.are_apart(&model.closure) =>
                {
                    let twice = lambda * 2.0;
                    let force = self.add_stretch(model, points, twice, out);
                    self.pull(model, points, force);
                    if let Length::Driven(length) = *length {
                        out[length * n + length] -= twice;
                    }
                    are_pulled = true;
                }
                ConstraintKind::Product(product) if product.points.are_apart(&model.closure) => {
                    self.add_mixed(model, product, lambda, out);
                    are_pulled = true;
                }
                _ => {
                    let at = Place { tree: &model.closure, poses: &self.poses, q };
                    constraint.for_each_second_derivative(at, &mut |i, j, value| {
                        out[i * n + j] += lambda * value;
                    });
                }
            }
            c += constraint.count();
        }
        if are_pulled {
            self.add_pulls(&model.closure, n, out);
        }
    }

    /// Takes a force at the first of two points, and its opposite at the other.
    fn pull(&mut self, model: &Model, points: &PointPair, force: Vec3<S>) {
        for (end, force) in [(&points.a, force), (&points.b, -force)] {
            if let Some(pull) = self.pulls.get_mut(end.joint) {
                pull.force += force;
                let (point, _) = self.poses.point(&model.closure, end);
                self.couple(end.joint, point, force);
            }
        }
    }

    /// Takes a couple on a vector that a joint carries: opposite forces at its ends.
    fn couple(&mut self, joint: usize, vector: Vec3<S>, force: Vec3<S>) {
        if let Some(pull) = self.pulls.get_mut(joint) {
            pull.is_there = true;
            for (column, force) in pull.product.0.iter_mut().zip(force.0) {
                *column += vector * force;
            }
        }
    }

    /// Adds `d_i·d_j`, times a factor, by the coordinates between two points; returns `d` times it.
    fn add_stretch(
        &mut self,
        model: &Model,
        points: &PointPair,
        factor: S,
        out: &mut [S],
    ) -> Vec3<S> {
        let (n, tree) = (model.dimensions.coordinates(), &model.closure);
        let at = points.separation(tree, &self.poses);
        self.gradients.clear();
        let gradient = |joint: &PathJoint| joint.gradient(tree, &self.poses, &at);
        let gradients = points.path.iter().map(|joint| (joint.coordinate, gradient(joint)));
        self.gradients.extend(gradients);
        add_pairs(&self.gradients, n, out, |row, column| (row * factor).dot(column));
        at.difference * factor
    }

    /// Adds `u_i·w_j + u_j·w_i`, times a factor, by the coordinates between two vectors, and pulls at them with each
    /// other.
    fn add_mixed(&mut self, model: &Model, product: &Product, factor: S, out: &mut [S]) {
        let (n, tree) = (model.dimensions.coordinates(), &model.closure);
        let at = ProductAt::new(product, tree, &self.poses);
        self.vectors.clear();
        let path = product.points.path.iter();
        self.vectors.extend(path.map(|joint| (joint.coordinate, at.gradients(joint))));
        add_pairs(&self.vectors, n, out, |[row_u, row_w], [u, w]| {
            (row_u * factor).dot(w) + (row_w * factor).dot(u)
        });
        let vectors = [at.u, at.w];
        self.pull_vectors(model, product, vectors, factor);
    }

    /// Pulls at each vector of a product with the other one, times a factor.
    fn pull_vectors(&mut self, model: &Model, product: &Product, [u, w]: [Vec3<S>; 2], factor: S) {
        for (vector, value, force) in [(product.u, u, w * factor), (product.w, w, u * factor)] {
            match product.end(vector) {
                None => self.pull(model, &product.points, force),
                Some(end) => self.couple(end.joint, value, force),
            }
        }
    }

    /// Sums up what pulls at each joint and below it, and finds for each joint `j` what the second derivatives of `Σ f·p`
    /// with joints `i` at or above it are made of. With their axes `w_i`, and the sums over what `j` carries,
    ///
    /// ```text
    /// w_i · Σ ∂p/∂q_j × f      hinge: Σ (w × (p − o)) × f = Σ p fᵀ w − o (F·w) − w (Σ p·f − o·F)
    ///                          slider: w × F      screw: both
    /// ```
    ///
    /// Sliders above turn nothing. The axes of a ball joint turn with it: of two of them, the derivative in row `i`
    /// and column `j` is `w_j · Σ ∂p/∂q_i × f`.
    fn find_torques(&mut self, tree: &Tree) {
        for (j, joint) in tree.joints.iter().enumerate().rev() {
            let pull = self.pulls[j];
            self.torques[j] = Vec3::ZERO;
            if !pull.is_there {
                continue;
            }
            if let Some(parent) = self.pulls.get_mut(joint.parent) {
                parent.add(&pull);
            }
            let (axis, place) = (self.poses.axis(tree, j), self.poses.place(tree, j));
            let [x, y, z] = pull.product.0;
            let along = x[0] + y[1] + z[2] - place.dot(pull.force);
            let of_hinge =
                || pull.product.apply(axis) - place * pull.force.dot(axis) - axis * along;
            self.torques[j] = match joint.kind {
                JointKind::Revolute | JointKind::Ball(_) => of_hinge(),
                JointKind::Prismatic => axis.cross(pull.force),
                JointKind::Screw(pitch) => of_hinge() + axis.cross(pull.force).scaled(pitch),
            };
        }
    }

    /// Adds the second derivatives of `Σ f·p`, O(n·depth) for however many forces.
    fn add_pulls(&mut self, tree: &Tree, n: usize, out: &mut [S]) {
        self.find_torques(tree);
        for (j, joint) in tree.joints.iter().enumerate() {
            if !self.pulls[j].is_there {
                continue;
            }
            let (axis, torque) = (self.poses.axis(tree, j), self.torques[j]);
            let own = joint.coordinate;
            let mut i = j;
            while let Some(above) = tree.joints.get(i) {
                if above.kind != JointKind::Prismatic {
                    let value = self.poses.axis(tree, i).dot(torque);
                    out[own * n + above.coordinate] += value;
                    if i != j {
                        let is_one = tree.one_ball(i, j);
                        let mirrored = if is_one { axis.dot(self.torques[i]) } else { value };
                        out[above.coordinate * n + own] += mirrored;
                    }
                }
                i = above.parent;
            }
        }
    }
}

impl Closure {
    /// Finds `Σ_c λ_c D²h_c` at `q` as products of vectors.
    pub(crate) fn bend(&mut self, model: &Model, q: &[f64], multipliers: &[f64], out: &mut Bends) {
        let tree = &model.closure;
        self.pulls.fill(Pull::NONE);
        out.begin();
        let mut c = 0;
        while let Some(constraint) = model.constraints.get(c) {
            let lambda = multipliers[c];
            match &constraint.kind {
                ConstraintKind::Axis(equation) => {
                    self.pull(model, &equation.points, equation.force(&multipliers[c..]));
                }
                ConstraintKind::Distance(PointDistance { points, .. }) => {
                    let at = points.separation(tree, &self.poses);
                    for axis in Mat3::<f64>::IDENTITY.0 {
                        out.add_separation((tree, &self.poses), (points, &at), axis, 2.0 * lambda);
                    }
                    self.pull(model, points, at.difference * (2.0 * lambda));
                }
                ConstraintKind::PathLength(path) => {
                    for points in &path.segments {
                        let at = points.separation(tree, &self.poses);
                        let (along, inverse) = Distance::new(points, tree, &self.poses).line();
                        for axis in across(along) {
                            let weight = lambda * inverse;
                            out.add_separation((tree, &self.poses), (points, &at), axis, weight);
                        }
                        self.pull(model, points, along * lambda);
                    }
                }
                ConstraintKind::Coupling(_) => {
                    let at = Place { tree, poses: &self.poses, q };
                    constraint.for_each_second_derivative(at, &mut |i, _, value| {
                        out.add_own(i, lambda * value);
                    });
                }
                ConstraintKind::Product(product) => {
                    let at = ProductAt::new(product, tree, &self.poses);
                    for axis in across(at.direction()) {
                        out.add_vectors(&at, axis, lambda);
                    }
                    let vectors = [at.u, at.w];
                    self.pull_vectors(model, product, vectors, lambda);
                }
            }
            c += constraint.count();
        }
        self.find_torques(tree);
        let joints = tree.joints.iter().enumerate().map(|(j, joint)| Bend {
            coordinate: joint.coordinate,
            parent: joint.parent,
            first: joint.first_axis(j),
            axis: match joint.kind {
                JointKind::Prismatic => Vec3::ZERO,
                _ => self.poses.axis(tree, j),
            },
            torque: self.torques[j],
        });
        out.joints.iter_mut().zip(joints).for_each(|(to, joint)| *to = joint);
    }
}

impl Closure {
    /// Largest violation in units of its round-off.
    pub(crate) fn violation(&self) -> f64 {
        let pairs = self.value.iter().zip(&self.round_off);
        pairs.map(|(h, round_off)| in_units(*h, *round_off)).fold(0.0, larger)
    }

    /// Evaluates all there is at a configuration.
    pub(crate) fn complete(&mut self, model: &Model, q: &[f64], orientations: &[Mat3]) {
        self.evaluate(model, q, orientations);
        self.differentiate(model, q);
        self.place_in_plane(model, q);
        self.known = Known::All;
    }

    /// Finds what a step begins with, at the configuration of the last [`Closure::evaluate`].
    pub(crate) fn begin(&mut self, model: &Model, q: &[f64]) {
        if self.in_plane.is_some() {
            self.place_in_plane(model, q);
            self.known = Known::Place;
        } else {
            self.differentiate(model, q);
            self.known = Known::All;
        }
    }

    /// Whether parts of the Jacobian are turned.
    pub(crate) fn is_turned(&self) -> bool {
        !self.unturned.is_empty()
    }

    /// Turns the parts of the Jacobian, of `n` columns, that stand in three columns from `i` on.
    pub(crate) fn turn(&mut self, i: usize, n: usize, turned: impl Fn(Vec3) -> Vec3) {
        for (c, row) in self.jacobian.chunks_exact_mut(n).enumerate() {
            let part = three(row, i);
            self.unturned.push((c * n + i, part));
            row[i..i + 3].copy_from_slice(&turned(part).0);
        }
    }

    /// Makes the Jacobian what it was before it was turned.
    pub(crate) fn turn_back(&mut self) {
        for (at, part) in self.unturned.drain(..) {
            self.jacobian[at..at + 3].copy_from_slice(&part.0);
        }
    }

    /// Wrenches of loops at the configuration of the last [`Closure::evaluate`], where there are some.
    pub(crate) fn place_in_plane(&mut self, model: &Model, q: &[f64]) {
        if let (Some(in_plane), Some(loops), Some(joints)) =
            (&mut self.in_plane, &model.loops, &model.planar)
        {
            let round_off = &mut self.coordinate_round_off;
            in_plane.place(model, loops, joints, &self.poses, q, round_off);
        }
    }

    /// [`Closure::subtract_impulses`] by wrenches where there are some, else by the Jacobian.
    pub(crate) fn subtract_pushes(&mut self, model: &Model, multipliers: &[f64], out: &mut [f64]) {
        match (&mut self.in_plane, &model.loops, &model.planar) {
            (Some(in_plane), Some(loops), Some(joints)) => {
                in_plane.subtract_impulses(loops, joints, multipliers, out);
            }
            _ => self.subtract_impulses(model, multipliers, out),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lagrangian::samples;
    use crate::lagrangian::samples::Configuration;
    use plantd_math::scalar::Dual;

    fn closure<S: Scalar>(model: &Model, at: &Configuration<S>) -> Closure<S> {
        let mut closure = Closure::new(model);
        closure.evaluate(model, &at.q, &at.orientations);
        closure.differentiate(model, &at.q);
        closure
    }

    fn hessian<S: Scalar>(model: &Model, at: &Configuration<S>, multipliers: &[S]) -> Vec<S> {
        let mut out = vec![S::ZERO; at.q.len() * at.q.len()];
        closure(model, at).hessian(model, &at.q, multipliers, &mut out);
        out
    }

    /// Scenes of elements, and random ones.
    fn models() -> Vec<Model> {
        let random = samples::random_models(100);
        assert!(random.len() > 25, "a test of little: {} models", random.len());
        samples::models().into_iter().chain(random).collect()
    }

    #[test]
    fn derivatives_agree_with_differences_and_dual_numbers() {
        for model in models().iter().filter(|model| !model.constraints.is_empty()) {
            let (name, d) = (&model.scene.name, model.dimensions);
            let n = d.coordinates();
            let multipliers: Vec<f64> =
                (0..d.constraints).map(|c| (1.3 * c as f64 + 0.5).cos()).collect();
            for sample in 0..3 {
                let (q, direction) = samples::configuration(model, sample);
                let (at, curvature) = (closure(model, &q), hessian(model, &q, &multipliers));
                for j in 0..n {
                    let unit = samples::unit(n, j);
                    let found = samples::slope(model, &q, &unit, |q| closure(model, q).value);
                    let column: Vec<f64> = at.jacobian.iter().skip(j).step_by(n).copied().collect();
                    samples::assert_close(&format!("{name} h_{j}"), &column, &found);
                    let found = samples::slope(model, &q, &unit, |q| {
                        let jacobian = closure(model, q).jacobian;
                        let pull = |i| {
                            let rows = jacobian.iter().skip(i).step_by(n);
                            rows.zip(&multipliers).map(|(entry, lambda)| entry * lambda).sum()
                        };
                        (0..n).map(pull).collect()
                    });
                    let column: Vec<f64> = curvature.iter().skip(j).step_by(n).copied().collect();
                    samples::assert_close(&format!("{name} h_i{j}"), &column, &found);
                }
                let dual = samples::along(model, &q, &direction);
                let lifted: Vec<Dual> = multipliers.iter().map(|x| Dual::constant(*x)).collect();
                let along = |values: Vec<Dual>| values.iter().map(|x| x.eps).collect::<Vec<_>>();
                let found =
                    samples::slope(model, &q, &direction, |q| hessian(model, q, &multipliers));
                samples::assert_close(name, &along(hessian(model, &dual, &lifted)), &found);
                let found = samples::slope(model, &q, &direction, |q| closure(model, q).jacobian);
                samples::assert_close(name, &along(closure(model, &dual).jacobian), &found);
            }
        }
    }

    /// Products of vectors, summed up entry by entry, are the second derivatives.
    #[test]
    fn second_derivatives_are_products_of_vectors() {
        let mut tested = 0;
        for model in models().iter().filter(|model| !model.constraints.is_empty()) {
            let mut bends = Bends::new(model);
            let (d, n) = (model.dimensions, model.dimensions.coordinates());
            let multipliers: Vec<f64> =
                (0..d.constraints).map(|c| (1.3 * c as f64 + 0.5).cos()).collect();
            for sample in 0..3 {
                let (q, _) = samples::configuration(model, sample);
                closure(model, &q).bend(model, &q.q, &multipliers, &mut bends);
                let mut found = vec![0.0; n * n];
                for (y, z, weight) in bends.products() {
                    for (i, j) in (0..n * n).map(|k| (k / n, k % n)) {
                        found[i * n + j] += weight * y[i] * z[j];
                    }
                }
                let carries = |above: usize, mut joint: usize| {
                    while joint != above && joint < bends.joints.len() {
                        joint = bends.joints[joint].parent;
                    }
                    joint == above
                };
                for (i, row) in bends.joints.iter().enumerate() {
                    for (j, column) in bends.joints.iter().enumerate() {
                        let is_above = row.first != column.first && carries(i, j);
                        let value = if is_above {
                            row.axis.dot(column.torque)
                        } else if row.first == column.first || carries(j, i) {
                            column.axis.dot(row.torque)
                        } else {
                            continue;
                        };
                        found[row.coordinate * n + column.coordinate] += value;
                    }
                }
                // Of a prescribed length nothing else has a row.
                let mut expected = hessian(model, &q, &multipliers);
                for i in d.dynamic..n {
                    found[i * n..][..n].fill(0.0);
                    expected[i * n..][..n].fill(0.0);
                }
                samples::assert_close(&model.scene.name, &found, &expected);
                tested += 1;
            }
        }
        assert!(tested > 10, "a test of little: {tested}");
    }
}
