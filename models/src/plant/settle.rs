//! Where a plant can rest: minima of the potential energy on the constraints.
//!
//! Minimises `V(q) − W(q)` subject to `h(q) = 0` over the dynamic coordinates that are not held, with
//! `W` the work of constant inputs. Every iterate satisfies the constraints. With `g = V_q − f`,
//! `A = Dh(q)` and `Z` a basis of the directions that `A` leaves free,
//!
//! ```text
//! Aᵀ μ = −g  (least squares)       H = V_qq − f_q + Σ μ D²h       Zᵀ H Z = Q Λ Qᵀ
//! dq = −Z Q |Λ|⁻¹ Qᵀ Zᵀ g           q ← project(q + α dq)
//! ```
//!
//! `|Λ|` turns Newton's step downhill where the energy curves downwards, a line search keeps it
//! descending, and a stationary point that is no minimum is left along its steepest curvature. All
//! coordinates are scaled by the root of their inertia. Dense and allocating: not for a control path.

use nalgebra::{DMatrix, DVector, SVD};
use plantd_math::null_space::tangent_basis;
use plantd_scene::UnknownName;

use crate::constraints::closure::Closure;
use crate::constraints::projection::{Limits, Reached, project};
use crate::lagrangian::derivatives::Derivatives;
use crate::lagrangian::energy::potential_energy;
use crate::model::conditioning::Conditioning;
use crate::model::manifold::orientations;
use crate::model::mechanism::Model;

/// Iterations before the search is given up.
const MAX_ITERATIONS: u32 = 300;
/// Halvings of a step.
const MAX_HALVINGS: u32 = 40;
/// No iteration turns a joint by more than this, rad.
const LONGEST_TURN: f64 = 1.0;
/// How configurations are brought onto the constraints.
const PROJECTION: Limits = Limits {
    corrections: 60,
    enough: 1.0,
    floor: 1e4,
    longest: 0.5,
    shortest: 0.0,
    round_off_is_fresh: true,
};
/// The energy has no lower bound if a coordinate descends this far, m.
const FAR_M: f64 = 1e6;
/// It has none either if an angle is that far at the iteration limit, rad.
const FAR_RAD: f64 = 50.0;
/// Singular values of the constraints below this fraction of the largest are zero.
const RANK_CUT: f64 = 1e-9;
/// Curvatures below this fraction of the largest are flat.
const FLAT: f64 = 1e-9;
/// Curvature of constraints blurs no more than this fraction of the forces.
const CURVED: f64 = 1e-9;
/// A residual that no longer falls is at its floor below this fraction of the forces.
const FLOOR: f64 = 1e-7;

/// Where to look for an equilibrium.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct SettleRequest {
    /// First guess, nd + nk; need not satisfy the constraints.
    pub q: Vec<f64>,
    /// Coordinates that keep their value. Prescribed ones always do.
    pub hold: Vec<String>,
    /// Constant inputs, ni; none means zero.
    pub inputs: Vec<f64>,
}

/// A configuration at rest.
#[derive(Clone, Debug, PartialEq)]
pub struct Equilibrium {
    /// Configuration, nd + nk.
    pub q: Vec<f64>,
    /// The inputs, ni.
    pub inputs: Vec<f64>,
    /// Potential energy of gravity and springs, J.
    pub potential_j: f64,
    /// Largest force without balance on a coordinate that is not held, N or N·m.
    pub residual: f64,
    /// Multipliers as forces: `Dhᵀ μ` are the generalized forces that the constraints take away. nc.
    pub constraint_forces: Vec<f64>,
    /// Every small displacement costs energy: `smallest_stiffness` is greater than zero.
    pub stable: bool,
    /// Smallest eigenvalue of `Zᵀ (V_qq + Σ μ D²h) Z` with `Z` an orthonormal basis of the directions
    /// that constraints and held coordinates leave free, N/m or N·m/rad; infinite if there are none.
    pub smallest_stiffness: f64,
    /// Iterations.
    pub iterations: u32,
}

