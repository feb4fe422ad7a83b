//! Steps of planar mechanisms by Newton's method with the whole matrix, in twice the digits or in ordinary
//! numbers: a solution that shares nothing with the crate's.

use std::ops::{Add, Mul, Neg, Sub};

use nalgebra::{DMatrix, DVector};
use plantd_models::scene::{Axis, Constraint, Joint, Point};
use plantd_models::{Initial, Linearization, Plant, Scene, State};

/// Numbers, of either precision.
trait Real:
    Copy + From<f64> + Add<Output = Self> + Sub<Output = Self> + Mul<Output = Self> + Neg<Output = Self>
{
    fn sin_cos(self) -> (Self, Self);
    fn inverse(h: f64) -> Self;
    fn value(self) -> f64;
    fn double(self) -> Double;
}

impl Real for f64 {
    fn sin_cos(self) -> (Self, Self) {
        f64::sin_cos(self)
    }

    fn inverse(h: f64) -> Self {
        1.0 / h
    }

    fn value(self) -> f64 {
        self
    }

    fn double(self) -> Double {
        Double(self, 0.0)
    }
}

/// The sum of two numbers, the second below half a unit in the last place of the first.
#[derive(Clone, Copy, Debug)]
struct Double(f64, f64);

fn two_sum(a: f64, b: f64) -> Double {
    let sum = a + b;
    let part = sum - a;
    Double(sum, (a - (sum - part)) + (b - part))
}

impl From<f64> for Double {
    fn from(x: f64) -> Self {
        Self(x, 0.0)
    }
}

impl Add for Double {
    type Output = Self;
    fn add(self, other: Self) -> Self {
        let (high, low) = (two_sum(self.0, other.0), two_sum(self.1, other.1));
        let sum = two_sum(high.0, high.1 + low.0);
        two_sum(sum.0, sum.1 + low.1)
    }
}

impl Neg for Double {
    type Output = Self;
    fn neg(self) -> Self {
        Self(-self.0, -self.1)
    }
}

impl Sub for Double {
    type Output = Self;
    fn sub(self, other: Self) -> Self {
        self + -other
    }
}

impl Mul for Double {
    type Output = Self;
    fn mul(self, other: Self) -> Self {
        let high = self.0 * other.0;
        let low = self.0.mul_add(other.0, -high) + (self.0 * other.1 + self.1 * other.0);
        two_sum(high, low)
    }
}

impl Real for Double {
    fn sin_cos(self) -> (Self, Self) {
        let (mut sin, mut cos, mut term) = (Self(0.0, 0.0), Self(1.0, 0.0), Self(1.0, 0.0));
        for k in 1..100 {
            let inverse = <Self as Real>::inverse(f64::from(k));
            term = term * self * inverse;
            match k % 4 {
                1 => sin = sin + term,
                2 => cos = cos - term,
                3 => sin = sin - term,
                _ => cos = cos + term,
            }
        }
        (sin, cos)
    }

    fn inverse(h: f64) -> Self {
        let high = 1.0 / h;
        Self(high, high.mul_add(-h, 1.0) * high)
    }

    fn value(self) -> f64 {
        self.0
    }

    fn double(self) -> Double {
        self
    }
}

struct Link {
    parent: Option<usize>,
    slides: bool,
    at: [f64; 2],
    mass: f64,
    center: [f64; 2],
    inertia: f64,
}

/// Hinges about y and sliders along x in the plane of x and z, with points that coincide.
pub(crate) struct Mechanism {
    links: Vec<Link>,
    pins: Vec<[(Option<usize>, [f64; 2]); 2]>,
    gravity: f64,
    h: f64,
}

/// Where links are: sine and cosine of their angles, and their joints.
struct At<R> {
    turn: Vec<(R, R)>,
    origin: Vec<[R; 2]>,
}

fn turned<R: Real>((sin, cos): (R, R), [x, z]: [f64; 2]) -> [R; 2] {
    let (x, z) = (R::from(x), R::from(z));
    [x * cos + z * sin, z * cos - x * sin]
}

fn plus<R: Real>(a: [R; 2], b: [R; 2]) -> [R; 2] {
    [a[0] + b[0], a[1] + b[1]]
}

