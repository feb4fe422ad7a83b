//! Moments of inertia that no body has: judged once bodies that move together are one.

use nalgebra::Matrix3;
use plantd_math::spatial::Sym3;
use plantd_scene::{Frame, Problem, Scene};

use crate::compile::scene::{Layout, Placement, full, placed};

/// How far principal moments may be from possible ones, relative to the largest.
const TOLERANCE: f64 = 1e-9;

/// What is wrong with principal moments.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Fault {
    Negative,
    Uneven,
}

/// What the principal moments of a tensor have against them, and the moments, smallest first.
fn fault(tensor: &Sym3) -> Option<(Fault, [f64; 3])> {
    let Sym3 { xx, yy, zz, xy, xz, yz } = *tensor;
    let all = [xx, yy, zz, xy, xz, yz];
    let largest = all.iter().fold(0.0_f64, |a, x| a.max(x.abs()));
    if largest == 0.0 {
        return None;
    }
    let [xx, yy, zz, xy, xz, yz] = all.map(|x| x / largest);
    let matrix = Matrix3::new(xx, xy, xz, xy, yy, yz, xz, yz, zz);
    let mut principal: [f64; 3] = matrix.symmetric_eigenvalues().into();
    principal.sort_by(f64::total_cmp);
    let [a, b, c] = principal;
    let shown = principal.map(|x| x * largest);
    if a < -TOLERANCE {
        Some((Fault::Negative, shown))
    } else if a + b < c * (1.0 - TOLERANCE) {
        Some((Fault::Uneven, shown))
    } else {
        None
    }
}

/// Errors and warnings: bodies of which no body has the moments, also not together with those that are
/// fixed to them.
pub(super) fn judge(scene: &Scene) -> [Vec<Problem>; 2] {
    let own = |frame: &Frame| {
        let body = frame.body.as_ref()?;
        fault(&full(&placed(body, &Placement::HERE).inertia))
    };
    let culprits: Vec<(usize, &Frame)> =
        scene.frames.iter().enumerate().filter(|(_, frame)| own(frame).is_some()).collect();
    let mut found = [Vec::new(), Vec::new()];
    if culprits.is_empty() {
        return found;
    }
    let layout = Layout::new(scene);
    for (i, frame) in culprits {
        // Bodies fixed in the world do not move.
        let Some(joint) = layout.joints.get(layout.frames[&frame.name].joint) else { continue };
        let Some((fault, moments)) = fault(&full(&joint.body.inertia)) else { continue };
        let is_allowed = frame.body.as_ref().is_some_and(|body| body.any_inertia);
        let message = match fault {
            Fault::Negative => format!("has a negative principal moment: {moments:?}"),
            Fault::Uneven if is_allowed => {
                format!("no body has these principal moments: {moments:?} violate a + b ≥ c")
            }
            Fault::Uneven => format!(
                "no body has these principal moments: {moments:?} violate a + b ≥ c; `any_inertia = true` takes them"
            ),
        };
        let problem = Problem { path: format!("frames[{i}].body.inertia"), message };
        found[usize::from(is_allowed && fault == Fault::Uneven)].push(problem);
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::Model;

    /// A link with impossible moments, alone or with a motor fixed to it.
    fn scene(link: &str, motor: &str) -> Scene {
        let text = format!(
            "format = 1\nname = \"link\"\ngravity = [0, 0, 0]\n[[frames]]\nname = \"link\"\njoint = {{ type = \"revolute\", axis = [0, 1, 0] }}\nbody = {{ mass = 1, {link} }}\n[[frames]]\nname = \"motor\"\nparent = \"link\"\nrotation = {{ rpy = [0.3, 0.2, 0.1] }}\n{motor}\n"
        );
        Scene::from_toml(&text).unwrap()
    }

    fn problems(scene: &Scene) -> Vec<Problem> {
        Model::compile(scene).map_or_else(|error| error.problems, |_| Vec::new())
    }

    #[test]
    fn impossible_moments_are_judged_with_what_is_fixed_to_them() {
        const LINK: &str = "inertia = [0.1, 0.2, 0.4]";
        let refused = problems(&scene(LINK, ""));
        assert_eq!(refused[0].path, "frames[0].body.inertia", "{refused:?}");
        assert!(refused[0].message.contains("any_inertia"), "{refused:?}");
        for impossible in ["[0.1, -0.1, 0.0]", "[0.1, 0.1, 0.1, 0.2, 0.0, 0.0]"] {
            let refused = problems(&scene(&format!("inertia = {impossible}"), ""));
            assert_eq!(refused[0].path, "frames[0].body.inertia", "{impossible}: {refused:?}");
        }
        // 0.2 more of each.
        let heavy = "body = { mass = 1, inertia = [0.2, 0.2, 0.2] }";
        assert_eq!(problems(&scene(LINK, heavy)), []);
        let light = "body = { mass = 1, inertia = [0.02, 0.02, 0.02] }";
        assert_eq!(problems(&scene(LINK, light)).len(), 1);
        let allowed = scene(&format!("{LINK}, any_inertia = true"), "");
        let model = Model::compile(&allowed).unwrap();
        assert_eq!(model.warnings().len(), 1, "{:?}", model.warnings());
        assert!(model.plan().contains("warning"), "{}", model.plan());
        let negative = scene("inertia = [-0.1, 0.2, 0.2], any_inertia = true", "");
        assert!(problems(&negative)[0].message.contains("negative"));
    }
}
