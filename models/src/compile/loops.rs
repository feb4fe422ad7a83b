//! Loops of planar mechanisms: in which order joints and the equations that close loops are eliminated.
//!
//! Eliminating a joint leaves a small dense matrix, a *front*: how what is eliminated pushes the bodies that
//! carry it when these move, and what equations that are still open say about them. A body of a front takes
//! six rows and columns, an open equation one. A ladder of loops keeps two bodies and a few equations in its
//! front however long it is, and so is eliminated in O(n), like a tree, of which a front has one body.
//!
//! An equation is eliminated as soon as as many joints below it as it needs are. In [`Plan::new`], `spare`
//! joints more are asked for: fronts are larger, pivots too.

use crate::integrator::workspace::Workspace;
use crate::model::loop_plan::{Above, Absorbed, BODY, Equation, Loops, Opened, Plan, Step};
use crate::model::mechanism::{Constraint, Model};
use crate::model::planar_tree::{PlanarJoint, PlanarJoints};
use crate::model::tree::{Tree, WORLD};

/// How many times the work of fronts dense matrices must be to take as long.
const MARGIN: f64 = 2.0;
/// Entries of fronts that are always few.
const ROOM: usize = 1 << 16;
/// Most joints more than needed that an equation waits for.
const SPARE_MOST: usize = 2;

impl Loops {
    /// The loops of trees in one plane, of which all joints are dynamic and in the order of their
    /// coordinates; `None` where other equations than those between points act. Equations that no coordinate
    /// moves have no `weight` and are left out.
    pub(crate) fn new(
        joints: &PlanarJoints,
        constraints: &[Constraint],
        closure: &Tree,
        weight: &[f64],
        spare: usize,
        work: f64,
    ) -> Option<Self> {
        let plane = joints.plane?;
        let mut in_closure = vec![WORLD; joints.len()];
        for (place, joint) in closure.joints.iter().enumerate() {
            *in_closure.get_mut(joint.coordinate)? = place;
        }
        let mut equations = Vec::new();
        for (c, constraint) in constraints.iter().enumerate().filter(|(c, _)| weight[*c] > 0.0) {
            let points = constraint.points_in_plane()?;
            let bodies = [&points.a, &points.b]
                .map(|end| closure.joints.get(end.joint).map(|joint| joint.coordinate));
            let both = |&i: &usize| bodies.iter().all(|body| carries(joints, i, *body));
            let ancestor = (0..joints.len()).rev().find(both);
            equations.push(Equation { constraint: c, bodies, ancestor });
        }
        let bodies: Vec<_> = equations.iter().map(|equation| equation.bodies).collect();
        let plan = Plan::new(joints, &bodies, spare, work)?;
        Some(Self { plan, equations, plane, in_closure })
    }
}

/// What a front has rows for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Var {
    Body(usize),
    Equation(usize),
}

impl Var {
    fn len(self) -> usize {
        match self {
            Self::Body(_) => BODY,
            Self::Equation(_) => 1,
        }
    }
}

/// A front while the plan is made.
#[derive(Clone, Debug)]
struct Part {
    front: usize,
    places: Vec<(Var, usize)>,
    used: Vec<bool>,
}

impl Part {
    fn place(&self, var: Var) -> Option<usize> {
        self.places.iter().find(|(v, _)| *v == var).map(|(_, place)| *place)
    }

    /// The place of a variable: where it is, or the first rows that are free.
    fn take(&mut self, var: Var) -> usize {
        if let Some(place) = self.place(var) {
            return place;
        }
        let len = var.len();
        let is_free = |at: &usize| !self.used.iter().skip(*at).take(len).any(|used| *used);
        let place = (0..=self.used.len()).find(is_free).unwrap_or(self.used.len());
        self.used.resize(self.used.len().max(place + len), false);
        self.used[place..place + len].fill(true);
        self.places.push((var, place));
        place
    }

    fn free(&mut self, var: Var) {
        if let Some(place) = self.place(var) {
            self.used[place..place + var.len()].fill(false);
            self.places.retain(|(v, _)| *v != var);
        }
    }
}

/// Equations about the same two bodies.
#[derive(Clone, Debug)]
struct Group {
    bodies: [Option<usize>; 2],
    equations: Vec<usize>,
    /// Joints that move one of the bodies and not the other, the last ones first.
    path: Vec<usize>,
    is_open: bool,
    is_closed: bool,
}

/// What becomes of a joint.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Fate {
    Remaining,
    /// Eliminated, and no equation needed it.
    Spare,
    Used,
}

struct Planner<'a> {
    joints: &'a [PlanarJoint],
    groups: Vec<Group>,
    parts: Vec<Part>,
    fates: Vec<Fate>,
    children: Vec<usize>,
    /// Rows of the front in which each joint would be eliminated, where they are known.
    rows: Vec<Option<usize>>,
    spare: usize,
    plan: Plan,
}

