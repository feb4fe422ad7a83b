//! What acts between bodies of which none is above the other, along paths over several bodies, and on sums of
//! coordinates: to the second derivatives, products of few rows.
//!
//! Such an element pulls with `T_k(q, v)` at lengths `y_k(q)`: components of the separation of two points, lengths of
//! paths, sums of coordinates. With `f_i = Σ_k T_k ∂y_k/∂q_i`
//!
//! ```text
//! ∂f_i/∂q_j = Σ_k ∂y_k/∂q_i ∂T_k/∂q_j + Σ_k T_k ∂²y_k/∂q_i∂q_j      ∂f_i/∂v_j = Σ_k ∂y_k/∂q_i ∂T_k/∂v_j
//! ```
//!
//! The first sum has as many terms as the element has rows. The second one is what forces of constant direction at
//! the points give, which act from the world ([`fields`](crate::lagrangian::fields)).
//!
//! ```text
//! two points    y = a − b, in three rows
//! path          two rows for each segment, across it, and one for the length
//! sum           one row
//! ```

use plantd_math::spatial::Vec3;

use crate::lagrangian::instant::Instant;
use crate::lagrangian::vectors::{Distance, across};
use crate::model::mechanism::{Forces, Model, PointPair, Potentials, Spring, mover, span};
use crate::model::tree::WORLD;

/// An element whose second derivatives are such products.
pub(crate) trait Tie {
    /// The points that it is between; none of a sum of coordinates.
    fn segments(&self) -> &[PointPair];

    /// How many rows it has.
    fn rows(&self) -> usize;

    /// Writes its rows, and its forces at points.
    fn tie(&self, at: &Instant<'_>, out: &mut Ties);
}

/// A force of constant direction at a point of a body, from the world.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Pull {
    pub(crate) joint: usize,
    pub(crate) point: Vec3,
    pub(crate) force: Vec3,
}

/// How the separation of two points changes, and its rate, with a coordinate.
#[derive(Clone, Copy, Debug, Default)]
struct Moved {
    by: Vec3,
    faster: Vec3,
}

/// An entry of a row: how `y` changes with the coordinate, and `T` with it and its velocity.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Entry {
    pub(crate) length: f64,
    pub(crate) by_position: f64,
    pub(crate) by_velocity: f64,
}

/// The rows of the ties of a model at one instant.
#[derive(Clone, Debug)]
pub(crate) struct Ties {
    /// Coordinates, the length of a row.
    n: usize,
    rows: Vec<Entry>,
    pulls: Vec<Pull>,
    /// How many rows and pulls there are so far.
    filled: usize,
    pulled: usize,
    /// What forces count; of springs 1.
    weight: f64,
    moved: Vec<Moved>,
}

impl Spring {
    fn tie(&self) -> Option<&dyn Tie> {
        match self {
            Self::Point(spring) if are_tied(std::slice::from_ref(&spring.ends)) => Some(spring),
            Self::Path(spring) if are_tied(&spring.segments) => Some(spring),
            Self::Linear(spring) if spring.terms.len() > 1 => Some(spring),
            _ => None,
        }
    }
}

/// Whether what is between such points is a tie, where there are ties: it moves, not by one joint alone, and is not
/// between a body and the world.
fn are_tied(segments: &[PointPair]) -> bool {
    let is_moved = segments.iter().any(|ends| !ends.path.is_empty());
    let is_from_world = span(segments).is_some_and(|span| span.base == WORLD);
    is_moved && mover(segments).is_none() && !is_from_world
}

/// How many rows a path has.
pub(crate) fn tied_rows(segments: &[PointPair]) -> usize {
    1 + 2 * segments.iter().filter(|ends| !ends.path.is_empty()).count()
}

impl Model {
    /// Its ties, and what each counts, where forces count `weight` times. None where all is by generators.
    fn ties(&self, weight: f64) -> impl Iterator<Item = (&dyn Tie, f64)> {
        let springs = self.potentials.ties().map(|tie| (tie, 1.0));
        let forces = self.forces.iter().flat_map(Forces::ties).map(move |tie| (tie, weight));
        springs.chain(forces).filter(|_| self.has_ties)
    }

    /// How many rows they have.
    pub(crate) fn rows_of_ties(&self) -> usize {
        self.ties(1.0).map(|(tie, _)| tie.rows()).sum()
    }

    /// The joints that carry the points of ties.
    pub(crate) fn tied_joints(&self) -> impl Iterator<Item = usize> {
        let segments = self.ties(1.0).flat_map(|(tie, _)| tie.segments());
        segments.flat_map(|ends| [ends.a.joint, ends.b.joint]).filter(|joint| *joint != WORLD)
    }
}

impl Potentials {
    fn ties(&self) -> impl Iterator<Item = &dyn Tie> {
        self.springs.iter().filter_map(Spring::tie)
    }
}

impl Forces {
    fn ties(&self) -> impl Iterator<Item = &dyn Tie> {
        let at_points = self.point_forces.iter();
        let at_points = at_points.filter(|force| are_tied(std::slice::from_ref(&force.ends)));
        let along = self.path_forces.iter().filter(|force| are_tied(&force.segments));
        let on_sums = self.linear_dampers.iter().map(|damper| damper as &dyn Tie);
        at_points
            .map(|force| force as &dyn Tie)
            .chain(along.map(|force| force as &dyn Tie))
            .chain(on_sums)
    }
}

