//! Piecewise quintic splines.
//!
//! Value and the first two derivatives are continuous. At each knot a slope that is not given is
//! replaced by continuity of the third derivative, a curvature that is not given by continuity of the
//! fourth. Before the first and after the last knot goes on one quadratic piece each, so that there
//! the third and fourth derivatives are zero. On an interval of width `w`, with values `y`, slopes `s`
//! and curvatures `c` at its ends 0 and 1, and `m = (y1 − y0)/w`,
//!
//! ```text
//! f'''(0)  = [60 m − 36 s0 − 24 s1]/w² + [−9 c0 + 3 c1]/w
//! f'''(w)  = [60 m − 24 s0 − 36 s1]/w² + [−3 c0 + 9 c1]/w
//! f''''(0) = [−360 m + 192 s0 + 168 s1]/w³ + [36 c0 − 24 c1]/w²
//! f''''(w) = [ 360 m − 168 s0 − 192 s1]/w³ + [−24 c0 + 36 c1]/w²
//! ```

use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use crate::scalar::Scalar;

/// A pivot below this fraction of its row's largest entry leaves the spline undetermined.
const SINGULAR: f64 = 1e-12;

/// A spline; pieces are polynomials in the distance from where they start.
#[derive(Clone, Debug)]
pub struct Spline {
    /// Positions of the knots, increasing.
    knots: Vec<f64>,
    /// Coefficients, constant first. The first piece ends at the first knot and counts from it,
    /// every other one starts at a knot.
    pieces: Vec<[f64; 6]>,
    /// Integral from the first knot to where the piece counts from.
    integrals: Vec<f64>,
}

impl Spline {
    /// The spline through at least two knots with increasing positions, all numbers finite; none if
    /// the knots leave it undetermined.
    pub fn new(knots: &[Knot]) -> Option<Self> {
        let shapes = shapes(knots)?;
        let first = &knots[0];
        let mut spline = Self {
            knots: knots.iter().map(|knot| knot.x).collect(),
            pieces: vec![[first.value, shapes[0][0], 0.5 * shapes[0][1], 0.0, 0.0, 0.0]],
            integrals: vec![0.0, 0.0],
        };
        for (ends, shapes) in knots.windows(2).zip(shapes.windows(2)) {
            let width = ends[1].x - ends[0].x;
            let piece = quintic(width, [ends[0].value, ends[1].value], [shapes[0], shapes[1]]);
            let start = spline.integrals[spline.pieces.len()];
            spline.integrals.push(start + width * mean(&piece, width));
            spline.pieces.push(piece);
        }
        let (last, shape) = (&knots[knots.len() - 1], shapes[knots.len() - 1]);
        spline.pieces.push([last.value, shape[0], 0.5 * shape[1], 0.0, 0.0, 0.0]);
        let mut all = spline.pieces.iter().flatten().chain(&spline.integrals);
        all.all(|x| x.is_finite()).then_some(spline)
    }

    /// A bound of the second derivative.
    pub fn steepest(&self) -> f64 {
        let widths = self.knots.windows(2).map(|ends| ends[1] - ends[0]);
        let widths = std::iter::once(0.0).chain(widths).chain([0.0]);
        let bounds = self.pieces.iter().zip(widths).map(|([_, _, a2, a3, a4, a5], width)| {
            let rest = (20.0 * a5.abs() * width + 12.0 * a4.abs()) * width + 6.0 * a3.abs();
            rest * width + 2.0 * a2.abs()
        });
        bounds.fold(0.0, f64::max)
    }

    /// Index of the piece at `x`, and the distance from where it counts.
    #[inline]
    fn locate<S: Scalar>(&self, x: S) -> (usize, S) {
        let piece = self.knots.partition_point(|knot| *knot <= x.value());
        (piece, x - self.knots[piece.saturating_sub(1)])
    }

    /// Value.
    #[inline]
    pub fn value<S: Scalar>(&self, x: S) -> S {
        let (piece, x) = self.locate(x);
        let [a0, a1, a2, a3, a4, a5] = self.pieces[piece];
        ((((x * a5 + a4) * x + a3) * x + a2) * x + a1) * x + a0
    }

