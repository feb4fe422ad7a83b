//! Orientations of ball joints: three entries of `q` that are a rotation vector.

use plantd_proto::v1;

/// Indices at which the rotation vectors of a model's ball joints begin in `q`, as in
/// [`v1::Gain::rotations`].
pub fn rotations(model: &v1::Model) -> Vec<u32> {
    let groups = model.coordinates.iter().map(|c| c.rotation_group.as_str()).enumerate();
    let mut previous = "";
    let starts = groups.filter_map(|(index, group)| {
        let begins = !group.is_empty() && group != previous;
        previous = group;
        begins.then_some(index as u32)
    });
    starts.collect()
}

/// `x − x_reference`, where the three entries from each index of `rotations` on are orientations
/// whose difference is the rotation vector of `R_referenceᵀ R`, of a length up to π.
///
/// Serves for states and for configurations alike. Entries that one side lacks are left out.
pub fn difference(x_reference: &[f64], x: &[f64], rotations: &[u32]) -> Vec<f64> {
    let mut difference: Vec<f64> = x.iter().zip(x_reference).map(|(x, r)| x - r).collect();
    for &start in rotations {
        let start = start as usize;
        let entries = start..start.saturating_add(3);
        let (Some(from), Some(to)) = (vector(x_reference, start), vector(x, start)) else {
            continue;
        };
        if let Some(entries) = difference.get_mut(entries) {
            entries.copy_from_slice(&between(from, to));
        }
    }
    difference
}

/// The `x` whose [`difference`] from `x_reference` is `dx`.
pub fn compose(x_reference: &[f64], dx: &[f64], rotations: &[u32]) -> Vec<f64> {
    let mut x: Vec<f64> = dx.iter().zip(x_reference).map(|(dx, r)| dx + r).collect();
    for &start in rotations {
        let start = start as usize;
        let (Some(from), Some(turn)) = (vector(x_reference, start), vector(dx, start)) else {
            continue;
        };
        if let Some(entries) = x.get_mut(start..start.saturating_add(3)) {
            entries.copy_from_slice(&between(from.map(|e| -e), turn));
        }
    }
    x
}

fn vector(x: &[f64], start: usize) -> Option<[f64; 3]> {
    x.get(start..)?.first_chunk().copied()
}

/// Rotation vector of `R(from)ᵀ R(to)`, by quaternions.
fn between(from: [f64; 3], to: [f64; 3]) -> [f64; 3] {
    let ((w0, a), (w1, b)) = (quaternion(from), quaternion(to));
    let dot = |a: [f64; 3], b: [f64; 3]| a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
    let cross = [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
    let w = w0 * w1 + dot(a, b);
    let v = [0, 1, 2].map(|i| w0 * b[i] - w1 * a[i] - cross[i]);
    let (w, v) = if w < 0.0 { (-w, v.map(|e| -e)) } else { (w, v) };
    let sine = dot(v, v).sqrt();
    let scale = if sine == 0.0 { 2.0 } else { 2.0 * sine.atan2(w) / sine };
    v.map(|e| scale * e)
}

/// Scalar and vector part of the unit quaternion of a rotation vector.
fn quaternion(rotation: [f64; 3]) -> (f64, [f64; 3]) {
    let angle = rotation.iter().map(|e| e * e).sum::<f64>().sqrt();
    let half = 0.5 * angle;
    let scale = if angle == 0.0 { 0.5 } else { half.sin() / angle };
    (half.cos(), rotation.map(|e| scale * e))
}

#[cfg(test)]
mod tests {
    use std::f64::consts::PI;

    use super::*;

    #[track_caller]
    fn assert_close(actual: &[f64], expected: &[f64]) {
        assert_eq!(actual.len(), expected.len());
        let error = actual.iter().zip(expected).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        assert!(error < 1e-14, "{actual:?} instead of {expected:?}");
    }

    #[test]
    fn about_one_axis_angles_are_subtracted_and_wrap() {
        let turned = |angle: f64| [0.0, 0.6 * angle, 0.8 * angle];
        assert_close(&between(turned(0.3), turned(1.0)), &turned(0.7));
        assert_close(&between(turned(3.0), turned(-3.0)), &turned(2.0 * PI - 6.0));
        assert_close(&between(turned(0.0), turned(1e-12)), &turned(1e-12));
    }

    #[test]
    fn the_difference_is_in_the_axes_of_the_reference() {
        // A quarter turn about z, then one about the new x, which is the old y.
        let quarter = PI / 2.0;
        let both = 2.0 * PI / 3.0 / f64::sqrt(3.0);
        assert_close(&between([0.0, 0.0, quarter], [both, both, both]), &[quarter, 0.0, 0.0]);
    }

    #[test]
    fn compose_undoes_the_difference() {
        let (from, to) = ([1.0, 0.3, -1.2, 0.8, 5.0], [1.5, -0.9, 1.7, 0.4, 4.0]);
        let dx = difference(&from, &to, &[1]);
        assert_close(&compose(&from, &dx, &[1]), &to);
        let quarters = compose(&[0.0, 0.0, PI / 2.0], &[PI / 2.0, 0.0, 0.0], &[0]);
        assert_close(&quarters, &[2.0 * PI / 3.0 / f64::sqrt(3.0); 3]);
    }

    #[test]
    fn only_the_named_entries_are_rotations() {
        let (from, to) = ([1.0, 0.0, 0.0, 3.0, 5.0], [1.5, 0.0, 0.0, -3.0, 4.0]);
        assert_close(&difference(&from, &to, &[1]), &[0.5, 0.0, 0.0, 2.0 * PI - 6.0, -1.0]);
        assert_close(&difference(&from, &to, &[4, u32::MAX]), &[0.5, 0.0, 0.0, -6.0, -1.0]);
    }

    #[test]
    fn rotations_of_a_model_begin_where_their_group_does() {
        let coordinate =
            |group: &str| v1::Coordinate { rotation_group: group.to_owned(), ..Default::default() };
        let groups = ["", "a", "a", "a", "b", "b", "b", ""];
        let model = v1::Model { coordinates: groups.map(coordinate).into(), ..Default::default() };
        assert_eq!(rotations(&model), [1, 4]);
    }
}
