//! The Lagrangian of a planar tree: momentum recursion and second derivatives with vectors of three
//! numbers, a small part of what [`Momenta`] and [`Curvature`] cost.
//!
//! A twist is `(w, v)`, a wrench `(n, f)`: an angular part and two linear ones, in world axes and about
//! the joint that they belong to. From a joint to its parent, `e` away, a wrench moves by `n += e × f`,
//! and back a twist by `v += w ẑ×e`. About its own joint, with the velocity `v` of the parent's body there,
//!
//! ```text
//! hinge   J = (s, 0)     J̇ = (0, −s ẑ×v)             s = ±1
//! slider  J = (0, d)     J̇ = (0, w_parent ẑ×d)
//!
//! ∂L/∂v = J·H      ∂L/∂q = J̇·H + J·(S×g, m g)       H, S, m: momentum, moment and mass of the subtree
//! F = I J          P = J ×* H + I J̇                 I: inertia of the subtree
//! ```
//!
//! and second derivatives are products of these as in space. Turning by an angle is a complex number.
//!
//! Only sums along the tree need one joint after the other: directions, velocities, momenta, moments and
//! inertia. All else is the same for each joint, and is computed for four of them side by side ([`Fours`]).
//!
//! A second home of the formulas of [`Momenta`] and [`Curvature`], kept because it pays: without it, and
//! without the recursion that builds on it ([`crate::kkt::planar`]), a step takes 1.2 (two joints) to 2
//! (chains of 16 and of 128) times as long, and a step with its derivatives 1.3 to 5 times. The price is this
//! file and the one of the recursion, and a test that compares every entry with those in space.
//!
//! [`Momenta`]: crate::lagrangian::momenta::Momenta
//! [`Curvature`]: crate::lagrangian::curvature::Curvature

mod nudge;

use std::ops::Range;

use plantd_math::scalar::{Compared, LanesOf, Scalar, Truths, in_registers};
use plantd_math::tree_lu::TreeLu;

use crate::lagrangian::arrangement::{
    Arrangement, Fours, InARow, List, Ones, Order, Planar, one2, one3, put2,
};
use crate::lagrangian::curvature::SecondDerivatives;
use crate::lagrangian::plane::{
    Vec2, Vec3, add, add4, combined, cross, dot, linear, spun, times, turned,
};
use crate::model::mechanism::Pair;
use crate::model::planar_tree::{PlanarJoint, PlanarJoints};

/// Joints up to which one after the other is faster.
const FEW: usize = 3;

/// A planar tree at a configuration and velocity.
#[derive(Clone, Debug)]
pub(crate) enum PlanarTree<S: Planar = f64> {
    Few(Joints<Ones<S>>),
    Many(Joints<S::Many>),
}

impl<S: Planar> PlanarTree<S> {
    pub(crate) fn new(joints: &PlanarJoints) -> Self {
        if joints.len() > FEW {
            Self::Many(Joints::new(joints))
        } else {
            Self::Few(Joints::new(joints))
        }
    }

    /// Writes `∂L/∂q` and `∂L/∂v` of the dynamic coordinates, the first `l_q.len()` ones, without springs.
    pub(crate) fn gradient(
        &mut self,
        joints: &PlanarJoints,
        q: &[S],
        velocity: &[S],
        l_q: &mut [S],
        l_v: &mut [S],
    ) {
        match self {
            Self::Few(tree) => tree.gradient(joints, q, velocity, l_q, l_v),
            Self::Many(tree) => tree.gradient(joints, q, velocity, l_q, l_v),
        }
    }

    /// Prepares second derivatives at the last gradient, for [`PlanarTree::pair`].
    pub(crate) fn differentiate(&mut self, joints: &PlanarJoints) {
        match self {
            Self::Few(tree) => {
                tree.differentiate(joints);
                tree.place(joints);
            }
            Self::Many(tree) => {
                tree.differentiate(joints);
                tree.place(joints);
            }
        }
    }