    /// First derivative.
    #[inline]
    pub fn slope<S: Scalar>(&self, x: S) -> S {
        let (piece, x) = self.locate(x);
        let [_, a1, a2, a3, a4, a5] = self.pieces[piece];
        (((x * (5.0 * a5) + 4.0 * a4) * x + 3.0 * a3) * x + 2.0 * a2) * x + a1
    }

    /// Integral from the first knot.
    pub fn integral<S: Scalar>(&self, x: S) -> S {
        let (piece, x) = self.locate(x);
        x * mean(&self.pieces[piece], x) + self.integrals[piece]
    }
}

/// Mean of a piece from where it counts to `x`.
fn mean<S: Scalar>(piece: &[f64; 6], x: S) -> S {
    let [a0, a1, a2, a3, a4, a5] = *piece;
    ((((x * (a5 / 6.0) + a4 / 5.0) * x + a3 / 4.0) * x + a2 / 3.0) * x + a1 / 2.0) * x + a0
}

/// The quintic with values `y` and `[slope, curvature]` at the ends of an interval.
fn quintic(width: f64, y: [f64; 2], [[s0, c0], [s1, c1]]: [[f64; 2]; 2]) -> [f64; 6] {
    let w = width;
    let m = (y[1] - y[0]) / w;
    [
        y[0],
        s0,
        0.5 * c0,
        (10.0 * m - 6.0 * s0 - 4.0 * s1 + 0.5 * w * (c1 - 3.0 * c0)) / (w * w),
        (-15.0 * m + 8.0 * s0 + 7.0 * s1 + 0.5 * w * (3.0 * c0 - 2.0 * c1)) / (w * w * w),
        (6.0 * m - 3.0 * s0 - 3.0 * s1 + 0.5 * w * (c1 - c0)) / (w * w * w * w),
    ]
}

/// Slope and curvature at each knot, from `2 n` equations for `(s0, c0, s1, c1, ..)` of bandwidth 3.
///
/// Unknowns are scaled by the width `u` around their knot, `s u` and `c u²`, and so are the equations.
fn shapes(knots: &[Knot]) -> Option<Vec<[f64; 2]>> {
    let n = knots.len();
    let width = |i: usize| knots[i + 1].x - knots[i].x;
    let unit = |i: usize| match i {
        0 => width(0),
        i if i == n - 1 => width(n - 2),
        i => width(i - 1).min(width(i)),
    };
    let mut system = Banded::new(2 * n);
    for (i, knot) in knots.iter().enumerate() {
        let u = unit(i);
        for (order, given) in [(0, knot.slope), (1, knot.curvature)] {
            let row = 2 * i + order;
            if let Some(given) = given {
                *system.at(row, row) = 1.0;
                system.right[row] = given * u.powi(order as i32 + 1);
                continue;
            }
            // The jump of the third or fourth derivative is zero.
            let scale = u.powi(order as i32 + 3);
            for (side, sign) in [(i.checked_sub(1), -1.0), ((i + 1 < n).then_some(i), 1.0)] {
                let Some(left) = side else { continue };
                let w = width(left);
                let at_left = left == i;
                let (mean, [s0, s1], [c0, c1]) = match (order, at_left) {
                    (0, true) => (60.0, [-36.0, -24.0], [-9.0, 3.0]),
                    (0, false) => (60.0, [-24.0, -36.0], [-3.0, 9.0]),
                    (_, true) => (-360.0, [192.0, 168.0], [36.0, -24.0]),
                    (_, false) => (360.0, [-168.0, -192.0], [-24.0, 36.0]),
                };
                let per_slope = sign * scale / w.powi(order as i32 + 2);
                let per_curvature = per_slope * w;
                let (u0, u1) = (unit(left), unit(left + 1));
                let column = 2 * left;
                *system.at(row, column) += per_slope * s0 / u0;
                *system.at(row, column + 1) += per_curvature * c0 / (u0 * u0);
                *system.at(row, column + 2) += per_slope * s1 / u1;
                *system.at(row, column + 3) += per_curvature * c1 / (u1 * u1);
                let m = (knots[left + 1].value - knots[left].value) / w;
                system.right[row] -= per_slope * mean * m;
            }
        }
    }
    let solution = system.solve()?;
    let shape = |i: usize| {
        let u = unit(i);
        [solution[2 * i] / u, solution[2 * i + 1] / (u * u)]
    };
    Some((0..n).map(shape).collect())
}

