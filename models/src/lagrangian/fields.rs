//! What acts on a body at a pose, from the world or from a body above it, to the second derivatives: springs, dampers
//! and drag between two points, along paths between two bodies, and wrenches.
//!
//! Such an element exerts a wrench `W(q, v)` on its body. With the axis `J_j` of a joint above the body and its rate
//! `J̇_j`, about the origin of the tree,
//!
//! ```text
//! ∂W/∂q_j = C J_j + D J̇_j      ∂W/∂v_j = D J_j
//! ```
//!
//! where `C` and `D` are 6 by 6. The generalized force of joint `i` is `J_i · W`, summed over what hangs from it; with
//! these sums, for `i` above `j` (or `i = j`),
//!
//! ```text
//! ∂f_i/∂q_j = J_i · pull_j                  pull = C J + D J̇      ∂f_i/∂v_j = J_i · drag_j      drag = D J
//! ∂f_j/∂q_i = J_i · turn_j + J̇_i · back_j   turn = J ×* W + Cᵀ J  ∂f_j/∂v_i = J_i · back_j      back = Dᵀ J
//! ```
//!
//! so that a spring on a long chain does not fill the Newton matrix: see
//! [`generators`](crate::lagrangian::generators). Two axes of one ball joint turn with it: for both orders the second
//! line holds.
//!
//! What acts from a body above acts on that one too, and nothing of it changes with the joints above both, which
//! feel nothing of it. Between the bodies it is as if from the world, so sums end above the joint that hangs from
//! the upper one. All that acts across one joint has to be from the same body for that, or from the world
//! ([`Model::find_acting`]); else matrices are filled entry by entry.

use plantd_math::eights::{Eight, InEights, in_eights};
use plantd_math::rows::Block;
use plantd_math::spatial::{Force, Mat3, Motion, Vec3};

use crate::lagrangian::curvature::Curvature;
use crate::lagrangian::instant::Instant;
use crate::lagrangian::momenta::Momenta;
use crate::lagrangian::ties::Pull;
use crate::model::mechanism::{
    Acting, Blocks, Forces, Model, Potentials, Span, Spring, mover, span,
};
use crate::model::tree::{Tree, WORLD};

/// Takes a wrench, and its change with the motion of the body `(J, J̇)`.
pub(crate) type Take<'a> = &'a mut dyn FnMut(Force, &dyn Fn(Motion, Motion) -> Force);

/// The wrench of an element on its body, and how it changes.
pub(crate) trait Field {
    /// The body, and what the element acts from.
    fn span(&self) -> Option<Span>;

    /// Whether it changes with velocities.
    fn has_rates(&self) -> bool {
        false
    }

    /// Gives the wrench and its change, maybe in parts.
    fn exert(&self, at: &Instant<'_>, take: Take<'_>);
}

/// A 6 by 6 matrix by columns, and by rows.
type Both = [[Block; 6]; 2];

/// Sums over a joint and all below it.
#[derive(Clone, Copy, Debug, Default)]
struct Sum {
    wrench: Block,
    by_motion: Both,
    by_rate: Both,
}

/// What a joint gives to the second derivatives.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Given {
    pub(crate) pull: Block,
    pub(crate) turn: Block,
    pub(crate) drag: Block,
    pub(crate) back: Block,
}

/// Derivatives of the torque of a ball joint by its own turn and velocity.
#[derive(Clone, Copy, Debug)]
pub(crate) struct OwnTorque {
    pub(crate) by_turn: Mat3,
    pub(crate) by_velocity: Mat3,
}

/// The elements of a model at one configuration and velocity.
#[derive(Clone, Debug)]
pub(crate) struct Fields {
    /// Of joints on which something acts, or from which several hang; the others pass on what is below them.
    sums: Vec<Sum>,
    /// The place of each joint in `sums`, or [`NOWHERE`].
    places: Vec<usize>,
    pub(crate) given: Vec<Given>,
    passed: Vec<Passed>,
    /// Whether some follow velocities: else `D` is zero, and nobody looks at `drag` and `back`.
    pub(crate) has_rates: bool,
}

