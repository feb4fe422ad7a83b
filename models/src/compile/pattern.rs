//! Which coordinates a model couples, and a check that its elements keep to it.

use std::collections::BTreeSet;

use plantd_math::elimination::SymbolicElimination;

use crate::lagrangian::instant::Instant;
use crate::lagrangian::kinematics::Poses;
use crate::lagrangian::momenta::Momenta;
use crate::model::manifold::orientations;
use crate::model::mechanism::{Armatures, Forces, MixedPair, Model, Pair, Potentials, Spring};
use crate::model::tree::Tree;

/// Which dynamic coordinates each one is coupled with, among those before it.
pub(super) fn couplings(
    dynamic: usize,
    tree: &Tree,
    potentials: &Potentials,
    armature: &Armatures,
    forces: Option<&Forces>,
) -> Vec<BTreeSet<usize>> {
    let mut couplings = vec![BTreeSet::new(); dynamic];
    let mut couple = |earlier: usize, later: usize| {
        if earlier != later && earlier.max(later) < dynamic {
            couplings[later.max(earlier)].insert(later.min(earlier));
        }
    };
    for joint in 0..tree.joints.len() {
        // Those above are coupled when it is their turn.
        for above in tree.path(joint) {
            couple(tree.joints[above].coordinate, tree.joints[joint].coordinate);
        }
    }
    armature.entries().for_each(|a| couple(a.row, a.column));
    let of_springs = potentials.springs.iter().map(Spring::couples);
    let of_forces = forces.into_iter().flat_map(Forces::couples);
    for coordinates in of_springs.chain(of_forces) {
        for (k, &later) in coordinates.iter().enumerate() {
            coordinates[..k].iter().for_each(|&earlier| couple(earlier, later));
        }
    }
    couplings
}

/// Pairs of joints on one path to the root: both dynamic, and exactly one of them prescribed.
pub(super) fn joint_pairs(
    dynamic: usize,
    tree: &Tree,
    elimination: &SymbolicElimination,
) -> (Vec<Pair>, Vec<MixedPair>) {
    let (mut pairs, mut mixed) = (Vec::new(), Vec::new());
    for (joint, descendant) in tree.joints.iter().enumerate() {
        for above in tree.path(joint) {
            let ancestor = &tree.joints[above];
            match (ancestor.coordinate < dynamic, descendant.coordinate < dynamic) {
                (true, true) => {
                    let slot = elimination.slot(descendant.coordinate, ancestor.coordinate);
                    pairs.push(Pair {
                        ancestor: above as u32,
                        descendant: joint as u32,
                        row: ancestor.coordinate as u32,
                        column: descendant.coordinate as u32,
                        slot: slot.expect("coupled coordinates share an elimination path") as u32,
                    });
                }
                (false, false) => {}
                _ => mixed.push(MixedPair { ancestor: above, descendant: joint }),
            }
        }
    }
    (pairs, mixed)
}

/// Panics if an element has a derivative by coordinates that it does not say to couple: the factorization
/// has no place for it.
pub(super) fn check(model: &Model) {
    let (d, tree) = (model.dimensions, &model.dynamics);
    let check = |element: &str, i: usize, j: usize| {
        let has_place =
            i.max(j) >= d.dynamic || model.elimination.slot(i.max(j), i.min(j)).is_some();
        assert!(
            has_place,
            "a {element} of `{}` hides that it couples {i} and {j}",
            model.scene.name
        );
    };
    let q: Vec<f64> = model.coordinates.iter().map(|c| c.initial).collect();
    let mut poses = Poses::new(tree);
    if model.potentials.any || model.forces.is_some() {
        poses.evaluate(tree, &q, &orientations(model, &q));
    }
    model.for_each_spring_derivative(&poses, &q, |i, j, _| check("spring", i, j));
    if let Some(forces) = &model.forces {
        let (velocity, inputs) = (vec![1.0; q.len()], vec![0.0; d.inputs]);
        let mut momenta = Momenta::new(tree);
        let [mut l_q, mut l_v] = [0; 2].map(|_| vec![0.0; d.dynamic]);
        momenta.gradient(tree, &poses, &velocity, None, &mut l_q, &mut l_v);
        let at = Instant {
            tree,
            poses: &poses,
            momenta: &momenta,
            q: &q,
            velocity: &velocity,
            inputs: &inputs,
        };
        forces.for_each_derivative(&at, |i, j, _, _| check("force", i, j));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use plantd_scene::Scene;

    const SCENE: &str = include_str!("../../scenes/elements/two-point-damper.toml");

    fn model() -> Model {
        Model::compile(&Scene::from_toml(SCENE).unwrap()).unwrap()
    }

    /// Its elimination without what springs and forces couple.
    fn without_couplings(mut model: Model) -> Model {
        let (nd, tree) = (model.dimensions.dynamic, &model.dynamics);
        model.elimination = SymbolicElimination::new(&couplings(
            nd,
            tree,
            &Potentials::default(),
            &Armatures::default(),
            None,
        ));
        model
    }

    #[test]
    #[should_panic(expected = "a spring of `two-point-damper` hides that it couples")]
    fn a_spring_that_hides_a_coupling_is_found() {
        check(&without_couplings(model()));
    }

    #[test]
    #[should_panic(expected = "a force of `two-point-damper` hides that it couples")]
    fn a_force_that_hides_a_coupling_is_found() {
        check(&without_couplings(Model { potentials: Potentials::default(), ..model() }));
    }
}
