//! Convex hulls, by Quickhull.
//!
//! C. B. Barber, D. P. Dobkin, H. Huhdanpaa, "The quickhull algorithm for convex hulls", ACM Transactions on
//! Mathematical Software 22 (1996). Points are moved a little first, so that no four of them lie in a plane: volumes
//! change by as little.

use std::collections::BTreeMap;

use nalgebra::Vector3;

/// By how much points are moved, of the size of all; the next where rounding spoils the one before.
const MOVES: [f64; 3] = [1e-12, 1e-11, 1e-10];
/// Least volume of the first tetrahedron, of the cube of the size.
const FLAT: f64 = 1e-8;

/// Different points that are taken at most.
const POINTS_MAX: usize = 1 << 18;
/// Most comparisons of a point with a face for each point, on average. Points of a sphere take less; where each one
/// that is taken in sees a good part of the others' faces, it would be as many as there are points.
const WORK_MAX: usize = 1 << 10;

struct Face {
    /// Counter-clockwise when seen from outside.
    corners: [u32; 3],
    /// Beyond the edge from each corner to the next.
    neighbors: [usize; 3],
    normal: Vector3<f64>,
    /// Points that see it, each in the list of one face.
    outside: Vec<u32>,
    is_gone: bool,
}

struct Hull {
    points: Vec<Vector3<f64>>,
    faces: Vec<Face>,
    /// Comparisons that may still be made.
    work: usize,
}

/// Why there is no hull.
enum Spoiled {
    /// By rounding.
    Torn,
    /// It takes too much work.
    Endless,
}

/// Triangles of the convex hull, which look outwards.
pub(super) fn hull(points: &[Vector3<f64>]) -> Result<Vec<[u32; 3]>, String> {
    let mut order: Vec<u32> = (0..points.len() as u32).collect();
    let bits = |i: &u32| points[*i as usize].map(f64::to_bits);
    order.sort_by_key(|i| <[u64; 3]>::from(bits(i)));
    order.dedup_by_key(|i| bits(i));
    if order.len() > POINTS_MAX {
        let count = order.len();
        return Err(format!(
            "its convex hull is that of {count} points; at most {POINTS_MAX} are taken: use `inertia=\"exact\"`"
        ));
    }
    let origin = points.first().copied().unwrap_or_default();
    let size = points.iter().map(|p| (p - origin).amax()).fold(0.0, f64::max);
    let tetrahedron = tetrahedron(points, &order, size)
        .ok_or("it has no volume; `inertia=\"shell\"` gives a thin one mass")?;
    for by in MOVES {
        let points = moved(points, by * size);
        let mut hull = Hull { points, faces: Vec::new(), work: WORK_MAX * order.len() };
        hull.begin(tetrahedron, &order);
        match hull.grow() {
            Ok(found) => return Ok(found),
            Err(Spoiled::Torn) => {}
            Err(Spoiled::Endless) => {
                return Err(
                    "its convex hull takes too long to find: use `inertia=\"exact\"`".to_owned()
                );
            }
        }
    }
    Err("its convex hull is spoiled by rounding: use `inertia=\"exact\"`".to_owned())
}

/// Points that are moved by numbers which look random, up to so much.
fn moved(points: &[Vector3<f64>], by: f64) -> Vec<Vector3<f64>> {
    let mut seed = 1_u64;
    let mut next = || {
        // A linear congruential generator, whose upper bits are good.
        seed = seed.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        ((seed >> 32) as f64 / f64::from(u32::MAX) * 2.0 - 1.0) * by
    };
    points.iter().map(|p| p + Vector3::new(next(), next(), next())).collect()
}

/// Four points that are far apart; none if all lie in a plane.
fn tetrahedron(points: &[Vector3<f64>], order: &[u32], size: f64) -> Option<[u32; 4]> {
    let at = |i: u32| points[i as usize];
    let farthest = |distance: &dyn Fn(u32) -> f64| {
        order.iter().copied().max_by(|i, j| distance(*i).total_cmp(&distance(*j)))
    };
    let a = *order.first()?;
    let b = farthest(&|i| (at(i) - at(a)).norm())?;
    let c = farthest(&|i| (at(b) - at(a)).cross(&(at(i) - at(a))).norm())?;
    let normal = (at(b) - at(a)).cross(&(at(c) - at(a)));
    let d = farthest(&|i| normal.dot(&(at(i) - at(a))).abs())?;
    let height = normal.dot(&(at(d) - at(a)));
    (height.abs() > FLAT * size.powi(3)).then_some(if height > 0.0 {
        [a, c, b, d]
    } else {
        [a, b, c, d]
    })
}