/// A joint has no place of its own.
const NOWHERE: usize = usize::MAX;

/// The wrench of a force at a point.
pub(crate) fn at_point(p: Vec3, f: Vec3) -> Force {
    Force { n: p.cross(f), f }
}

/// Its change when the point moves and the force changes.
pub(crate) fn change_at_point([p, f]: [Vec3; 2], [moved, changed]: [Vec3; 2]) -> Force {
    Force { n: moved.cross(f) + p.cross(changed), f: changed }
}

fn six(Vec3([a, b, c]): Vec3, Vec3([d, e, f]): Vec3) -> Block {
    Block([a, b, c, d, e, f, 0.0, 0.0])
}

fn motion(Block([a, b, c, d, e, f, ..]): &Block) -> Motion {
    Motion { w: Vec3([*a, *b, *c]), v: Vec3([*d, *e, *f]) }
}

/// A unit of one of the six components.
fn unit(component: usize) -> Motion {
    let mut unit = Block::ZERO;
    unit.0[component] = 1.0;
    motion(&unit)
}

/// Adds a column of a matrix, also to its rows.
fn add(both: &mut Both, column: usize, Force { n, f }: Force) {
    let [columns, rows] = both;
    columns[column] = columns[column].plus(six(n, f));
    for (row, entry) in rows.iter_mut().zip(n.0.into_iter().chain(f.0)) {
        row.0[column] += entry;
    }
}

/// Axis and rate of a joint.
fn motions(momenta: &Momenta, tree: &Tree, joint: usize) -> [Block; 2] {
    let motions = [momenta.axis_of(tree, joint), momenta.axis_rate_of(tree, joint)];
    motions.map(|Motion { w, v }| six(w, v))
}

impl OwnTorque {
    /// None.
    pub(crate) const NONE: Self = Self { by_turn: Mat3::ZERO, by_velocity: Mat3::ZERO };
}

impl Model {
    /// What acts on bodies from the world or bodies above, at their poses, but what acts across one joint; and what
    /// each counts, where forces count `weight` times.
    fn fields(&self, weight: f64) -> impl Iterator<Item = (Span, &dyn Field, f64)> {
        let springs = self.potentials.fields().map(|field| (field, 1.0));
        let forces = self.forces.iter().flat_map(Forces::fields).map(move |field| (field, weight));
        let all = springs.chain(forces);
        let spanned = all.filter_map(|(field, weight)| Some((field.span()?, field, weight)));
        // With ties, what acts from bodies above is one of them.
        spanned.filter(|(span, ..)| !self.has_ties || span.base == WORLD)
    }

    /// What they are between, and what the forces of ties at points are.
    fn spans(&self) -> impl Iterator<Item = Span> {
        let of_ties = self.tied_joints().map(|body| Span { body, base: WORLD });
        self.fields(1.0).map(|(span, ..)| span).chain(of_ties)
    }

    /// Whether something does.
    pub(crate) fn has_fields(&self) -> bool {
        self.spans().next().is_some()
    }

    /// How many blocks the vectors of its joints have.
    pub(crate) fn blocks(&self) -> Blocks {
        let follows =
            |(span, field, _): (Span, &dyn Field, f64)| field.has_rates() && span.base != WORLD;
        match self.fields(1.0).any(follows) {
            true => Blocks::Three,
            false if self.has_fields() => Blocks::Two,
            false => Blocks::One,
        }
    }

    /// Finds [`Model::acting`], whether there are ties, and their rows with those of armatures.
    pub(crate) fn find_elements(&mut self) {
        let are_generated = self.forces.as_ref().is_none_or(Forces::are_generated)
            && self.potentials.springs.iter().all(Spring::is_generated);
        self.acting = self.find_acting();
        if !are_generated || self.acting.is_none() {
            self.has_ties = true;
            self.acting = self.find_acting();
        }
        self.tied_rows = self.rows_of_ties() + self.armature.sums.len();
    }

