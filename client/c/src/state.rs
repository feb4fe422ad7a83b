//! What C sees of a plant.

use plantd_client::link::{LinkDriver, StateView};

/// Sizes of a plant, `struct plantd_dimensions`.
#[repr(C)]
pub struct Dimensions {
    dynamic: usize,
    prescribed: usize,
    inputs: usize,
    constraints: usize,
    input_len: usize,
    time_step_s: f64,
    model_digest: u64,
}

impl Dimensions {
    pub(crate) fn of(driver: &LinkDriver) -> Self {
        let d = driver.dimensions();
        Self {
            dynamic: d.dynamic,
            prescribed: d.prescribed,
            inputs: d.inputs,
            constraints: d.constraints,
            input_len: d.inputs + d.prescribed,
            time_step_s: driver.time_step_s(),
            model_digest: driver.model_digest(),
        }
    }
}

/// Numbers within the link, `struct plantd_numbers`.
#[repr(C)]
pub(crate) struct Numbers {
    data: *const f64,
    len: usize,
}

impl From<&[f64]> for Numbers {
    fn from(numbers: &[f64]) -> Self {
        Self { data: numbers.as_ptr(), len: numbers.len() }
    }
}

/// A state, `struct plantd_state`.
#[repr(C)]
pub struct State {
    step: u64,
    time_s: f64,
    q: Numbers,
    p: Numbers,
    v: Numbers,
    velocity: Numbers,
    multipliers: Numbers,
    x: Numbers,
    outputs: Numbers,
    lost: Numbers,
    residual: f64,
    constraint_residual: f64,
    reciprocal_condition: f64,
    constraint_reciprocal_condition: f64,
    iterations: u32,
    factorizations: u32,
    redundant_constraints: u32,
    steps: u32,
    halvings: u32,
}

impl State {
    /// Writes a state, if it is wanted.
    ///
    /// # Safety
    ///
    /// The pointer is null or points to memory for a state.
    pub(crate) unsafe fn write(view: &StateView<'_>, state: *mut Self) {
        if state.is_null() {
            return;
        }
        let seen = Self {
            step: view.step,
            time_s: view.time_s,
            q: view.q.into(),
            p: view.p.into(),
            v: view.v.into(),
            velocity: view.velocity.into(),
            multipliers: view.multipliers.into(),
            x: view.x.into(),
            outputs: view.outputs.into(),
            lost: view.lost.into(),
            residual: view.residual,
            constraint_residual: view.constraint_residual,
            reciprocal_condition: view.reciprocal_condition,
            constraint_reciprocal_condition: view.constraint_reciprocal_condition,
            iterations: view.iterations,
            factorizations: view.factorizations,
            redundant_constraints: view.redundant_constraints,
            steps: view.steps,
            halvings: view.halvings,
        };
        // SAFETY: the pointer is not null, and the caller vouches for the memory.
        unsafe { state.write(seen) };
    }
}
