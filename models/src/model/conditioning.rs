//! What pivots are measured against, and which equations are independent.

/// References for pivots, and the independent equations.
#[derive(Clone, Debug, Default)]
pub(crate) struct Conditioning {
    /// Largest inertia of each dynamic coordinate, kg or kg·m²; zero where it moves none.
    pub(crate) inertia: Vec<f64>,
    /// One over the largest gradient of each equation in the metric of `inertia`; zero where no
    /// dynamic coordinate moves it.
    pub(crate) weight: Vec<f64>,
    /// Equations that are independent at the scene's initial configuration or near it, in their order.
    pub(crate) independent: Vec<usize>,
    /// The configuration where they are.
    pub(crate) regular: Vec<f64>,
}

impl Conditioning {
    /// Inertia of a coordinate; the largest one stands in where it moves none.
    pub(crate) fn inertia_of(&self, j: usize) -> f64 {
        let own = self.inertia[j];
        if own > 0.0 {
            return own;
        }
        let largest = self.inertia.iter().fold(0.0_f64, |a, b| a.max(*b));
        if largest > 0.0 { largest } else { 1.0 }
    }
}