/// Why no equilibrium was found.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum SettleError {
    /// A vector has the wrong length.
    #[error("{name} has {actual} entries; {expected} are needed")]
    Dimension {
        /// Which vector.
        name: &'static str,
        /// Entries it must have.
        expected: usize,
        /// Entries it has.
        actual: usize,
    },
    /// A number is NaN or infinite.
    #[error("{name}[{index}] is {value}")]
    NotFinite {
        /// Which vector.
        name: &'static str,
        /// Index of the entry.
        index: usize,
        /// The entry.
        value: f64,
    },
    /// No coordinate of that name.
    #[error("there is no coordinate {name}")]
    Unknown {
        /// The name.
        name: UnknownName,
    },
    /// No configuration near the guess satisfies the constraints.
    #[error(
        "no configuration near the guess satisfies constraint `{constraint}`: {violation:e} is left"
    )]
    Constraints {
        /// Name of the worst equation.
        constraint: String,
        /// Its value `h(q)`.
        violation: f64,
    },
    /// The energy falls without end.
    #[error("the energy has no minimum: it falls on and on along `{coordinate}`")]
    Unbounded {
        /// The coordinate that went farthest.
        coordinate: String,
    },
    /// The search came to no end.
    #[error("no equilibrium after {iterations} iterations: a force of {residual:e} is left")]
    NotConverged {
        /// Iterations done.
        iterations: u32,
        /// Largest force without balance, N or N·m.
        residual: f64,
    },
}

impl Model {
    /// Finds a configuration near the guess where a plant rests: a minimum of the potential energy
    /// less the work of constant inputs, subject to the constraints.
    ///
    /// Costs O(n³) for each of up to 300 iterations, and memory for a few matrices of n².
    pub fn settle(&self, request: &SettleRequest) -> Result<Equilibrium, SettleError> {
        Search::new(self, request)?.run(&request.q)
    }

    /// Which coordinates are dynamic and not held; the name of one to be held that is unknown.
    pub(crate) fn free_coordinates(&self, hold: &[String]) -> Result<Vec<bool>, UnknownName> {
        let d = self.dimensions;
        let mut is_free: Vec<bool> = (0..d.coordinates()).map(|i| i < d.dynamic).collect();
        for name in hold {
            let known = self.coordinates.iter().map(|coordinate| &coordinate.name);
            let index = self.coordinate_index(name);
            is_free[index.ok_or_else(|| UnknownName::among(name, known))?] = false;
        }
        Ok(is_free)
    }
}

/// The configuration an increment of the dynamic coordinates away.
fn retract(model: &Model, q: &[f64], increment: &DVector<f64>) -> Vec<f64> {
    let mut change = increment.as_slice().to_vec();
    change.resize(q.len(), 0.0);
    model.retract(q, &change)
}

/// A search in progress.
struct Search<'a> {
    model: &'a Model,
    blocks: Derivatives,
    closure: Closure,
    inputs: Vec<f64>,
    /// Whether each dynamic coordinate may move.
    moves: Vec<bool>,
    /// Largest force that has been met.
    largest: f64,
}

/// A configuration on the constraints.
struct Point {
    q: Vec<f64>,
    potential: f64,
    /// Generalized forces that do not come from the potential, nd.
    force: DVector<f64>,
    /// `V_q − f`, zero where held, nd.
    gradient: DVector<f64>,
    /// Weighted rows of the constraints in scaled coordinates, zero where held.
    rows: DMatrix<f64>,
    /// Multipliers as forces.
    forces: Vec<f64>,
    /// `g + Aᵀ μ`.
    unbalanced: DVector<f64>,
}

impl Point {
    fn residual(&self) -> f64 {
        self.unbalanced.amax()
    }
}

impl<'a> Search<'a> {
    fn new(model: &'a Model, request: &SettleRequest) -> Result<Self, SettleError> {
        let d = model.dimensions;
        check("q", &request.q, d.coordinates())?;
        let inputs =
            if request.inputs.is_empty() { vec![0.0; d.inputs] } else { request.inputs.clone() };
        check("inputs", &inputs, d.inputs)?;
        let mut moves =
            model.free_coordinates(&request.hold).map_err(|name| SettleError::Unknown { name })?;
        moves.truncate(d.dynamic);
        let (blocks, closure) = (Derivatives::new(model), Closure::new(model));
        Ok(Self { model, blocks, closure, inputs, moves, largest: 0.0 })
    }