impl Hull {
    fn at(&self, i: u32) -> Vector3<f64> {
        self.points[i as usize]
    }

    fn add(&mut self, corners: [u32; 3], neighbors: [usize; 3]) -> usize {
        let [a, b, c] = corners.map(|i| self.at(i));
        let normal = (b - a).cross(&(c - a));
        self.faces.push(Face { corners, neighbors, normal, outside: Vec::new(), is_gone: false });
        self.faces.len() - 1
    }

    /// Height of a point above a face, in units of twice its area.
    fn height(&self, face: usize, point: u32) -> f64 {
        let Face { corners, normal, .. } = &self.faces[face];
        normal.dot(&(self.at(point) - self.at(corners[0])))
    }

    /// A tetrahedron whose first three corners look away from the fourth.
    fn begin(&mut self, [a, b, c, d]: [u32; 4], order: &[u32]) {
        self.add([a, b, c], [1, 2, 3]);
        self.add([b, a, d], [0, 3, 2]);
        self.add([c, b, d], [0, 1, 3]);
        self.add([a, c, d], [0, 2, 1]);
        let rest = order.iter().copied().filter(|i| ![a, b, c, d].contains(i)).collect();
        self.share(rest, 0..4);
    }

    /// Gives each point to a face that it sees; those that see none are inside.
    fn share(&mut self, points: Vec<u32>, faces: std::ops::Range<usize>) {
        for point in points {
            let sees = faces.clone().find(|face| self.height(*face, point) > 0.0);
            let compared = sees.map_or(faces.len(), |face| face - faces.start + 1);
            self.work = self.work.saturating_sub(compared);
            if let Some(face) = sees {
                self.faces[face].outside.push(point);
            }
        }
    }

    /// Takes in the farthest point of one face after the other.
    fn grow(mut self) -> Result<Vec<[u32; 3]>, Spoiled> {
        let mut face = 0;
        while face < self.faces.len() {
            self.work = self.work.saturating_sub(self.faces[face].outside.len());
            let heights = self.faces[face].outside.iter().map(|i| (*i, self.height(face, *i)));
            let top = heights.max_by(|(_, a), (_, b)| a.total_cmp(b));
            match top.filter(|_| !self.faces[face].is_gone) {
                // New faces come at the end.
                Some((point, _)) => self.take_in(face, point).ok_or(Spoiled::Torn)?,
                None => face += 1,
            }
            if self.work == 0 {
                return Err(Spoiled::Endless);
            }
        }
        Ok(self.faces.iter().filter(|face| !face.is_gone).map(|face| face.corners).collect())
    }

