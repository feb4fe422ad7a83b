//! The linear system of a step, factored and solved: the KKT system
//!
//! ```text
//! [ K   −A0ᵀ ] [dx]     [r1]       S = A1 K⁻¹ A0ᵀ,   S dλ = A1 K⁻¹ r1 − r2
//! [ A1    0  ] [dλ] = − [r2],      dx = K⁻¹ (A0ᵀ dλ − r1)
//! ```
//!
//! The tree LU of `K` with the Schur complement `S` serves every scene. Where a recursion is faster, it takes
//! its place; what it cannot do sound falls back on the tree.

use plantd_math::tree_lu::{SmallestPivot, TreeLu};

use crate::constraints::closure::Closure;
use crate::kkt::held::HeldLimbs;
use crate::kkt::loops::{Mechanism, Multifrontal, Scales};
use crate::kkt::planar::PlanarRecursion;
use crate::kkt::schur::SchurComplement;
use crate::kkt::space::derivatives::Derivatives;
use crate::kkt::space::margins::Own;
use crate::kkt::space::{Added, Spatial};
use crate::kkt::tied::Tied;
use crate::lagrangian::fields::Fields;
use crate::lagrangian::generators::MatrixKind;
use crate::lagrangian::instant::Instant;
use crate::lagrangian::mechanics::Mechanics;
use crate::lagrangian::planar::PlanarTree;
use crate::lagrangian::turning::Weights;
use crate::model::mechanism::{Model, Solver};

/// Pivots of loops, relative to what they are compared with, from which on they are taken.
const SAFE: f64 = 1e-6;

/// What a factorization of the tree LU costs, in corrections.
pub(crate) const TREE_CORRECTIONS: u32 = 3;

/// The KKT system of a step, with all factors that its model may need.
#[derive(Clone, Debug)]
pub(crate) struct KktSystem {
    pub(crate) factored: Factored,
    pub(crate) schur: SchurComplement,
    /// What springs, dampers and armatures of coordinates add to the diagonal of `K`, for recursions.
    pub(crate) diagonal: Vec<f64>,
    /// How ball joints weigh their rows and columns.
    pub(crate) balls: Vec<Weights>,
    pub(crate) estimates: Estimates,
    /// What acts on bodies from the world or from bodies above, where generators have that.
    pub(crate) fields: Option<Box<Fields>>,
    /// What generators do not have of elements between bodies.
    pub(crate) tied: Option<Box<Tied>>,
    /// For linearizations by generators in space.
    pub(crate) in_space: Option<Derivatives>,
}

/// Factors of `K`.
#[derive(Clone, Debug, Default)]
pub(crate) struct Factored {
    /// Entry by entry; without room until it is filled, where generators stand for it.
    pub(crate) tree: TreeLu,
    pub(crate) recursion: Recursion,
    /// Which of them were factored last.
    pub(crate) valid: Factors,
}

/// Factors that take the place of the tree LU, or of most of it.
#[derive(Clone, Debug, Default)]
pub(crate) enum Recursion {
    #[default]
    None,
    Planar(Box<PlanarRecursion>),
    /// With the constraints.
    Loops(Box<Multifrontal>),
    Spatial(Box<Spatial>),
    /// Limbs with the constraints, and the tree LU of what they leave.
    Held(Box<HeldLimbs>),
}

/// Which factors are valid.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(crate) enum Factors {
    /// The tree LU.
    #[default]
    Tree,
    Recursion,
    /// None at the last evaluation: a linearization had its own.
    Stale,
}

/// Reciprocal condition estimates of the last factorization.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Estimates {
    pub(crate) matrix: f64,
    pub(crate) constraints: f64,
    pub(crate) redundant: u32,
}

/// Where a system is factored: at the last gradient of the mechanics.
pub(crate) struct Linearized<'a> {
    pub(crate) model: &'a Model,
    pub(crate) mechanics: &'a mut Mechanics,
    /// Constraints at the start and at the end of the step.
    pub(crate) constraints: [&'a Closure; 2],
    pub(crate) time_step_s: f64,
    pub(crate) singular_below: f64,
}