    fn run(&mut self, guess: &[f64]) -> Result<Equilibrium, SettleError> {
        let mut q = guess.to_vec();
        if self.project(&mut q).is_none() {
            let (constraint, violation) = self.model.worst_equation(&self.closure);
            return Err(SettleError::Constraints { constraint, violation });
        }
        let mut point = self.point(q);
        let mut radius = 1.0;
        for iteration in 1..=MAX_ITERATIONS {
            let stiffness = self.stiffness(&point);
            let basis = tangent_basis(&point.rows);
            let basis = self.without_held(basis);
            let reduced = basis.transpose() * self.scaled(&stiffness) * &basis;
            let slope = basis.transpose() * scaled(&self.model.conditioning, &point.gradient);
            let residual = point.residual();
            self.largest = self.largest.max(point.gradient.amax());
            let (size, round_off) = self.magnitudes(&point, &stiffness);
            // Eigenvalues of what is not finite are searched without end.
            if !residual.is_finite() || reduced.iter().any(|entry| !entry.is_finite()) {
                return Err(SettleError::NotConverged { iterations: iteration, residual });
            }
            if basis.ncols() == 0 {
                return self.equilibrium(point, iteration);
            }
            let modes = reduced.symmetric_eigen();
            let stiffest = modes.eigenvalues.amax();
            let at_rest = residual <= 4.0 * round_off;
            if at_rest {
                let softest = modes.eigenvalues.imin();
                if modes.eigenvalues[softest] < -FLAT * stiffest {
                    let away = &basis * modes.eigenvectors.column(softest);
                    if let Some(lower) =
                        self.leave(&point, &scaled(&self.model.conditioning, &away))
                    {
                        point = lower;
                        continue;
                    }
                }
                return self.equilibrium(point, iteration);
            }
            let along = modes.eigenvectors.transpose() * slope;
            let floor = (FLAT * stiffest).max(1e-6 * along.norm()).max(f64::MIN_POSITIVE);
            let step = DVector::from_fn(along.len(), |i, _| {
                -along[i] / modes.eigenvalues[i].abs().max(floor)
            });
            let mut step =
                scaled(&self.model.conditioning, &(&basis * (&modes.eigenvectors * step)));
            let limited = self.limit(&mut step, radius);
            match self.descend(&point, &step, round_off) {
                Some((next, fraction)) => {
                    if limited && fraction == 1.0 {
                        radius *= 2.0;
                    } else if fraction < 1.0 {
                        radius = (radius * fraction).max(1e-3);
                    }
                    point = next;
                }
                None if residual <= FLOOR * size => {
                    return self.equilibrium(point, iteration);
                }
                None => return Err(SettleError::NotConverged { iterations: iteration, residual }),
            }
            if let Some(coordinate) = self.far(&point.q, guess, FAR_M, false) {
                return Err(SettleError::Unbounded { coordinate });
            }
        }
        if let Some(coordinate) = self.far(&point.q, guess, FAR_RAD, true) {
            return Err(SettleError::Unbounded { coordinate });
        }
        let residual = point.residual();
        Err(SettleError::NotConverged { iterations: MAX_ITERATIONS, residual })
    }

    /// Everything of first order at a configuration.
    fn point(&mut self, q: Vec<f64>) -> Point {
        let (model, nd) = (self.model, self.model.dimensions.dynamic);
        self.evaluate(&q);
        let blocks = &self.blocks;
        let force = DVector::from_column_slice(&blocks.force);
        let gradient = DVector::from_fn(nd, |i, _| {
            if self.moves[i] { -(blocks.l_q[i] + blocks.force[i]) } else { 0.0 }
        });
        let potential = potential_energy(model, &blocks.poses, &blocks.momenta, &q);
        let mut rows = model.conditioning.rows(model, &mut self.closure, &q);
        without_columns(&mut rows, &self.moves);
        let scaled = scaled(&model.conditioning, &gradient);
        let weighted = pseudo_solve(rows.transpose(), &-&scaled);
        let unbalanced = scaled + rows.transpose() * &weighted;
        let unbalanced = DVector::from_fn(nd, |i, _| {
            unbalanced[i] * self.model.conditioning.inertia_of(i).sqrt()
        });
        let forces = weighted.iter().zip(&model.conditioning.weight).map(|(f, w)| f * w).collect();
        Point { q, potential, force, gradient, rows, forces, unbalanced }
    }

    /// Everything that does not come from constraints, at rest.
    fn evaluate(&mut self, q: &[f64]) {
        let (model, at_rest) = (self.model, vec![0.0; q.len()]);
        self.blocks.evaluate(model, (q, &orientations(model, q)), &at_rest, &self.inputs);
    }

    /// `V_qq − f_q + Σ μ D²h` of the dynamic coordinates, its symmetric part.
    fn stiffness(&mut self, point: &Point) -> DMatrix<f64> {
        let (model, n) = (self.model, point.q.len());
        let nd = model.dimensions.dynamic;
        // The line search has been elsewhere.
        self.evaluate(&point.q);
        let blocks = &self.blocks;
        let mut stiffness =
            DMatrix::from_fn(nd, nd, |i, j| -(blocks.l_qq[i * n + j] + blocks.f_q[i * n + j]));
        if model.dimensions.constraints > 0 {
            let mut hessian = vec![0.0; n * n];
            model.conditioning.rows(model, &mut self.closure, &point.q);
            self.closure.hessian(model, &point.q, &point.forces, &mut hessian);
            for i in 0..nd {
                for j in 0..nd {
                    stiffness[(i, j)] += hessian[i * n + j];
                }
            }
        }
        0.5 * (&stiffness + stiffness.transpose())
    }