    /// Second derivatives of a pair of joints on one path to the root.
    #[inline(always)]
    pub(crate) fn pair(
        &self,
        joints: &[PlanarJoint],
        ancestor: usize,
        descendant: usize,
    ) -> SecondDerivatives<S> {
        match self {
            Self::Few(tree) => tree.pair(joints, ancestor, descendant),
            Self::Many(tree) => tree.pair(joints, ancestor, descendant),
        }
    }
}

impl<const N: usize> PlanarTree<LanesOf<N>> {
    fn links(&mut self) -> &mut [Links<LanesOf<N>>] {
        match self {
            Self::Few(tree) | Self::Many(tree) => &mut tree.links,
        }
    }

    /// Puts aside what the last [`PlanarTree::differentiate`] has found.
    pub(crate) fn put_aside(&mut self, kept: &mut [Slopes<LanesOf<N>>]) {
        for (kept, link) in kept.iter_mut().zip(self.links()) {
            kept.0 = link.slopes().map(|number| *number);
        }
    }

    /// Takes what was put aside for the lanes that are said.
    pub(crate) fn take_where(&mut self, lanes: Truths<N>, kept: &[Slopes<LanesOf<N>>]) {
        for (kept, link) in kept.iter().zip(self.links()) {
            for (own, kept) in link.slopes().into_iter().zip(&kept.0) {
                *own = LanesOf::choose(lanes, *kept, *own);
            }
        }
    }
}

impl PlanarTree {
    /// Takes over joints at a configuration and velocity, for second derivatives there.
    #[inline(always)]
    pub(crate) fn take<const N: usize>(&mut self, joints: &Joints<Ones<f64, InARow<N>>>) {
        if let Self::Few(tree) = self {
            tree.links.copy_from_slice(&joints.links);
        }
    }

    /// The joints of a tree of more than a few.
    pub(crate) fn many(&self) -> Option<&Joints<Fours>> {
        match self {
            Self::Many(tree) => Some(tree),
            Self::Few(_) => None,
        }
    }
}

impl<S: Planar> PlanarTree<S> {
    /// Writes the Jacobian of the residual by the increment, without springs and forces, entry by entry.
    pub(crate) fn fill_newton_matrix(
        &self,
        joints: &[PlanarJoint],
        pairs: &[Pair],
        step: f64,
        matrix: &mut TreeLu<S>,
    ) {
        match self {
            Self::Few(tree) => tree.fill_newton_matrix(joints, pairs, step, matrix),
            Self::Many(tree) => tree.fill_newton_matrix(joints, pairs, step, matrix),
        }
    }
}

/// Joints at a configuration and velocity.
#[derive(Clone, Copy, Debug, Default)]
struct Links<P> {
    q: P,
    speed: P,
    /// Sine and cosine of the angle of the joint; of the parent's body, and of the body.
    own: Vec2<P>,
    above: Vec2<P>,
    direction: Vec2<P>,
    /// Angular velocity of the parent's body, and of the body.
    spin_above: P,
    spin: P,
    /// Velocity of the joint, and how much more it is than that of the parent.
    velocity: Vec2<P>,
    faster: Vec2<P>,
    /// From the parent joint to this one.
    edge: Vec2<P>,
    /// The edge times the mass of the subtree.
    lever: Vec2<P>,
    /// `d` of a slider; zero for a hinge.
    slide: Vec2<P>,
    /// Linear part of `J̇`.
    rate: Vec2<P>,
    /// Angular momentum, momentum and first moment of mass of the subtree; of the momentum about the parent.
    turning: P,
    momentum: Vec2<P>,
    moment: Vec2<P>,
    torque: P,
    /// Inertia of the body, that of the subtree, and what is added to it about the parent.
    inertia: P,
    total_inertia: P,
    moved: P,
    /// `F`.
    force: Vec3<P>,
    /// `P`.
    slope: Vec3<P>,
    /// `f × g` for the linear part `f` of `F`.
    weight: P,
}