impl Factored {
    /// Room for the factors of a model.
    pub(crate) fn new(model: &Model) -> Self {
        let recursion = match (model.solver, &model.loops) {
            (Solver::Planar, _) => {
                Recursion::Planar(Box::new(PlanarRecursion::new(model.dimensions.dynamic)))
            }
            (Solver::Loops, Some(loops)) => Recursion::Loops(Box::new(Multifrontal::new(loops))),
            (Solver::Held, _) => match &model.held {
                Some(held) => Recursion::Held(Box::new(HeldLimbs::new(held))),
                None => Recursion::None,
            },
            (Solver::Spatial, _) => Recursion::Spatial(Box::new(Spatial::new(model))),
            (Solver::Tree | Solver::Loops, _) => Recursion::None,
        };
        // Long chains have many entries, and seldom need them.
        let tree = match model.solver {
            Solver::Spatial => TreeLu::default(),
            _ => TreeLu::new(&model.elimination),
        };
        Self { tree, recursion, valid: Factors::Tree }
    }
}

impl KktSystem {
    /// Room for the factors, by what suits the model; columns of the Schur complement are `stride` apart.
    pub(crate) fn new(model: &Model, stride: usize) -> Self {
        let nd = model.dimensions.dynamic;
        let entries = model.elimination.entries();
        let is_closed = model.dimensions.constraints > 0 || model.tied_rows > 0;
        // Limbs that are held have a linearization of their own.
        let mut in_space = (model.is_generated_in_space() && model.held.is_none())
            .then(|| Derivatives::new(model))
            .filter(|own| own.is_faster(entries, is_closed));
        if let Some(in_space) = &mut in_space {
            in_space.make_room();
        }
        let is_generated = in_space.is_some() || model.solver == Solver::Spatial;
        let fields = (is_generated && model.has_fields()).then(|| Box::new(Fields::new(model)));
        let is_tied = is_generated && model.tied_rows > 0;
        Self {
            factored: Factored::new(model),
            in_space,
            fields,
            tied: is_tied.then(|| Box::new(Tied::new(model, stride))),
            schur: SchurComplement::new(model, stride),
            diagonal: vec![0.0; nd],
            balls: vec![Weights::REST; model.orientations.len()],
            estimates: Estimates { matrix: 1.0, constraints: 1.0, redundant: 0 },
        }
    }

    /// What a factorization costs, in corrections.
    pub(crate) fn corrections(&self) -> u32 {
        if self.has_recursion() { 2 } else { TREE_CORRECTIONS }
    }

    pub(crate) fn has_recursion(&self) -> bool {
        !matches!(self.factored.recursion, Recursion::None)
    }