    /// Newton's method with the shortest correction; the total increment if it arrives.
    fn project(&mut self, q: &mut Vec<f64>) -> Option<DVector<f64>> {
        let (model, conditioning) = (self.model, &self.model.conditioning);
        let correction = |closure: &Closure| {
            let mut rows = conditioning.weigh(model, closure);
            without_columns(&mut rows, &self.moves);
            let value = DVector::from_fn(closure.value.len(), |c, _| {
                -closure.value[c] * conditioning.weight[c]
            });
            Some(scaled(conditioning, &pseudo_solve(rows, &value)).as_slice().to_vec())
        };
        match project(model, &mut self.closure, q, &PROJECTION, correction) {
            (Reached::Satisfied, total) => {
                Some(DVector::from_column_slice(&total[..self.moves.len()]))
            }
            _ => None,
        }
    }

    /// The point at the first fraction of a step that is low enough, and the fraction.
    fn descend(
        &mut self,
        point: &Point,
        step: &DVector<f64>,
        round_off: f64,
    ) -> Option<(Point, f64)> {
        let slope = point.gradient.dot(step);
        let mut fraction = 1.0;
        for _ in 0..MAX_HALVINGS {
            if let Some(next) = self.moved(point, &(step * fraction)) {
                let (next, change) = next;
                let blurred = (fraction * slope).abs()
                    <= 64.0 * (round_off + f64::EPSILON * point.potential.abs());
                let better = if blurred {
                    // Too little for the energy to tell; forces can.
                    next.residual() < point.residual()
                } else {
                    change <= 1e-4 * fraction * slope
                };
                if better {
                    return Some((next, fraction));
                }
                if blurred {
                    return None;
                }
            }
            fraction *= 0.5;
        }
        None
    }

    /// The point an increment away, back on the constraints, and what `V − W` changes by.
    fn moved(&mut self, point: &Point, increment: &DVector<f64>) -> Option<(Point, f64)> {
        let mut q = retract(self.model, &point.q, increment);
        let total = increment + self.project(&mut q)?;
        let next = self.point(q);
        let work = 0.5 * (&point.force + &next.force).dot(&total);
        let change = next.potential - point.potential - work;
        change.is_finite().then_some((next, change))
    }

    /// A lower point along a direction of negative curvature, to either side.
    fn leave(&mut self, point: &Point, direction: &DVector<f64>) -> Option<Point> {
        let mut size = 0.2 / direction.amax();
        for _ in 0..MAX_HALVINGS / 4 {
            for side in [size, -size] {
                match self.moved(point, &(direction * side)) {
                    Some((next, change)) if change < 0.0 => return Some(next),
                    _ => {}
                }
            }
            size *= 0.25;
        }
        None
    }

    /// Shortens a step to what its coordinates may move at once; whether it had to.
    fn limit(&self, step: &mut DVector<f64>, radius: f64) -> bool {
        let coordinates = self.model.coordinates.iter();
        let excess = coordinates.zip(step.iter()).fold(1.0_f64, |excess, (coordinate, x)| {
            excess.max(x.abs() / if coordinate.is_angle { LONGEST_TURN } else { radius })
        });
        *step /= excess;
        excess > 1.0
    }

    /// The coordinate that went farthest, if it went that far.
    fn far(&self, q: &[f64], start: &[f64], limit: f64, angles: bool) -> Option<String> {
        let coordinates = self.model.coordinates.iter().zip(q.iter().zip(start));
        let moved = coordinates
            .filter(|(coordinate, _)| coordinate.is_angle == angles)
            .map(|(coordinate, (now, then))| (coordinate, (now - then).abs()));
        let (coordinate, distance) = moved.max_by(|a, b| a.1.total_cmp(&b.1))?;
        (distance > limit).then(|| coordinate.name.clone())
    }

    /// What the forces of a point are made of, and their round-off. Where a constraint has a kink, its
    /// curvature knows no bound and says nothing of that.
    fn magnitudes(&self, point: &Point, stiffness: &DMatrix<f64>) -> (f64, f64) {
        let farthest = point.q.iter().fold(1.0_f64, |a, q| a.max(q.abs()));
        let slopes = self.blocks.l_qq.iter().chain(&self.blocks.f_q);
        let own = slopes.fold(0.0_f64, |a, x| a.max(x.abs()));
        let size = self.largest + own * farthest;
        let curved = (f64::EPSILON * stiffness.amax() * farthest).min(CURVED * self.largest);
        (size, f64::EPSILON * size + curved)
    }

