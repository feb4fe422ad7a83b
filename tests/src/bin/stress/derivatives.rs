//! The linearization of a step against differences of the step itself.
//!
//! Central differences along random directions, of the configuration, of the momentum, of forces and of
//! prescribed positions, are extrapolated to zero displacement (Ridders 1982). The extrapolation
//! estimates its own error; no estimate is trusted below what the rounding of the map makes of it.

use std::ops::Range;

use anyhow::{Context as _, Result, ensure};
use nalgebra::{DMatrix, DVector};
use plantd_models::{Initial, Linearization, Plant, State};

use crate::numbers::Numbers;
use crate::plants::largest;

/// An error estimate may be too low by this factor.
const MARGIN: f64 = 30.0;
/// A derivative this much larger than what is resolved is told from zero.
const RESOLVED: f64 = 1e3;
/// Round-off to which a step is solved at best, in units.
const SOLVED: f64 = 4.0;
/// Displacements, each half of the one before.
const LEVELS: usize = 18;
/// Halvings until a displacement is small enough for there to be a step.
const HALVINGS: usize = 60;
/// Powers of the displacement that are removed, one of two.
const ORDERS: usize = 7;
/// Angle by which the largest displacement moves a coordinate, rad.
const REACH: f64 = 0.3;

/// An error, and what differences can resolve; both relative to the derivative.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Error {
    pub(crate) found: f64,
    pub(crate) resolved: f64,
    /// What was displaced, and what of the result differs.
    pub(crate) by: &'static str,
    pub(crate) of: &'static str,
}

impl Error {
    pub(crate) fn is_resolved(&self) -> bool {
        self.found <= self.resolved
    }
    pub(crate) fn ratio(&self) -> f64 {
        self.found / self.resolved
    }
}

/// A displacement of state and input.
struct Direction {
    name: &'static str,
    q: Vec<f64>,
    p: Vec<f64>,
    forces: Vec<f64>,
    /// Of the next prescribed positions, as a change of the whole configuration.
    next: Vec<f64>,
}

/// The map about a point.
struct Map {
    plant: Plant,
    x: State,
    u: Vec<f64>,
    /// Where the step ends, with the next prescribed positions.
    end: Vec<f64>,
    /// How often the period was halved: another number makes another map.
    halvings: u32,
}

impl Map {
    /// Where the step ends after a displacement: `(q, p, λ)`, `q` beyond the end of the step in question.
    /// None where there is no such step of the same map.
    fn at(&mut self, direction: &Direction, s: f64) -> Option<DVector<f64>> {
        let model = self.plant.model().clone();
        let d = model.dimensions();
        let scaled = |v: &[f64]| -> Vec<f64> { v.iter().map(|x| s * x).collect() };
        let mut q = model.retract(&self.x.q, &scaled(&direction.q));
        if d.constraints > 0 && largest(&direction.q) > 0.0 {
            let projection = Initial::Projection { q, hold: Vec::new() };
            self.plant.initialize(&projection).ok()?;
            q = self.plant.q().to_vec();
        }
        let p = self.x.p.iter().zip(&direction.p).map(|(p, x)| p + s * x).collect();
        self.plant.initialize(&Initial::Momentum { q, p, v: self.x.v.clone() }).ok()?;
        let forces = self.u[..d.inputs].iter().zip(&direction.forces).map(|(u, x)| u + s * x);
        let end = model.retract(&self.end, &scaled(&direction.next));
        let u: Vec<f64> = forces.chain(end[d.dynamic..].iter().copied()).collect();
        let report = self.plant.step(&u).ok()?;
        if report.halvings != self.halvings {
            return None;
        }
        let q = model.difference(&self.end, self.plant.q());
        let rows = [&q[..d.dynamic], self.plant.p(), self.plant.multipliers()].concat();
        Some(DVector::from_vec(rows))
    }
}

impl Map {
    /// How results scatter about a line over displacements that are too small to matter otherwise.
    fn scatter(&mut self, direction: &Direction, slope: &DVector<f64>, reach: f64) -> DVector<f64> {
        const SMALL: f64 = 1e-11;
        let mut worst = DVector::zeros(slope.len());
        let Some(middle) = self.at(direction, 0.0) else { return worst };
        for k in 1..=4 {
            let s = SMALL * reach * f64::from(k);
            if let Some(moved) = self.at(direction, s) {
                let off = (moved - &middle - slope * s).abs();
                worst = worst.sup(&off);
            }
        }
        worst
    }
}

