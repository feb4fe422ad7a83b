//! Forces that do not come from a potential: inputs and damping of coordinates, `f = B u − C v`.

/// Writes the input forces of a step; they do not change within it.
#[inline(never)]
pub(crate) fn input_forces(inputs: &[(usize, f64)], u: &[f64], force: &mut [f64]) {
    force.fill(0.0);
    for ((coordinate, gain), value) in inputs.iter().zip(u) {
        force[*coordinate] += gain * value;
    }
}

/// Writes `total = input − C v`.
#[inline(never)]
pub(crate) fn add_damping(damping: &[f64], velocity: &[f64], input: &[f64], total: &mut [f64]) {
    for (((total, input), c), v) in total.iter_mut().zip(input).zip(damping).zip(velocity) {
        *total = input - c * v;
    }
}
