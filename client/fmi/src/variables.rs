//! The variables of an FMU: what their value references stand for, with names and units.

use plantd_models::scene::CoordinateKind;
use plantd_models::{Model, parameters};

/// What a variable is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Kind {
    Time,
    /// Entry of `u`: inputs, then next positions of prescribed coordinates.
    Input(usize),
    /// Configuration, nd + nk.
    Position(usize),
    /// Velocity of all coordinates, from the momentum projected onto the constraints, nd + nk.
    Velocity(usize),
    Energy(EnergyKind),
    /// Discrete momentum, nd.
    Momentum(usize),
    /// Velocity of prescribed coordinates over the last step, nk.
    Rate(usize),
    /// Constraint multiplier over the time step, nc.
    Force(usize),
    /// Entry of `x = (q, p, v)` one time step ahead.
    Next(usize),
    /// Number of the scene.
    Parameter(usize),
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum EnergyKind {
    Total,
    Kinetic,
    Potential,
}

/// A variable; its value reference is its place in the list.
#[derive(Clone, Debug)]
pub(crate) struct Variable {
    pub(crate) name: String,
    pub(crate) kind: Kind,
    /// Name of a unit in [`UNITS`].
    pub(crate) unit: Option<&'static str>,
    /// Least and greatest value, of inputs: coordinates may leave their limits.
    pub(crate) limits: Option<[f64; 2]>,
    pub(crate) description: String,
}

/// A unit by the exponents of its base units.
pub(crate) struct Unit {
    pub(crate) name: &'static str,
    pub(crate) base: &'static [(&'static str, i32)],
}

pub(crate) const UNITS: &[Unit] = &[
    Unit { name: "s", base: &[("s", 1)] },
    Unit { name: "m", base: &[("m", 1)] },
    Unit { name: "rad", base: &[("rad", 1)] },
    Unit { name: "m/s", base: &[("m", 1), ("s", -1)] },
    Unit { name: "rad/s", base: &[("rad", 1), ("s", -1)] },
    Unit { name: "m/s2", base: &[("m", 1), ("s", -2)] },
    Unit { name: "kg", base: &[("kg", 1)] },
    Unit { name: "kg.m2", base: &[("kg", 1), ("m", 2)] },
    Unit { name: "N", base: &[("kg", 1), ("m", 1), ("s", -2)] },
    Unit { name: "N.m", base: &[("kg", 1), ("m", 2), ("s", -2)] },
    Unit { name: "N.s", base: &[("kg", 1), ("m", 1), ("s", -1)] },
    Unit { name: "N.m.s", base: &[("kg", 1), ("m", 2), ("s", -1)] },
    Unit { name: "J", base: &[("kg", 1), ("m", 2), ("s", -2)] },
    Unit { name: "Hz", base: &[("s", -1)] },
];

/// Every variable of a model; `numbers` are the paths of its parameters.
pub(crate) fn variables(model: &Model, numbers: &[(String, f64)]) -> Vec<Variable> {
    let mut list = vec![variable("time", Kind::Time, Some("s"), "Time")];
    push_inputs(model, &mut list);
    push_outputs(model, &mut list);
    push_state(model, &mut list);
    for (i, name) in model.constraint_names().iter().enumerate() {
        let text = format!("Multiplier of constraint equation {name} over the last time step");
        list.push(variable(&format!("force({name})"), Kind::Force(i), None, &text));
    }
    for (i, name) in state_names(model).into_iter().enumerate() {
        let text = format!("{name} one time step ahead, with the inputs of now");
        let unit = list.iter().find(|v| v.name == name).and_then(|v| v.unit);
        list.push(variable(&format!("next({name})"), Kind::Next(i), unit, &text));
    }
    for (i, (path, _)) in numbers.iter().enumerate() {
        list.push(variable(path, Kind::Parameter(i), unit_of(path), "Number of the scene"));
    }
    list
}

/// Numbers of the scene that are parameters of the FMU: those that move it, except for initial
/// configurations, which are start values, and the tables of signals.
pub(crate) fn tunable(model: &Model) -> Vec<(String, f64)> {
    let mut numbers = parameters::numbers(model.scene());
    numbers.retain(|(path, _)| {
        let is_table = path.starts_with("signals[")
            && [".times_s[", ".values[", ".knots["].iter().any(|table| path.contains(table));
        let informs = path.starts_with("operating_points[")
            || path.contains("].visuals[")
            || (path.starts_with("coordinates[") && path.ends_with("].initial"))
            || (path.starts_with("inputs[") && path.contains("].limits["));
        !is_table && !informs
    });
    numbers
}