/// What [`Joints::differentiate`] finds of a joint, put aside.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Slopes<P>([P; 7]);

impl<S: Compared> Links<S> {
    fn slopes(&mut self) -> [&mut S; 7] {
        let ([n, x, y], [m, px, py]) = (self.force.each_mut(), self.slope.each_mut());
        [n, x, y, m, px, py, &mut self.weight]
    }
}

/// What a joint passes on to those below it: sine and cosine of the angle of its body, the angular velocity,
/// and its own velocity.
#[derive(Clone, Copy, Debug)]
struct Motion<S> {
    direction: Vec2<S>,
    spin: S,
    velocity: Vec2<S>,
}

impl<S: Scalar> Motion<S> {
    const NONE: Self = Self { direction: [S::ZERO, S::ONE], spin: S::ZERO, velocity: [S::ZERO; 2] };
}

/// What the joint after this one passes on to it: momentum and moment of its subtree, and angular momentum.
#[derive(Clone, Copy, Debug)]
struct Below<S> {
    sums: [S; 4],
    turning: S,
}

impl<S: Scalar> Below<S> {
    const NONE: Self = Self { sums: [S::ZERO; 4], turning: S::ZERO };
}

/// The joints of a planar tree at a configuration and velocity, block by block.
#[derive(Clone, Debug)]
pub(crate) struct Joints<A: Arrangement> {
    links: List<A, Links<A::Several>>,
    /// Momentum and first moment of mass, joint by joint, to the end of the last block.
    sums: List<A, [A::Number; 4]>,
    /// What changes above each joint make of its torque; used by [`PlanarTree::nudge`] alone.
    from_above: List<A, A::Several>,
    /// Sums over children that do not follow their parent in the list; zero but within a pass.
    branches: List<A, Below<A::Number>>,
    inertia_of_branches: List<A, A::Number>,
    /// Where the joints are, from the origin of the tree; set by [`Joints::place`].
    positions: List<A, Vec2<A::Number>>,
}

/// A joint at a configuration and velocity.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Link<S> {
    pub(crate) edge: Vec2<S>,
    pub(crate) slide: Vec2<S>,
    pub(crate) rate: Vec2<S>,
    pub(crate) force: Vec3<S>,
    pub(crate) slope: Vec3<S>,
    pub(crate) weight: S,
}

/// The joints of a block.
#[inline(always)]
fn group<A: Arrangement>(joints: &[PlanarJoint], block: usize) -> &[PlanarJoint] {
    if A::COUNT == 1 {
        return std::slice::from_ref(&joints[block]);
    }
    let rest = &joints[A::COUNT * block..];
    &rest[..A::COUNT.min(rest.len())]
}

impl<A: Arrangement> Joints<A> {
    #[inline(always)]
    pub(crate) fn new(joints: &PlanarJoints) -> Self {
        let n = joints.len();
        Self {
            links: A::Order::list(Links::default(), n.div_ceil(A::COUNT)),
            sums: A::Order::list([A::Number::ZERO; 4], n.next_multiple_of(A::COUNT)),
            from_above: A::Order::list(A::Several::ZERO, n.div_ceil(A::COUNT)),
            branches: A::Order::list(Below::NONE, n),
            inertia_of_branches: A::Order::list(A::Number::ZERO, n),
            positions: A::Order::list([A::Number::ZERO; 2], n),
        }
    }

    /// From the roots to the leaves and back, about 60 flops a joint beside a sine and a cosine.
    #[inline(never)]
    pub(crate) fn gradient(
        &mut self,
        joints: &PlanarJoints,
        q: &[A::Number],
        velocity: &[A::Number],
        l_q: &mut [A::Number],
        l_v: &mut [A::Number],
    ) {
        in_registers!(A::Number, {
            self.gradient_here(joints, [q, velocity], [l_q, l_v]);
        })
    }

