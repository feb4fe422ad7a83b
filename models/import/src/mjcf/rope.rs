//! Ropes over pulleys as paths.
//!
//! A tendon of several branches has the length `L = Σ L_b / d_b`, with the divisors `d_b` of the pulleys before
//! them. A scene's path has no divisors, but it may go to and fro: with the least common multiple `D` of the
//! divisors it leads `D / d_b` times along branch `b`, and from the end of one branch to the begin of the next,
//! which is a constant length `c` where both are on one body. Its length is `D L + c`.

use nalgebra::{Isometry3, Point3};
use plantd_models::scene::Point;

/// The greatest least common multiple of divisors.
const TIMES_MAX: usize = 64;

/// A point of a body, none for the world.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Stop {
    pub(super) body: Option<usize>,
    pub(super) point: Point,
}

impl Stop {
    fn at(&self) -> Point3<f64> {
        Point3::from(self.point.at)
    }
}

/// Stops between two pulleys, and what divides the length between them.
pub(super) struct Branch {
    pub(super) divisor: f64,
    pub(super) stops: Vec<Stop>,
}

/// A path whose length is `times` that of the tendon, and a constant.
pub(super) struct Rope {
    stops: Vec<Stop>,
    pub(super) times: f64,
    constant: f64,
}

impl Rope {
    /// None where divisors are no whole numbers, or where branches end and begin on different bodies.
    pub(super) fn of(branches: &[Branch]) -> Option<Self> {
        let whole = |branch: &Branch| {
            let is_whole = branch.divisor.fract() == 0.0;
            (is_whole && (1.0..=TIMES_MAX as f64).contains(&branch.divisor))
                .then_some(branch.divisor as usize)
        };
        let divisors: Vec<usize> = branches.iter().map(whole).collect::<Option<_>>()?;
        let times = (1..=TIMES_MAX).find(|times| divisors.iter().all(|d| times % d == 0))?;
        // Each branch from either end; which of the two ways before leads there.
        let ways: Vec<[Vec<Stop>; 2]> = branches
            .iter()
            .zip(&divisors)
            .map(|(branch, divisor)| [false, true].map(|back| along(branch, times / divisor, back)))
            .collect();
        let mut from: Vec<[Option<usize>; 2]> = vec![[Some(0); 2]];
        for pair in ways.windows(2) {
            let before = from[from.len() - 1];
            let meets = |next: &Vec<Stop>| {
                let ends_there = |way: &usize| {
                    let (end, begin) = (pair[0][*way].last(), next.first());
                    before[*way].is_some()
                        && end.zip(begin).is_some_and(|(end, begin)| end.body == begin.body)
                };
                (0..2).find(ends_there)
            };
            from.push([meets(&pair[1][0]), meets(&pair[1][1])]);
        }
        let mut way = (0..2).find(|way| from[from.len() - 1][*way].is_some())?;
        let mut chosen = Vec::new();
        for i in (0..ways.len()).rev() {
            chosen.push(&ways[i][way]);
            way = from[i][way]?;
        }
        let (mut stops, mut constant): (Vec<Stop>, f64) = (Vec::new(), 0.0);
        for branch in chosen.into_iter().rev() {
            if let (Some(end), Some(begin)) = (stops.last(), branch.first()) {
                constant += (begin.at() - end.at()).norm();
            }
            for stop in branch {
                if stops.last() != Some(stop) {
                    stops.push(stop.clone());
                }
            }
        }
        Some(Self { stops, times: times as f64, constant })
    }

    pub(super) fn points(&self) -> Vec<Point> {
        self.stops.iter().map(|stop| stop.point.clone()).collect()
    }

    /// The path's length where the tendon has a given one.
    pub(super) fn path_length(&self, length: f64) -> f64 {
        self.times * length + self.constant
    }