fn variable(name: &str, kind: Kind, unit: Option<&'static str>, description: &str) -> Variable {
    let (name, description) = (name.to_owned(), description.to_owned());
    Variable { name, kind, unit, limits: None, description }
}

fn push_inputs(model: &Model, list: &mut Vec<Variable>) {
    for (i, input) in model.scene().inputs.iter().enumerate() {
        // The unit of a number that is scaled, or that several forces use, is the scene's own.
        let unit = match &input.coordinate {
            Some(name) if input.gain == 1.0 => {
                let is_angle = model
                    .coordinate_index(name)
                    .is_some_and(|index| model.coordinates()[index].is_angle);
                Some(if is_angle { "N.m" } else { "N" })
            }
            None if !input.points.is_empty() && input.gain == 1.0 => Some("N"),
            _ => None,
        };
        let text = format!("Input {}, held during a communication step", input.name);
        let limits = input.limits;
        let variable = variable(&format!("u({})", input.name), Kind::Input(i), unit, &text);
        list.push(Variable { limits, ..variable });
    }
    let (ni, prescribed) = (model.dimensions().inputs, prescribed(model));
    for (k, (name, is_angle)) in prescribed.into_iter().enumerate() {
        let text = format!("Position that {name} reaches in the next time step");
        let unit = Some(if is_angle { "rad" } else { "m" });
        list.push(variable(&format!("u({name})"), Kind::Input(ni + k), unit, &text));
    }
}

fn push_outputs(model: &Model, list: &mut Vec<Variable>) {
    for (i, c) in model.coordinates().iter().enumerate() {
        let unit = Some(if c.is_angle { "rad" } else { "m" });
        let text = format!("Coordinate {}", c.name);
        list.push(variable(&format!("q({})", c.name), Kind::Position(i), unit, &text));
    }
    for (i, c) in model.coordinates().iter().enumerate() {
        let unit = Some(if c.is_angle { "rad/s" } else { "m/s" });
        let text =
            format!("Velocity of {}, from the momentum projected onto the constraints", c.name);
        list.push(variable(&format!("velocity({})", c.name), Kind::Velocity(i), unit, &text));
    }
    for (name, kind, text) in [
        ("energy", EnergyKind::Total, "Kinetic and potential energy"),
        ("kinetic", EnergyKind::Kinetic, "Kinetic energy"),
        ("potential", EnergyKind::Potential, "Potential energy of gravity and springs"),
    ] {
        list.push(variable(name, Kind::Energy(kind), Some("J"), text));
    }
}

fn push_state(model: &Model, list: &mut Vec<Variable>) {
    let dynamic = model.coordinates().iter().filter(|c| c.kind == CoordinateKind::Dynamic);
    for (i, c) in dynamic.enumerate() {
        let unit = Some(if c.is_angle { "N.m.s" } else { "N.s" });
        let text = format!("Discrete momentum of {}", c.name);
        list.push(variable(&format!("p({})", c.name), Kind::Momentum(i), unit, &text));
    }
    for (k, (name, is_angle)) in prescribed(model).into_iter().enumerate() {
        let unit = Some(if is_angle { "rad/s" } else { "m/s" });
        let text = format!("Velocity of {name} over the last time step");
        list.push(variable(&format!("v({name})"), Kind::Rate(k), unit, &text));
    }
}

/// Names of the entries of `x = (q, p, v)`.
fn state_names(model: &Model) -> Vec<String> {
    let q = model.coordinates().iter().map(|c| format!("q({})", c.name));
    let dynamic = model.coordinates().iter().filter(|c| c.kind == CoordinateKind::Dynamic);
    let p = dynamic.map(|c| format!("p({})", c.name));
    let v = prescribed(model).into_iter().map(|(name, _)| format!("v({name})"));
    q.chain(p).chain(v).collect()
}

/// Prescribed coordinates, and whether they are angles.
fn prescribed(model: &Model) -> Vec<(&str, bool)> {
    let all = model.coordinates().iter().filter(|c| c.kind == CoordinateKind::Prescribed);
    all.map(|c| (c.name.as_str(), c.is_angle)).collect()
}

/// Unit of a number of the scene where the key alone tells it.
fn unit_of(path: &str) -> Option<&'static str> {
    let key = path.rsplit('.').next().unwrap_or(path);
    match key.split('[').next().unwrap_or(key) {
        "gravity" => Some("m/s2"),
        "mass" => Some("kg"),
        "inertia" => Some("kg.m2"),
        "translation" | "center_of_mass" | "at" | "length" | "rest_length" => Some("m"),
        "rpy" | "phase_rad" => Some("rad"),
        "frequency_hz" | "start_hz" | "end_hz" => Some("Hz"),
        "duration_s" | "settling_time_s" => Some("s"),
        _ => None,
    }
}
