//! The chain rule over the steps of a control period.
//!
//! With the tangent `D = ∂(q, p, k)/∂θ` of where a step begins, by the parameters `θ = (q, p, u, k)`
//! of the period, and the derivatives `[x', p']` of the step by its own parameters,
//!
//! ```text
//! D_q ← D_q + x' D        D_p ← p' D        inputs add what they do to the step
//! ```
//!
//! O(n²) for each of the parameters and steps.

use plantd_math::rows::{Term, add_rows, padded};

use crate::linearization::ends::InputImpulse;
use crate::linearization::linearize::{Kind, Linearization, Part};
use crate::model::mechanism::Model;

/// Numbers that the steps of a period may take: 1 GiB.
const NUMBERS_MAX: usize = 1 << 27;

/// The tangent along the steps of a period. Empty until it is used.
#[derive(Clone, Debug, Default)]
pub(crate) struct Chain {
    /// `D`, row-major: rows `(q, p, k)`, columns `(q, p, u, k)`, padded.
    tangent: Vec<f64>,
    next: Vec<f64>,
    /// `∂λ/∂θ`, summed over the steps.
    multipliers: Vec<f64>,
    stride: usize,
    terms: Vec<Term>,
}

impl Chain {
    /// Begins at the start of the period.
    pub(crate) fn begin(&mut self, model: &Model, out: &mut Linearization) {
        let (n, rows) = (out.nd + out.nk, out.next_columns() + out.nk);
        self.stride = padded((rows + out.ni).max(1));
        self.tangent.clear();
        self.tangent.resize(rows * self.stride, 0.0);
        self.next.clear();
        self.next.resize(rows * self.stride, 0.0);
        self.multipliers.clear();
        self.multipliers.resize(model.dimensions.constraints * self.stride, 0.0);
        for row in 0..n + out.nd {
            self.tangent[row * self.stride + row] = 1.0;
        }
        out.kind = Kind::Period { steps: 0 };
        let numbers = 3 * self.tangent.len() + 2 * out.nd * out.stride;
        out.parts_max = (NUMBERS_MAX / numbers.max(1)).max(1);
    }

    /// Room for the derivatives of the next step, which goes from one fraction of the period to another.
    pub(crate) fn next_part<'a>(
        &mut self,
        model: &Model,
        out: &'a mut Linearization,
        from: f64,
        to: f64,
    ) -> &'a mut Linearization {
        let Kind::Period { steps } = &mut out.kind else { return out };
        // Steps that are too many to be kept share a place.
        let at = if *steps < out.parts_max { *steps } else { 0 };
        *steps += 1;
        let theta = out.parameters();
        let (nd, nk, last) = (theta.nd, theta.nk, theta.next());
        for k in 0..nk {
            for (row, fraction) in [(nd + k, from), (2 * nd + nk + k, to)] {
                let row = &mut self.tangent[row * self.stride..][..self.stride];
                row.fill(0.0);
                row[nd + k] = 1.0 - fraction;
                row[last + k] = fraction;
            }
        }
        if out.parts.len() == at {
            let step = Linearization::new(model);
            out.parts.push(Part { step, tangent: Vec::new() });
        }
        let part = &mut out.parts[at];
        part.tangent.clone_from(&self.tangent);
        &mut part.step
    }

    /// Goes over the step whose derivatives stand in the last part.
    pub(crate) fn go_on(&mut self, out: &Linearization) {
        let Kind::Period { steps } = out.kind else { return };
        let Some(last) = steps.checked_sub(1) else { return };
        let step = &out.parts[if last < out.parts_max { last } else { 0 }].step;
        let (theta, stride) = (out.parameters(), self.stride);
        let (nd, nk, ni) = (theta.nd, theta.nk, theta.ni);
        let (n, inputs) = (theta.n(), theta.inputs());
        let Self { tangent, next, multipliers, terms, .. } = self;
        let mut follow = |target: &mut [f64], part: &[f64], i: usize, driven: usize| {
            let row = &part[i * step.stride..][..inputs + nk];
            terms.clear();
            terms.extend(row.iter().copied().zip(0..).filter(|(entry, _)| *entry != 0.0));
            add_rows(target, tangent, stride, terms);
            let target = &mut target[inputs..][..ni];
            if matches!(step.kind, Kind::Step) {
                for impulse in &step.ends.inputs {
                    target[impulse.input] += impulse.residual * row[n + impulse.coordinate];
                }
            } else {
                let driven = &step.driven[(driven + i) * ni..][..ni];
                target.iter_mut().zip(driven).for_each(|(t, entry)| *t += entry);
            }
        };
        next.fill(0.0);
        let nc = multipliers.len() / stride;
        for (c, row) in multipliers.chunks_exact_mut(stride).enumerate() {
            follow(row, &step.multipliers, c, nd);
        }
        for i in 0..nd {
            follow(&mut next[i * stride..][..stride], &step.increment, i, 0);
            follow(&mut next[(n + i) * stride..][..stride], &step.momentum, i, nd + nc);
        }
        if matches!(step.kind, Kind::Step) {
            for &InputImpulse { input, coordinate, residual, momentum } in &step.ends.inputs {
                next[(n + coordinate) * stride + inputs + input] += momentum - residual;
            }
        }
        for t in &step.ends.turnings {
            for column in 0..stride {
                let at = |i: usize| (t.coordinate + i) * stride + column;
                let [turn, start] = [&*next, &*tangent].map(|m| [0, 1, 2].map(|i| m[at(i)]));
                let end = t.to_end.apply(plantd_math::spatial::Vec3(turn))
                    + t.carried.apply(plantd_math::spatial::Vec3(start));
                for i in 0..3 {
                    // What is added below.
                    next[at(i)] = end[i] - start[i];
                }
            }
        }
        for (next, start) in next[..nd * stride].iter_mut().zip(&tangent[..]) {
            *next += start;
        }
        std::mem::swap(tangent, next);
    }

    /// Hands out the derivatives of the whole period, of length `h`.
    pub(crate) fn finish(&self, h: f64, out: &mut Linearization) {
        let (theta, stride) = (out.parameters(), self.stride);
        let (nd, ni, n, inputs) = (theta.nd, theta.ni, theta.n(), theta.inputs());
        out.ends.time_step_s = h;
        out.ends.turnings.clear();
        out.driven.clear();
        let row = |row: usize| &self.tangent[row * stride..][..stride];
        let increments = (0..nd).map(row);
        let momenta = (n..n + nd).map(row);
        let lambdas = self.multipliers.chunks_exact(stride);
        for row in increments.clone().chain(lambdas.clone()).chain(momenta.clone()) {
            out.driven.extend_from_slice(&row[inputs..][..ni]);
        }
        let width = out.stride.max(1);
        let put = |rows: &mut [f64], sources: &mut dyn Iterator<Item = &[f64]>| {
            let rows = rows.chunks_exact_mut(width).zip(sources);
            rows.for_each(|(target, source)| theta.drop_inputs(source, target));
        };
        put(&mut out.increment, &mut { increments });
        put(&mut out.multipliers, &mut { lambdas });
        put(&mut out.momentum, &mut { momenta });
        for i in 0..nd {
            out.increment[i * width + i] -= 1.0;
        }
    }
}