/// Compares; the error is the one largest in proportion to what is resolved.
pub(crate) fn check(plant: &Plant, u: &[f64], seed: u64) -> Result<Error> {
    let mut plant = plant.clone();
    let model = plant.model().clone();
    let (d, n) = (model.dimensions(), model.dimensions().coordinates());
    // From the rounded state: what it keeps beyond that cannot be displaced.
    let State { q, p, v, .. } = plant.state();
    plant.initialize(&Initial::Momentum { q, p, v })?;
    let x = plant.state();
    let tangent = tangent(&mut plant);
    let jacobian = plant.constraint_jacobian();
    let mut out = Linearization::new(&model);
    let report = plant.linearize(u, &mut out)?;
    ensure!(plant.constraint_jacobian() == jacobian, "linearize changes the constraint Jacobian");
    let jacobian = jacobian.columns(0, d.dynamic).into_owned();
    let redundant = report.redundant_constraints > 0;
    let condition = report.reciprocal_condition.min(report.constraint_reciprocal_condition);
    plant.step(u)?;
    let end = plant.q().to_vec();
    let stack = |x: DMatrix<f64>, multipliers: DMatrix<f64>| {
        let columns = x.ncols();
        let mut rows = DMatrix::zeros(2 * d.dynamic + d.constraints, columns);
        rows.rows_mut(0, d.dynamic).copy_from(&x.rows(0, d.dynamic));
        rows.rows_mut(d.dynamic, d.dynamic).copy_from(&x.rows(n, d.dynamic));
        rows.rows_mut(2 * d.dynamic, d.constraints).copy_from(&multipliers);
        rows
    };
    let by_x = stack(out.a(), out.multipliers_x());
    let by_u = stack(out.b(), out.multipliers_u());
    // What rounding makes of the results: their own, and that of the displaced states.
    let ends = [&end[..d.dynamic], plant.p(), plant.multipliers()].concat();
    let sum = |row: usize, columns: Range<usize>, size: f64| {
        by_x.row(row).columns(columns.start, columns.len()).abs().sum() * size
    };
    let (size_q, size_p) = (largest(&x.q), largest(&x.p));
    let solved = SOLVED.max(report.residual).max(report.constraint_residual);
    let rounding: Vec<f64> = (0..ends.len())
        .map(|i| {
            let of_state = sum(i, 0..n, size_q) + sum(i, n..n + d.dynamic, size_p);
            solved * f64::EPSILON * (ends[i].abs() + of_state)
        })
        .collect();
    let mut map = Map { plant, x, u: u.to_vec(), end, halvings: report.halvings };
    let mut random = Numbers::new(seed);
    let mut worst = Error { found: 0.0, resolved: f64::MIN_POSITIVE, by: "", of: "" };
    for direction in directions(&mut random, &model.dimensions(), &tangent) {
        let dx = [&direction.q[..], &direction.p, &vec![0.0; d.prescribed]].concat();
        let du = [&direction.forces[..], &direction.next[d.dynamic..]].concat();
        let (dx, du) = (DVector::from_vec(dx), DVector::from_vec(du));
        let predicted = &by_x * &dx + &by_u * &du;
        // What is added up to it.
        let summed = by_x.abs() * dx.abs() + by_u.abs() * du.abs();
        let given = largest(&direction.q).max(largest(&direction.next));
        let reach = predicted.rows(0, d.dynamic).amax().max(given);
        if reach == 0.0 {
            continue;
        }
        let table = Table::new(REACH / reach, |s| map.at(&direction, s));
        let scatter = map.scatter(&direction, &predicted, REACH / reach);
        let parts = [
            ("q", 0..d.dynamic),
            ("p", d.dynamic..2 * d.dynamic),
            // Where equations are redundant, impulses are not unique.
            ("λ", 2 * d.dynamic..if redundant { 2 * d.dynamic } else { predicted.len() }),
        ];
        for (of, part) in parts.into_iter().filter(|(_, part)| !part.is_empty()) {
            let noise = largest(&rounding[part.clone()]);
            let noise = noise.max(largest(&scatter.as_slice()[part.clone()]));
            let (slope, estimate) =
                table.slope(&part, noise).context("no step near the state succeeds")?;
            let own = if of == "λ" { 0.0 } else { dx.amax() };
            // Impulses of constraints that cancel what is displaced.
            let impulses = jacobian.tr_mul(&predicted.rows(2 * d.dynamic, d.constraints)).amax();
            let mobility = part.clone().map(|row| sum(row, n..n + d.dynamic, impulses));
            let added = summed.rows(part.start, part.len()).amax() + own;
            let rounded = f64::EPSILON * mobility.fold(added, f64::max) / condition;
            let resolved = MARGIN * (estimate + rounded);
            let expected = predicted.rows(part.start, part.len());
            let (size, found) = (slope.amax(), (slope - expected).amax());
            if found <= resolved && size < RESOLVED * resolved {
                // Zero, as far as can be told.
                continue;
            }
            let error =
                Error { found: found / size, resolved: resolved / size, by: direction.name, of };
            if !(error.ratio() <= worst.ratio()) {
                worst = error;
            }
        }
    }
    Ok(worst)
}

