//! What a step costs, estimated from a model alone: for people who ask what their scene spends its time on.
//!
//! The coefficients are instructions on x86-64 with AVX2, read from callgrind on the built-in scenes; the
//! sums are right to a factor of two, which the tests of the instruction counts hold them to.

use crate::integrator::settings::Settings;
use crate::model::mechanism::{Blocks, ConstraintKind, Forces, Model, Solver};
use crate::model::tree::{Rotational, Tree};

/// A part of a step of the midpoint rule, or of its linearization.
#[derive(Clone, Debug, PartialEq)]
pub struct StageCost {
    /// What is done.
    pub name: &'static str,
    /// How often a step does it, on a smooth motion; zero for what only a linearization does.
    pub times: f64,
    /// Instructions each time.
    pub instructions: f64,
}

impl Model {
    /// The parts of a step, and the linearization last.
    pub fn stage_costs(&self) -> Vec<StageCost> {
        let d = self.dimensions();
        let (nd, nc) = (d.dynamic as f64, d.constraints as f64);
        let entries = self.elimination.entries() as f64;
        // Of a factorization entry by entry: each row changes those of its ancestors.
        let changes: f64 = self.elimination.lengths().map(|entries| (entries as f64).powi(2)).sum();
        let support: Vec<f64> =
            self.constraints.iter().map(|c| c.coordinates.len() as f64).collect();

        let (evaluation, generators) = if self.planar.is_some() {
            (230.0 * self.dynamics.joints.len() as f64, 200.0)
        } else {
            (in_space(&self.dynamics), 340.0)
        };
        let others = self.potentials.springs.len() as f64
            + self.forces.as_ref().map_or(0, Forces::coupling) as f64;
        let balls = 1500.0 * self.orientations.len() as f64;
        let joints = self.dynamics.joints.len() as f64;
        // Of loops.
        let plan = self.loops.as_ref().map(|loops| &loops.plan);
        let (fronts, rows) = plan.map_or((0.0, 0.0), |plan| (plan.work(), plan.rows() as f64));
        let (factorization, correction) = match self.solver {
            Solver::Tree | Solver::Held => {
                (generators * joints + 60.0 * entries + 24.0 * changes, 110.0 + 27.0 * entries)
            }
            Solver::Planar => (100.0 + 340.0 * joints, 110.0 + 88.0 * joints),
            Solver::Loops => (5.0 * fronts, 41.0 * rows),
            Solver::Spatial => {
                let (more, correction) = match self.blocks() {
                    Blocks::One => (0.0, 0.0),
                    Blocks::Two => (2950.0, 77.0),
                    Blocks::Three => (7850.0, 154.0),
                };
                let (acted_on, ties) = (self.acted_on() as f64, self.tied_rows as f64);
                let solution = 110.0 + 93.0 * joints + correction * acted_on;
                // Each row of a tie is solved for, and met with all others.
                let closing = ties * (solution + nd * (40.0 + ties)) + 2.0 * ties.powi(3);
                (100.0 + 1350.0 * joints + more * acted_on + closing, solution + 1.5 * nd * ties)
            }
        };
        let responses = if self.solver == Solver::Spatial { correction } else { 165.0 * nd };
        let schur = 800.0 + responses * nc + 2.0 * nc.powi(3);
        let jacobian = 71.0 * support.iter().sum::<f64>();
        // Equations along world axes share what their second derivatives are made of.
        let alone = self.constraints.iter().zip(&support);
        let alone = alone.filter(|(c, _)| !matches!(c.kind, ConstraintKind::Axis(_)));
        let hessians = 50.0 * alone.map(|(_, size)| size * size).sum::<f64>() + 40.0 * entries;
        let columns = (d.coordinates() + d.dynamic + d.prescribed) as f64;
        let mut linearization = 84.0 * nd * columns;

        let stage = |name, times, instructions| StageCost { name, times, instructions };
        let evaluation = 560.0 + evaluation + balls + 300.0 * others;
        // Where the end of a step is foreseen, the last correction is not looked at, but for a linearization.
        let is_foreseen = self.is_foreseen(&Settings::new(self));
        let (evaluations, corrections) = if is_foreseen { (1.8, 1.8) } else { (3.2, 3.1) };
        let mut stages = vec![
            stage("evaluation", evaluations, evaluation),
            stage("factorization", 1.1, 100.0 + factorization),
            stage(
                "correction",
                corrections,
                correction + if plan.is_some() { 0.0 } else { 30.0 * nd * nc },
            ),
        ];
        if is_foreseen {
            stages.push(stage("what it leaves over", 1.0, 220.0 * joints));
            linearization += evaluation;
        }
        if nc > 0.0 {
            let values = in_space(&self.closure) / 2.0 + 200.0 * nc;
            // Where the last correction leads they are looked at in any case.
            let looks = if is_foreseen { evaluations + 1.0 } else { evaluations };
            stages.push(stage("constraints", looks, values));
            linearization += jacobian + hessians;
            if plan.is_some() {
                stages.push(stage("their wrenches", 2.1, 310.0 * joints));
                linearization += factorization + 15.0 * rows * columns;
            } else if self.held.is_some() {
                stages.push(stage("their Jacobian", 2.0, jacobian));
            } else {
                stages.push(stage("their Jacobian", 2.0, jacobian));
                stages.push(stage("their factorization", 1.1, schur));
                linearization += schur + 300.0 * nd * nc;
            }
        }
        stages.push(stage("all else", 1.0, 900.0 + 60.0 * nd));
        stages.push(stage("A and B", 0.0, linearization));
        stages
    }
}

/// An evaluation of a tree in space.
fn in_space(tree: &Tree) -> f64 {
    let of = |inertia: &Rotational| match inertia {
        Rotational::None => 250.0,
        Rotational::Point => 320.0,
        Rotational::Isotropic(_) => 360.0,
        Rotational::Full(_) => 600.0,
    };
    tree.joints.iter().map(|joint| of(&joint.body.inertia)).sum()
}
