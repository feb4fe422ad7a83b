//! The methods of higher order, and their coefficients.
//!
//! **Gauss collocation** with `s` stages has order `2s`; the midpoint rule is the one with `s = 1`. With
//! the nodes `c_i` and weights `b_i` of Gauss and Legendre on the unit interval, `x = 2c − 1`, and the
//! Legendre polynomials `P_k`,
//!
//! ```text
//! a_ij = μ_ij b_j        μ_ij = ½ + ½ Σ_k (P_k(x_i) P_{k−1}(x_j) − P_{k−1}(x_i) P_k(x_j)),  k = 1 … s − 1
//! ```
//!
//! of which the sum is skew to the last bit: `μ_ij + μ_ji = 1`, which is what makes the method symplectic.
//! Constraints hold at the nodes of Lobatto (see [`closures`](super::collocation::closures)), up to which the
//! velocities at the nodes of Gauss are integrated,
//!
//! ```text
//! κ_ji = (∫ ℓ_i) / b_i = ½ (1 + x̃_j) + ½ Σ_k P_k(x_i) (P_{k+1}(x̃_j) − P_{k−1}(x̃_j)),  k = 1 … s − 1
//! ```

use plantd_math::trigonometry::sin_cos_of;

/// Stages at most.
pub(crate) const STAGES_MAX: usize = 8;

/// How a substep is taken.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) enum Scheme {
    Midpoint,
    /// Gauss collocation with so many stages.
    Gauss(usize),
}

impl Scheme {
    /// The method that has an order.
    pub(crate) fn of_order(order: u32) -> Result<Self, &'static str> {
        match order {
            2 => Ok(Self::Midpoint),
            4 | 6 | 8 | 12 | 16 => Ok(Self::Gauss(order as usize / 2)),
            _ => Err("is none of 2, 4, 6, 8, 12 and 16"),
        }
    }
}

/// Coefficients of Gauss collocation.
#[derive(Clone, Debug)]
pub(crate) struct Tableau {
    pub(crate) nodes: Vec<f64>,
    pub(crate) weights: Vec<f64>,
    /// `μ_ij`, row-major.
    pub(crate) coupling: Vec<f64>,
    /// `σ_ij = μ_ij − ½`, skew, row-major.
    pub(crate) skew: Vec<f64>,
    /// The velocities of the next step from those of the last: the collocation polynomial one step on,
    /// column after column.
    pub(crate) onward: Vec<f64>,
    /// The nodes of Lobatto, `s + 1` with both ends, where constraints hold.
    pub(crate) ends: Vec<f64>,
    /// `κ_ji = (∫ ℓ_i) / b_i` from the start to the node `j` of Lobatto, row-major.
    pub(crate) reach: Vec<f64>,
    /// `κ_ji − ½`, the same way: from the middle of the step.
    pub(crate) reach_from_middle: Vec<f64>,
    /// What a node has of the constraint impulses of a step where forces are constant: that of the start has what
    /// the end of the step before has, too.
    pub(crate) shares: Vec<f64>,
}

/// `P_0(x) … P_s(x)`.
fn legendre(x: f64) -> [f64; STAGES_MAX + 1] {
    let mut p = [1.0; STAGES_MAX + 1];
    p[1] = x;
    for k in 1..STAGES_MAX {
        let order = k as f64;
        p[k + 1] = ((2.0 * order + 1.0) * x * p[k] - order * p[k - 1]) / (order + 1.0);
    }
    p
}

/// The nodes of Lobatto from −1 to 1: the ends, and between them the roots of `P_s'`.
fn lobatto(stages: usize) -> Vec<f64> {
    let count = stages as f64;
    let root = |i: usize| {
        let mut x = -sin_cos_of(std::f64::consts::PI * i as f64 / count).1;
        for _ in 0..10 {
            let p = legendre(x);
            let rest = 1.0 - x * x;
            let slope = count * (p[stages - 1] - x * p[stages]) / rest;
            x -= slope * rest / (2.0 * x * slope - count * (count + 1.0) * p[stages]);
        }
        x
    };
    let mut nodes: Vec<f64> = (0..=stages)
        .map(|i| match i {
            0 => -1.0,
            i if i == stages => 1.0,
            i => root(i),
        })
        .collect();
    for i in 1..stages {
        nodes[i] = 0.5 * (nodes[i] - nodes[stages - i]);
        nodes[stages - i] = -nodes[i];
    }
    nodes
}