impl Plan {
    /// The order for joints, listed depth first, and equations, each about two bodies: those that the joints
    /// carry, or the world. `None` where equations outnumber the joints that they are about, and where fronts
    /// take more than `work` or more room than one dense matrix of everything. O(n²) for `n` joints and
    /// equations, but for the fronts' sizes.
    pub(crate) fn new(
        joints: &[PlanarJoint],
        equations: &[[Option<usize>; 2]],
        spare: usize,
        work: f64,
    ) -> Option<Self> {
        let mut groups: Vec<Group> = Vec::new();
        for (equation, &bodies) in equations.iter().enumerate() {
            match groups.iter_mut().find(|group| group.bodies == bodies) {
                Some(group) => group.equations.push(equation),
                None => groups.push(Group {
                    bodies,
                    equations: vec![equation],
                    path: path(joints, bodies),
                    is_open: false,
                    is_closed: false,
                }),
            }
        }
        let mut children = vec![0; joints.len()];
        for parent in joints.iter().filter_map(|joint| joint.parent.checked_sub(1)) {
            children[parent] += 1;
        }
        let mut planner = Planner {
            joints,
            groups,
            parts: Vec::new(),
            fates: vec![Fate::Remaining; joints.len()],
            children,
            rows: vec![None; joints.len()],
            spare,
            plan: Self::default(),
        };
        let (most, mut spent) = ((joints.len() + equations.len()).pow(2).max(ROOM), 0.0);
        for _ in 0..joints.len() {
            let next = planner.next()?;
            planner.eliminate(next);
            spent += planner.plan.steps.last().map_or(0.0, Step::work);
            let room: usize = planner.plan.fronts.iter().map(|rows| rows * rows).sum();
            if spent > work || room > most {
                return None;
            }
        }
        planner.groups.iter().all(|group| group.is_closed).then_some(planner.plan)
    }

    /// Rows of all fronts, each counted as often as joints are eliminated in it.
    pub(crate) fn rows(&self) -> usize {
        self.steps.iter().map(|step| step.rows).sum()
    }

    /// Multiplications and additions of a factorization, about.
    pub(crate) fn work(&self) -> f64 {
        self.steps.iter().map(Step::work).sum()
    }
}

/// Whether a joint carries a body.
fn carries(joints: &[PlanarJoint], i: usize, body: Option<usize>) -> bool {
    body.is_some_and(|body| (i..=i + joints[i].descendants).contains(&body))
}

/// Joints that carry one of two bodies and not the other, the last ones first.
fn path(joints: &[PlanarJoint], bodies: [Option<usize>; 2]) -> Vec<usize> {
    let one = |&i: &usize| carries(joints, i, bodies[0]) != carries(joints, i, bodies[1]);
    (0..joints.len()).rev().filter(one).collect()
}

