//! Models as text.

use std::fmt::Write as _;

use plantd_client::v1;

use crate::contract::names;
use crate::output::page::{Cell, Page, Table, table};
use crate::output::text::number;

/// A model of the server.
pub(crate) fn known(model: &v1::Model) -> Page {
    described(model, if model.builtin { "built in" } else { "uploaded" })
}

/// The model of a scene that was only looked at.
pub(crate) fn validated(model: &v1::Model) -> Page {
    described(model, "valid, not uploaded")
}

fn described(model: &v1::Model, origin: &str) -> Page {
    let mut text = Page::from(format!("{}: {}\n", model.name, model.description));
    let _ = writeln!(text, "{origin}, time step {} s", number(model.time_step_s));
    let has_limits = model.coordinates.iter().any(|c| c.limits.is_some());
    let columns = if has_limits { 5 } else { 4 };
    let row = |c| coordinate(c).into_iter().take(columns).collect();
    let rows: Vec<Vec<Cell>> = model.coordinates.iter().map(row).collect();
    let titles = ["coordinate", "kind", "unit", "initial", "limits"];
    text.next_table(table(&titles[..columns], rows));
    let inputs = (0..).zip(&model.inputs).map(|(index, name)| {
        let own = model.input_limits.iter().find(|own| own.u_index == index);
        own.map_or_else(|| name.clone(), |own| format!("{name} ({})", limits(own.limits.as_ref())))
    });
    for (title, names) in [
        ("inputs", &inputs.collect()),
        ("constraints", &model.constraints),
        ("operating points", &model.operating_points),
    ] {
        let names = if names.is_empty() { "none".to_owned() } else { names.join(", ") };
        let _ = writeln!(text, "\n{title}: {names}");
    }
    if !model.signals.is_empty() {
        let row = |s: &v1::Signal| {
            let effect = if s.replaces { "replaces u" } else { "added to u" };
            vec![s.drives.clone(), s.kind.clone(), format!("{effect}[{}]", s.u_index)]
        };
        let rows = model.signals.iter().map(row);
        text.next_table(table(&["signal drives", "kind", "effect"], rows));
    }
    let _ = text.write_str(&guess(&model.initial_violations));
    text
}

/// Warns of an initial configuration that is only a guess; the first few of many violations.
fn guess(violations: &[v1::ConstraintViolation]) -> String {
    const SHOWN: usize = 8;
    if violations.is_empty() {
        return String::new();
    }
    let by = |v: &v1::ConstraintViolation| format!("{} by {:.3e}", v.constraint, v.value);
    let mut shown: Vec<_> = violations.iter().take(SHOWN).map(by).collect();
    if violations.len() > SHOWN {
        shown.push(format!("{} more", violations.len() - SHOWN));
    }
    format!(
        "\nwarning: the initial configuration is only a guess, which violates {}; no plant starts there: `plantctl settle` finds one that satisfies the constraints\n",
        shown.join(", ")
    )
}

fn coordinate(c: &v1::Coordinate) -> Vec<Cell> {
    let kind = if c.prescribed { "prescribed" } else { "dynamic" };
    let unit = names::unit(c);
    let unit = match c.rotation_group.as_str() {
        "" => unit.to_owned(),
        joint => format!("{unit}, rotation vector of {joint}"),
    };
    let name = c.name.as_str();
    vec![name.into(), kind.into(), unit.into(), c.initial.into(), limits(c.limits.as_ref()).into()]
}

fn limits(limits: Option<&v1::Limits>) -> String {
    limits.map_or_else(String::new, |l| format!("{} to {}", number(l.low), number(l.high)))
}

/// Models, one per row.
pub(crate) fn list(models: &[v1::Model]) -> Table {
    let row = |m: &v1::Model| {
        let prescribed = m.coordinates.iter().filter(|c| c.prescribed).count();
        vec![
            m.name.clone(),
            (m.coordinates.len() - prescribed).to_string(),
            prescribed.to_string(),
            m.inputs.len().to_string(),
            m.constraints.len().to_string(),
            m.description.clone(),
        ]
    };
    let head = ["model", "dynamic", "prescribed", "inputs", "constraints", "description"];
    table(&head, models.iter().map(row))
}
