//! Regulator about an equilibrium: the discrete algebraic Riccati equation.

use nalgebra::{Complex, DMatrix};

use crate::coordinates::Coordinates;
use crate::doubling;
use crate::error::RiccatiError;
use crate::manifold::Tangent;
use crate::matrix::{is_positive_semidefinite, solve_definite, symmetrize};
use crate::spectrum::{balance, eigenvalues, sorted};
use crate::weights::Weights;

/// Residual above which Newton's method polishes the solution.
const RESIDUAL_POLISH: f64 = 1e-12;
/// Residual above which there is no solution to speak of.
const RESIDUAL_MAX: f64 = 1e-8;
/// Newton steps at most; each squares the error.
const POLISH_MAX: u32 = 12;
/// State weight, relative to the largest one, that makes every mode visible while searching for a
/// first stabilising gain.
const VISIBILITY: f64 = 1e-10;
/// A mode with a modulus above this does not decay by itself.
const MODULUS_MARGINAL: f64 = 1.0 - 1e-9;
/// Distance to losing rank, relative to the size of the matrix, at which rank counts as lost.
const RANK_LOST: f64 = 1e-9;

/// A regulator `u = u_ref − K (x − x_ref)`.
#[derive(Clone, Debug, PartialEq)]
pub struct Regulator {
    /// `K`, m × n.
    pub gain: DMatrix<f64>,
    /// `P`, n × n, symmetric positive semidefinite: the cost to go is `½ dxᵀ P dx`.
    pub value: DMatrix<f64>,
    /// Largest modulus of the eigenvalues of the closed loop `A − BK`; less than 1.
    pub spectral_radius: f64,
    /// Eigenvalues of the closed loop `A − BK`, largest modulus first, conjugate ones side by side.
    pub closed_loop: Vec<Complex<f64>>,
    /// `‖P − (Q + AᵀPA − Kᵀ(R + BᵀPB)K)‖ / ‖P‖`, Frobenius, with the cross term taken into `A` and `Q`.
    pub residual: f64,
    /// Reciprocal condition of `R + BᵀPB` in the 1-norm, at most 1.
    pub reciprocal_condition: f64,
    /// Doublings.
    pub iterations: u32,
}

/// Solves the infinite-horizon regulator problem of `x[k+1] = A x + B u`; `q_final` plays no part.
///
/// Structure-preserving doubling, about `15n³` flops for each of 6 to 30 doublings; `A` may be
/// singular, as it is with constraints and prescribed coordinates. A cross term is taken into the map,
///
/// ```text
/// A' = A − B R⁻¹ Sᵀ ,   Q' = Q − S R⁻¹ Sᵀ ,   K = K' + R⁻¹ Sᵀ ,
/// ```
///
/// which leaves `P` and `A − BK` as they are; `R` is well invertible then. What comes out has passed three
/// checks: it solves the equation, it is positive semidefinite, and it stabilises. When a check
/// fails, the modes of `A` tell why.
///
/// ```
/// use std::f64::consts::PI;
/// use std::sync::Arc;
/// use plantd_control::{Weights, infinite_horizon};
/// use plantd_models::{Initial, Linearization, Model, Plant, Settings, builtin};
///
/// // Balance the pole of a cart upright.
/// let model = Arc::new(Model::compile(&builtin::scene("cart-pole").unwrap())?);
/// let mut plant = Plant::new(Arc::clone(&model), Settings::new(&model))?;
/// plant.initialize(&Initial::Momentum { q: vec![0.0, PI], p: vec![0.0; 2], v: vec![] })?;
/// let mut linearization = Linearization::new(&model);
/// plant.linearize(&[0.0], &mut linearization)?;
/// let weights = Weights::diagonal(&[1.0; 4], &[0.1])?;
/// let regulator = infinite_horizon(&linearization.a(), &linearization.b(), &weights)?;
/// assert_eq!(regulator.gain.shape(), (1, 4));
/// assert!(regulator.spectral_radius < 1.0 && regulator.residual < 1e-9);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
pub fn infinite_horizon(
    a: &DMatrix<f64>,
    b: &DMatrix<f64>,
    weights: &Weights,
) -> Result<Regulator, RiccatiError> {
    regulate(a, b, Coordinates(None), weights)
}

/// The regulator on the constraint manifold, at an equilibrium with that tangent space: the cost counts
/// only what the tangent space holds, the gain acts on the full state, and the spectral radius
/// leaves out directions off the manifold.
pub fn infinite_horizon_on_manifold(
    a: &DMatrix<f64>,
    b: &DMatrix<f64>,
    tangent: &Tangent,
    weights: &Weights,
) -> Result<Regulator, RiccatiError> {
    regulate(a, b, Coordinates(Some(tangent)), weights)
}

