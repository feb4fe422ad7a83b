//! `modelDescription.xml`.

use std::fmt::Write as _;

use crate::blueprint::Blueprint;
use crate::variables::{Kind, UNITS, Variable};

/// Names of the categories of messages.
pub(crate) const LOG_CATEGORIES: &[(&str, &str)] = &[
    ("logStatusError", "Calls that were refused"),
    ("logStatusDiscard", "Steps that cannot be taken"),
    ("logStatusFatal", "Instances that are of no use any more"),
];

/// The description of an FMU.
pub(crate) fn description(blueprint: &Blueprint) -> String {
    let scene = blueprint.model.scene();
    let h = blueprint.settings.time_step_s;
    let mut xml = String::from("<?xml version=\"1.0\" encoding=\"UTF-8\"?>\n");
    let mut line = |text: String| {
        xml.push_str(&text);
        xml.push('\n');
    };
    line(format!(
        "<fmiModelDescription fmiVersion=\"3.0\" modelName=\"{}\" instantiationToken=\"{}\"{} \
         generationTool=\"plantd {}\" variableNamingConvention=\"flat\">",
        escaped(&scene.name),
        escaped(&blueprint.token),
        attribute("description", &scene.description),
        env!("CARGO_PKG_VERSION"),
    ));
    line(format!(
        "  <CoSimulation modelIdentifier=\"{}\" canHandleVariableCommunicationStepSize=\"false\" \
         fixedInternalStepSize=\"{h:?}\" canGetAndSetFMUState=\"true\" canSerializeFMUState=\"true\" \
         providesDirectionalDerivatives=\"true\" providesAdjointDerivatives=\"true\"/>",
        blueprint.identifier(),
    ));
    line("  <UnitDefinitions>".to_owned());
    for unit in UNITS {
        let base = unit.base.iter().fold(String::new(), |mut text, (name, exponent)| {
            let _ = write!(text, " {name}=\"{exponent}\"");
            text
        });
        line(format!("    <Unit name=\"{}\"><BaseUnit{base}/></Unit>", unit.name));
    }
    line("  </UnitDefinitions>\n  <LogCategories>".to_owned());
    for (name, text) in LOG_CATEGORIES {
        line(format!("    <Category name=\"{name}\" description=\"{text}\"/>"));
    }
    line("  </LogCategories>".to_owned());
    line(format!(
        "  <DefaultExperiment startTime=\"0\" stopTime=\"{:?}\" stepSize=\"{h:?}\"/>",
        stop_s(h)
    ));
    line("  <ModelVariables>".to_owned());
    for (reference, variable) in blueprint.variables.iter().enumerate() {
        line(element(blueprint, reference, variable));
    }
    line("  </ModelVariables>\n  <ModelStructure>".to_owned());
    // No output depends on an input of the same time.
    let outputs = || {
        let all = blueprint.variables.iter().enumerate();
        all.filter(|(_, v)| is_output(v.kind)).map(|(reference, v)| (reference, v.kind))
    };
    for (reference, _) in outputs() {
        line(format!("    <Output valueReference=\"{reference}\" dependencies=\"\"/>"));
    }
    for (reference, _) in outputs().filter(|(_, kind)| matches!(kind, Kind::Energy(_))) {
        line(format!("    <InitialUnknown valueReference=\"{reference}\"/>"));
    }
    line("  </ModelStructure>\n</fmiModelDescription>".to_owned());
    xml
}

/// The end of the experiment that is proposed: a second of steps at least, and a whole number of them.
fn stop_s(h: f64) -> f64 {
    (10.0 / h).round().max(1.0) * h
}

fn is_output(kind: Kind) -> bool {
    matches!(kind, Kind::Position(_) | Kind::Velocity(_) | Kind::Energy(_))
}

fn element(blueprint: &Blueprint, reference: usize, variable: &Variable) -> String {
    let start = &blueprint.start;
    let (role, start) = match variable.kind {
        Kind::Time => ("causality=\"independent\" variability=\"continuous\"", None),
        Kind::Input(i) => ("causality=\"input\"", Some(start.input[i])),
        Kind::Position(i) => ("causality=\"output\" initial=\"exact\"", Some(start.q[i])),
        Kind::Velocity(i) => ("causality=\"output\" initial=\"exact\"", Some(start.velocity[i])),
        Kind::Energy(_) => ("causality=\"output\" initial=\"calculated\"", None),
        Kind::Momentum(_) | Kind::Rate(_) | Kind::Force(_) | Kind::Next(_) => {
            ("causality=\"local\" initial=\"calculated\"", None)
        }
        Kind::Parameter(i) => {
            let role = "causality=\"parameter\" variability=\"tunable\"";
            (role, Some(blueprint.numbers[i].1))
        }
    };
    let mut text = format!(
        "    <Float64 name=\"{}\" valueReference=\"{reference}\" {role}",
        escaped(&variable.name)
    );
    text += &attribute("unit", variable.unit.unwrap_or_default());
    if let Some([least, most]) = variable.limits {
        let _ = write!(text, " min=\"{least:?}\" max=\"{most:?}\"");
    }
    if let Some(start) = start {
        let _ = write!(text, " start=\"{start:?}\"");
    }
    text + &attribute("description", &variable.description) + "/>"
}

/// An attribute, or nothing if there is nothing in it.
fn attribute(name: &str, value: &str) -> String {
    if value.is_empty() { String::new() } else { format!(" {name}=\"{}\"", escaped(value)) }
}

/// Text within an attribute. Characters that XML does not have become spaces.
fn escaped(text: &str) -> String {
    let mut escaped = String::with_capacity(text.len());
    for character in text.chars() {
        match character {
            '&' => escaped.push_str("&amp;"),
            '<' => escaped.push_str("&lt;"),
            '>' => escaped.push_str("&gt;"),
            '"' => escaped.push_str("&quot;"),
            c if c.is_control() || matches!(c, '\u{fffe}' | '\u{ffff}') => escaped.push(' '),
            c => escaped.push(c),
        }
    }
    escaped
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_is_escaped() {
        assert_eq!(escaped("a<b> & \"c\"\n\u{1}d"), "a&lt;b&gt; &amp; &quot;c&quot;  d");
    }

    #[test]
    fn the_proposed_experiment_is_a_whole_number_of_steps() {
        for h in [1e-3, 0.007, 0.1, 30.0] {
            let steps = stop_s(h) / h;
            assert!((steps - steps.round()).abs() < 1e-9 && steps >= 1.0, "{h}");
        }
    }
}