/// A linear system whose row `i` has entries in columns `i − 3` to `i + 3`; row exchanges fill in up
/// to column `i + 6`.
struct Banded {
    /// Entry of column `i − 3 + k` at place `k`.
    rows: Vec<[f64; 10]>,
    right: Vec<f64>,
}

impl Banded {
    fn new(size: usize) -> Self {
        Self { rows: vec![[0.0; 10]; size], right: vec![0.0; size] }
    }

    fn at(&mut self, row: usize, column: usize) -> &mut f64 {
        &mut self.rows[row][column + 3 - row]
    }

    /// Gaussian elimination with row exchanges; none if the matrix is singular.
    fn solve(mut self) -> Option<Vec<f64>> {
        let n = self.right.len();
        for (row, right) in self.rows.iter_mut().zip(&mut self.right) {
            let largest = row.iter().fold(0.0_f64, |a, x| a.max(x.abs()));
            row.iter_mut().for_each(|x| *x /= largest);
            *right /= largest;
        }
        for k in 0..n {
            let (rows, columns) = (k + 1..n.min(k + 4), k..n.min(k + 7));
            for row in rows.clone() {
                if self.at(row, k).abs() > self.at(k, k).abs() {
                    for column in columns.clone() {
                        let upper = *self.at(k, column);
                        *self.at(k, column) = std::mem::replace(self.at(row, column), upper);
                    }
                    self.right.swap(k, row);
                }
            }
            let pivot = *self.at(k, k);
            if !(pivot.abs() > SINGULAR) {
                return None;
            }
            for row in rows {
                let factor = *self.at(row, k) / pivot;
                for column in columns.clone() {
                    *self.at(row, column) -= factor * *self.at(k, column);
                }
                self.right[row] -= factor * self.right[k];
            }
        }
        for k in (0..n).rev() {
            for column in k + 1..n.min(k + 7) {
                self.right[k] -= *self.at(k, column) * self.right[column];
            }
            self.right[k] /= *self.at(k, k);
        }
        Some(self.right)
    }
}

/// A knot of a spline, which is piecewise quintic with continuous value, slope and curvature.
///
/// A slope that is not given is replaced by continuity of the third derivative, a curvature by
/// continuity of the fourth. Before the first and after the last knot the spline is quadratic.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Knot {
    /// Position; greater than that of the knot before.
    pub x: f64,
    /// Value.
    pub value: f64,
    /// First derivative.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub slope: Option<f64>,
    /// Second derivative.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub curvature: Option<f64>,
}

#[cfg(test)]
mod tests {
    use super::*;

    fn knot(x: f64, value: f64, slope: Option<f64>, curvature: Option<f64>) -> Knot {
        Knot { x, value, slope, curvature }
    }

    /// Derivative of order `order` of a piece at distance `x` from where it counts.
    fn derivative(piece: &[f64; 6], order: usize, x: f64) -> f64 {
        let falling = |k: usize| ((k - order + 1)..=k).map(|i| i as f64).product::<f64>();
        (order..6).map(|k| piece[k] * falling(k) * x.powi((k - order) as i32)).sum()
    }

    /// Unevenly spaced knots that say what `given` says: bit 2i the slope, bit 2i + 1 the curvature.
    fn knots(given: u32) -> Vec<Knot> {
        let wave = |i: usize, phase: f64| (2.3 * i as f64 + phase).sin();
        (0..6)
            .map(|i| {
                let says = |bit: usize| given >> (2 * i + bit) & 1 == 1;
                let x = 0.4 * i as f64 + 0.15 * wave(i, 0.3) - 1.0;
                knot(x, wave(i, 0.0), says(0).then(|| wave(i, 1.0)), says(1).then(|| wave(i, 2.0)))
            })
            .collect()
    }

