//! Poles of the linearized map of a plant.

use nalgebra::DMatrix;
use plantd_control::{self as control, Mode};
use plantd_models::{Linearization, Plant};
use plantd_proto::v1;

use crate::core::feedback::regulator::Constraints;
use crate::core::feedback::space::Space;
use crate::wire::status::RpcError;

/// Poles of the linearized map at a plant's state: of A, as the modes of Analyze on the constraints, and with a
/// gain of `A − B K` in the directions in which the plant can be moved.
pub(crate) fn poles(
    plant: &mut Plant,
    linearization: &Linearization,
    gain: Option<&DMatrix<f64>>,
) -> Result<v1::Poles, RpcError> {
    let (a, time_step_s) = (linearization.a(), plant.settings().time_step_s);
    let space = Space::new(plant, Constraints::Manifold);
    let of = |map: &DMatrix<f64>| -> Result<Vec<v1::Complex>, RpcError> {
        let modes = control::modes(map, time_step_s)?.into_iter();
        Ok(modes.map(|Mode { real, imaginary, .. }| v1::Complex { real, imaginary }).collect())
    };
    let closed_loop = match gain {
        Some(gain) => of(&space.moving_map(&(&a - linearization.b() * gain)))?,
        None => Vec::new(),
    };
    Ok(v1::Poles { open_loop: of(&space.free(&a))?, closed_loop })
}