    fn equilibrium(&mut self, point: Point, iterations: u32) -> Result<Equilibrium, SettleError> {
        let model = self.model;
        let (n, nd) = (point.q.len(), model.dimensions.dynamic);
        let residual = point.residual();
        let stiffness = self.stiffness(&point);
        // In the coordinates' own units now.
        let mut rows = DMatrix::from_fn(model.dimensions.constraints, nd, |c, j| {
            let moved = model.conditioning.weight[c] > 0.0 && self.moves[j];
            if moved { self.closure.jacobian[c * n + j] } else { 0.0 }
        });
        let forces = pseudo_solve(rows.transpose(), &-&point.gradient);
        // A row as small as its round-off has no direction.
        for mut row in rows.row_iter_mut() {
            if row.norm() <= 1e-14 {
                row.fill(0.0);
            }
        }
        let basis = self.without_held(tangent_basis(&rows));
        let reduced = basis.transpose() * &stiffness * &basis;
        let eigenvalues = if reduced.is_empty() || !reduced.iter().all(|x| x.is_finite()) {
            Vec::new()
        } else {
            reduced.symmetric_eigenvalues().as_slice().to_vec()
        };
        let smallest = eigenvalues.iter().copied().fold(f64::INFINITY, f64::min);
        let largest = eigenvalues.iter().fold(0.0_f64, |a, x| a.max(x.abs()));
        Ok(Equilibrium {
            q: point.q,
            inputs: self.inputs.clone(),
            potential_j: point.potential,
            residual,
            constraint_forces: forces.as_slice().to_vec(),
            stable: smallest > FLAT * largest,
            smallest_stiffness: smallest,
            iterations,
        })
    }

    /// The columns of a basis that have no part in held coordinates.
    fn without_held(&self, basis: DMatrix<f64>) -> DMatrix<f64> {
        let held: Vec<usize> = (0..self.moves.len()).filter(|j| !self.moves[*j]).collect();
        if held.is_empty() {
            return basis;
        }
        // Columns of held coordinates are zero in the constraints: the free directions split.
        let mut rows = DMatrix::zeros(held.len(), basis.nrows());
        held.iter().enumerate().for_each(|(i, j)| rows[(i, *j)] = 1.0);
        let within = tangent_basis(&(rows * &basis));
        basis * within
    }

    fn scaled(&self, matrix: &DMatrix<f64>) -> DMatrix<f64> {
        let conditioning = &self.model.conditioning;
        DMatrix::from_fn(matrix.nrows(), matrix.ncols(), |i, j| {
            matrix[(i, j)] / (conditioning.inertia_of(i) * conditioning.inertia_of(j)).sqrt()
        })
    }
}

/// A gradient in the scaled coordinates, or an increment of these in the coordinates' own units.
fn scaled(conditioning: &Conditioning, increment: &DVector<f64>) -> DVector<f64> {
    increment.map_with_location(|i, _, x| x / conditioning.inertia_of(i).sqrt())
}

/// Zeroes the columns of what does not move.
fn without_columns(rows: &mut DMatrix<f64>, moves: &[bool]) {
    for (j, _) in moves.iter().enumerate().filter(|(_, moves)| !**moves) {
        rows.column_mut(j).fill(0.0);
    }
}

/// The least-squares solution of least norm.
fn pseudo_solve(matrix: DMatrix<f64>, right: &DVector<f64>) -> DVector<f64> {
    let columns = matrix.ncols();
    // Iterations on what is not finite would not end.
    if matrix.is_empty() || !matrix.iter().chain(right.iter()).all(|x| x.is_finite()) {
        return DVector::zeros(columns);
    }
    let svd = SVD::new(matrix, true, true);
    let cut = RANK_CUT * svd.singular_values.max();
    svd.solve(right, cut.max(f64::MIN_POSITIVE)).unwrap_or_else(|_| DVector::zeros(columns))
}

fn check(name: &'static str, values: &[f64], expected: usize) -> Result<(), SettleError> {
    if values.len() != expected {
        return Err(SettleError::Dimension { name, expected, actual: values.len() });
    }
    match values.iter().position(|value| !value.is_finite()) {
        Some(index) => Err(SettleError::NotFinite { name, index, value: values[index] }),
        None => Ok(()),
    }
}