    /// The same in the code of the caller.
    #[inline(always)]
    pub(crate) fn gradient_here(
        &mut self,
        joints: &PlanarJoints,
        [q, velocity]: [&[A::Number]; 2],
        [l_q, l_v]: [&mut [A::Number]; 2],
    ) {
        if joints.have_sliders {
            self.walk::<true>(joints, q, velocity, l_q, l_v);
        } else {
            self.walk::<false>(joints, q, velocity, l_q, l_v);
        }
    }

    /// Computes `F` and `P` of each joint at the last gradient.
    #[inline(never)]
    pub(crate) fn differentiate(&mut self, joints: &PlanarJoints) {
        in_registers!(A::Number, { self.differentiate_here(joints) })
    }

    /// The same in the code of the caller.
    #[inline(always)]
    pub(crate) fn differentiate_here(&mut self, joints: &PlanarJoints) {
        let links = &mut self.links[..];
        for link in &mut *links {
            link.moved = dot(link.edge, add(link.lever, times(link.moment, 2.0)));
        }
        let branches = &mut self.inertia_of_branches[..];
        let mut below = A::Number::ZERO;
        for (block, link) in links.iter_mut().enumerate().rev() {
            let first = A::COUNT * block;
            for (lane, joint) in group::<A>(joints, block).iter().enumerate().rev() {
                let joint = A::Order::ties(joint, first + lane);
                let mut sum = A::one(&link.inertia, lane);
                if joint.is_followed {
                    sum += below;
                }
                if joint.has_branches {
                    sum += std::mem::take(&mut branches[first + lane]);
                }
                A::put(sum, &mut link.total_inertia, lane);
                sum += A::one(&link.moved, lane);
                match joint.parent {
                    0 => {}
                    parent if parent == first + lane => below = sum,
                    parent => branches[parent - 1] += sum,
                }
            }
        }
        for (block, link) in links.iter_mut().enumerate() {
            let Links { slide, rate, momentum, moment, total_inertia, .. } = *link;
            let (body, f) = (A::body(joints, block), momentum);
            let push = add(spun(moment, body.turn), times(slide, body.subtree_mass));
            let pull = add(spun(f, body.turn), times(rate, body.subtree_mass));
            link.force = [total_inertia * body.turn + cross(moment, slide), push[0], push[1]];
            link.slope = [cross(slide, f) + cross(moment, rate), pull[0], pull[1]];
            link.weight = cross(push, body.gravity);
        }
    }

    /// `SLIDES`: some joint is a slider.
    #[inline(always)]
    fn walk<const SLIDES: bool>(
        &mut self,
        joints: &PlanarJoints,
        q: &[A::Number],
        velocity: &[A::Number],
        l_q: &mut [A::Number],
        l_v: &mut [A::Number],
    ) {
        let blocks = self.links.len();
        let (parts, part) = if A::ALONE { (blocks, 1) } else { (1, blocks) };
        let part = |i: usize| part * i..part * (i + 1);
        let mut last = Motion::NONE;
        for i in 0..parts {
            last = self.descend::<SLIDES>(joints, part(i), q, velocity, last);
        }
        let mut below = Below::NONE;
        for i in (0..parts).rev() {
            below = self.ascend::<SLIDES>(joints, part(i), l_q, l_v, below);
        }
    }