    /// Replaces the faces that a point sees by a cone over their rim.
    fn take_in(&mut self, from: usize, point: u32) -> Option<()> {
        let (mut open, mut points) = (vec![from], Vec::new());
        let mut rim: BTreeMap<u32, (u32, usize)> = BTreeMap::new();
        let mut edges = 0;
        self.faces[from].is_gone = true;
        while let Some(face) = open.pop() {
            self.work = self.work.saturating_sub(3);
            points.append(&mut self.faces[face].outside);
            let Face { corners, neighbors, .. } = self.faces[face];
            for (i, beyond) in neighbors.into_iter().enumerate() {
                if self.faces[beyond].is_gone {
                    continue;
                }
                if self.height(beyond, point) > 0.0 {
                    self.faces[beyond].is_gone = true;
                    open.push(beyond);
                } else {
                    rim.insert(corners[i], (corners[(i + 1) % 3], beyond));
                    edges += 1;
                }
            }
        }
        let first = self.faces.len();
        let (start, mut corner) = (*rim.first_key_value()?.0, *rim.first_key_value()?.0);
        loop {
            let (next, beyond) = *rim.get(&corner)?;
            let own = self.add([corner, next, point], [beyond, 0, 0]);
            let back = self.faces[beyond].corners.iter().position(|c| *c == next)?;
            self.faces[beyond].neighbors[back] = own;
            corner = next;
            if corner == start {
                break;
            }
            if self.faces.len() - first > rim.len() {
                return None;
            }
        }
        let count = self.faces.len() - first;
        if count != rim.len() || count != edges {
            return None;
        }
        for i in 0..count {
            self.faces[first + i].neighbors[1] = first + (i + 1) % count;
            self.faces[first + i].neighbors[2] = first + (i + count - 1) % count;
        }
        points.retain(|i| *i != point);
        self.share(points, first..first + count);
        Some(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn volume(points: &[Vector3<f64>], hull: &[[u32; 3]]) -> f64 {
        let at = |i: u32| points[i as usize];
        hull.iter().map(|[a, b, c]| at(*a).dot(&at(*b).cross(&at(*c))) / 6.0).sum()
    }

    /// Points of a grid, most of them in planes with many others, are a box.
    #[test]
    fn a_grid_is_a_box() {
        let grid = (0..1000).map(|i| {
            Vector3::new(f64::from(i % 10), f64::from(i / 10 % 10), f64::from(i / 100)) / 9.0
        });
        let points: Vec<_> = grid.collect();
        let hull = hull(&points).unwrap();
        assert!((volume(&points, &hull) - 1.0).abs() < 1e-9);
    }

    /// No point is outside, edges have two sides, and Euler's formula holds.
    #[test]
    fn a_hull_encloses_all_points() {
        let points: Vec<_> = moved(&vec![Vector3::zeros(); 2000], 1.0)
            .into_iter()
            .map(|p| if p.norm() > 1.0 { p.normalize() } else { p })
            .collect();
        let hull = hull(&points).unwrap();
        let mut edges = std::collections::BTreeSet::new();
        let mut corners = std::collections::BTreeSet::new();
        for [a, b, c] in &hull {
            let at = |i: &u32| points[*i as usize];
            let normal = (at(b) - at(a)).cross(&(at(c) - at(a))).normalize();
            assert!(points.iter().all(|p| normal.dot(&(p - at(a))) < 1e-9));
            for edge in [(*a, *b), (*b, *c), (*c, *a)] {
                assert!(edges.insert(edge), "{edge:?} twice");
            }
            corners.extend([*a, *b, *c]);
        }
        assert!(edges.iter().all(|(a, b)| edges.contains(&(*b, *a))));
        assert_eq!(corners.len() + hull.len(), edges.len() / 2 + 2);
        assert!(volume(&points, &hull) < 4.0 / 3.0 * std::f64::consts::PI);
    }

    /// Points on a sphere, and on curves of which each point is a corner that sees many others, in time that grows
    /// with their count: within the work that is allowed.
    #[test]
    fn hulls_of_many_corners_are_bounded() {
        let sphere = |count: usize| -> Vec<Vector3<f64>> {
            moved(&vec![Vector3::zeros(); count], 1.0).into_iter().map(|p| p.normalize()).collect()
        };
        assert_eq!(hull(&sphere(5000)).unwrap().len(), 2 * 5000 - 4);
        let error = hull(&sphere(POINTS_MAX + 1)).unwrap_err();
        assert!(error.contains("at most 262144 are taken"), "{error}");
        // Two circles that interlock: of each, all points see all edges of the other.
        let count = 1000;
        let rings = (0..2 * count).map(|i| {
            let (sin, cos) =
                (f64::from(i / 2) / f64::from(count) * std::f64::consts::TAU).sin_cos();
            match i % 2 {
                0 => Vector3::new(cos, sin, 0.0),
                _ => Vector3::new(1.0 + cos, 0.0, sin),
            }
        });
        let rings: Vec<_> = rings.collect();
        match hull(&rings) {
            Ok(found) => assert!(found.len() <= 2 * rings.len() - 4),
            Err(error) => assert!(error.contains("too long"), "{error}"),
        }
    }

    #[test]
    fn what_is_flat_has_none() {
        let flat: Vec<_> =
            (0..100).map(|i| Vector3::new(f64::from(i % 10), f64::from(i / 10), 0.3)).collect();
        for points in [&flat[..], &flat[..10], &flat[..1], &[]] {
            assert!(hull(points).unwrap_err().contains("no volume"));
        }
    }
}