    /// [`Model::acting`].
    fn find_acting(&self) -> Option<Vec<Acting>> {
        let joints = &self.dynamics.joints[..];
        let mut bases = vec![None; joints.len()];
        for Span { body, base } in self.spans() {
            let mut at = body;
            // Above a joint that is between the same base and another body, all have been there.
            while at != base && bases[at] != Some(base) {
                if bases[at].replace(base).is_some() {
                    return None;
                }
                at = joints[at].parent;
            }
        }
        let acting = joints.iter().zip(bases).map(|(joint, base)| match base {
            None => Acting::Nothing,
            Some(base) if base != WORLD && base == joint.parent => Acting::Ends,
            Some(_) => Acting::Through,
        });
        Some(acting.collect())
    }

    /// Across how many joints something acts.
    pub(crate) fn acted_on(&self) -> usize {
        self.acting.iter().flatten().filter(|acting| acting.is_any()).count()
    }
}

impl Potentials {
    fn fields(&self) -> impl Iterator<Item = &dyn Field> {
        self.springs.iter().filter_map(|spring| match spring {
            Spring::Point(spring) if spring.ends.mover.is_none() => Some(spring as &dyn Field),
            Spring::Path(spring) if mover(&spring.segments).is_none() => Some(spring as &dyn Field),
            _ => None,
        })
    }
}

impl Forces {
    fn fields(&self) -> impl Iterator<Item = &dyn Field> {
        let wrenches = self.wrenches.iter().map(|wrench| wrench as &dyn Field);
        let at_points = self.point_forces.iter().filter(|force| force.ends.mover.is_none());
        let along = self.path_forces.iter().filter(|force| mover(&force.segments).is_none());
        wrenches
            .chain(at_points.map(|force| force as &dyn Field))
            .chain(along.map(|force| force as &dyn Field))
    }

    /// Whether all act on bodies from the world or from one above, or on single coordinates, and none couple more.
    pub(crate) fn are_generated(&self) -> bool {
        let Self { linear_dampers, path_forces, point_forces, .. } = self;
        linear_dampers.is_empty()
            && path_forces.iter().all(|force| span(&force.segments).is_some())
            && point_forces.iter().all(|force| force.ends.span().is_some())
    }
}

impl Fields {
    pub(crate) fn new(model: &Model) -> Self {
        let joints = &model.dynamics.joints[..];
        let mut places = vec![NOWHERE; joints.len()];
        let acted_on = model.spans().map(|Span { body, .. }| body);
        let apart = joints.iter().enumerate().filter(|(i, joint)| !joint.follows(*i));
        let (mut count, parents) = (0, apart.map(|(_, joint)| joint.parent));
        for joint in acted_on.chain(parents) {
            if let Some(place) = places.get_mut(joint).filter(|place| **place == NOWHERE) {
                *place = count;
                count += 1;
            }
        }
        let given = vec![Given::default(); joints.len()];
        let has_rates = model.fields(1.0).any(|(_, field, _)| field.has_rates());
        let (sums, passed) = (vec![Sum::default(); count], vec![Passed::default(); joints.len()]);
        Self { sums, places, given, passed, has_rates }
    }

