//! Products with what closes the derivatives of a tree: multipliers of constraints, and forces of ties.
//!
//! Each pushes against the tree as a momentum does, by a row of `R`, and follows from an equation:
//!
//! ```text
//! x' = X θ' − X_p Rᵀ μ      p[k+1]' = P θ' − (P_p Rᵀ + Vᵀ) μ      C x' + C_θ θ' + E μ = 0
//!
//! D = E − C X_p Rᵀ          D μ = −(C X + C_θ) θ'
//!
//! multipliers               R = A0     V = 0              C = A1     E = 0
//! forces of ties, opposed   R          V = 2 ∂y/∂q − R    C = G      E = 1
//! of armatures, opposed     R          V = −R             C = G      E = 1
//! ```
//!
//! `X` and `P` are the derivatives without them, of which no more is needed than products.

use plantd_math::pivoted_lu::PivotedLu;
use plantd_math::rows::dot;

/// Some equations, with what they push.
#[derive(Debug)]
pub(crate) struct Closing {
    nd: usize,
    /// `C` and `C_θ`, a row for each equation.
    by_increment: Vec<f64>,
    by_parameters: Vec<f64>,
    /// `−R X_pᵀ` and `−(R P_pᵀ + V)`, a row for each equation.
    increments: Vec<f64>,
    momenta: Vec<f64>,
    /// `D`, factored.
    lu: PivotedLu,
    /// `−μ`, or what weighs the equations.
    values: Vec<f64>,
}

/// An equation, with what it pushes.
pub(crate) struct Equation<'a> {
    pub(crate) by_increment: &'a mut [f64],
    pub(crate) by_parameters: &'a mut [f64],
    pub(crate) increment: &'a mut [f64],
    pub(crate) momentum: &'a mut [f64],
}

impl Closing {
    /// Room for so many equations of a tree with so many dynamic coordinates and parameters, with room for `D`.
    pub(crate) fn new(nd: usize, parameters: usize, lu: PivotedLu, equations: usize) -> Self {
        let zeros = |width: usize| vec![0.0; equations * width];
        Self {
            nd,
            by_increment: zeros(nd),
            by_parameters: zeros(parameters),
            increments: zeros(nd),
            momenta: zeros(nd),
            lu,
            values: zeros(1),
        }
    }

    /// Its equations, to be written.
    pub(crate) fn equations(&mut self) -> impl Iterator<Item = Equation<'_>> {
        let parameters = self.by_parameters.len() / self.values.len().max(1);
        let by_increment = self.by_increment.chunks_exact_mut(self.nd);
        let by_parameters = self.by_parameters.chunks_exact_mut(parameters);
        let increments = self.increments.chunks_exact_mut(self.nd);
        let momenta = self.momenta.chunks_exact_mut(self.nd);
        by_increment.zip(by_parameters).zip(increments.zip(momenta)).map(
            |((by_increment, by_parameters), (increment, momentum))| Equation {
                by_increment,
                by_parameters,
                increment,
                momentum,
            },
        )
    }

    /// Takes what belongs to pushes of its equations, one after the other, with what finds the increment and the momentum
    /// at the end, in the place of a push.
    pub(crate) fn take_responses(
        &mut self,
        mut respond: impl FnMut(&mut [f64], &mut [f64]),
    ) -> impl FnMut(&mut [f64]) {
        let mut equations = self.equations();
        move |push| {
            if let Some(Equation { increment, momentum, .. }) = equations.next() {
                respond(push, momentum);
                increment.copy_from_slice(push);
            }
        }
    }

    /// Takes `D`, as it was factored.
    pub(crate) fn take_factors_of(&mut self, lu: &PivotedLu) {
        self.lu.take_factors_of(lu);
    }

    /// From the products `X θ'` and `P θ'`, makes those with the equations.
    pub(crate) fn close(&mut self, by: &[f64], x: &mut [f64], momentum: &mut [f64]) {
        let Self { nd, by_increment, by_parameters, increments, momenta, lu, values } = self;
        let rows = by_increment.chunks_exact(*nd).zip(by_parameters.chunks_exact(by.len()));
        for (value, (by_increment, by_parameters)) in values.iter_mut().zip(rows) {
            *value = dot(by_increment, x) + dot(by_parameters, by);
        }
        lu.solve(values);
        subtract_rows(values, increments, x);
        subtract_rows(values, momenta, momentum);
    }

    /// From what increments weigh, and the momenta at the end, makes what increments without the equations weigh.
    pub(crate) fn weigh(&mut self, x: &mut [f64], momentum: &[f64]) {
        let Self { nd, by_increment, increments, momenta, lu, values, .. } = self;
        let rows = increments.chunks_exact(*nd).zip(momenta.chunks_exact(*nd));
        for (value, (by_x, by_momentum)) in values.iter_mut().zip(rows) {
            *value = dot(by_x, x) + dot(by_momentum, momentum);
        }
        lu.solve_transposed(values);
        subtract_rows(values, by_increment, x);
    }

    /// Adds what the parameters get by the equations, as they were weighed last.
    pub(crate) fn add_weighed(&self, by: &mut [f64]) {
        subtract_rows(&self.values, &self.by_parameters, by);
    }
}

/// `out −= Σ value · row`.
fn subtract_rows(values: &[f64], rows: &[f64], out: &mut [f64]) {
    for (value, row) in values.iter().zip(rows.chunks_exact(out.len())) {
        out.iter_mut().zip(row).for_each(|(out, entry)| *out -= value * entry);
    }
}
