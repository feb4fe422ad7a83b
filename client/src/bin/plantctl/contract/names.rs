//! Names of the entries of a model's vectors, in the contract's order.

use plantd_client::v1;

/// Names of all coordinates.
pub(crate) fn coordinates(model: &v1::Model) -> Vec<&str> {
    model.coordinates.iter().map(|c| c.name.as_str()).collect()
}

/// Names of the prescribed coordinates.
pub(crate) fn prescribed(model: &v1::Model) -> impl Iterator<Item = &String> {
    model.coordinates.iter().filter(|c| c.prescribed).map(|c| &c.name)
}

/// Names of the dynamic coordinates.
pub(crate) fn dynamic(model: &v1::Model) -> impl Iterator<Item = &String> {
    model.coordinates.iter().filter(|c| !c.prescribed).map(|c| &c.name)
}

/// Names of the entries of `x = (q, p, v)`.
pub(crate) fn state(model: &v1::Model) -> Vec<String> {
    let q = model.coordinates.iter().map(|c| c.name.clone());
    let p = dynamic(model).map(|name| format!("p({name})"));
    q.chain(p).chain(prescribed(model).map(|name| format!("v({name})"))).collect()
}

/// Names of the entries of `u`.
pub(crate) fn input(model: &v1::Model) -> Vec<String> {
    model.inputs.iter().chain(prescribed(model)).cloned().collect()
}

/// Unit of a coordinate.
pub(crate) fn unit(coordinate: &v1::Coordinate) -> &'static str {
    match coordinate.unit() {
        v1::Unit::Metre => "m",
        v1::Unit::Radian => "rad",
        v1::Unit::Unspecified => "",
    }
}

/// Unit of its momentum.
pub(crate) fn momentum_unit(coordinate: &v1::Coordinate) -> &'static str {
    match coordinate.unit() {
        v1::Unit::Metre => "N s",
        v1::Unit::Radian => "N m s",
        v1::Unit::Unspecified => "",
    }
}

/// Names of the velocities of all coordinates.
pub(crate) fn velocity(model: &v1::Model) -> impl Iterator<Item = String> {
    model.coordinates.iter().map(|c| format!("velocity({})", c.name))
}

/// Names of the numbers of a recorded state: of the entries of `x`, then of the constraint impulses.
pub(crate) fn recorded(model: &v1::Model) -> Vec<String> {
    let impulses = model.constraints.iter().map(|name| format!("impulse({name})"));
    state(model).into_iter().chain(impulses).collect()
}

/// The numbers of a recorded state, in the order of their names.
pub(crate) fn recorded_numbers(state: &v1::State) -> Vec<f64> {
    [&state.q[..], &state.p, &state.v, &state.multipliers].concat()
}