impl Tableau {
    pub(crate) fn new(stages: usize) -> Self {
        let count = stages as f64;
        // Roots of P_s, by Newton's method from a classical guess; P_s' = s (x P_s − P_{s−1}) / (x² − 1).
        let slope = |x: f64, p: &[f64]| count * (x * p[stages] - p[stages - 1]) / (x * x - 1.0);
        let root = |i: usize| {
            let mut x = sin_cos_of(std::f64::consts::PI * (i as f64 + 0.75) / (count + 0.5)).1;
            for _ in 0..10 {
                let p = legendre(x);
                x -= p[stages] / slope(x, &p);
            }
            x
        };
        let mut roots: Vec<f64> = (0..stages).rev().map(root).collect();
        for i in 0..stages {
            roots[i] = 0.5 * (roots[i] - roots[stages - 1 - i]);
            roots[stages - 1 - i] = -roots[i];
        }
        let nodes: Vec<f64> = roots.iter().map(|x| 0.5 + 0.5 * x).collect();
        let weight = |x: &f64| 1.0 / ((1.0 - x * x) * slope(*x, &legendre(*x)).powi(2));
        let weights: Vec<f64> = roots.iter().map(weight).collect();
        let mut coupling = Vec::with_capacity(stages * stages);
        let mut onward = Vec::with_capacity(stages * stages);
        for (i, x) in roots.iter().enumerate() {
            for (j, y) in roots.iter().enumerate() {
                let (p, q) = (legendre(*x), legendre(*y));
                let skew = |k: usize| p[k] * q[k - 1] - p[k - 1] * q[k];
                let skew: f64 = (1..stages).map(skew).sum();
                // Two that add up to 1 exactly: the larger is rounded, the smaller what is left.
                let larger = 0.5 + 0.5 * skew.abs();
                coupling.push(if skew < 0.0 { 1.0 - larger } else { larger });
                let others = nodes.iter().enumerate().filter(|(k, _)| *k != i);
                let factors = others.map(|(_, c)| (1.0 + nodes[j] - c) / (nodes[i] - c));
                onward.push(factors.product());
            }
        }
        // No digit is lost: what rounds is `μ`.
        let skew = coupling.iter().map(|mu| mu - 0.5).collect();
        let ends = lobatto(stages);
        let mut reach = Vec::with_capacity(ends.len() * stages);
        for (x, y) in ends.iter().flat_map(|x| roots.iter().map(move |y| (x, y))) {
            let (p, q) = (legendre(*x), legendre(*y));
            let rest: f64 = (1..stages).map(|k| q[k] * (p[k + 1] - p[k - 1])).sum();
            reach.push(0.5 * ((1.0 + x) + rest));
        }
        let share = |(j, x): (usize, &f64)| {
            let weight = 1.0 / (count * (count + 1.0) * legendre(*x)[stages].powi(2));
            if j == 0 { 2.0 * weight } else { weight }
        };
        let reach_from_middle = reach.iter().map(|kappa| kappa - 0.5).collect();
        let shares = ends[..stages].iter().enumerate().map(share).collect();
        let ends = ends.iter().map(|x| 0.5 + 0.5 * x).collect();
        Self { nodes, weights, coupling, skew, onward, ends, reach, reach_from_middle, shares }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The simplifying assumptions B(2s) and C(s), and symplecticity, which define the method.
    #[test]
    fn the_tableaus_are_those_of_gauss() {
        for stages in [1, 2, 3, 4, 6, 8] {
            let Tableau { nodes, weights, coupling, skew, .. } = Tableau::new(stages);
            for k in 1..=2 * stages as i32 {
                let sum: f64 = weights.iter().zip(&nodes).map(|(b, c)| b * c.powi(k - 1)).sum();
                assert!((sum - 1.0 / f64::from(k)).abs() < 2e-15, "B({k}), {stages} stages");
            }
            for (i, c) in nodes.iter().enumerate() {
                let row = coupling[i * stages..][..stages].iter().zip(&weights).map(|(m, b)| m * b);
                for k in 1..=stages as i32 {
                    let sum: f64 = row.clone().zip(&nodes).map(|(a, c)| a * c.powi(k - 1)).sum();
                    assert!((sum - c.powi(k) / f64::from(k)).abs() < 2e-15, "C({k})");
                }
                for j in 0..stages {
                    let sum = coupling[i * stages + j] + coupling[j * stages + i];
                    assert_eq!(sum, 1.0, "symplectic to the last bit");
                    let sum = skew[i * stages + j] + skew[j * stages + i];
                    assert_eq!(sum, 0.0, "symmetric to the last bit");
                }
            }
        }
    }

    /// Lobatto's quadrature, polynomials of degree s, and the ends.
    #[test]
    fn the_nodes_of_constraints_are_those_of_lobatto() {
        for stages in [1, 2, 3, 4, 6, 8] {
            let Tableau { nodes, weights, ends, reach, shares, .. } = Tableau::new(stages);
            let mut lobatto = shares.clone();
            lobatto[0] *= 0.5;
            lobatto.push(lobatto[0]);
            for k in 1..=2 * stages as i32 {
                let sum: f64 = lobatto.iter().zip(&ends).map(|(b, c)| b * c.powi(k - 1)).sum();
                assert!((sum - 1.0 / f64::from(k)).abs() < 2e-15, "B({k}), {stages} stages");
            }
            for (c, row) in ends.iter().zip(reach.chunks_exact(stages)) {
                for k in 1..=stages as i32 {
                    let entries = row.iter().zip(&weights).zip(&nodes);
                    let sum: f64 = entries.map(|((m, b), c)| m * b * c.powi(k - 1)).sum();
                    assert!((sum - c.powi(k) / f64::from(k)).abs() < 2e-15, "C({k})");
                }
            }
            assert_eq!(reach[..stages], vec![0.0; stages], "where a step begins");
            assert_eq!(reach[stages * stages..], vec![1.0; stages], "where it ends");
            for (j, i) in (0..=stages).flat_map(|j| (0..stages).map(move |i| (j, i))) {
                let back = reach[(stages - j) * stages + stages - 1 - i];
                assert!((reach[j * stages + i] + back - 1.0).abs() < 1e-15, "there and back");
            }
        }
    }

    /// A polynomial of degree s − 1 is continued exactly.
    #[test]
    fn the_polynomial_goes_on() {
        let tableau = Tableau::new(4);
        let motion = |t: f64| 1.0 - t + 0.5 * t * t - 2.0 * t * t * t;
        for (i, c) in tableau.nodes.iter().enumerate() {
            let row = tableau.onward.iter().skip(i).step_by(4);
            let next: f64 = row.zip(&tableau.nodes).map(|(e, c)| e * motion(*c)).sum();
            assert!((next - motion(1.0 + c)).abs() < 1e-12, "{next}");
        }
    }
}
