//! Volumes, centres and inertias of meshes, by MuJoCo's rules.
//!
//! A mesh is a sum of pyramids over its triangles, of volume `V = c · n / 6` with the normal `n` of length twice
//! the area and the triangle's centre `c` from the common apex; `∫ x xᵀ = V/20 (Σ d dᵀ + s sᵀ)` with the corners
//! `d` from the apex and their sum `s`. A shell has the areas in place of volumes, and 12 for 20.

use nalgebra::{Isometry3, Matrix3, Translation3, UnitQuaternion, Vector3};

use crate::inertia::Inertia;
use crate::mjcf::settings::TINY;
use crate::surface::Surface;

/// Of which body a mesh is the surface.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) enum Rule {
    /// Pyramids over all triangles from the middle of the surface, which count as much where they look inwards.
    #[default]
    Legacy,
    /// What it encloses.
    Exact,
    /// The convex hull.
    Convex,
    /// A layer on it.
    Shell,
}

/// Their names, in the order of [`Rule`].
pub(super) const RULES: [&str; 4] = ["legacy", "exact", "convex", "shell"];

impl Rule {
    pub(super) fn of(place: usize) -> Self {
        [Self::Legacy, Self::Exact, Self::Convex, Self::Shell][place]
    }
}

/// What is done with the points of a file: `scale Rᵀ (x − position)`.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Placement {
    pub(super) position: [f64; 3],
    pub(super) turn: UnitQuaternion<f64>,
    pub(super) scale: [f64; 3],
}

impl Placement {
    /// Where the file stands in the mesh, but for its scale; exact unless it is turned and scaled by different
    /// factors.
    pub(super) fn pose(&self) -> Isometry3<f64> {
        let turn = self.turn.inverse();
        let shift =
            -(turn * Vector3::from(self.position)).component_mul(&Vector3::from(self.scale));
        Isometry3::from_parts(Translation3::from(shift), turn)
    }
}

/// Least area vector of a surface, of its area, that counts as a hole.
const HOLE: f64 = 1e-5;

/// Volume, m³, or of a shell area, m², as mass, with centre and tensor of density 1.
pub(super) fn solid(
    surface: &Surface,
    rule: Rule,
    placement: &Placement,
) -> Result<Inertia, String> {
    let Placement { position, turn, scale } = placement;
    let (origin, back) = (Vector3::from(*position), turn.inverse());
    let point = |p: &[f32; 3]| {
        let p = Vector3::from(p.map(f64::from));
        (back * (p - origin)).component_mul(&Vector3::from(*scale))
    };
    let points: Vec<Vector3<f64>> = surface.points.iter().map(point).collect();
    let hull;
    let triangles = if rule == Rule::Convex {
        hull = crate::mjcf::hull::hull(&points)?;
        &hull
    } else {
        &surface.triangles
    };
    // What is mirrored looks inwards.
    let side = if rule != Rule::Convex && scale.iter().product::<f64>() < 0.0 { -1.0 } else { 1.0 };
    let faces = || {
        triangles.iter().map(|corners| {
            let [a, b, c] = corners.map(|i| points[i as usize]);
            let normal = (b - a).cross(&(c - a)) * side;
            ([a, b, c], (a + b + c) / 3.0, normal)
        })
    };
    let (mut area, mut middle, mut open) = (0.0, Vector3::zeros(), Vector3::zeros());
    for (_, center, normal) in faces() {
        let own = normal.norm() / 2.0;
        (area, middle, open) = (area + own, middle + center * own, open + normal / 2.0);
    }
    if area <= TINY {
        return Err("it has no area".to_owned());
    }
    middle /= area;
    if rule == Rule::Exact && open.norm() > HOLE * area {
        return Err("`exact` needs a closed surface whose faces all look outwards".to_owned());
    }
    let weight = |from: &Vector3<f64>, center: &Vector3<f64>, normal: &Vector3<f64>| {
        let volume = (center - from).dot(normal) / 6.0;
        match rule {
            Rule::Shell => normal.norm() / 2.0,
            Rule::Legacy => volume.abs(),
            Rule::Exact | Rule::Convex => volume,
        }
    };
    let (mut sum, mut moment) = (0.0, Vector3::zeros());
    for (_, center, normal) in faces() {
        let own = weight(&middle, &center, &normal);
        // The centre of a pyramid is a quarter of the way up.
        let at = if rule == Rule::Shell { center } else { center * 0.75 + middle * 0.25 };
        (sum, moment) = (sum + own, moment + at * own);
    }
    if sum <= TINY {
        return Err("it has no volume; `inertia=\"shell\"` gives a thin one mass".to_owned());
    }
    let center = moment / sum;
    let (mut mass, mut second) = (0.0, Matrix3::zeros());
    for (corners, middle, normal) in faces() {
        let own = weight(&center, &middle, &normal);
        let from_center = corners.map(|corner| corner - center);
        let total: Vector3<f64> = from_center.iter().sum();
        let squares: Matrix3<f64> = from_center.iter().map(|d| d * d.transpose()).sum();
        mass += own;
        second += (squares + total * total.transpose()) * own;
    }
    second /= if rule == Rule::Shell { 12.0 } else { 20.0 };
    let tensor = Matrix3::identity() * second.trace() - second;
    Ok(Inertia { mass, center, tensor })
}