fn minus<R: Real>(a: [R; 2], b: [R; 2]) -> [R; 2] {
    [a[0] - b[0], a[1] - b[1]]
}

fn dot<R: Real>(a: [R; 2], b: [R; 2]) -> R {
    a[0] * b[0] + a[1] * b[1]
}

/// How a vector changes with an angle, times a number.
fn across<R: Real>([x, z]: [R; 2], rate: R) -> [R; 2] {
    [z * rate, -(x * rate)]
}

impl Mechanism {
    pub(crate) fn new(scene: &Scene) -> Self {
        let index = |name: &str| scene.frames.iter().position(|frame| frame.name == name);
        let links = scene
            .frames
            .iter()
            .map(|frame| {
                let body = frame.body.clone().unwrap();
                Link {
                    parent: index(&frame.parent),
                    slides: matches!(frame.joint, Some(Joint::Prismatic { .. })),
                    at: [frame.translation[0], frame.translation[2]],
                    mass: body.mass,
                    center: [body.center_of_mass[0], body.center_of_mass[2]],
                    inertia: body.inertia.get(1).copied().unwrap_or_default(),
                }
            })
            .collect();
        let point = |point: &Point| (index(&point.frame), [point.at[0], point.at[2]]);
        let pins = scene
            .constraints
            .iter()
            .map(|constraint| match constraint {
                Constraint::PointToPoint { a, b, axes, .. } => {
                    assert!(axes.contains(&Axis::X) && axes.contains(&Axis::Z));
                    [point(a), point(b)]
                }
                _ => panic!("another constraint"),
            })
            .collect();
        Self { links, pins, gravity: scene.gravity.unwrap()[2], h: scene.time_step_s }
    }

    fn at<R: Real>(&self, q: &[R]) -> At<R> {
        let mut at: At<R> = At { turn: Vec::new(), origin: Vec::new() };
        let mut angles: Vec<R> = Vec::new();
        for (link, &q) in self.links.iter().zip(q) {
            let zero = R::from(0.0);
            let (angle, origin) = match link.parent {
                Some(parent) => {
                    (angles[parent], plus(at.origin[parent], turned(at.turn[parent], link.at)))
                }
                None => (zero, link.at.map(R::from)),
            };
            let turn = angle.sin_cos();
            if link.slides {
                let [x, z] = turned(turn, [1.0, 0.0]);
                angles.push(angle);
                at.turn.push(turn);
                at.origin.push(plus(origin, [x * q, z * q]));
            } else {
                angles.push(angle + q);
                at.turn.push((angle + q).sin_cos());
                at.origin.push(origin);
            }
        }
        at
    }

    fn carriers(&self, link: usize) -> impl Iterator<Item = usize> {
        std::iter::successors(Some(link), |link| self.links[*link].parent)
    }

    /// `∂p/∂q_j` of a point of what `j` carries.
    fn gradient<R: Real>(&self, at: &At<R>, j: usize, point: [R; 2]) -> [R; 2] {
        if self.links[j].slides {
            turned(at.turn[j], [1.0, 0.0])
        } else {
            across(minus(point, at.origin[j]), R::from(1.0))
        }
    }

    fn rate<R: Real>(&self, link: usize, v: &[R]) -> R {
        self.carriers(link)
            .filter(|j| !self.links[*j].slides)
            .fold(R::from(0.0), |sum, j| sum + v[j])
    }

    fn velocity<R: Real>(&self, at: &At<R>, link: usize, point: [R; 2], v: &[R]) -> [R; 2] {
        self.carriers(link).fold([R::from(0.0); 2], |sum, j| {
            let [x, z] = self.gradient(at, j, point);
            plus(sum, [x * v[j], z * v[j]])
        })
    }