    /// Where joints are and how fast, and the momenta of their bodies, for some blocks.
    #[inline(always)]
    fn descend<const SLIDES: bool>(
        &mut self,
        joints: &PlanarJoints,
        blocks: Range<usize>,
        q: &[A::Number],
        velocity: &[A::Number],
        mut last: Motion<A::Number>,
    ) -> Motion<A::Number> {
        for block in blocks.clone() {
            let (link, body) = (&mut self.links[block], A::body(joints, block));
            link.q = A::gather(joints, block, q);
            link.speed = A::gather(joints, block, velocity);
            link.own = (link.q * body.turn).sin_cos().into();
            link.spin = link.speed * body.turn;
        }
        self.turn(joints, blocks.clone(), &mut last);
        for block in blocks.clone() {
            let (link, body) = (&mut self.links[block], A::body(joints, block));
            let Links { q, speed, above, spin_above, .. } = *link;
            let mut edge = turned(above, body.offset);
            link.faster = if SLIDES {
                link.slide = turned(above, body.slide);
                edge = add(edge, times(link.slide, q));
                add(spun(edge, spin_above), times(link.slide, speed))
            } else {
                spun(edge, spin_above)
            };
            link.lever = times(edge, body.subtree_mass);
            link.edge = edge;
        }
        self.go_on(joints, blocks.clone(), &mut last);
        for block in blocks {
            let (link, body) = (&mut self.links[block], A::body(joints, block));
            let Links { direction, slide, spin_above, spin, velocity, .. } = *link;
            let arm = turned(direction, body.center);
            let f = times(add(velocity, spun(arm, spin)), body.mass);
            let moment = times(arm, body.mass);
            let [x, y] = spun(velocity, body.turn);
            link.rate = [-x, -y];
            if SLIDES {
                // A hinge has no slide, and a slider no turn.
                link.rate = add(link.rate, spun(slide, spin_above));
            }
            link.turning = spin * body.inertia + cross(arm, f);
            link.inertia = dot(arm, arm) * body.mass + A::Several::ONE * body.inertia;
            let sums = &mut self.sums[A::COUNT * block..];
            A::spread([f[0], f[1], moment[0], moment[1]], sums);
        }
        last
    }

    /// Angles and angular velocities of bodies.
    #[inline(always)]
    fn turn(&mut self, joints: &PlanarJoints, blocks: Range<usize>, last: &mut Motion<A::Number>) {
        let links = &mut self.links[..blocks.end];
        let Motion { mut direction, mut spin, .. } = *last;
        for block in blocks {
            let first = A::COUNT * block;
            for (lane, joint) in group::<A>(joints, block).iter().enumerate() {
                let joint = A::Order::ties(joint, first + lane);
                match joint.parent {
                    0 => Motion { direction, spin, .. } = Motion::NONE,
                    parent if parent == first + lane => {}
                    parent => {
                        let (above, lane) =
                            (&links[(parent - 1) / A::COUNT], (parent - 1) % A::COUNT);
                        direction = one2::<A>(&above.direction, lane);
                        spin = A::one(&above.spin, lane);
                    }
                }
                let link = &mut links[block];
                put2::<A>(direction, &mut link.above, lane);
                A::put(spin, &mut link.spin_above, lane);
                direction = combined(direction, one2::<A>(&link.own, lane));
                spin += A::one(&link.spin, lane);
                put2::<A>(direction, &mut link.direction, lane);
                A::put(spin, &mut link.spin, lane);
            }
        }
        (last.direction, last.spin) = (direction, spin);
    }

    /// Velocities of joints.
    #[inline(always)]
    fn go_on(&mut self, joints: &PlanarJoints, blocks: Range<usize>, last: &mut Motion<A::Number>) {
        let links = &mut self.links[..blocks.end];
        let mut velocity = last.velocity;
        for block in blocks {
            let first = A::COUNT * block;
            for (lane, joint) in group::<A>(joints, block).iter().enumerate() {
                let joint = A::Order::ties(joint, first + lane);
                match joint.parent {
                    0 => velocity = [A::Number::ZERO; 2],
                    parent if parent == first + lane => {}
                    parent => {
                        let above = &links[(parent - 1) / A::COUNT].velocity;
                        velocity = one2::<A>(above, (parent - 1) % A::COUNT);
                    }
                }
                let link = &mut links[block];
                velocity = add(velocity, one2::<A>(&link.faster, lane));
                put2::<A>(velocity, &mut link.velocity, lane);
            }
        }
        last.velocity = velocity;
    }