    /// The tendon's length where bodies have given poses.
    pub(super) fn length(&self, poses: &[Isometry3<f64>]) -> f64 {
        let place = |stop: &Stop| {
            stop.body.map_or_else(Isometry3::identity, |body| poses[body]) * stop.at()
        };
        let points: Vec<_> = self.stops.iter().map(place).collect();
        let whole: f64 = points.windows(2).map(|pair| (pair[1] - pair[0]).norm()).sum();
        (whole - self.constant) / self.times
    }
}

/// To and fro along a branch, so many times, beginning at its first stop or at its last.
fn along(branch: &Branch, times: usize, back: bool) -> Vec<Stop> {
    let mut stops = Vec::new();
    for time in 0..times {
        let ahead = branch.stops.iter().skip(usize::from(time > 0));
        let behind = branch.stops.iter().rev().skip(usize::from(time > 0));
        if (time % 2 == 1) == back {
            stops.extend(ahead.cloned())
        } else {
            stops.extend(behind.cloned())
        }
    }
    stops
}

#[cfg(test)]
mod tests {
    use super::*;

    fn branch(divisor: f64, stops: &[(usize, [f64; 3])]) -> Branch {
        let stop = |(body, at): &(usize, [f64; 3])| Stop {
            body: Some(*body),
            point: Point { frame: body.to_string(), at: *at },
        };
        Branch { divisor, stops: stops.iter().map(stop).collect() }
    }

    /// The path is as long as the sum over branches says, wherever bodies are.
    #[test]
    fn a_path_goes_to_and_fro() {
        let cases = [
            vec![branch(1.0, &[(0, [0.1, 0.0, 0.0]), (1, [0.0, 0.2, 0.0]), (2, [0.0; 3])])],
            vec![
                branch(1.0, &[(0, [0.1, 0.0, 0.0]), (1, [0.0, 0.2, 0.0])]),
                branch(2.0, &[(1, [0.5, 0.0, 0.0]), (2, [0.0, 0.0, 0.3])]),
            ],
            // The second branch must be led backwards, and the third begins where that ends.
            vec![
                branch(3.0, &[(0, [0.0; 3]), (1, [0.0, 0.2, 0.0])]),
                branch(3.0, &[(2, [0.0, 0.0, 0.3]), (3, [0.1; 3]), (1, [0.0, 0.2, 0.0])]),
                branch(1.0, &[(2, [0.4, 0.0, 0.0]), (0, [0.0, 1.0, 0.0])]),
            ],
        ];
        let poses: Vec<_> = (0..4)
            .map(|i| {
                let i = f64::from(i);
                Isometry3::new(
                    nalgebra::Vector3::new(i.sin(), 2.0 * (3.0 * i).cos(), i),
                    nalgebra::Vector3::new(i, 0.3 - i, 0.7 * i),
                )
            })
            .collect();
        for branches in cases {
            let length = |branch: &Branch| {
                let place = |stop: &Stop| poses[stop.body.unwrap()] * stop.at();
                let pairs = branch.stops.windows(2);
                pairs.map(|pair| (place(&pair[1]) - place(&pair[0])).norm()).sum::<f64>()
                    / branch.divisor
            };
            let expected: f64 = branches.iter().map(length).sum();
            let rope = Rope::of(&branches).unwrap();
            assert!((rope.length(&poses) - expected).abs() < 1e-13, "{}", rope.times);
        }
    }

    #[test]
    fn branches_that_no_path_joins_are_none() {
        let first = || branch(1.0, &[(0, [0.0; 3]), (1, [0.0; 3])]);
        assert!(Rope::of(&[first(), branch(1.5, &[(1, [0.1; 3]), (2, [0.0; 3])])]).is_none());
        assert!(Rope::of(&[first(), branch(2.0, &[(2, [0.1; 3]), (3, [0.0; 3])])]).is_none());
        assert!(Rope::of(&[first(), branch(67.0, &[(1, [0.1; 3]), (2, [0.0; 3])])]).is_none());
    }
}