/// The regulator in coordinates of the state.
fn regulate(
    a: &DMatrix<f64>,
    b: &DMatrix<f64>,
    space: Coordinates<'_>,
    weights: &Weights,
) -> Result<Regulator, RiccatiError> {
    let n = weights.states();
    RiccatiError::check_map(0, (a, b), (n, weights.inputs()))?;
    space.check(0, n)?;
    let (a, b, q) = (space.map(space, a), space.reduce(b), space.restrict(weights.q()));
    let s = weights.s().map(|s| space.reduce(s));
    let reduced = solve(&a, &b, &q, weights.r(), s.as_deref())?;
    Ok(Regulator {
        gain: space.extend_gain(&reduced.gain),
        value: space.extend_value(&reduced.value),
        ..reduced
    })
}

fn solve(
    a: &DMatrix<f64>,
    b: &DMatrix<f64>,
    q: &DMatrix<f64>,
    r: &DMatrix<f64>,
    s: Option<&DMatrix<f64>>,
) -> Result<Regulator, RiccatiError> {
    let Some(s) = s.filter(|s| s.iter().any(|&entry| entry != 0.0)) else {
        return solve_without_cross(a, b, q, r);
    };
    let Some(factor) = r.clone().cholesky() else {
        return Err(RiccatiError::Overflow { sample: 0 });
    };
    let shift = factor.solve(&s.transpose());
    let mut rest = q - s * &shift;
    symmetrize(&mut rest);
    let regulator = solve_without_cross(&(a - b * &shift), b, &rest, r)?;
    Ok(Regulator { gain: &regulator.gain + shift, ..regulator })
}

/// The problem without a cross term, of matrices that fit.
pub(super) fn solve_without_cross(
    a: &DMatrix<f64>,
    b: &DMatrix<f64>,
    q: &DMatrix<f64>,
    r: &DMatrix<f64>,
) -> Result<Regulator, RiccatiError> {
    let equation = RiccatiEquation { a, b, q, r };
    let (regulator, iterations) = equation.attempt(q);
    let regulator = regulator.filter(Regulator::is_good);
    let regulator = match regulator {
        Some(regulator) if regulator.spectral_radius < MODULUS_MARGINAL => return Ok(regulator),
        marginal => marginal,
    };
    // A closed loop within round-off of the unit circle may be a mode that nothing moves.
    if let Some(reason) = equation.diagnose()? {
        return Err(reason);
    }
    if let Some(regulator) = regulator {
        return Ok(regulator);
    }
    // An unstable mode without weight leads doubling to a solution that leaves the mode alone.
    // With a little weight everywhere it stabilises, and Newton's method then keeps to the
    // stabilising branch of the equation as it was asked.
    let mut visible = q.clone();
    let weight = VISIBILITY * q.diagonal().amax().max(f64::MIN_POSITIVE.sqrt());
    for i in 0..visible.nrows() {
        visible[(i, i)] += weight;
    }
    let (regulator, more_iterations) = equation.attempt(&visible);
    let iterations = iterations + more_iterations;
    match regulator {
        Some(regulator) if regulator.is_good() => Ok(Regulator { iterations, ..regulator }),
        other => {
            let found = other.map(|found| (found.residual, found.spectral_radius));
            let (residual, spectral_radius) = found.unwrap_or((f64::INFINITY, f64::INFINITY));
            Err(RiccatiError::NotConverged { iterations, residual, spectral_radius })
        }
    }
}

impl Regulator {
    /// The a-posteriori checks, written so that NaN fails.
    fn is_good(&self) -> bool {
        self.residual <= RESIDUAL_MAX
            && self.spectral_radius < 1.0
            && is_positive_semidefinite(&self.value)
    }
}

/// The equation `P = Q + AᵀPA − AᵀPB (R + BᵀPB)⁻¹ BᵀPA`.
struct RiccatiEquation<'a> {
    a: &'a DMatrix<f64>,
    b: &'a DMatrix<f64>,
    q: &'a DMatrix<f64>,
    r: &'a DMatrix<f64>,
}