    /// `L_q` and `L_v`.
    fn derivatives<R: Real>(&self, q: &[R], v: &[R]) -> [Vec<R>; 2] {
        let at = self.at(q);
        let mut out = [vec![R::from(0.0); q.len()], vec![R::from(0.0); q.len()]];
        for (b, link) in self.links.iter().enumerate() {
            let center = plus(at.origin[b], turned(at.turn[b], link.center));
            let velocity = self.velocity(&at, b, center, v);
            let (mass, rate) = (R::from(link.mass), self.rate(b, v));
            for j in self.carriers(b) {
                let gradient = self.gradient(&at, j, center);
                out[1][j] = out[1][j] + mass * dot(velocity, gradient);
                let bend = if self.links[j].slides {
                    across(gradient, self.rate(j, v))
                } else {
                    out[1][j] = out[1][j] + R::from(link.inertia) * rate;
                    let of_origin = self.velocity(&at, j, at.origin[j], v);
                    across(minus(velocity, of_origin), R::from(1.0))
                };
                out[0][j] =
                    out[0][j] + mass * (dot(velocity, bend) + R::from(self.gravity) * gradient[1]);
            }
        }
        out
    }

    fn end<R: Real>(&self, at: &At<R>, (link, point): (Option<usize>, [f64; 2])) -> [R; 2] {
        match link {
            Some(link) => plus(at.origin[link], turned(at.turn[link], point)),
            None => point.map(R::from),
        }
    }

    fn closure<R: Real>(&self, q: &[R]) -> Vec<R> {
        let at = self.at(q);
        self.pins.iter().flat_map(|[a, b]| minus(self.end(&at, *a), self.end(&at, *b))).collect()
    }

    /// Row-major.
    fn jacobian<R: Real>(&self, q: &[R]) -> Vec<Vec<R>> {
        let at = self.at(q);
        let mut rows = vec![vec![R::from(0.0); q.len()]; 2 * self.pins.len()];
        for (c, pin) in self.pins.iter().enumerate() {
            for (end, sign) in pin.iter().zip([1.0, -1.0]) {
                let point = self.end(&at, *end);
                for j in end.0.into_iter().flat_map(|link| self.carriers(link)) {
                    let gradient = self.gradient(&at, j, point);
                    for axis in 0..2 {
                        let entry = &mut rows[2 * c + axis][j];
                        *entry = *entry + R::from(sign) * gradient[axis];
                    }
                }
            }
        }
        rows
    }

    /// Residuals of a step.
    fn residual<R: Real>(&self, [q, p]: [&[f64]; 2], x: &[R], lambda: &[R]) -> [Vec<R>; 2] {
        let start: Vec<R> = q.iter().map(|q| R::from(*q)).collect();
        let half = R::from(0.5);
        let mid: Vec<R> = start.iter().zip(x).map(|(q, x)| *q + half * *x).collect();
        let end: Vec<R> = start.iter().zip(x).map(|(q, x)| *q + *x).collect();
        let rate = R::inverse(self.h);
        let v: Vec<R> = x.iter().map(|x| *x * rate).collect();
        let [l_q, l_v] = self.derivatives(&mid, &v);
        let h = R::from(0.5 * self.h);
        let mut first: Vec<R> =
            (0..q.len()).map(|i| (R::from(p[i]) - l_v[i]) + h * l_q[i]).collect();
        for (row, lambda) in self.jacobian(&start).iter().zip(lambda) {
            for (r, entry) in first.iter_mut().zip(row) {
                *r = *r - *entry * *lambda;
            }
        }
        [first, self.closure(&end)]
    }

    /// The whole matrix at `x`, rounded, and what rounding took.
    fn matrix<R: Real>(&self, state: [&[f64]; 2], x: &[R], lambda: &[R]) -> [DMatrix<f64>; 2] {
        let all: Vec<R> = [x, lambda].concat();
        let mut matrix = DMatrix::zeros(all.len(), all.len());
        let mut low = matrix.clone();
        for j in 0..all.len() {
            let delta = 1e-9;
            let side = |sign: f64| {
                let all: Vec<Double> = all
                    .iter()
                    .enumerate()
                    .map(|(i, x)| {
                        let change = if i == j { sign * delta } else { 0.0 };
                        x.double() + Double::from(change)
                    })
                    .collect();
                let (x, lambda) = all.split_at(x.len());
                self.residual(state, x, lambda).concat()
            };
            let (more, less) = (side(1.0), side(-1.0));
            for (i, (more, less)) in more.iter().zip(&less).enumerate() {
                let slope = (*more - *less) * <Double as Real>::inverse(2.0 * delta);
                (matrix[(i, j)], low[(i, j)]) = (slope.0, slope.1);
            }
        }
        [matrix, low]
    }