impl Planner<'_> {
    /// Equations that eliminating a joint would open.
    fn opens(&self, joint: usize) -> impl Iterator<Item = &Group> {
        self.groups
            .iter()
            .filter(move |group| !group.is_open && group.bodies.contains(&Some(joint)))
    }

    /// The leaf with the smallest front.
    fn next(&mut self) -> Option<usize> {
        let is_leaf = |i: &usize| self.fates[*i] == Fate::Remaining && self.children[*i] == 0;
        let leaves: Vec<usize> = (0..self.joints.len()).rev().filter(is_leaf).collect();
        for &i in &leaves {
            if self.rows[i].is_none() {
                self.rows[i] = Some(self.rows_with(i));
            }
        }
        leaves.into_iter().min_by_key(|&i| self.rows[i])
    }

    /// Rows of the front in which a joint would be eliminated, with those of its parent.
    fn rows_with(&self, joint: usize) -> usize {
        let mut vars = vec![Var::Body(joint)];
        vars.extend(self.joints[joint].parent.checked_sub(1).map(Var::Body));
        for group in self.opens(joint) {
            vars.extend(group.bodies.iter().flatten().map(|&body| Var::Body(body)));
            vars.extend(group.equations.iter().map(|&equation| Var::Equation(equation)));
        }
        for part in self.parts.iter().filter(|part| part.place(Var::Body(joint)).is_some()) {
            vars.extend(part.places.iter().map(|(var, _)| *var));
        }
        let is_first = |k: &usize| !vars[..*k].contains(&vars[*k]);
        (0..vars.len()).filter(is_first).map(|k| vars[k].len()).sum()
    }

    fn eliminate(&mut self, joint: usize) {
        let body = Var::Body(joint);
        let touches = |part: &mut Part| part.place(body).is_some();
        let mut touching: Vec<Part> = self.parts.extract_if(.., touches).collect();
        touching.sort_by_key(|part| part.used.len());
        let mut part = touching.pop().unwrap_or_else(|| {
            self.plan.fronts.push(0);
            Part { front: self.plan.fronts.len() - 1, places: Vec::new(), used: Vec::new() }
        });
        let absorbed = touching.into_iter().map(|other| {
            let mut rows = Vec::new();
            for (var, from) in other.places {
                let to = part.take(var);
                rows.extend((0..var.len()).map(|k| (from + k, to + k)));
            }
            Absorbed { front: other.front, rows }
        });
        let absorbed = absorbed.collect();
        let place = part.take(body);
        let mut opened = Vec::new();
        for group in self.groups.iter_mut().filter(|g| g.bodies.contains(&Some(joint))) {
            if !std::mem::replace(&mut group.is_open, true) {
                let bodies = group.bodies.map(|body| body.map(|body| part.take(Var::Body(body))));
                opened.extend(group.equations.iter().map(|&equation| Opened {
                    equation,
                    place: part.take(Var::Equation(equation)),
                    bodies,
                }));
            }
        }
        self.fates[joint] = Fate::Spare;
        let closed = self.close(&part);
        let above = match self.joints[joint].parent.checked_sub(1).map(Var::Body) {
            None => Above::World,
            Some(parent) => part.place(parent).map_or(Above::Here, Above::At),
        };
        let (front, rows) = (part.front, part.used.len());
        let size = &mut self.plan.fronts[front];
        *size = (*size).max(rows);
        for (equation, _) in &closed {
            part.free(Var::Equation(*equation));
        }
        part.free(body);
        if let Some(parent) = self.joints[joint].parent.checked_sub(1) {
            self.children[parent] -= 1;
            if above == Above::Here {
                part.places.push((Var::Body(parent), place));
                part.used[place..place + BODY].fill(true);
            }
        }
        while part.used.last() == Some(&false) {
            part.used.pop();
        }
        for (var, _) in &part.places {
            if let Var::Body(body) = var {
                self.rows[*body] = None;
            }
        }
        if !part.places.is_empty() {
            self.parts.push(part);
        }
        let step = Step { joint, front, rows, place, above, absorbed, opened, closed };
        self.plan.steps.push(step);
    }

    /// The open equations of a front that can be eliminated, with their places.
    fn close(&mut self, part: &Part) -> Vec<(usize, usize)> {
        let mut closed = Vec::new();
        for group in self.groups.iter_mut().filter(|group| group.is_open && !group.is_closed) {
            let fates = &self.fates;
            let places = group.equations.iter().map(|&e| Some((e, part.place(Var::Equation(e))?)));
            let Some(places) = places.collect::<Option<Vec<_>>>() else { continue };
            let needed = group.equations.len();
            let path = &group.path;
            let of = |fate: Fate| path.iter().copied().filter(move |&i| fates[i] == fate);
            let (has_more, free) = (of(Fate::Remaining).next().is_some(), of(Fate::Spare).count());
            if free >= needed + if has_more { self.spare } else { 0 } {
                let used: Vec<_> = of(Fate::Spare).take(needed).collect();
                for joint in used {
                    self.fates[joint] = Fate::Used;
                }
                group.is_closed = true;
                closed.extend(places);
            }
        }
        closed
    }
}

impl Model {
    /// Finds the loops, and eliminates them with the joints where that is faster.
    ///
    /// A step took so many microseconds with dense matrices of the constraints and with fronts, a
    /// linearization beyond it
    ///
    /// ```text
    /// scissor-    4: 3.5, 4.7   8: 8.6, 8.6    16: 29, 18   32: 139, 40    64: 890, 90
    ///             4: 3.0, 4.7   8: 9.2, 12     16: 42, 35   32: 245, 117   64: 1970, 436
    /// ```
    pub(crate) fn find_loops(&mut self) {
        if let Some(loops) = self.loops_within(self.dense_work() / MARGIN) {
            self.take_loops(loops);
        }
    }

    /// The loops, in an order that takes no more than some work and of which the pivots are sound at the
    /// configuration that [`Conditioning`] found.
    ///
    /// [`Conditioning`]: crate::model::conditioning::Conditioning
    pub(crate) fn loops_within(&mut self, work: f64) -> Option<Loops> {
        let (d, conditioning) = (self.dimensions, &self.conditioning);
        let are_all = self.dynamics.joints.iter().map(|joint| joint.coordinate).eq(0..d.dynamic);
        let moved = conditioning.weight.iter().filter(|weight| **weight > 0.0).count();
        if d.constraints == 0 || d.prescribed > 0 || !are_all || self.constraint_rank() < moved {
            return None;
        }
        let solver = self.solver;
        let found = (0..=SPARE_MOST).find_map(|spare| {
            let (joints, weight) = (self.planar.as_ref()?, &self.conditioning.weight);
            let loops = Loops::new(joints, &self.constraints, &self.closure, weight, spare, work)?;
            self.take_loops(loops);
            let are_sound = Workspace::new(self).can_eliminate_constraints(self);
            self.loops.take().filter(|_| are_sound)
        });
        self.solver = solver;
        found
    }

    /// Multiplications and additions of dense matrices of the constraints.
    fn dense_work(&self) -> f64 {
        let rows = self.elimination.lengths().map(|entries| entries as f64);
        let (entries, changes) = rows.fold((0.0, 0.0), |(n, sum), row| (n + row, sum + row * row));
        let support: usize = self.constraints.iter().map(|c| c.coordinates.len()).sum();
        let nc = self.dimensions.constraints as f64;
        4.0 * changes + nc * (4.0 * entries + 2.0 * support as f64) + 2.0 / 3.0 * nc.powi(3)
    }
}