    #[test]
    fn every_mixture_of_conditions_holds() {
        for given in 0..1 << 12 {
            let knots = knots(given);
            let spline = Spline::new(&knots).unwrap();
            for (i, knot) in knots.iter().enumerate() {
                let distance = if i == 0 { 0.0 } else { knot.x - knots[i - 1].x };
                let [before, after] = [0, 1].map(|side| {
                    let distance = if side == 0 { distance } else { 0.0 };
                    [0, 1, 2, 3, 4].map(|k| derivative(&spline.pieces[i + side], k, distance))
                });
                let continuous = |order: usize| (before[order] - after[order]).abs();
                let close = |order: usize, to: f64| (after[order] - to).abs() < 1e-11;
                assert!(close(0, knot.value) && continuous(0) < 1e-11, "{given:b} at {i}");
                assert!(continuous(1) < 1e-10 && continuous(2) < 1e-9, "{given:b} at {i}");
                match knot.slope {
                    Some(slope) => assert!(close(1, slope), "{given:b} at {i}"),
                    None => assert!(continuous(3) < 1e-8, "{given:b} at {i}: {before:?} {after:?}"),
                }
                match knot.curvature {
                    Some(curvature) => assert!(close(2, curvature), "{given:b} at {i}"),
                    None => assert!(continuous(4) < 1e-7, "{given:b} at {i}: {before:?} {after:?}"),
                }
            }
        }
    }

    #[test]
    fn slope_and_integral_belong_to_the_value() {
        let spline = Spline::new(&knots(0b0110_0010_1101)).unwrap();
        for k in -15..20 {
            let x = 0.1 * f64::from(k);
            let difference = |f: &dyn Fn(f64) -> f64| {
                (8.0 * (f(x + 1e-3) - f(x - 1e-3)) - f(x + 2e-3) + f(x - 2e-3)) / 12e-3
            };
            let value = difference(&|x| spline.integral(x));
            assert!((spline.value(x) - value).abs() < 1e-8, "{x}");
            let slope = difference(&|x| spline.value(x));
            assert!((spline.slope(x) - slope).abs() < 1e-6, "{x}: {} {slope}", spline.slope(x));
        }
        assert_eq!(spline.integral(spline.knots[0]), 0.0);
    }

    #[test]
    fn a_quintic_is_found_again() {
        let coefficients = [0.3, -1.0, 0.5, 2.0, -0.7, 0.2];
        let at = |order, x| derivative(&coefficients, order, x);
        let full = |x| knot(x, at(0, x), Some(at(1, x)), Some(at(2, x)));
        let bare = |x| knot(x, at(0, x), None, None);
        let spline = Spline::new(&[full(-1.0), bare(0.2), bare(0.3), full(1.5)]).unwrap();
        for k in 0..=25 {
            let x = -1.0 + 0.1 * f64::from(k);
            assert!((spline.value(x) - at(0, x)).abs() < 1e-12, "{x}");
            assert!((spline.slope(x) - at(1, x)).abs() < 1e-11, "{x}");
        }
        let beyond = at(0, 1.5) + 2.0 * at(1, 1.5) + 2.0 * at(2, 1.5);
        assert!((spline.value(3.5) - beyond).abs() < 1e-12);
        let before = at(0, -1.0) - 2.0 * at(1, -1.0) + 2.0 * at(2, -1.0);
        assert!((spline.value(-3.0) - before).abs() < 1e-12);
    }

    #[test]
    fn two_bare_knots_leave_a_curvature_open() {
        assert!(Spline::new(&[knot(0.0, 1.0, None, None), knot(1.0, 2.0, None, None)]).is_none());
        let line = Spline::new(&[knot(0.0, 1.0, Some(1.0), None), knot(1.0, 2.0, None, None)]);
        assert!((line.unwrap().value(7.0) - 8.0).abs() < 1e-12);
    }
}