/// Projects displacements of dynamic coordinates onto those that keep the constraints; none without any.
pub(crate) fn tangent(plant: &mut Plant) -> Option<DMatrix<f64>> {
    /// Part of a gradient that must be left beside the others for it to count.
    const INDEPENDENT: f64 = 1e-8;
    let d = plant.model().dimensions();
    if d.constraints == 0 {
        return None;
    }
    let jacobian = plant.constraint_jacobian();
    let mut tangent = DMatrix::identity(d.dynamic, d.dynamic);
    for row in jacobian.row_iter() {
        let gradient = row.columns(0, d.dynamic).transpose();
        // Twice is enough (Kahan).
        let rest = &tangent * (&tangent * &gradient);
        if rest.norm() > INDEPENDENT * gradient.norm() {
            let unit = rest.normalize();
            tangent -= &unit * unit.transpose();
        }
    }
    Some(tangent)
}

fn directions(
    random: &mut Numbers,
    d: &plantd_models::Dimensions,
    tangent: &Option<DMatrix<f64>>,
) -> Vec<Direction> {
    let n = d.coordinates();
    let mut some =
        |len: usize| -> Vec<f64> { (0..len).map(|_| random.between(-1.0, 1.0)).collect() };
    let mut directions = Vec::new();
    for _ in 0..2 {
        let zero = |name| Direction {
            name,
            q: vec![0.0; n],
            p: vec![0.0; d.dynamic],
            forces: vec![0.0; d.inputs],
            next: vec![0.0; n],
        };
        let mut q = some(n);
        if let Some(tangent) = tangent {
            q.truncate(d.dynamic);
            q = (tangent * DVector::from_vec(q)).as_slice().to_vec();
            q.resize(n, 0.0);
        }
        directions.push(Direction { q, ..zero("q") });
        directions.push(Direction { p: some(d.dynamic), ..zero("p") });
        directions.push(Direction { forces: some(d.inputs), ..zero("forces") });
        let next = [vec![0.0; d.dynamic], some(d.prescribed)].concat();
        directions.push(Direction { next, ..zero("next") });
    }
    directions
}

/// Differences of halved displacements.
struct Table {
    rows: Vec<(f64, DVector<f64>)>,
}

impl Table {
    fn new(start: f64, mut along: impl FnMut(f64) -> Option<DVector<f64>>) -> Self {
        let mut rows = Vec::new();
        let mut delta = start;
        for _ in 0..LEVELS + HALVINGS {
            if rows.len() == LEVELS {
                break;
            }
            match (along(delta), along(-delta)) {
                (Some(ahead), Some(behind)) => rows.push((delta, (ahead - behind) / (2.0 * delta))),
                // Larger ones cannot be trusted either.
                _ => rows.clear(),
            }
            delta /= 2.0;
        }
        Self { rows }
    }

    /// The derivative of some rows with the smallest error, and the estimate of the error: an estimate may
    /// be small by accident, so it counts no less than how far the next best derivatives lie.
    fn slope(&self, part: &Range<usize>, noise: f64) -> Option<(DVector<f64>, f64)> {
        const BEST: usize = 6;
        let mut found: Vec<(f64, DVector<f64>)> = Vec::new();
        let mut above: Vec<DVector<f64>> = Vec::new();
        for (delta, difference) in &self.rows {
            let mut row = vec![difference.rows(part.start, part.len()).into_owned()];
            for (order, coarse) in above.iter().take(ORDERS).enumerate() {
                let fine = &row[order];
                let next = fine + (fine - coarse) / (4_f64.powi(order as i32 + 1) - 1.0);
                let estimate = (&next - fine).amax().max((&next - coarse).amax());
                found.push((estimate.max(noise / delta), next.clone()));
                row.push(next);
            }
            above = row;
        }
        found.sort_by(|(a, _), (b, _)| a.total_cmp(b));
        let (estimate, best) = found.first()?.clone();
        let others = found.iter().take(BEST).map(|(_, other)| (other - &best).amax());
        let estimate = others.fold(estimate, f64::max);
        Some((best, estimate))
    }
}