    /// Momenta and moments of subtrees, and the derivatives, for some blocks.
    #[inline(always)]
    fn ascend<const SLIDES: bool>(
        &mut self,
        joints: &PlanarJoints,
        blocks: Range<usize>,
        l_q: &mut [A::Number],
        l_v: &mut [A::Number],
        mut below: Below<A::Number>,
    ) -> Below<A::Number> {
        let Self { links, sums, branches, .. } = self;
        let (links, sums) = (&mut links[..blocks.end], &mut sums[..A::COUNT * blocks.end]);
        let branches = &mut branches[..];
        for block in blocks.clone().rev() {
            let (first, link) = (A::COUNT * block, &mut links[block]);
            // Of one joint in registers: what is written in parts waits before it is read as a whole.
            let mut single = [sums[first]];
            let own = if A::COUNT == 1 { &mut single[..] } else { &mut sums[first..][..A::COUNT] };
            for (lane, joint) in group::<A>(joints, block).iter().enumerate().rev() {
                let joint = A::Order::ties(joint, first + lane);
                let mut sum = own[lane];
                if joint.is_followed {
                    sum = add4(sum, below.sums);
                }
                if joint.has_branches {
                    let others = &mut branches[first + lane].sums;
                    sum = add4(sum, std::mem::replace(others, Below::NONE.sums));
                }
                own[lane] = sum;
                let [x, y] = one2::<A>(&link.lever, lane);
                let sum = [sum[0], sum[1], sum[2] + x, sum[3] + y];
                match joint.parent {
                    0 => {}
                    parent if parent == first + lane => below.sums = sum,
                    parent => {
                        let others = &mut branches[parent - 1].sums;
                        *others = add4(*others, sum);
                    }
                }
            }
            let [fx, fy, x, y] = A::collect(own);
            (link.momentum, link.moment) = ([fx, fy], [x, y]);
            link.torque = cross(link.edge, [fx, fy]);
        }
        for block in blocks.clone().rev() {
            let (first, link) = (A::COUNT * block, &mut links[block]);
            for (lane, joint) in group::<A>(joints, block).iter().enumerate().rev() {
                let joint = A::Order::ties(joint, first + lane);
                let mut sum = A::one(&link.turning, lane);
                if joint.is_followed {
                    sum += below.turning;
                }
                if joint.has_branches {
                    sum += std::mem::take(&mut branches[first + lane].turning);
                }
                A::put(sum, &mut link.turning, lane);
                sum += A::one(&link.torque, lane);
                match joint.parent {
                    0 => {}
                    parent if parent == first + lane => below.turning = sum,
                    parent => branches[parent - 1].turning += sum,
                }
            }
        }
        for block in blocks {
            let (link, body) = (&links[block], A::body(joints, block));
            let Links { slide, rate, turning, momentum: f, moment, .. } = *link;
            let mut by_velocity = turning * body.turn;
            let mut by_position = dot(rate, f) + cross(moment, body.gravity) * body.turn;
            if SLIDES {
                by_velocity += dot(slide, f);
                by_position += dot(slide, body.gravity) * body.subtree_mass;
            }
            A::scatter(joints, block, by_velocity, l_v);
            A::scatter(joints, block, by_position, l_q);
        }
        below
    }

    /// Places the joints, for [`PlanarTree::pair`].
    #[inline(never)]
    fn place(&mut self, joints: &PlanarJoints) {
        if A::Number::IS_SEVERAL {
            in_registers!(A::Number, { self.place_here(joints) })
        } else {
            self.place_here(joints);
        }
    }