    /// Finds what joints give, with the forces of ties at points; forces count `weight` times.
    pub(crate) fn evaluate(
        &mut self,
        model: &Model,
        at: &Instant<'_>,
        pulls: &[Pull],
        weight: f64,
    ) {
        self.sums.fill(Sum::default());
        for &Pull { joint, point, force } in pulls {
            let Some(sum) = self.sums.get_mut(self.places[joint]) else { continue };
            let Force { n, f } = at_point(point, force);
            sum.wrench = sum.wrench.plus(six(n, f));
            for component in 0..6 {
                let moved = unit(component).at(point);
                let change = change_at_point([point, force], [moved, Vec3::ZERO]);
                add(&mut sum.by_motion, component, change);
            }
        }
        for (Span { body, .. }, field, weight) in model.fields(weight) {
            let place = self.places.get(body).copied().unwrap_or(NOWHERE);
            let Some(sum) = self.sums.get_mut(place) else { continue };
            let scaled = |Force { n, f }: Force| Force { n: n * weight, f: f * weight };
            field.exert(at, &mut |wrench, change| {
                let Force { n, f } = scaled(wrench);
                sum.wrench = sum.wrench.plus(six(n, f));
                for component in 0..6 {
                    let (unit, rest) = (unit(component), Motion::default());
                    add(&mut sum.by_motion, component, scaled(change(unit, rest)));
                    if self.has_rates {
                        add(&mut sum.by_rate, component, scaled(change(rest, unit)));
                    }
                }
            });
        }
        let acting = model.acting.as_deref().unwrap_or_default();
        in_eights(Gather { fields: self, acting, at });
    }

    /// Adds, `weight` times, how the generalized forces change with changes of the dynamic coordinates and their
    /// velocities, at the last evaluation; but for what ball joints have of themselves.
    pub(crate) fn add_change(
        &mut self,
        model: &Model,
        curvature: &Curvature,
        changes: [&[f64]; 2],
        weight: f64,
        force: &mut [f64],
    ) {
        let (tree, acting) = (&model.dynamics, model.acting.as_deref().unwrap_or_default());
        in_eights(Change { fields: self, tree, acting, curvature, changes, weight, force });
    }

    /// What the axes of a ball joint that begin with `first` have among themselves.
    pub(crate) fn within_ball(&self, tree: &Tree, momenta: &Momenta, first: usize) -> OwnTorque {
        let mut own = OwnTorque::NONE;
        for (row, column) in (0..9).map(|entry| (entry / 3, entry % 3)) {
            let Given { turn, back, .. } = &self.given[first + row];
            let [axis, rate] = motions(momenta, tree, first + column);
            own.by_turn.0[column].0[row] = Block::dot_of(&axis, turn) + Block::dot_of(&rate, back);
            own.by_velocity.0[column].0[row] = Block::dot_of(&axis, back);
        }
        own
    }
}

/// What [`Fields::evaluate`] does once each body has what acts on it.
struct Gather<'a> {
    fields: &'a mut Fields,
    acting: &'a [Acting],
    at: &'a Instant<'a>,
}

impl InEights for Gather<'_> {
    type Output = ();

    #[inline(always)]
    fn run<E: Eight>(self) {
        let Self { fields: Fields { sums, places, given, has_rates, .. }, acting, at } = self;
        let mut sum = Sum::default();
        let joints = at.tree.joints.iter().zip(acting).enumerate().rev();
        for (i, (joint, acting)) in joints.filter(|(_, (_, acting))| acting.is_any()) {
            if let Some(own) = sums.get(places[i]) {
                sum.add::<E>(own);
            }
            let Sum { wrench, by_motion, by_rate } = &sum;
            let [axis, rate] = &motions(at.momenta, at.tree, i);
            let Motion { w: n, v: f } = motion(wrench);
            let Force { n, f } = motion(axis).cross_force(Force { n, f });
            let given = &mut given[i];
            let mut pull = combined::<E>(&by_motion[0], axis);
            combined::<E>(&by_motion[1], axis).plus(E::of(&six(n, f))).put(&mut given.turn);
            if *has_rates {
                pull = pull.plus(combined(&by_rate[0], rate));
                combined::<E>(&by_rate[0], axis).put(&mut given.drag);
                combined::<E>(&by_rate[1], axis).put(&mut given.back);
            }
            pull.put(&mut given.pull);
            let is_end = *acting == Acting::Ends;
            if !is_end && !joint.follows(i) && joint.parent != WORLD {
                sums[places[joint.parent]].add::<E>(&sum);
            }
            if is_end || !joint.follows(i) {
                sum = Sum::default();
            }
        }
    }
}