    /// Increments and multipliers of a step from `(q, p)`, from a guess of them.
    fn solve<R: Real>(&self, state: [&[f64]; 2], guess: [&[f64]; 2]) -> [Vec<R>; 2] {
        let numbers = |guess: &[f64]| guess.iter().map(|x| R::from(*x)).collect::<Vec<R>>();
        let [mut x, mut lambda] = guess.map(numbers);
        for _ in 0..5 {
            let [matrix, _] = self.matrix(state, &x, &lambda);
            let right = self.residual(state, &x, &lambda).concat();
            let right = DVector::from_iterator(right.len(), right.iter().map(|r| r.value()));
            let change = matrix.full_piv_lu().solve(&right).unwrap();
            for (x, change) in x.iter_mut().chain(&mut lambda).zip(change.iter()) {
                *x = *x - R::from(*change);
            }
        }
        [x, lambda]
    }

    /// Derivatives of the multipliers by the momenta, column by column; refined so many times.
    fn slopes(&self, [high, low]: &[DMatrix<f64>; 2], refinements: usize) -> Vec<Double> {
        let (size, n) = (high.nrows(), self.links.len());
        let lu = high.clone().full_piv_lu();
        let column = |j: usize| {
            let mut y = vec![Double::from(0.0); size];
            for _ in 0..=refinements {
                let rest = DVector::from_fn(size, |i, _| {
                    let unit = Double::from(if i == j { 1.0 } else { 0.0 });
                    let entry = |k: usize| Double(high[(i, k)], low[(i, k)]);
                    -(0..size).fold(unit, |sum, k| sum + entry(k) * y[k]).value()
                });
                let change = lu.solve(&rest).unwrap();
                y.iter_mut().zip(change.iter()).for_each(|(y, c)| *y = *y + Double::from(*c));
            }
            y.split_off(n)
        };
        (0..n).flat_map(column).collect()
    }

    /// Relative errors of the multipliers of a plant's next step and of their derivatives by the momenta,
    /// each beside that of the whole matrix in ordinary numbers. Takes the step.
    pub(crate) fn errors(&self, plant: &mut Plant) -> [[f64; 2]; 2] {
        let State { q, p, .. } = plant.state();
        // As they are, without what rounding took from them before.
        plant.initialize(&Initial::Momentum { q: q.clone(), p: p.clone(), v: vec![] }).unwrap();
        let mut out = Linearization::new(&plant.model().clone());
        let input = vec![0.0; plant.model().dimensions().input()];
        plant.step_and_linearize(&input, &mut out).unwrap();
        let x: Vec<f64> = plant.q().iter().zip(&q).map(|(end, start)| end - start).collect();
        let (state, guess) = ([&q[..], &p], [&x[..], plant.multipliers()]);
        let [true_x, truth] = self.solve::<Double>(state, guess);
        let [whole_x, whole] = self.solve::<f64>(state, guess);
        let true_slopes = self.slopes(&self.matrix(state, &true_x, &truth), 6);
        let [matrix, rounding] = self.matrix(state, &whole_x, &whole);
        let whole_slopes: Vec<f64> =
            self.slopes(&[matrix, rounding * 0.0], 0).iter().map(|slope| slope.value()).collect();
        let by_momentum = out.multipliers_x().columns(q.len(), p.len()).into_owned();
        [
            [error(plant.multipliers(), &truth), error(&whole, &truth)],
            [error(by_momentum.as_slice(), &true_slopes), error(&whole_slopes, &true_slopes)],
        ]
    }
}

/// The largest error, relative to the largest entry.
fn error(found: &[f64], truth: &[Double]) -> f64 {
    assert_eq!(found.len(), truth.len());
    let size = truth.iter().fold(0.0_f64, |largest, x| largest.max(x.value().abs()));
    let errors = found.iter().zip(truth).map(|(x, truth)| (Double::from(*x) - *truth).value());
    errors.fold(0.0_f64, |largest, error| largest.max(error.abs())) / size
}
