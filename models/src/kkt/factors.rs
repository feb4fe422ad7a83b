//! The Newton matrix of a step, factored: entry by entry, or by its generators.

use crate::kkt::planar::MatrixKind;
use crate::kkt::{loops, planar, space};
use crate::lagrangian::mechanics::Mechanics;
use crate::lagrangian::planar::PlanarTree;
use crate::math::tree_lu::{SmallestPivot, TreeLu};
use crate::model::mechanism::{Model, Solver};

/// The Newton matrix `K`, factored.
#[derive(Clone, Debug)]
pub(crate) struct Factors {
    /// Entry by entry.
    pub(crate) matrix: TreeLu,
    /// By its generators, where that is faster.
    pub(crate) generators: Option<Box<Generators>>,
}

/// The Newton matrix of a tree in planes or in space.
#[derive(Clone, Debug)]
pub(crate) enum Generators {
    Planar(planar::PlanarRecursion),
    /// With the constraints.
    Loops(Box<loops::Multifrontal>),
    Spatial(space::SpatialRecursion),
}

impl Factors {
    pub(crate) fn new(model: &Model) -> Self {
        let joints = model.dimensions.dynamic;
        let generators = match model.solver {
            Solver::Tree => None,
            Solver::Planar => Some(Generators::Planar(planar::PlanarRecursion::new(joints))),
            Solver::Loops => {
                let loops = model.loops.as_ref();
                loops.map(|loops| Generators::Loops(Box::new(loops::Multifrontal::new(loops))))
            }
            Solver::Spatial => Some(Generators::Spatial(space::SpatialRecursion::new(
                &model.dynamics,
                model.gravity,
            ))),
        };
        Self { matrix: TreeLu::new(&model.elimination), generators: generators.map(Box::new) }
    }

    /// The generators of a planar tree.
    pub(crate) fn planar(&mut self) -> Option<&mut planar::PlanarRecursion> {
        match self.generators.as_deref_mut() {
            Some(Generators::Planar(generators)) => Some(generators),
            _ => None,
        }
    }

    /// Factors the generators, where there are some, at the last gradient of `mechanics`.
    pub(crate) fn generate(
        &mut self,
        model: &Model,
        mechanics: &mut Mechanics,
        diagonal: &[f64],
        step: f64,
        kind: MatrixKind,
    ) -> Option<SmallestPivot> {
        let inertia = &model.conditioning.inertia;
        match (self.generators.as_deref_mut()?, &mut mechanics.planar, &model.planar) {
            (Generators::Planar(generators), Some(planar), Some(joints)) => {
                let PlanarTree::Many(tree) = &mut **planar else { return None };
                tree.differentiate(joints);
                Some(generators.factor(tree, joints, diagonal, inertia, step, kind))
            }
            (Generators::Spatial(generators), ..) => {
                mechanics.differentiate(model);
                Some(generators.factor(&model.dynamics, mechanics, diagonal, inertia, step, kind))
            }
            _ => None,
        }
    }

    /// Those of a mechanism with loops.
    pub(crate) fn loops(&mut self) -> Option<&mut loops::Multifrontal> {
        match self.generators.as_deref_mut() {
            Some(Generators::Loops(generators)) => Some(generators),
            _ => None,
        }
    }

    /// Solves for increments and multipliers in place.
    pub(crate) fn solve_loops(&mut self, model: &Model, x: &mut [f64], constraints: &mut [f64]) {
        if let (Some(generators), Some(loops)) = (self.loops(), &model.loops) {
            generators.solve(loops, x, constraints);
        }
    }

    /// Solves `K x = b` in place.
    pub(crate) fn solve(&mut self, model: &Model, x: &mut [f64]) {
        match (self.generators.as_deref_mut(), &model.planar) {
            (Some(Generators::Planar(generators)), Some(joints)) => generators.solve(joints, x),
            (Some(Generators::Spatial(generators)), _) => generators.solve(&model.dynamics, x),
            _ => self.matrix.solve(&model.elimination, x),
        }
    }
}
