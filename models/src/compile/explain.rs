//! What a model evaluates, for people to read.

use std::fmt::Write as _;

use crate::model::mechanism::{ConstraintKind, Model, Solver};
use crate::model::signal::{Signal, Target};
use crate::model::tree::JointKind;

impl Model {
    /// What a step evaluates and what it skips, for people to read.
    pub fn plan(&self) -> String {
        let mut plan = String::new();
        let mut line = |text: String| {
            let _ = writeln!(plan, "{text}");
        };
        self.explain_structure(&mut line);
        self.explain_elements(&mut line);
        self.explain_cost(&mut line);
        self.warnings().iter().for_each(|warning| line(format!("warning       {warning}")));
        plan
    }

    /// Coordinates, joints, and how a step solves.
    fn explain_structure(&self, line: &mut impl FnMut(String)) {
        let d = self.dimensions;
        line(format!(
            "coordinates   {} dynamic, {} prescribed; state {}, input {}",
            d.dynamic,
            d.prescribed,
            d.state(),
            d.input()
        ));
        let joints = &self.dynamics.joints;
        let count = |is: fn(&JointKind) -> bool| joints.iter().filter(|j| is(&j.kind)).count();
        let kinds = [
            ("revolute", count(|kind| matches!(kind, JointKind::Revolute))),
            ("prismatic", count(|kind| matches!(kind, JointKind::Prismatic))),
            ("screw", count(|kind| matches!(kind, JointKind::Screw(_)))),
            ("of ball joints", count(|kind| matches!(kind, JointKind::Ball(_)))),
        ];
        let kinds = kinds.iter().filter(|(_, n)| *n > 0).map(|(kind, n)| format!("{n} {kind}"));
        line(format!(
            "midpoint      {}, {} axes of {} moving frames: {}",
            if self.planar.is_some() { "in the plane" } else { "in space" },
            joints.len(),
            self.scene.frames.iter().filter(|f| !f.motions().is_empty()).count(),
            kinds.collect::<Vec<_>>().join(", ")
        ));
        let (axes, most) = self.straightened;
        if axes > 0 {
            line(format!(
                "axes          {axes} of them turned by up to {most:.1e} rad, to be parallel or across"
            ));
        }
        let islands = self.elimination.islands();
        let islands = format!("{islands} {}", if islands == 1 { "island" } else { "islands" });
        line(match self.solver {
            Solver::Tree => format!(
                "factorization tree-sparse, {} entries of {} in each triangle, {islands}",
                self.elimination.entries(),
                d.dynamic * (d.dynamic + 1) / 2,
            ),
            Solver::Held => {
                let limbs = self.held.iter().flat_map(|held| &held.limbs);
                let rows = limbs.clone().map(|limb| limb.coordinates.len()).sum::<usize>();
                format!(
                    "factorization {} limbs with their constraints, {} coordinates tree-sparse",
                    limbs.count(),
                    d.dynamic - rows,
                )
            }
            Solver::Loops => {
                let plan = self.loops.as_ref().map(|loops| &loops.plan);
                let most = plan.and_then(|plan| plan.fronts.iter().max()).copied().unwrap_or(0);
                format!(
                    "factorization by generators with loops, {} joints in fronts of up to {most} rows, {islands}",
                    joints.len()
                )
            }
            Solver::Planar | Solver::Spatial => {
                let fields = if self.solver == Solver::Spatial && self.has_fields() {
                    ", with what acts at poses"
                } else {
                    ""
                };
                let ties = match self.tied_rows {
                    rows if rows > 0 && self.solver == Solver::Spatial => {
                        format!(", {rows} rows of ties")
                    }
                    _ => String::new(),
                };
                format!(
                    "factorization by generators{fields}{ties}, {} joints, {islands}",
                    joints.len()
                )
            }
        });
    }

    /// Gravity, springs, damping, inputs, forces, signals and constraints.
    fn explain_elements(&self, line: &mut impl FnMut(String)) {
        let d = self.dimensions;
        let skipped = |is: bool| if is { "" } else { " (skipped)" };
        line(format!(
            "gravity       {}",
            if self.gravity.is_some() { "uniform" } else { "none (skipped)" }
        ));
        let springs = self.potentials.springs.len();
        let counts = self.potentials.counts();
        line(format!("springs       {springs}: {counts}{}", skipped(springs > 0)));
        let damped = self.damping.iter().filter(|c| **c != 0.0).count();
        line(format!("damping       {damped} coordinates{}", skipped(damped > 0)));
        line(format!("inputs        {}{}", d.inputs, skipped(d.inputs > 0)));
        line(match &self.forces {
            None => "forces        0 (skipped)".to_owned(),
            Some(forces) => format!(
                "forces        {} wrenches, {} between points, {} on coordinates, {} linear, {} along paths or segments of them",
                forces.wrenches.len(),
                forces.point_forces.len(),
                forces.coordinate_forces.len(),
                forces.linear_dampers.len(),
                forces.path_forces.len()
            ),
        });
        let on_inputs = |s: &&Signal| matches!(s.target, Target::Input(_));
        let on_inputs = self.signals.iter().filter(on_inputs).count();
        line(match self.signals.len() {
            0 => "signals       0 (skipped)".to_owned(),
            n => format!("signals       {on_inputs} on inputs, {} on coordinates", n - on_inputs),
        });
        let equations = |is: fn(&ConstraintKind) -> bool| {
            self.constraints.iter().filter(|constraint| is(&constraint.kind)).count()
        };
        line(format!(
            "constraints   {} equations over {} joints: {} distance, {} axis, {} product, {} path, {} coupling{}",
            d.constraints,
            self.closure.joints.len(),
            equations(|kind| matches!(kind, ConstraintKind::Distance(_))),
            equations(|kind| matches!(kind, ConstraintKind::Axis(_))),
            equations(|kind| matches!(kind, ConstraintKind::Product(_))),
            equations(|kind| matches!(kind, ConstraintKind::PathLength(_))),
            equations(|kind| matches!(kind, ConstraintKind::Coupling(_))),
            skipped(d.constraints > 0)
        ));
    }

    /// The cost of a step, stage by stage.
    fn explain_cost(&self, line: &mut impl FnMut(String)) {
        let stages = self.stage_costs();
        let step: f64 = stages.iter().map(|stage| stage.times * stage.instructions).sum();
        line(format!("cost          about {:.1} thousand instructions a step:", step / 1e3));
        for stage in stages {
            let (share, thousands) =
                (stage.times * stage.instructions / step, stage.instructions / 1e3);
            line(match stage.times {
                0.0 => format!("  {:<20}and {thousands:.1} more", stage.name),
                times => {
                    format!(
                        "  {:<20}{times:.1} × {thousands:.1}, {:.0} %",
                        stage.name,
                        100.0 * share
                    )
                }
            });
        }
    }
}
