//! Finds limbs whose ends are held.

use std::collections::BTreeSet;
use std::ops::Range;

use plantd_math::elimination::SymbolicElimination;

use crate::integrator::workspace::Workspace;
use crate::kkt::held::MOST;
use crate::model::held::{Held, HeldLimb, Run};
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
        if d.constraints == 0 || self.constraint_rank() < d.constraints {
            return None;
        }
        let mut groups: Vec<Equations> = Vec::new();
        for (c, constraint) in self.constraints.iter().enumerate() {
            let moved: BTreeSet<usize> =
                constraint.coordinates[..constraint.dynamic].iter().copied().collect();
            match groups.last_mut().filter(|group| group.moved == moved) {
                Some(group) => group.range.end = c + 1,
                None => groups.push(Equations { range: c..c + 1, moved }),
            }
        }
        let mut limbs = Vec::new();
        for (at, group) in groups.iter().enumerate() {
            let others = groups.iter().enumerate().filter(|(other, _)| *other != at);
            let is_wanted = |i: &usize| others.clone().any(|(_, other)| other.moved.contains(i));
            let ends = self.ends(&group.moved);
            let mut found = ends.filter_map(|last| self.held_limb(group, last));
            limbs.push(found.find(|limb| !limb.coordinates.clone().any(|i| is_wanted(&i)))?);
        }
        for at in 1..limbs.len() {
            let differs = limbs[at - 1].border != limbs[at].border;
            (limbs[at - 1].is_last, limbs[at].is_first) = (differs, differs);
        }
        // Nothing of the rest hangs from a limb, and no limb is held by another one.
        let held: BTreeSet<usize> =
            limbs.iter().flat_map(|limb| limb.coordinates.clone()).collect();
        let is_held = |row: &usize| held.contains(row);
        let mut rest: Vec<BTreeSet<usize>> = Vec::new();
        for k in 0..d.dynamic {
            let above = self.above(k);
            match is_held(&k) {
                true => rest.push(BTreeSet::new()),
                false if above.iter().any(is_held) => return None,
                false => rest.push(above.iter().copied().collect()),
            }
        }
        for limb in &limbs {
            if limb.border.iter().any(is_held) {
                return None;
            }
            for later in &limb.border {
                rest[*later].extend(limb.border.iter().filter(|earlier| *earlier < later));
            }
        }
        let rest = SymbolicElimination::new(&rest);
        for limb in &mut limbs {
            for (row, column) in
                limb.border.iter().flat_map(|i| limb.border.iter().map(move |k| (i, k)))
            {
                limb.places.push(rest.slot(*row.max(column), *row.min(column))?);
            }
        }
        let mut kept: Vec<Run> = Vec::new();
        for k in (0..d.dynamic).filter(|k| !is_held(k)) {
            for (from, ancestor) in self.elimination.entries_of(k) {
                let to = rest.slot(k, ancestor)?;
                match kept.last_mut() {
                    Some(Run { from: a, to: b, len }) if (*a + *len, *b + *len) == (from, to) => {
                        *len += 1;
                    }
                    _ => kept.push(Run { from, to, len: 1 }),
                }
            }
        }
        let inertia = self.conditioning.inertia.iter().enumerate();
        let inertia = inertia.map(|(k, inertia)| if is_held(&k) { 0.0 } else { *inertia });
        Some(Held { inertia: inertia.collect(), limbs, rest, kept })
    }

    /// The coordinates above one in its elimination.
    fn above(&self, k: usize) -> &[usize] {
        self.elimination.above(k)
    }

    /// The lowest of some coordinates in each of the two chains that they are in, the last one first.
    fn ends(&self, moved: &BTreeSet<usize>) -> impl Iterator<Item = usize> {
        let last = moved.last().copied();
        let is_apart =
            move |i: &&usize| last.is_some_and(|k| k != **i && !self.above(k).contains(i));
        let other = moved.iter().rev().find(is_apart).copied();
        [last, other].into_iter().flatten()
    }

    /// The limb that ends in a coordinate and is held by equations.
    fn held_limb(&self, equations: &Equations, last: usize) -> Option<HeldLimb> {
        let Equations { range, moved } = equations;
        let (above, count) = (self.above(last), range.len());
        let begin = (above.len() + 1).checked_sub(count)?;
        let (above, own) = above.split_at(begin.min(above.len()));
        let first = own.first().copied().unwrap_or(last);
        let follow = own.iter().chain([&last]).zip(first..).all(|(own, next)| *own == next);
        let coordinates = first..last + 1;
        let is_other = |i: &&usize| !above.contains(i) && !coordinates.contains(i);
        let mut border = above.to_vec();
        border.extend(moved.iter().filter(is_other));
        if count > MOST || !follow || border.is_empty() {
            return None;
        }
        Some(HeldLimb {
            equations: range.clone(),
            above: above.len(),
            places: Vec::new(),
            is_first: true,
            is_last: true,
            coordinates,
            border,
        })
    }
}

/// Equations that the same coordinates change.
struct Equations {
    range: Range<usize>,
    moved: BTreeSet<usize>,
}