#[cfg(test)]
mod tests {
    use super::*;

    const STRAIGHT: Placement = Placement {
        position: [0.0; 3],
        turn: UnitQuaternion::new_unchecked(nalgebra::Quaternion::new(1.0, 0.0, 0.0, 0.0)),
        scale: [1.0; 3],
    };

    /// A box with a corner at the origin.
    fn cuboid(sides: [f64; 3]) -> Surface {
        let corner = |i: usize| {
            (0..3).map(|k| if i >> k & 1 == 1 { sides[k] } else { 0.0 }).collect::<Vec<_>>()
        };
        let points: Vec<f64> = (0..8).flat_map(corner).collect();
        let quads =
            [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
        let halves = quads.iter().flat_map(|[a, b, c, d]| [*a, *b, *c, *a, *c, *d]);
        Surface::of_lists(&points, &halves.map(f64::from).collect::<Vec<_>>()).unwrap()
    }

    #[test]
    fn a_box_is_a_box_by_every_rule() {
        let [x, y, z] = [0.5, 0.25, 2.0];
        let volume: f64 = x * y * z;
        let moment = |a: f64, b: f64| volume / 12.0 * (a * a + b * b);
        let expected =
            Matrix3::from_diagonal(&Vector3::new(moment(y, z), moment(x, z), moment(x, y)));
        for rule in [Rule::Legacy, Rule::Exact, Rule::Convex] {
            let found = solid(&cuboid([x, y, z]), rule, &STRAIGHT).unwrap();
            assert!((found.mass - volume).abs() < 1e-9, "{rule:?}");
            assert!((found.center - Vector3::new(x, y, z) / 2.0).amax() < 1e-9, "{rule:?}");
            assert!((found.tensor - expected).amax() < 1e-9, "{rule:?}");
        }
        let shell = solid(&cuboid([x, y, z]), Rule::Shell, &STRAIGHT).unwrap();
        assert!((shell.mass - 2.0 * (x * y + y * z + z * x)).abs() < 1e-12);
    }

    /// A mesh that stands elsewhere in its file, and is scaled and mirrored afterwards.
    #[test]
    fn files_are_placed() {
        let turn = UnitQuaternion::from_euler_angles(0.3, -0.4, 0.7);
        let scale = [0.5, -2.0, 3.0];
        let found = solid(
            &cuboid([1.0; 3]),
            Rule::Exact,
            &Placement { position: [0.1, 0.2, 0.3], turn, scale },
        )
        .unwrap();
        assert!((found.mass - 3.0).abs() < 1e-12);
        let center = turn.inverse() * Vector3::new(0.4, 0.3, 0.2);
        assert!((found.center - center.component_mul(&Vector3::from(scale))).amax() < 1e-12);
        assert!(found.is_possible());
    }

    #[test]
    fn surfaces_that_enclose_nothing_are_refused() {
        let mut open = cuboid([1.0; 3]);
        open.triangles.pop();
        assert!(solid(&open, Rule::Exact, &STRAIGHT).unwrap_err().contains("closed"));
        let mut inwards = cuboid([1.0; 3]);
        inwards.triangles.iter_mut().for_each(|t| t.swap(0, 1));
        assert!(solid(&inwards, Rule::Exact, &STRAIGHT).unwrap_err().contains("no volume"));
        assert!(solid(&inwards, Rule::Legacy, &STRAIGHT).is_ok());
        let flat =
            Surface::of_lists(&[0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0, 0.0], &[0.0, 1.0, 2.0])
                .unwrap();
        for rule in [Rule::Legacy, Rule::Convex] {
            assert!(solid(&flat, rule, &STRAIGHT).unwrap_err().contains("no volume"), "{rule:?}");
        }
        assert!(solid(&flat, Rule::Shell, &STRAIGHT).is_ok());
        let point = Surface::of_lists(&[0.0; 3], &[0.0; 3]).unwrap();
        assert!(solid(&point, Rule::Shell, &STRAIGHT).unwrap_err().contains("no area"));
    }
}