    /// The same in the code of the caller.
    #[inline(always)]
    pub(crate) fn place_here(&mut self, joints: &PlanarJoints) {
        for i in 0..self.positions.len() {
            // The root of a tree is its origin, unless that moves on.
            let joint = A::Order::ties(&joints[i], i);
            self.positions[i] = match joint.parent {
                0 => [A::Number::ZERO; 2],
                parent => add(self.positions[parent - 1], self.edge(i)),
            };
            if joint.is_anchor {
                // All joints placed so far in its tree are its ancestors.
                self.positions[i] = [A::Number::ZERO; 2];
                let mut below = i;
                while joints[below].parent > 0 {
                    let (parent, edge) = (joints[below].parent - 1, self.edge(below));
                    let position = self.positions[below];
                    self.positions[parent] = [position[0] - edge[0], position[1] - edge[1]];
                    below = parent;
                }
            }
        }
    }

    #[inline(always)]
    fn edge(&self, joint: usize) -> Vec2<A::Number> {
        one2::<A>(&self.links[joint / A::COUNT].edge, joint % A::COUNT)
    }

    #[inline(always)]
    pub(crate) fn link(&self, joint: usize) -> Link<A::Number> {
        let (links, lane) = (&self.links[joint / A::COUNT], joint % A::COUNT);
        Link {
            edge: one2::<A>(&links.edge, lane),
            slide: one2::<A>(&links.slide, lane),
            rate: one2::<A>(&links.rate, lane),
            force: one3::<A>(&links.force, lane),
            slope: one3::<A>(&links.slope, lane),
            weight: A::one(&links.weight, lane),
        }
    }

    #[inline(always)]
    fn pair(
        &self,
        joints: &[PlanarJoint],
        ancestor: usize,
        descendant: usize,
    ) -> SecondDerivatives<A::Number> {
        let (above, below) = (self.link(ancestor), self.link(descendant));
        let ([x0, y0], [x, y]) = (self.positions[ancestor], self.positions[descendant]);
        let (s, arm) = (joints[ancestor].body.turn, [x - x0, y - y0]);
        let along = |wrench: Vec3<A::Number>| {
            let f = linear(wrench);
            (wrench[0] + cross(arm, f)) * s + dot(above.slide, f)
        };
        SecondDerivatives {
            qq: dot(above.rate, linear(below.slope)) + below.weight * s,
            v_above_q_below: along(below.slope),
            q_above_v_below: dot(above.rate, linear(below.force)),
            vv: along(below.force),
        }
    }
}

impl<A: Arrangement> Joints<A> {
    #[inline(never)]
    fn fill_newton_matrix(
        &self,
        joints: &[PlanarJoint],
        pairs: &[Pair],
        step: f64,
        matrix: &mut TreeLu<A::Number>,
    ) {
        if A::Number::IS_SEVERAL {
            in_registers!(A::Number, { self.fill(joints, pairs, step, matrix) })
        } else {
            self.fill(joints, pairs, step, matrix);
        }
    }

    #[inline(always)]
    fn fill(
        &self,
        joints: &[PlanarJoint],
        pairs: &[Pair],
        step: f64,
        matrix: &mut TreeLu<A::Number>,
    ) {
        for pair in pairs {
            let [ancestor, descendant, slot] =
                [pair.ancestor, pair.descendant, pair.slot].map(|i| i as usize);
            self.fill_entry(joints, [ancestor, descendant], step, (matrix, slot));
        }
    }

    /// Fills the entries of a joint and one on its path to the root.
    #[inline(always)]
    pub(crate) fn fill_entry(
        &self,
        joints: &[PlanarJoint],
        [ancestor, descendant]: [usize; 2],
        step: f64,
        (matrix, slot): (&mut TreeLu<A::Number>, usize),
    ) {
        let (quarter, inverse) = (0.25 * step, 1.0 / step);
        let second = self.pair(joints, ancestor, descendant);
        let common = second.qq * quarter - second.vv * inverse;
        let skew = (second.q_above_v_below - second.v_above_q_below) * 0.5;
        matrix.upper[slot] = common + skew;
        matrix.lower[slot] = common - skew;
    }
}