impl Ties {
    pub(crate) fn new(model: &Model) -> Self {
        let n = model.dimensions.coordinates();
        let count = model.rows_of_ties();
        Self {
            n,
            rows: vec![Entry::default(); n * count],
            pulls: vec![Pull::default(); model.tied_joints().count()],
            filled: 0,
            pulled: 0,
            weight: 1.0,
            moved: vec![Moved::default(); n],
        }
    }

    /// Finds all rows; forces count `weight` times.
    pub(crate) fn evaluate(&mut self, model: &Model, at: &Instant<'_>, weight: f64) {
        (self.filled, self.pulled) = (0, 0);
        for (tie, weight) in model.ties(weight) {
            self.weight = weight;
            tie.tie(at, self);
        }
    }

    /// A row each, of all coordinates.
    pub(crate) fn rows(&self) -> impl ExactSizeIterator<Item = &[Entry]> {
        self.rows.chunks_exact(self.n)
    }

    /// The forces at points.
    pub(crate) fn pulls(&self) -> &[Pull] {
        &self.pulls[..self.pulled]
    }

    /// Finds how the separation of two points changes with each coordinate.
    fn move_ends(&mut self, ends: &PointPair, at: &Instant<'_>) {
        self.moved.fill(Moved::default());
        let separation = ends.separation(at.tree, at.poses);
        for (end, point, sign) in [(&ends.a, separation.a, 1.0), (&ends.b, separation.b, -1.0)] {
            let velocity = at.twist(end).at(point);
            for joint in at.tree.ascend(end.joint) {
                let axis = at.momenta.axis_of(at.tree, joint);
                let rate = at.momenta.axis_rate_of(at.tree, joint);
                let own = &mut self.moved[at.tree.joints[joint].coordinate];
                own.by += axis.at(point) * sign;
                own.faster += (rate.at(point) + axis.w.cross(velocity)) * sign;
            }
        }
    }

    /// Begins a row, to which nothing is added yet.
    pub(crate) fn begin_row(&mut self) -> usize {
        let start = self.filled * self.n;
        self.rows[start..start + self.n].fill(Entry::default());
        self.filled += 1;
        start
    }

    /// Adds to a row, by what [`Self::move_ends`] has found.
    fn add_to(&mut self, start: usize, entry: impl Fn(&Moved) -> Entry) {
        let Self { rows, moved, weight, n, .. } = self;
        for (to, moved) in rows[start..start + *n].iter_mut().zip(moved) {
            let Entry { length, by_position, by_velocity } = entry(moved);
            to.length += length;
            to.by_position += by_position * *weight;
            to.by_velocity += by_velocity * *weight;
        }
    }

    /// Adds three rows for the separation of two points, by how the force at the first one changes with it and its
    /// rate, and that force.
    pub(crate) fn add_separation(
        &mut self,
        ends: &PointPair,
        at: &Instant<'_>,
        force: Vec3,
        change: impl Fn(Vec3, Vec3) -> Vec3,
    ) {
        self.move_ends(ends, at);
        for axis in 0..3 {
            let row = self.begin_row();
            self.add_to(row, |Moved { by, faster }| Entry {
                length: by.0[axis],
                by_position: change(*by, *faster).0[axis],
                by_velocity: change(Vec3::ZERO, *by).0[axis],
            });
        }
        self.pull(ends, at, force);
    }

    /// Adds two rows for a segment of a path under tension `T`, and its part of the row of the length: `change` makes
    /// of the change of the length, and of its rate, those of `T` with positions and velocities.
    pub(crate) fn add_segment(
        &mut self,
        length: usize,
        ends: &PointPair,
        at: &Instant<'_>,
        tension: f64,
        change: impl Fn(f64, f64) -> [f64; 2],
    ) {
        if ends.path.is_empty() {
            return;
        }
        let (along, inverse) = Distance::new(ends, at.tree, at.poses).line();
        let separation = ends.separation(at.tree, at.poses);
        let velocity = at.twist(&ends.a).at(separation.a) - at.twist(&ends.b).at(separation.b);
        let turned = (velocity - along * along.dot(velocity)) * inverse;
        self.move_ends(ends, at);
        self.add_to(length, |Moved { by, faster }| {
            let longer = along.dot(*by);
            let [by_position, by_velocity] = change(longer, turned.dot(*by) + along.dot(*faster));
            Entry { length: longer, by_position, by_velocity }
        });
        for across in across(along) {
            let row = self.begin_row();
            self.add_to(row, |Moved { by, .. }| {
                let length = across.dot(*by);
                Entry { length, by_position: tension * inverse * length, by_velocity: 0.0 }
            });
        }
        self.pull(ends, at, along * tension);
    }

    /// Adds a row of a sum of coordinates, `T` of which changes with the sum and its rate.
    pub(crate) fn add_sum(&mut self, terms: &[(usize, f64)], [by_position, by_velocity]: [f64; 2]) {
        let start = self.begin_row();
        for &(i, c) in terms {
            let row = &mut self.rows[start + i];
            row.length += c;
            row.by_position += by_position * c * self.weight;
            row.by_velocity += by_velocity * c * self.weight;
        }
    }

    /// Forces at both points, `force` at the first.
    fn pull(&mut self, ends: &PointPair, at: &Instant<'_>, force: Vec3) {
        let separation = ends.separation(at.tree, at.poses);
        let force = force * self.weight;
        for (joint, point, force) in
            [(ends.a.joint, separation.a, force), (ends.b.joint, separation.b, -force)]
        {
            if joint != WORLD {
                self.pulls[self.pulled] = Pull { joint, point, force };
                self.pulled += 1;
            }
        }
    }
}
