//! Finds limbs whose ends are held.

use std::collections::BTreeSet;
use std::ops::Range;

use plantd_math::elimination::SymbolicElimination;

use crate::integrator::workspace::Workspace;
use crate::kkt::held::MOST;
use crate::model::held::{Held, HeldLimb};
use crate::model::mechanism::{Model, Solver};

impl Model {
    /// Finds the limbs that are held, and eliminates them with their equations where these are all there are, and
    /// the pivots are sound at the configuration that [`Conditioning`] found.
    ///
    /// [`Conditioning`]: crate::model::conditioning::Conditioning
    pub(crate) fn find_held(&mut self) {
        if self.solver != Solver::Tree || self.planar.is_some() || self.loops.is_some() {
            return;
        }
        self.held = self.held_limbs();
        if self.held.is_some() {
            self.solver = Solver::Held;
            if !Workspace::new(self).can_eliminate_constraints(self) {
                (self.held, self.solver) = (None, Solver::Tree);
            }
        }
    }

    fn held_limbs(&self) -> Option<Held> {
        let d = self.dimensions;
        if d.constraints == 0 || d.prescribed > 0 || self.constraint_rank() < d.constraints {
            return None;
        }
        let (mut limbs, mut begin) = (Vec::<HeldLimb>::new(), 0);
        while let Some(first) = self.constraints.get(begin) {
            let moved: BTreeSet<usize> = first.coordinates.iter().copied().collect();
            let alike = self.constraints[begin..].iter().take_while(|constraint| {
                constraint.coordinates.iter().copied().collect::<BTreeSet<_>>() == moved
            });
            let equations = begin..begin + alike.count();
            begin = equations.end;
            limbs.push(self.held_limb(equations, &moved)?);
        }
        for at in 1..limbs.len() {
            let differs = limbs[at - 1].above != limbs[at].above;
            (limbs[at - 1].is_last, limbs[at].is_first) = (differs, differs);
        }
        // No limb is above another row, nor moves another's equations.
        let is_held = |row: &usize| limbs.iter().any(|limb| limb.coordinates.contains(row));
        let SymbolicElimination { offsets, ancestors, .. } = &self.elimination;
        let proper = |k: usize| -> BTreeSet<usize> {
            ancestors[offsets[k]..offsets[k + 1] - 1].iter().copied().collect()
        };
        let are_last = limbs.iter().all(|limb| limb.above.iter().all(|above| !is_held(above)));
        let others = (0..d.dynamic).filter(|k| !is_held(k));
        // Nor have two the same coordinates: equations that move the same end may move different others.
        let owned: usize = limbs.iter().map(|limb| limb.coordinates.len()).sum();
        let are_apart = owned == (0..d.dynamic).filter(is_held).count();
        if !are_last || !are_apart || others.clone().any(|k| proper(k).iter().any(is_held)) {
            return None;
        }
        let rest = (0..d.dynamic).map(|k| if is_held(&k) { BTreeSet::new() } else { proper(k) });
        let rest = SymbolicElimination::new(&rest.collect::<Vec<_>>());
        let inertia = self.conditioning.inertia.iter().enumerate();
        let inertia = inertia.map(|(k, inertia)| if is_held(&k) { 0.0 } else { *inertia });
        Some(Held { inertia: inertia.collect(), limbs, rest })
    }

    /// The limb that equations hold which some coordinates change.
    fn held_limb(&self, equations: Range<usize>, moved: &BTreeSet<usize>) -> Option<HeldLimb> {
        let (last, count) = (*moved.last()?, equations.len());
        let SymbolicElimination { offsets, ancestors, .. } = &self.elimination;
        let chain = &ancestors[offsets[last]..offsets[last + 1]];
        let begin = chain.len().checked_sub(count).filter(|begin| *begin > 0)?;
        let (above, own) = chain.split_at(begin);
        let follow = own.iter().zip(own[0]..).all(|(own, next)| *own == next);
        let is_moved_here = moved.iter().all(|i| chain.binary_search(i).is_ok());
        if count > MOST || !follow || !is_moved_here {
            return None;
        }
        Some(HeldLimb {
            coordinates: own[0]..last + 1,
            equations,
            above: above.to_vec(),
            is_first: true,
            is_last: true,
        })
    }
}
