//! Tables and matrices for people.

use std::fmt::Write as _;

use plantd_client::{MatrixExt as _, v1};

/// Most rows or columns of a matrix that are printed; beyond it the middle is left out.
const MATRIX_SHOWN: usize = 12;

/// A table with left-aligned columns, two spaces apart.
pub(crate) fn table(head: &[&str], rows: &[Vec<String>]) -> String {
    let width = |col: usize| {
        let cells = rows.iter().map(|row| row[col].chars().count());
        cells.chain([head[col].chars().count()]).max().unwrap_or(0)
    };
    let widths: Vec<usize> = (0..head.len()).map(width).collect();
    let mut text = String::new();
    let head_row: Vec<String> = head.iter().map(|&cell| cell.to_owned()).collect();
    for row in std::iter::once(&head_row).chain(rows) {
        let mut line = String::new();
        for (cell, width) in row.iter().zip(&widths) {
            let _ = write!(line, "{cell:<width$}  ");
        }
        let _ = writeln!(text, "{}", line.trim_end());
    }
    text
}

/// A matrix under its title, with a name before each row and above each column.
pub(crate) fn matrix(title: &str, matrix: &v1::Matrix, rows: &[String], cols: &[String]) -> String {
    let shown_cols = shown(matrix.cols as usize);
    let mut lines: Vec<Vec<String>> = Vec::new();
    let head = |col: &Option<usize>| col.map_or("…".to_owned(), |c| label(cols, c));
    lines.push(std::iter::once(String::new()).chain(shown_cols.iter().map(head)).collect());
    for row in shown(matrix.rows as usize) {
        let Some(row) = row else {
            lines.push(vec!["…".to_owned(); shown_cols.len() + 1]);
            continue;
        };
        let entry =
            |col: &Option<usize>| col.map_or("…".to_owned(), |c| number(matrix.at(row, c)));
        let name = std::iter::once(label(rows, row));
        lines.push(name.chain(shown_cols.iter().map(entry)).collect());
    }
    let width = |col: usize| lines.iter().map(|line| line[col].chars().count()).max().unwrap_or(0);
    let widths: Vec<usize> = (0..=shown_cols.len()).map(width).collect();
    let mut text = format!("{title} ({} × {})\n", matrix.rows, matrix.cols);
    for line in &lines {
        let _ = write!(text, "  {:<width$}", line[0], width = widths[0]);
        for (cell, width) in line[1..].iter().zip(&widths[1..]) {
            let _ = write!(text, "  {cell:>width$}");
        }
        text.push('\n');
    }
    text
}

/// Indices to print, `None` standing for those left out.
fn shown(count: usize) -> Vec<Option<usize>> {
    if count <= MATRIX_SHOWN {
        return (0..count).map(Some).collect();
    }
    let half = MATRIX_SHOWN / 2;
    (0..half).map(Some).chain([None]).chain((count - half..count).map(Some)).collect()
}

fn label(names: &[String], index: usize) -> String {
    names.get(index).cloned().unwrap_or_else(|| index.to_string())
}

/// A number with seven significant digits.
pub(crate) fn number(x: f64) -> String {
    let magnitude = x.abs();
    if x == 0.0 {
        "0".to_owned()
    } else if !x.is_finite() {
        x.to_string()
    } else if (1e-4..1e7).contains(&magnitude) {
        let before_point = magnitude.log10().floor() as i32 + 1;
        format!("{x:.*}", (7 - before_point).clamp(0, 10) as usize)
    } else {
        format!("{x:.6e}")
    }
}

/// Numbers, comma-separated.
pub(crate) fn numbers(values: &[f64]) -> String {
    values.iter().map(|&x| number(x)).collect::<Vec<_>>().join(", ")
}