    /// Factors by the recursion: false where there is none or its pivots are not sound, and the tree has to
    /// do. Of limbs that are held `K` is filled. The error is a pivot that is too small. Of masses alone all
    /// pivots of trees are taken.
    pub(crate) fn factor_recursion(
        &mut self,
        at: Linearized<'_>,
        kind: MatrixKind,
    ) -> Result<bool, SmallestPivot> {
        let Linearized { model, mechanics, constraints, time_step_s, singular_below } = at;
        let (conditioning, diagonal) = (&model.conditioning, &self.diagonal);
        let inertia = &conditioning.inertia;
        let Factored { tree: matrix, recursion, valid } = &mut self.factored;
        *valid = Factors::Tree;
        let pivot = match (recursion, mechanics.planar.as_deref_mut(), &model.planar) {
            (Recursion::Planar(recursion), Some(PlanarTree::Many(tree)), Some(joints)) => {
                tree.differentiate(joints);
                recursion.factor(tree, joints, diagonal, inertia, time_step_s, kind)
            }
            (Recursion::Loops(fronts), Some(PlanarTree::Many(tree)), Some(joints)) => {
                let [start, end] = constraints.map(|closure| closure.in_plane.as_deref());
                let (Some(loops), Some(start), Some(end)) = (&model.loops, start, end) else {
                    return Ok(false);
                };
                tree.differentiate(joints);
                let at = Mechanism { loops, joints, tree, start, end };
                let scales = Scales { inertia, weight: &conditioning.weight };
                let pivots = fronts.factor(at, diagonal, scales, time_step_s, kind);
                if pivots.joints.relative < SAFE
                    || pivots.equations < SAFE
                    || pivots.steepness < singular_below
                {
                    return Ok(false);
                }
                *valid = Factors::Recursion;
                self.estimates = Estimates {
                    matrix: pivots.joints.relative,
                    constraints: pivots.equations.min(pivots.steepness),
                    redundant: (model.constraints.len() - loops.equations.len()) as u32,
                };
                return Ok(true);
            }
            (Recursion::Held(limbs), ..) => {
                let (Some(held), MatrixKind::Newton) = (&model.held, kind) else {
                    return Ok(false);
                };
                let pivots = limbs.factor(model, held, matrix, constraints, time_step_s);
                let Some(pivot) = pivots.rest.filter(|pivot| pivot.relative >= SAFE) else {
                    return Ok(false);
                };
                *valid = Factors::Recursion;
                let (matrix, constraints) = (pivot.relative, pivots.equations);
                self.estimates = Estimates { matrix, constraints, redundant: 0 };
                return Ok(true);
            }
            (Recursion::Spatial(recursion), ..) => {
                mechanics.differentiate(model);
                let fields = self.fields.as_deref().filter(|_| kind == MatrixKind::Newton);
                let added = Added { diagonal, balls: &self.balls, fields };
                let pivot =
                    recursion.factor(model, (&mechanics.curvature, added), time_step_s, kind);
                if let Some(tied) = &mut self.tied {
                    if kind == MatrixKind::Mass {
                        tied.weigh_masses(time_step_s);
                    }
                    // A pivot that is too small may be one by the generators alone.
                    if !tied.is_idle
                        && (pivot.relative < singular_below || !tied.factor(|x| recursion.solve(x)))
                    {
                        return Ok(false);
                    }
                }
                pivot
            }
            (Recursion::None | Recursion::Planar(_) | Recursion::Loops(_), ..) => {
                return Ok(false);
            }
        };
        *valid = Factors::Recursion;
        if kind == MatrixKind::Newton {
            self.judge(pivot, singular_below).map(|()| true)
        } else {
            let is_free = model.constraints.is_empty();
            Ok(is_free || self.factor_schur(model, constraints, time_step_s, singular_below))
        }
    }

    /// Finds what ties and other elements between bodies give at an instant; forces count `weight` times.
    pub(crate) fn evaluate_elements(&mut self, model: &Model, at: &Instant<'_>, weight: f64) {
        let mut pulls = &[][..];
        if let Some(tied) = &mut self.tied {
            tied.ties.evaluate(model, at, weight);
            pulls = tied.ties.pulls();
        }
        if let Some(fields) = &mut self.fields {
            fields.evaluate(model, at, pulls, weight);
        }
    }

    /// Factors by generators in space at the last second derivatives, for derivatives of the step. The error is a
    /// pivot that is too small.
    pub(crate) fn differentiate_in_space(
        &mut self,
        at: Linearized<'_>,
        own: Own<'_>,
        derivatives: &mut Derivatives,
    ) -> Result<(), SmallestPivot> {
        let Linearized { model, mechanics, time_step_s, singular_below, .. } = at;
        let (diagonal, balls) = (&self.diagonal[..], &self.balls[..]);
        let added = Added { diagonal, balls, fields: self.fields.as_deref() };
        self.factored.valid = Factors::Stale;
        let step = (&model.conditioning.inertia[..], time_step_s);
        let pivot = derivatives.factor((&mechanics.curvature, added), own, step);
        self.judge(pivot, singular_below)
    }

    /// Factors `K`, which is filled, by the tree LU. The error is a pivot that is too small.
    pub(crate) fn factor_tree(
        &mut self,
        model: &Model,
        time_step_s: f64,
        singular_below: f64,
    ) -> Result<(), SmallestPivot> {
        self.factored.valid = Factors::Tree;
        let inertia = &model.conditioning.inertia;
        let pivot = self.factored.tree.factor(&model.elimination, inertia, 1.0 / time_step_s.abs());
        self.judge(pivot, singular_below)
    }