impl RiccatiEquation<'_> {
    /// Doubling with state weight `q`, polished for the weight of the equation; with the number of
    /// doublings. The caller judges the result.
    fn attempt(&self, q: &DMatrix<f64>) -> (Option<Regulator>, u32) {
        let Some(r) = self.r.clone().cholesky() else {
            return (None, 0);
        };
        let mut g = self.b * r.solve(&self.b.transpose());
        symmetrize(&mut g);
        match doubling::riccati(self.a, &g, q) {
            Err(iterations) => (None, iterations),
            Ok((value, iterations)) => {
                let rough = self.evaluate(value, iterations);
                (rough.map(|rough| self.polish(rough)), iterations)
            }
        }
    }

    fn evaluate(&self, value: DMatrix<f64>, iterations: u32) -> Option<Regulator> {
        let (gain, reciprocal_condition) = gain(self.a, self.b, self.r, &value)?;
        let closed_loop = self.a - self.b * &gain;
        let modes = sorted(eigenvalues(&closed_loop).ok()?);
        let spectral_radius = modes.first().map_or(0.0, |z| z.norm());
        let defect =
            self.stage_cost(&gain) + closed_loop.transpose() * (&value * &closed_loop) - &value;
        let residual = defect.norm() / value.norm().max(f64::MIN_POSITIVE);
        Some(Regulator {
            gain,
            value,
            spectral_radius,
            closed_loop: modes,
            residual,
            reciprocal_condition,
            iterations,
        })
    }

    /// Newton-Kleinman: the cost of the gain in hand, then the gain that is best for that cost.
    /// From a stabilising gain it converges to the stabilising solution, monotonically.
    fn polish(&self, mut regulator: Regulator) -> Regulator {
        for _ in 0..POLISH_MAX {
            if regulator.residual <= RESIDUAL_POLISH || regulator.spectral_radius >= 1.0 {
                break;
            }
            let closed_loop = self.a - self.b * &regulator.gain;
            let Some(better) = doubling::lyapunov(&closed_loop, &self.stage_cost(&regulator.gain))
                .and_then(|value| self.evaluate(value, regulator.iterations))
                .filter(|better| better.residual < regulator.residual)
            else {
                break;
            };
            regulator = better;
        }
        regulator
    }

    /// `Q + KᵀRK`.
    fn stage_cost(&self, gain: &DMatrix<f64>) -> DMatrix<f64> {
        let mut cost = gain.transpose() * (self.r * gain) + self.q;
        symmetrize(&mut cost);
        cost
    }

    /// Why there is no regulator, if the modes of `A` that do not decay tell
    /// (Popov-Belevitch-Hautus).
    fn diagnose(&self) -> Result<Option<RiccatiError>, RiccatiError> {
        let modes = eigenvalues(self.a)?;
        let lasting: Vec<_> =
            modes.into_iter().filter(|z| z.norm() >= MODULUS_MARGINAL && z.im >= 0.0).collect();
        if let Some(mode) = Reach::of_inputs(self.a, self.b).lost(&lasting) {
            let (real, imaginary, modulus) = (mode.re, mode.im, mode.norm());
            return Ok(Some(RiccatiError::NotStabilisable { real, imaginary, modulus }));
        }
        let on_circle: Vec<_> =
            lasting.into_iter().filter(|z| z.norm() <= 2.0 - MODULUS_MARGINAL).collect();
        let unseen = Reach::of_weight(self.a, self.q).lost(&on_circle);
        Ok(unseen.map(|z| RiccatiError::NotDetectable { real: z.re, imaginary: z.im }))
    }
}

/// A map and what is to reach its modes, in units in which those of states and inputs do not matter.
struct Reach {
    a: DMatrix<f64>,
    b: DMatrix<f64>,
}

impl Reach {
    /// How inputs reach the modes of `A`.
    fn of_inputs(a: &DMatrix<f64>, b: &DMatrix<f64>) -> Self {
        let mut reach = Self { a: a.clone(), b: b.clone() };
        balance(&mut reach.a, &mut reach.b);
        let size = reach.a.norm();
        for mut column in reach.b.column_iter_mut() {
            let norm = column.norm();
            if norm > 0.0 {
                column *= size / norm;
            }
        }
        reach
    }

    /// How a weight sees the modes of `A`, whose units it shares.
    fn of_weight(a: &DMatrix<f64>, q: &DMatrix<f64>) -> Self {
        let mut reach = Self { a: a.transpose(), b: q.clone() };
        let scales = balance(&mut reach.a, &mut reach.b);
        for (mut column, scale) in reach.b.column_iter_mut().zip(scales.iter()) {
            column /= *scale;
        }
        let norm = reach.b.norm();
        if norm > 0.0 {
            reach.b *= reach.a.norm() / norm;
        }
        reach
    }

    /// Of the modes, the one that `B` moves least, if that is not at all: `[A − zI, B]` loses rank.
    fn lost(&self, modes: &[Complex<f64>]) -> Option<Complex<f64>> {
        let distances = modes.iter().filter_map(|&z| Some((z, self.distance(z)?)));
        let (mode, distance) = distances.min_by(|(_, a), (_, b)| a.total_cmp(b))?;
        (distance < RANK_LOST).then_some(mode)
    }

    /// Distance of `[A − zI, B]` to losing rank, relative to the size of `A` and `z`.
    fn distance(&self, z: Complex<f64>) -> Option<f64> {
        let (n, m) = self.b.shape();
        let scale = (self.a.norm() + z.norm()).recip();
        let mut pencil = DMatrix::<Complex<f64>>::zeros(n, n + m);
        for row in 0..n {
            for col in 0..n {
                pencil[(row, col)] = Complex::from(self.a[(row, col)] * scale);
            }
            pencil[(row, row)] -= z * scale;
            for col in 0..m {
                pencil[(row, n + col)] = Complex::from(self.b[(row, col)] * scale);
            }
        }
        let svd = nalgebra::SVD::try_new(pencil, false, false, f64::EPSILON, 60 * (n + m))?;
        Some(svd.singular_values.min())
    }
}

/// `(R + BᵀPB)⁻¹ BᵀPA` and the reciprocal condition of the bracket, or nothing if the bracket is not
/// positive definite in floating point.
fn gain(
    a: &DMatrix<f64>,
    b: &DMatrix<f64>,
    r: &DMatrix<f64>,
    p: &DMatrix<f64>,
) -> Option<(DMatrix<f64>, f64)> {
    let bt_p = (p * b).transpose();
    solve_definite(&bt_p * b + r, &(bt_p * a))
}