/// Names of the entries of `x = (q, p, v)`.
pub(crate) fn state_names(model: &v1::Model) -> Vec<String> {
    let all = model.coordinates.iter().map(|c| c.name.clone());
    let dynamic = model.coordinates.iter().filter(|c| !c.prescribed);
    let prescribed = model.coordinates.iter().filter(|c| c.prescribed);
    all.chain(dynamic.map(|c| format!("p({})", c.name)))
        .chain(prescribed.map(|c| format!("v({})", c.name)))
        .collect()
}

/// Names of the entries of `u`.
pub(crate) fn input_names(model: &v1::Model) -> Vec<String> {
    let prescribed = model.coordinates.iter().filter(|c| c.prescribed);
    model.inputs.iter().cloned().chain(prescribed.map(|c| c.name.clone())).collect()
}

/// A model.
pub(crate) fn model(model: &v1::Model) -> String {
    described(model, if model.builtin { "built in" } else { "uploaded" })
}

/// The model of a scene that was only looked at.
pub(crate) fn validated(model: &v1::Model) -> String {
    described(model, "valid, not uploaded")
}

fn described(model: &v1::Model, origin: &str) -> String {
    let mut text = format!("{}: {}\n", model.name, model.description);
    let _ = writeln!(text, "{origin}, time step {} s", number(model.time_step_s));
    let rows: Vec<_> = model.coordinates.iter().map(coordinate).collect();
    let _ = write!(text, "\n{}", table(&["coordinate", "kind", "unit", "initial"], &rows));
    for (title, names) in [
        ("inputs", &model.inputs),
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
        let rows: Vec<_> = model.signals.iter().map(row).collect();
        let _ = write!(text, "\n{}", table(&["signal drives", "kind", "effect"], &rows));
    }
    text.push_str(&guess(&model.initial_violations));
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

fn coordinate(c: &v1::Coordinate) -> Vec<String> {
    let kind = if c.prescribed { "prescribed" } else { "dynamic" };
    let unit = match c.unit() {
        v1::Unit::Metre => "m",
        v1::Unit::Radian => "rad",
        v1::Unit::Unspecified => "",
    };
    let unit = match c.rotation_group.as_str() {
        "" => unit.to_owned(),
        joint => format!("{unit}, rotation vector of {joint}"),
    };
    vec![c.name.clone(), kind.to_owned(), unit, number(c.initial)]
}

/// Models, one per row.
pub(crate) fn models(models: &[v1::Model]) -> String {
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
    table(&head, &models.iter().map(row).collect::<Vec<_>>())
}

/// Plants, one per row.
pub(crate) fn plants(plants: &[v1::PlantInfo]) -> String {
    let row = |p: &v1::PlantInfo| {
        let state = p.state.as_ref();
        let dt = p.settings.as_ref().map_or(0.0, |s| s.time_step_s);
        let driver = if p.driver.is_empty() { "-" } else { &p.driver };
        let link = if p.link_open { "open" } else { "-" };
        vec![
            p.id.clone(),
            p.model.clone(),
            number(dt),
            state.map_or(0, |s| s.step).to_string(),
            number(state.map_or(0.0, |s| s.time_s)),
            driver.to_owned(),
            link.to_owned(),
        ]
    };
    let head = ["plant", "model", "dt/s", "step", "time/s", "driver", "link"];
    table(&head, &plants.iter().map(row).collect::<Vec<_>>())
}

/// Recordings as a table, with the reasons of those that failed.
pub(crate) fn recordings(recordings: &[v1::Recording]) -> String {
    let row = |r: &v1::Recording| {
        let status = match r.status() {
            v1::RecordingStatus::Unspecified => "-",
            v1::RecordingStatus::Active => "active",
            v1::RecordingStatus::Done => "done",
            v1::RecordingStatus::Failed => "failed",
        };
        let plant = if r.plant.is_empty() { "-" } else { &r.plant };
        vec![
            r.name.clone(),
            plant.to_owned(),
            status.to_owned(),
            r.steps.to_string(),
            r.lost.to_string(),
            r.bytes.to_string(),
        ]
    };
    let head = ["recording", "plant", "status", "steps", "lost", "bytes"];
    let mut text = table(&head, &recordings.iter().map(row).collect::<Vec<_>>());
    for recording in recordings.iter().filter(|recording| !recording.failure.is_empty()) {
        let _ = writeln!(text, "{}: {}", recording.name, recording.failure);
    }
    text
}

/// By which method a plant is stepped.
pub(crate) fn stepping(plant: &v1::PlantInfo) -> String {
    let settings = plant.settings.unwrap_or_default();
    let precision = if settings.precision() == v1::Precision::Fast { "fast" } else { "exact" };
    let (order, substeps, halvings) = (settings.order, settings.substeps, settings.halvings());
    let accuracy = plant.accuracy.as_ref().map_or(String::new(), |accuracy| {
        format!("; off by {} over {} steps", number(accuracy.error), accuracy.periods)
    });
    format!(
        "  order {order}, substeps {substeps}, halvings {halvings} at most, {precision}{accuracy}\n"
    )
}

/// A state; vectors that the model does not have are left out.
pub(crate) fn state(state: &v1::State) -> String {
    let mut text = format!("step {}, time {} s\n", state.step, number(state.time_s));
    for (name, values) in
        [("q", &state.q), ("p", &state.p), ("v", &state.v), ("multipliers", &state.multipliers)]
    {
        if !values.is_empty() {
            let _ = writeln!(text, "  {name}: {}", numbers(values));
        }
    }
    text
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

/// A and B of a linearization, and the multipliers' rows where there are constraints.
pub(crate) fn linearization(linearization: &v1::Linearization, model: &v1::Model) -> String {
    let (x, u) = (state_names(model), input_names(model));
    let blocks = [
        ("A = df/dx", &linearization.a, &x, &x),
        ("B = df/du", &linearization.b, &x, &u),
        ("C = dλ/dx", &linearization.multipliers_x, &model.constraints, &x),
        ("D = dλ/du", &linearization.multipliers_u, &model.constraints, &u),
    ];
    let filled = blocks.into_iter().filter_map(|(title, block, rows, cols)| {
        let block = block.as_ref().filter(|m| !m.data.is_empty())?;
        Some(matrix(title, block, rows, cols))
    });
    filled.collect::<Vec<_>>().join("\n")
}

/// One matrix per output of a tensor that has any, under a title with the output's name.
fn slices(
    title: &str,
    tensor: Option<&v1::Tensor>,
    outputs: &[String],
    first: &[String],
    second: &[String],
) -> String {
    let Some(tensor) = tensor.filter(|t| !t.data.is_empty()) else { return String::new() };
    let (rows, cols) = (tensor.first, tensor.second);
    let slices = tensor.data.chunks(rows as usize * cols as usize).enumerate();
    let slice = |(output, data): (usize, &[f64])| {
        let block = v1::Matrix { rows, cols, data: data.to_vec() };
        matrix(&format!("{title} of {}", label(outputs, output)), &block, first, second)
    };
    slices.map(slice).collect::<Vec<_>>().join("\n")
}

/// Second derivatives, block by block and output by output.
pub(crate) fn second_order(tensors: &v1::SecondOrder, model: &v1::Model) -> String {
    let (x, u, c) = (state_names(model), input_names(model), &model.constraints);
    let blocks = [
        slices("d²/dxdx", tensors.xx.as_ref(), &x, &x, &x),
        slices("d²/dxdu", tensors.xu.as_ref(), &x, &x, &u),
        slices("d²/dudu", tensors.uu.as_ref(), &x, &u, &u),
        slices("d²/dxdx", tensors.multipliers_xx.as_ref(), c, &x, &x),
        slices("d²/dxdu", tensors.multipliers_xu.as_ref(), c, &x, &u),
        slices("d²/dudu", tensors.multipliers_uu.as_ref(), c, &u, &u),
    ];
    blocks.into_iter().filter(|block| !block.is_empty()).collect::<Vec<_>>().join("\n")
}

/// A Hessian of a weighted sum of outputs.
pub(crate) fn contraction(contraction: &v1::Contraction, model: &v1::Model) -> String {
    let (x, u) = (state_names(model), input_names(model));
    let blocks = [
        ("d²/dxdx", &contraction.xx, &x, &x),
        ("d²/dxdu", &contraction.xu, &x, &u),
        ("d²/dudu", &contraction.uu, &u, &u),
    ];
    let filled = blocks.into_iter().filter_map(|(title, block, rows, cols)| {
        Some(matrix(title, block.as_ref().filter(|m| !m.data.is_empty())?, rows, cols))
    });
    filled.collect::<Vec<_>>().join("\n")
}

/// Accelerations, constraint forces, and their derivatives where there are any.
pub(crate) fn dynamics(answer: &v1::EvaluateDynamicsResponse, model: &v1::Model) -> String {
    let all = || model.coordinates.iter();
    let dynamic: Vec<_> = all().filter(|c| !c.prescribed).map(|c| c.name.clone()).collect();
    let forces = answer.multipliers.iter().zip(&model.constraints);
    let rows: Vec<_> = answer
        .acceleration
        .iter()
        .zip(&dynamic)
        .map(|(value, name)| vec![format!("d²({name})/dt²"), number(*value)])
        .chain(forces.map(|(value, name)| vec![format!("λ({name})"), number(*value)]))
        .collect();
    let mut text = table(&["", "value"], &rows);
    let outputs: Vec<_> = dynamic.iter().chain(&model.constraints).cloned().collect();
    let rates = all().map(|c| format!("d({})/dt", c.name));
    let accelerations = all().filter(|c| c.prescribed).map(|c| format!("d²({})/dt²", c.name));
    let parameters: Vec<_> = all()
        .map(|c| c.name.clone())
        .chain(rates)
        .chain(model.inputs.iter().cloned())
        .chain(accelerations)
        .collect();
    if let Some(jacobian) = &answer.jacobian {
        let _ = write!(text, "\n{}", matrix("derivatives", jacobian, &outputs, &parameters));
    }
    if answer.hessian.is_some() {
        let hessian = slices(
            "second derivatives",
            answer.hessian.as_ref(),
            &outputs,
            &parameters,
            &parameters,
        );
        let _ = write!(text, "\n{hessian}");
    }
    text
}

/// Ranks, modes and responses.
pub(crate) fn analysis(answer: &v1::AnalyzeResponse, model: &v1::Model) -> String {
    let mut text = format!(
        "order {}\ncontrollability rank: {}\nobservability rank: {}\nspectral radius: {}\n",
        answer.order,
        answer.controllability_rank,
        answer.observability_rank,
        number(answer.spectral_radius)
    );
    // Of a conjugate pair one stands for both.
    let shown = answer.modes.iter().filter(|mode| mode.imaginary >= 0.0);
    let rows: Vec<_> = shown
        .map(|mode| {
            let eigenvalue = match mode.imaginary {
                0.0 => number(mode.real),
                imaginary => format!("{} ± {}i", number(mode.real), number(imaginary)),
            };
            vec![
                eigenvalue,
                number(mode.modulus),
                number(mode.natural_frequency_hz),
                number(mode.damping_ratio),
                number(mode.time_constant_s),
            ]
        })
        .collect();
    let head = ["eigenvalue", "modulus", "frequency/Hz", "damping ratio", "time constant/s"];
    let _ = write!(text, "\n{}", table(&head, &rows));
    let inputs = input_names(model);
    for response in &answer.responses {
        let title = format!("response at {} Hz", number(response.frequency_hz));
        for (what, block) in
            [("magnitude", &response.magnitude), ("phase, rad", &response.phase_rad)]
        {
            if let Some(block) = block {
                let title = format!("{title}: {what}");
                let _ = write!(text, "\n{}", matrix(&title, block, &answer.outputs, &inputs));
            }
        }
    }
    text
}

/// A settled configuration.
pub(crate) fn settled(answer: &v1::SettleResponse, model: &v1::Model) -> String {
    let coordinates = model.coordinates.iter().map(|c| c.name.as_str());
    let inputs = model.inputs.iter().map(String::as_str);
    let rows: Vec<_> = coordinates
        .zip(&answer.q)
        .chain(inputs.zip(&answer.u))
        .map(|(name, value)| vec![name.to_owned(), number(*value)])
        .collect();
    let mut text = table(&["coordinate or input", "value"], &rows);
    if let Some(equilibrium) = &answer.equilibrium {
        let kind = if equilibrium.stable { "stable" } else { "unstable" };
        let _ = write!(
            text,
            "\n{kind} equilibrium after {} iterations: {} J, smallest stiffness {}, residual {}\n",
            equilibrium.iterations,
            number(equilibrium.potential_j),
            number(equilibrium.smallest_stiffness),
            number(equilibrium.residual)
        );
        let _ = write!(text, "{}", forces(&equilibrium.constraint_forces, model));
    }
    text
}

/// Constraint forces, one per row; nothing without constraints.
fn forces(forces: &[f64], model: &v1::Model) -> String {
    if forces.is_empty() {
        return String::new();
    }
    let row = |(name, force): (&String, &f64)| vec![name.clone(), number(*force)];
    let rows: Vec<_> = model.constraints.iter().zip(forces).map(row).collect();
    format!("\n{}", table(&["constraint", "force"], &rows))
}

/// A settled configuration as an operating point of a scene: what differs from the initial one, in
/// all digits.
pub(crate) fn operating_point(answer: &v1::SettleResponse, model: &v1::Model) -> String {
    let list = |entries: Vec<String>| format!("{{ {} }}", entries.join(", "));
    let coordinates: Vec<_> = model
        .coordinates
        .iter()
        .zip(&answer.q)
        .filter(|(coordinate, value)| coordinate.initial != **value)
        .map(|(coordinate, value)| format!("{} = {value:?}", key(&coordinate.name)))
        .collect();
    let mut text =
        format!("[[operating_points]]\nname = \"settled\"\ncoordinates = {}\n", list(coordinates));
    let inputs: Vec<_> = model
        .inputs
        .iter()
        .zip(&answer.u)
        .filter(|(_, value)| **value != 0.0)
        .map(|(name, value)| format!("{} = {value:?}", key(name)))
        .collect();
    if !inputs.is_empty() {
        let _ = writeln!(text, "inputs = {}", list(inputs));
    }
    text
}

/// A key of TOML, quoted where it must be.
fn key(name: &str) -> String {
    let is_bare = |c: char| c.is_ascii_alphanumeric() || c == '_' || c == '-';
    if !name.is_empty() && name.chars().all(is_bare) {
        return name.to_owned();
    }
    format!("{:?}", name)
}

/// What can be said of a state.
pub(crate) fn diagnosis(answer: &v1::DiagnoseResponse, model: &v1::Model) -> String {
    let redundant = match answer.redundant_constraints.as_slice() {
        [] => "none".to_owned(),
        names => names.join(", "),
    };
    let mut text = format!(
        "step {}\n  degrees of freedom: {}\n  independent constraints: {} of {}; redundant: \
         {redundant}\n",
        answer.step,
        answer.degrees_of_freedom,
        answer.constraint_rank,
        model.constraints.len(),
    );
    text += &answer.energy.as_ref().map(energy).unwrap_or_default();
    let _ = write!(
        text,
        "  mass: {} kg, centre at ({}) m\n  linear momentum: ({}) kg m/s\n  angular momentum about \
         the origin: ({}) kg m²/s\n  reciprocal condition: {} mass matrix, {} constraints\n",
        number(answer.mass_kg),
        numbers(&answer.center_of_mass),
        numbers(&answer.linear_momentum),
        numbers(&answer.angular_momentum),
        number(answer.mass_matrix_reciprocal_condition),
        number(answer.constraint_reciprocal_condition),
    );
    text += &forces(&answer.constraint_forces, model);
    text
}

/// A feedback law.
pub(crate) fn gain(gain: &v1::Gain, model: &v1::Model) -> String {
    let (x, u) = (state_names(model), input_names(model));
    let k = gain.k.as_ref().map_or(String::new(), |k| matrix("K", k, &u, &x));
    let forward = if gain.feedforward.is_empty() { "" } else { " + feedforward" };
    format!("u = u_reference{forward} - K (x - x_reference)\n\n{k}")
}

/// A steady-state Kalman filter.
pub(crate) fn kalman(answer: &v1::SolveKalmanResponse, model: &v1::Model) -> String {
    let gain = answer.gain.as_ref();
    let gain = gain.map(|l| matrix("L", l, &state_names(model), &answer.outputs));
    let radius = answer.error_modes.iter().map(|z| z.real.hypot(z.imaginary)).fold(0.0, f64::max);
    format!(
        "x = x_predicted + L (y - C x_predicted)\n\n{}\nspectral radius of the error: {}\nRiccati \
         residual: {}\n",
        gain.unwrap_or_default(),
        number(radius),
        number(answer.residual),
    )
}

/// Numbers of the scene that were changed for a plant; nothing if none were.
pub(crate) fn parameters(plant: &v1::PlantInfo) -> String {
    let line = |p: &v1::Parameter| format!("  {} = {}\n", p.path, number(p.value));
    plant.parameters.iter().map(line).collect()
}

/// The bounds that protect a plant, and which of them holds it.
pub(crate) fn safety(safety: &v1::SafetyInfo) -> String {
    let name = |action: v1::WatchdogAction| {
        action.as_str_name().trim_start_matches("WATCHDOG_ACTION_").to_lowercase()
    };
    let mut text = String::new();
    for dog in &safety.watchdogs {
        let end = |end: Option<f64>| end.map_or_else(String::new, number);
        let (min, max) = (end(dog.min), end(dog.max));
        let _ =
            writeln!(text, "  guard {} in [{min}, {max}]: {}", dog.quantity, name(dog.action()));
    }
    if safety.on_step_failure != 0 {
        let _ = writeln!(text, "  guard failed steps: {}", name(safety.on_step_failure()));
    }
    if let Some(trip) = &safety.frozen {
        let (quantity, step) = (trip.watchdog as usize, trip.step);
        let quantity = safety.watchdogs.get(quantity).map_or("", |dog| dog.quantity.as_str());
        let value = number(trip.value);
        let _ = writeln!(text, "  stopped by a watchdog at step {step}: {quantity} = {value}");
    }
    text
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

/// One message of a stream of gains.
pub(crate) fn watched_gain(message: &v1::WatchGainsResponse, model: &v1::Model) -> String {
    let mut text = String::new();
    if let Some(failure) = &message.failure {
        let _ = writeln!(text, "{}: {}", failure.reason, failure.message);
    }
    if let Some(law) = &message.gain {
        let _ = writeln!(text, "from step {} on, revision {}", law.step, message.revision);
        let lines = [
            ("x_reference", &law.x_reference),
            ("u_reference", &law.u_reference),
            ("feedforward", &law.feedforward),
        ];
        for (name, values) in lines.into_iter().filter(|(_, values)| !values.is_empty()) {
            let _ = writeln!(text, "  {name}: {}", numbers(values));
        }
        if let Some(k) = &law.k {
            text += &matrix("K", k, &input_names(model), &state_names(model));
        }
    }
    text
}

/// One iteration of a search, as a row of a table under [`ITERATIONS`].
pub(crate) fn iteration(progress: &v1::OptimizationProgress) -> String {
    let mut text = format!(
        "{:>9}  {:<12}  {:>14}  {:>14}  {:>12}  {:>12}\n",
        progress.iteration,
        method(progress.method()),
        number(progress.cost),
        number(progress.directional_derivative),
        number(progress.step_length),
        number(progress.bound_violation),
    );
    if !progress.fallback.is_empty() {
        let _ = writeln!(text, "           {}", progress.fallback);
    }
    text
}

/// Head of a table of iterations.
pub(crate) const ITERATIONS: &str =
    "iteration  method                  cost      derivative   step length  out of bounds\n";

fn method(method: v1::DescentMethod) -> &'static str {
    match method {
        v1::DescentMethod::Unspecified => "",
        v1::DescentMethod::Steepest => "steepest",
        v1::DescentMethod::QuasiNewton => "quasi-newton",
        v1::DescentMethod::Newton => "newton",
    }
}

/// The end of a search.
pub(crate) fn optimum(result: &v1::OptimizationResult) -> String {
    let mut text = match &result.failure {
        // Standard error says why, and what helps.
        Some(failure) => format!("stopped early: {}\n", failure.reason),
        None => "converged\n".to_owned(),
    };
    let _ = write!(text, "cost {}", number(result.cost));
    if result.bound_violation != 0.0 {
        let _ = write!(text, ", out of bounds by {}", number(result.bound_violation));
    }
    let iterations = result.checkpoint.as_ref().map_or(0, |c| c.iterations);
    let _ = writeln!(text, " after {iterations} iterations");
    text
}

/// How a reference compares with motions of the plant.
pub(crate) fn reference(report: &v1::ReferenceReport) -> String {
    let mut text = String::new();
    let verdict = if report.feasible { "is a motion" } else { "is not a motion" };
    let _ = writeln!(text, "the reference {verdict} of the plant");
    if !report.constraint.is_empty() {
        let _ = writeln!(
            text,
            "  constraints: off by {} at step {} ({})",
            number(report.constraint_violation),
            report.constraint_violation_step,
            report.constraint
        );
    }
    let _ = writeln!(
        text,
        "  forces: {} of {} at step {} cannot be exerted",
        number(report.unexplained_force),
        report.unexplained_force_coordinate,
        report.unexplained_force_step
    );
    let _ = writeln!(
        text,
        "  accelerations: {} of {} at step {} cannot be had",
        number(report.unexplained_acceleration),
        report.unexplained_coordinate,
        report.unexplained_step
    );
    let _ = writeln!(
        text,
        "  the motion found deviates by {} in {} at step {}",
        number(report.deviation),
        report.deviation_coordinate,
        report.deviation_step
    );
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn numbers_keep_seven_digits() {
        for (x, text) in [
            (0.0, "0"),
            (0.95333434, "0.9533343"),
            (-12.5, "-12.50000"),
            (0.000976, "0.0009760000"),
            (1e-9, "1.000000e-9"),
            (123456.0, "123456.0"),
        ] {
            assert_eq!(number(x), text);
        }
    }

    #[test]
    fn a_large_matrix_leaves_out_its_middle() {
        let big = v1::Matrix { rows: 40, cols: 40, data: vec![1.0; 1600] };
        let text = matrix("A", &big, &[], &[]);
        assert!(text.starts_with("A (40 × 40)\n"));
        assert_eq!(text.lines().count(), 2 + MATRIX_SHOWN + 1);
    }

    #[test]
    fn columns_line_up() {
        let rows = [vec!["a".to_owned(), "1".to_owned()], vec!["long".to_owned(), "2".to_owned()]];
        assert_eq!(table(&["n", "v"], &rows), "n     v\na     1\nlong  2\n");
    }
}