    /// Takes note of the smallest pivot; refuses one that is too small.
    fn judge(&mut self, pivot: SmallestPivot, singular_below: f64) -> Result<(), SmallestPivot> {
        self.estimates.matrix = pivot.relative;
        if pivot.relative >= singular_below { Ok(()) } else { Err(pivot) }
    }

    /// Factors `S` by the valid factors and the Jacobians at the start and the end; false if it is singular.
    pub(crate) fn factor_schur(
        &mut self,
        model: &Model,
        [start, end]: [&Closure; 2],
        time_step_s: f64,
        singular_below: f64,
    ) -> bool {
        let Self { factored: Factored { tree, recursion, valid }, schur, tied, .. } = self;
        match (recursion, *valid) {
            (Recursion::Spatial(recursion), Factors::Recursion) => {
                schur.respond(model, start, |x| solve_in_space(recursion, tied, x));
            }
            _ => schur.respond_by_tree(model, tree, start),
        }
        self.close_schur(model, end, time_step_s, singular_below)
    }

    /// The same by the responses that there are.
    pub(crate) fn close_schur(
        &mut self,
        model: &Model,
        end: &Closure,
        time_step_s: f64,
        singular_below: f64,
    ) -> bool {
        self.schur.factor(model, end);
        let lu = &self.schur.lu;
        self.estimates.constraints =
            lu.reciprocal_condition(model.constraint_rank(), time_step_s.abs());
        self.estimates.redundant = lu.deficiency() as u32;
        self.estimates.constraints >= singular_below
    }

    /// Solves in place with the valid factors: from `r1` and `r2` come `−dx` and `dλ`.
    pub(crate) fn solve(
        &mut self,
        model: &Model,
        end: &Closure,
        x: &mut [f64],
        lambda: &mut [f64],
    ) {
        match (&mut self.factored.recursion, self.factored.valid, &model.planar) {
            (Recursion::Planar(recursion), Factors::Recursion, Some(joints)) => {
                recursion.elimination.solve(joints, x);
            }
            (Recursion::Loops(fronts), Factors::Recursion, _) => {
                if let Some(loops) = &model.loops {
                    fronts.solve(loops, x, lambda);
                    lambda.iter_mut().for_each(|change| *change = -*change);
                }
            }
            (Recursion::Spatial(recursion), Factors::Recursion, _) => {
                solve_in_space(recursion, &mut self.tied, x);
                if !lambda.is_empty() {
                    self.schur.close(model, end, x, lambda);
                }
            }
            (Recursion::Held(limbs), Factors::Recursion, _) => {
                if let Some(held) = &model.held {
                    limbs.solve(held, x, lambda);
                }
            }
            _ => {
                self.factored.tree.solve(&model.elimination, x);
                if !lambda.is_empty() {
                    self.schur.close(model, end, x, lambda);
                }
            }
        }
    }

    /// Whether constraints are eliminated by the Schur complement of all of `K`.
    pub(crate) fn has_schur(&self) -> bool {
        let with_joints =
            matches!(self.factored.recursion, Recursion::Loops(_) | Recursion::Held(_));
        self.factored.valid != Factors::Recursion || !with_joints
    }

    /// Takes away from multipliers what redundant equations leave open; where constraints are eliminated together with
    /// joints, nothing is.
    pub(crate) fn remove_null(&self, multipliers: &mut [f64]) {
        if self.has_schur() {
            self.schur.lu.remove_null(multipliers);
        }
    }
}

/// Solves by generators, with the ties.
fn solve_in_space(recursion: &mut Spatial, tied: &mut Option<Box<Tied>>, x: &mut [f64]) {
    recursion.solve(x);
    if let Some(tied) = tied.as_deref_mut().filter(|tied| !tied.is_idle) {
        tied.close(x);
    }
}
