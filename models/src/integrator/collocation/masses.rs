//! The mass matrices of all stages, factored side by side along the elimination tree.
//!
//! Where nothing is stiff, a step is so short that the momenta of the stages depend on their velocities far more
//! than on anything else: with `Dᵀ M D / h b_i` in place of the Jacobian each round of corrections leaves about `h`
//! times the rates of the motion of what was left before, and costs O(n·depth) for all stages at once.

use plantd_math::scalar::{LanesOf, Scalar, Side, in_registers};

use crate::integrator::collocation::secants::Secants;
use crate::lagrangian::arrangement::Planar;
use crate::lagrangian::mechanics::Mechanics;
use crate::model::mechanism::Model;

/// `M = Lᵀ Δ L` of the stages: entries in the slots of the elimination, `N` stages side by side.
#[derive(Clone, Debug)]
pub(crate) struct Masses<const N: usize> {
    groups: usize,
    /// `M`, then `L`: slot after slot, those of all stages.
    entries: Vec<LanesOf<N>>,
    /// `Δ⁻¹`.
    inverse: Vec<LanesOf<N>>,
    /// Right-hand sides of `N` stages.
    pub(crate) right: Vec<LanesOf<N>>,
    pub(crate) secants: Secants,
}

impl<const N: usize> Masses<N> {
    pub(crate) fn new(model: &Model, width: usize, count: usize) -> Self {
        let (groups, nd) = (width / N, model.dimensions.dynamic);
        Self {
            groups,
            entries: vec![LanesOf::ZERO; groups * model.elimination.slots()],
            inverse: vec![LanesOf::ZERO; groups * nd],
            right: vec![LanesOf::ZERO; nd],
            secants: Secants::new(nd * count),
        }
    }

    /// Forgets all entries: what is not written is zero.
    pub(crate) fn clear(&mut self) {
        self.entries.fill(LanesOf::ZERO);
    }

    /// Takes the mass matrices at the last gradient, of the stages from one on.
    pub(crate) fn take<S: Planar + Side>(
        &mut self,
        model: &Model,
        mechanics: &mut Mechanics<S>,
        stage: usize,
    ) {
        mechanics.differentiate(model);
        let (group, lane) = (stage / N, stage % N);
        for pair in &model.pairs {
            let second = mechanics.pair(model, pair.ancestor as usize, pair.descendant as usize);
            let entry = &mut self.entries[pair.slot as usize * self.groups + group];
            second.vv.store(&mut entry.0[lane..]);
        }
    }

    /// Adds armatures, and factors.
    pub(crate) fn factor(&mut self, model: &Model) {
        let elimination = &model.elimination;
        for armature in model.armature.entries().filter(|a| a.row >= a.column) {
            if let Some(slot) = elimination.slot(armature.row, armature.column) {
                for entry in &mut self.entries[slot * self.groups..][..self.groups] {
                    *entry = *entry + armature.inertia;
                }
            }
        }
        match self.groups {
            1 => self.factor_groups::<1>(model),
            _ => self.factor_groups::<2>(model),
        }
    }

    fn factor_groups<const GROUPS: usize>(&mut self, model: &Model) {
        in_registers!(LanesOf<N>, {
            let elimination = &model.elimination;
            let entries = self.entries.as_chunks_mut::<GROUPS>().0;
            let inverse = self.inverse.as_chunks_mut::<GROUPS>().0;
            for k in (0..elimination.rows()).rev() {
                let ancestors = elimination.above(k);
                let (above, row) = entries.split_at_mut(elimination.start(k));
                let depth = ancestors.len();
                inverse[k] = row[depth].map(Scalar::recip);
                for (d, &ancestor) in ancestors.iter().enumerate().rev() {
                    let mut factor = row[d];
                    for (factor, inverse) in factor.iter_mut().zip(inverse[k]) {
                        *factor = *factor * inverse;
                    }
                    let target = &mut above[elimination.start(ancestor)..][..=d];
                    for (target, own) in target.iter_mut().zip(&row[..=d]) {
                        for g in 0..GROUPS {
                            target[g] -= factor[g] * own[g];
                        }
                    }
                    row[d] = factor;
                }
            }
        })
    }

    /// Solves for `N` stages, in place of the right-hand sides.
    pub(crate) fn solve(&mut self, model: &Model, g: usize) {
        in_registers!(LanesOf<N>, {
            let (elimination, groups) = (&model.elimination, self.groups);
            let Self { entries, inverse, right, .. } = self;
            for k in (0..elimination.rows()).rev() {
                let value = right[k];
                for (&ancestor, slot) in elimination.above(k).iter().zip(elimination.row(k)) {
                    right[ancestor] -= entries[slot * groups + g] * value;
                }
                right[k] = value * inverse[k * groups + g];
            }
            for k in 0..elimination.rows() {
                let mut value = right[k];
                for (&ancestor, slot) in elimination.above(k).iter().zip(elimination.row(k)) {
                    value -= entries[slot * groups + g] * right[ancestor];
                }
                right[k] = value;
            }
        })
    }
}