/// What joints pass on to each other where their motion changes.
#[derive(Clone, Copy, Debug, Default)]
struct Passed {
    /// `Σ J a` and `Σ J̇ a + J b`, on the way down.
    down: [Block; 2],
    /// `Σ pull a + drag b` of what is below.
    up: Block,
}

/// What [`Fields::add_change`] does: from the roots to the leaves and back.
struct Change<'a> {
    fields: &'a mut Fields,
    tree: &'a Tree,
    acting: &'a [Acting],
    curvature: &'a Curvature,
    changes: [&'a [f64]; 2],
    weight: f64,
    force: &'a mut [f64],
}

impl InEights for Change<'_> {
    type Output = ();

    #[inline(always)]
    fn run<E: Eight>(self) {
        let Self { fields, tree, acting, curvature, changes: [position, velocity], .. } = self;
        let Fields { given, passed, .. } = fields;
        let changes = |i: usize| match (position.get(i), velocity.get(i)) {
            (Some(a), Some(b)) => [*a, *b],
            _ => [0.0; 2],
        };
        let rest = [Block::ZERO; 2];
        let joints = tree.joints.iter().zip(acting).enumerate();
        let acted_on = joints.filter(|(_, (_, acting))| acting.is_any());
        // Whether nothing passes between a joint and its parent.
        let is_apart =
            |joint: usize| tree.joints[joint].parent == WORLD || acting[joint] == Acting::Ends;
        for (i, (joint, _)) in acted_on.clone() {
            let above = if is_apart(i) { rest } else { passed[joint.parent].down };
            let [a, b] = changes(joint.coordinate);
            let (axis, rate) = (E::of(&curvature.axis[i]), E::of(&curvature.rate[i]));
            let moved = E::of(&above[0]).plus(axis.scaled(a));
            let faster = E::of(&above[1]).plus(rate.scaled(a)).plus(axis.scaled(b));
            let own = &mut passed[i];
            moved.put(&mut own.down[0]);
            faster.put(&mut own.down[1]);
            own.up = Block::ZERO;
        }
        for (i, (joint, _)) in acted_on.rev() {
            let Given { pull, turn, drag, back } = &given[i];
            let [a, b] = changes(joint.coordinate);
            let own = E::of(pull).scaled(a).plus(E::of(drag).scaled(b));
            let all = E::of(&passed[i].up).plus(own);
            // Of a ball joint, what is above all of its axes, and below all.
            let [first, last] = [joint.first_axis(i), joint.last_axis(i)];
            let parent = tree.joints[first].parent;
            let [moved, faster] = if is_apart(first) { rest } else { passed[parent].down };
            let mut below = passed[last].up;
            if first == last {
                all.put(&mut below);
            }
            if let Some(force) = self.force.get_mut(joint.coordinate) {
                let from_above = E::dot_of(turn, &moved) + E::dot_of(back, &faster);
                *force += self.weight * (from_above + E::dot_of(&curvature.axis[i], &below));
            }
            if !is_apart(i) {
                let up = &mut passed[joint.parent].up;
                E::of(up).plus(all).put(up);
            }
        }
    }
}

/// The sum of six lines, each times a number.
#[inline(always)]
fn combined<E: Eight>(lines: &[Block; 6], numbers: &Block) -> E {
    let mut sum = E::ZERO;
    for (line, number) in lines.iter().zip(&numbers.0) {
        sum = sum.plus(E::of(line).scaled(*number));
    }
    sum
}

impl Sum {
    #[inline(always)]
    fn add<E: Eight>(&mut self, o: &Self) {
        let add = |own: &mut Block, more: &Block| E::of(own).plus(E::of(more)).put(own);
        add(&mut self.wrench, &o.wrench);
        for (own, more) in [(&mut self.by_motion, &o.by_motion), (&mut self.by_rate, &o.by_rate)] {
            let lines = own.as_flattened_mut().iter_mut().zip(more.as_flattened());
            lines.for_each(|(own, more)| add(own, more));
        }
    }
}
