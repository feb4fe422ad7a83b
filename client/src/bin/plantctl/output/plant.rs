//! Plants as text: their settings, states and what acts on them.

use std::fmt::Write as _;

use plantd_client::v1;

use crate::contract::names;
use crate::output::page::{Cell, Page, Table, table};
use crate::output::text::{number, numbers};

/// Plants, one per row.
pub(crate) fn list(plants: &[v1::PlantInfo]) -> Table {
    let row = |p: &v1::PlantInfo| {
        let state = p.state.as_ref();
        let dt = p.settings.as_ref().map_or(0.0, |s| s.time_step_s);
        let driver = if p.driver.is_empty() { "-" } else { &p.driver };
        let link = if p.link_open { "open" } else { "-" };
        vec![
            Cell::from(p.id.as_str()),
            p.model.as_str().into(),
            dt.into(),
            state.map_or(0, |s| s.step).into(),
            state.map_or(0.0, |s| s.time_s).into(),
            driver.into(),
            link.into(),
        ]
    };
    let head = ["plant", "model", "dt/s", "step", "time/s", "driver", "link"];
    table(&head, plants.iter().map(row))
}

/// By which method a plant is stepped.
pub(crate) fn stepping(plant: &v1::PlantInfo) -> String {
    let settings = plant.settings.unwrap_or_default();
    let precision = match settings.precision() {
        v1::Precision::Unspecified | v1::Precision::Exact => "exact",
        v1::Precision::Fast => "fast",
        v1::Precision::Coarse => "coarse",
    };
    let (order, substeps, halvings) = (settings.order, settings.substeps, settings.halvings());
    let accuracy = plant.accuracy.as_ref().map_or(String::new(), |accuracy| {
        format!("; off by {} over {} steps", number(accuracy.error), accuracy.periods)
    });
    format!(
        "  order {order}, substeps {substeps}, halvings {halvings} at most, {precision}{accuracy}\n"
    )
}

/// A state, with the names and units of its model; vectors that the model does not have are left out.
pub(crate) fn state(state: &v1::State, model: &v1::Model) -> Page {
    let mut page = Page::from(format!("step {}, time {} s\n", state.step, number(state.time_s)));
    let all = || model.coordinates.iter();
    let dynamic = || all().filter(|c| !c.prescribed);
    let with = |c: &v1::Coordinate, unit: &str| (c.name.clone(), unit.to_owned());
    let per_second = |c| with(c, &format!("{}/s", names::unit(c)));
    let impulses = model.constraints.iter().map(|name| (name.clone(), String::new()));
    for (what, values, names) in [
        ("q", &state.q, all().map(|c| with(c, names::unit(c))).collect::<Vec<_>>()),
        ("velocity", &state.velocity, all().map(per_second).collect()),
        ("p", &state.p, dynamic().map(|c| with(c, names::momentum_unit(c))).collect()),
        ("impulses", &state.multipliers, impulses.collect()),
    ] {
        if !values.is_empty() {
            let _ = writeln!(page, "  {what}: {}", named(&names, values));
        }
    }
    page.data(row(state, model));
    page
}

/// Numbers with their names and units; without where the names are those of something else.
fn named(names: &[(String, String)], values: &[f64]) -> String {
    if names.len() != values.len() {
        return numbers(values);
    }
    let one = |((name, unit), value): (&(String, String), &f64)| {
        format!("{name} = {} {unit}", number(*value)).trim_end().to_owned()
    };
    names.iter().zip(values).map(one).collect::<Vec<_>>().join(", ")
}

/// Numbers with their names; without where the names are those of something else.
pub(crate) fn listed(names: &[String], values: &[f64]) -> String {
    let names: Vec<_> = names.iter().map(|name| (name.clone(), String::new())).collect();
    named(&names, values)
}

/// A state as a row under the names that recordings have for its numbers.
fn row(state: &v1::State, model: &v1::Model) -> Table {
    let (x, velocity) = (names::recorded(model), names::velocity(model));
    let head: Vec<String> = ["step", "time_s"]
        .map(str::to_owned)
        .into_iter()
        .chain(x.clone())
        .chain(velocity)
        .collect();
    let head: Vec<&str> = head.iter().map(String::as_str).collect();
    // Before the first step there are no impulses.
    let nothing = || std::iter::repeat(Cell::from("-"));
    let filled =
        |values: Vec<f64>, count| values.into_iter().map(Cell::from).chain(nothing()).take(count);
    let start = [Cell::from(state.step), state.time_s.into()].into_iter();
    let numbers = filled(names::recorded_numbers(state), x.len());
    let velocity = filled(state.velocity.clone(), model.coordinates.len());
    table(&head, [start.chain(numbers).chain(velocity).collect()])
}

/// An energy.
pub(crate) fn energy(energy: &v1::Energy) -> String {
    let (kinetic, potential) = (energy.kinetic_j, energy.potential_j);
    format!(
        "  energy: {} J kinetic, {} J potential, {} J in all\n",
        number(kinetic),
        number(potential),
        number(kinetic + potential)
    )
}

/// A step report.
pub(crate) fn report(report: &v1::StepReport) -> String {
    let redundant = match report.redundant_constraints {
        0 => String::new(),
        count => format!(", {count} redundant constraints"),
    };
    let steps = match (report.steps, report.halvings) {
        (0 | 1, _) => String::new(),
        (steps, 0) => format!(" in {steps} steps"),
        (steps, halvings) => format!(" in {steps} steps, halved {halvings} times"),
    };
    format!(
        "  solver: {} iterations, {} factorizations{steps}, residual {} round-offs{redundant}\n",
        report.iterations,
        report.factorizations,
        number(report.residual)
    )
}

/// What a watcher sees of the outputs.
pub(crate) fn outputs(outputs: &v1::Outputs) -> String {
    let mut text = format!("  y: {}\n", numbers(&outputs.y));
    if !outputs.lost.is_empty() {
        let _ = writeln!(text, "  lost: {:?}", outputs.lost);
    }
    text
}

/// Numbers of the scene that were changed for a plant; nothing if none were.
pub(crate) fn parameters(plant: &v1::PlantInfo) -> String {
    let line = |p: &v1::Parameter| format!("  {} = {}\n", p.path, number(p.value));
    plant.parameters.iter().map(line).collect()
}

/// What a feedback is and does.
pub(crate) fn feedback(feedback: &v1::FeedbackInfo) -> String {
    let about = match feedback.horizon {
        0 => "about an operating point".to_owned(),
        steps => format!("along {steps} steps from step {} on", feedback.first_step),
    };
    let mode = match feedback.mode() {
        v1::FeedbackMode::Unspecified | v1::FeedbackMode::WatchOnly => "watch only",
        v1::FeedbackMode::Replace => "replaces the driver's input",
        v1::FeedbackMode::Add => "adds to the driver's input",
        v1::FeedbackMode::Guard => "guards",
    };
    let mut text = format!("feedback {about}, revision {}: {mode}\n", feedback.revision);
    if let Some(step) = feedback.tripped_at_step {
        let _ = writeln!(text, "  took over at step {step} because of {}", feedback.tripped_by);
    }
    if let Some(failure) = &feedback.failure {
        let _ = writeln!(text, "  {}: {}", failure.reason, failure.message);
    }
    text
}

/// Constraint forces, one per row.
pub(crate) fn forces(forces: &[f64], model: &v1::Model) -> Table {
    let row = |(name, force): (&String, &f64)| vec![Cell::from(name.as_str()), (*force).into()];
    table(&["constraint", "force"], model.constraints.iter().zip(forces).map(row))
}
