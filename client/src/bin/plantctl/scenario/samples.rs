//! What was seen of a plant: named columns over time.

use std::collections::BTreeMap;

use plantd_client::v1;

use crate::contract::names;

/// Columns of equal length: `q(theta)`, `p(theta)`, `v(lift)`, `velocity(theta)`, `u(tau)`,
/// `force(pin.x)`, `kinetic`, `potential`, `y(tip.x)`; with a reference also `ref.q(theta)` and
/// `error.q(theta)`, and so on.
///
/// A column of inputs holds at each sample the input of the step that led there.
#[derive(Clone, Debug, Default)]
pub(crate) struct Samples {
    time_s: Vec<f64>,
    columns: BTreeMap<String, Vec<f64>>,
}

/// Quantities for which a bare name stands, the first that there is.
const BARE: [&str; 4] = ["q", "u", "force", "y"];

impl Samples {
    /// Number of samples.
    pub(crate) fn len(&self) -> usize {
        self.time_s.len()
    }

    /// Time of each sample, s.
    pub(crate) fn time_s(&self) -> &[f64] {
        &self.time_s
    }

    /// A column by the name that an expression has for it.
    pub(crate) fn signal(&self, name: &str) -> Result<Vec<f64>, String> {
        if name == "energy" && !self.columns.contains_key("q(energy)") {
            let (kinetic, potential) = (self.signal("kinetic")?, self.signal("potential")?);
            return Ok(kinetic.iter().zip(potential).map(|(t, v)| t + v).collect());
        }
        let (group, bare) = match name.split_once('.') {
            Some((group @ ("ref" | "error"), rest)) => (format!("{group}."), rest),
            _ => (String::new(), name),
        };
        let candidates = BARE.map(|quantity| format!("{group}{quantity}({bare})"));
        // The velocity of a prescribed coordinate over the last step goes before.
        let velocity = name.strip_prefix("v(").map(|rest| format!("velocity({rest}"));
        let candidates = candidates.into_iter().chain([name.to_owned()]).chain(velocity);
        let column = candidates.filter_map(|candidate| self.columns.get(&candidate)).next();
        column.cloned().ok_or_else(|| self.no_signal(name))
    }

    fn no_signal(&self, name: &str) -> String {
        const SHOWN: usize = 30;
        let mut names: Vec<_> = self.columns.keys().map(String::as_str).take(SHOWN).collect();
        if self.columns.len() > SHOWN {
            names.push("...");
        }
        format!("there is no signal `{name}`; there are {}", names.join(", "))
    }

    /// Adds an entry to a column.
    pub(crate) fn push(&mut self, name: &str, value: f64) {
        match self.columns.get_mut(name) {
            Some(column) => column.push(value),
            None => self.put(name, vec![value]),
        }
    }

    /// Adds the time of a sample, s.
    pub(crate) fn push_time(&mut self, time_s: f64) {
        self.time_s.push(time_s);
    }

    /// Sets a column.
    pub(crate) fn put(&mut self, name: &str, values: Vec<f64>) {
        self.columns.insert(name.to_owned(), values);
    }

    #[cfg(test)]
    pub(crate) fn put_time(&mut self, time_s: Vec<f64>) {
        self.time_s = time_s;
    }
}

/// The columns of a model, in the order of the contract's vectors.
#[derive(Clone, Debug, Default)]
pub(crate) struct Columns {
    q: Vec<String>,
    p: Vec<String>,
    v: Vec<String>,
    velocity: Vec<String>,
    u: Vec<String>,
    force: Vec<String>,
    y: Vec<String>,
    rotations: Vec<u32>,
    has_reference: bool,
    has_energy: bool,
}

/// One sample, as the contract has it.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Sample<'a> {
    pub(crate) state: &'a v1::State,
    pub(crate) time_step_s: f64,
    /// Input of the step that led here.
    pub(crate) u: &'a [f64],
    /// What sensors deliver.
    pub(crate) y: &'a [f64],
    pub(crate) energy: Option<&'a v1::Energy>,
    /// State and input of the reference.
    pub(crate) reference: Option<(&'a [f64], &'a [f64])>,
}

impl Columns {
    /// The columns of a model, with outputs of these names.
    pub(crate) fn new(
        model: &v1::Model,
        outputs: &[String],
        has_reference: bool,
        has_energy: bool,
    ) -> Self {
        fn named<'a>(quantity: &str, names: impl IntoIterator<Item = &'a String>) -> Vec<String> {
            names.into_iter().map(|name| format!("{quantity}({name})")).collect()
        }
        let coordinates = || model.coordinates.iter().map(|c| &c.name);
        let prescribed = || names::prescribed(model);
        Self {
            q: named("q", coordinates()),
            p: named("p", names::dynamic(model)),
            v: named("v", prescribed()),
            velocity: named("velocity", coordinates()),
            u: named("u", model.inputs.iter().chain(prescribed())),
            force: named("force", &model.constraints),
            y: named("y", outputs),
            rotations: plantd_client::rotations(model),
            has_reference,
            has_energy,
        }
    }

    fn x(&self) -> impl Iterator<Item = &String> {
        self.q.iter().chain(&self.p).chain(&self.v)
    }

    /// Samples that have all columns and no rows.
    pub(crate) fn empty(&self) -> Samples {
        let mut samples = Samples::default();
        let others = [&self.velocity, &self.u, &self.force, &self.y];
        for name in self.x().chain(others.into_iter().flatten()) {
            samples.put(name, Vec::new());
        }
        if self.has_energy {
            samples.put("kinetic", Vec::new());
            samples.put("potential", Vec::new());
        }
        if self.has_reference {
            for name in self.x() {
                samples.put(&format!("ref.{name}"), Vec::new());
                samples.put(&format!("error.{name}"), Vec::new());
            }
            for name in &self.u {
                samples.put(&format!("ref.{name}"), Vec::new());
            }
        }
        samples
    }

    /// Adds a sample. What the server did not send is NaN, which no expectation takes for good.
    pub(crate) fn push(&self, samples: &mut Samples, sample: Sample<'_>) {
        let Sample { state, time_step_s, u, y, energy, reference } = sample;
        let entry = |values: &[f64], i: usize| values.get(i).copied().unwrap_or(f64::NAN);
        samples.push_time(state.time_s);
        let x = [state.q.as_slice(), &state.p, &state.v].concat();
        for (i, name) in self.x().enumerate() {
            samples.push(name, entry(&x, i));
        }
        for (i, name) in self.velocity.iter().enumerate() {
            samples.push(name, entry(&state.velocity, i));
        }
        for (i, name) in self.u.iter().enumerate() {
            samples.push(name, entry(u, i));
        }
        for (i, name) in self.y.iter().enumerate() {
            samples.push(name, entry(y, i));
        }
        for (i, name) in self.force.iter().enumerate() {
            // Before the first step there are none.
            let impulse =
                if state.multipliers.is_empty() { 0.0 } else { entry(&state.multipliers, i) };
            samples.push(name, impulse / time_step_s);
        }
        if self.has_energy {
            samples.push("kinetic", energy.map_or(f64::NAN, |e| e.kinetic_j));
            samples.push("potential", energy.map_or(f64::NAN, |e| e.potential_j));
        }
        if !self.has_reference {
            return;
        }
        let (x_reference, u_reference) = reference.unwrap_or_default();
        let error = match x_reference.len() == x.len() {
            true => plantd_client::difference(x_reference, &x, &self.rotations),
            false => Vec::new(),
        };
        for (i, name) in self.x().enumerate() {
            samples.push(&format!("ref.{name}"), entry(x_reference, i));
            samples.push(&format!("error.{name}"), entry(&error, i));
        }
        for (i, name) in self.u.iter().enumerate() {
            samples.push(&format!("ref.{name}"), entry(u_reference, i));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn model() -> v1::Model {
        let coordinate = |name: &str, prescribed| v1::Coordinate {
            name: name.to_owned(),
            prescribed,
            ..Default::default()
        };
        v1::Model {
            coordinates: vec![coordinate("theta", false), coordinate("lift", true)],
            inputs: vec!["tau".to_owned()],
            constraints: vec!["pin.x".to_owned()],
            ..Default::default()
        }
    }

    #[test]
    fn every_entry_of_a_sample_has_its_name() {
        let columns = Columns::new(&model(), &["tip.x".to_owned()], true, true);
        let mut samples = columns.empty();
        let state = v1::State {
            time_s: 0.5,
            q: vec![1.0, 2.0],
            p: vec![3.0],
            v: vec![4.0],
            multipliers: vec![5.0],
            velocity: vec![3.5, 4.0],
            ..Default::default()
        };
        let energy = v1::Energy { kinetic_j: 6.0, potential_j: 7.0 };
        let reference = ([0.5, 0.0, 0.0, 0.0], [9.0, 9.5]);
        let sample = Sample {
            state: &state,
            time_step_s: 0.1,
            u: &[8.0, 8.5],
            y: &[1.5],
            energy: Some(&energy),
            reference: Some((&reference.0, &reference.1)),
        };
        columns.push(&mut samples, sample);
        for (name, value) in [
            ("theta", 1.0),
            ("q(lift)", 2.0),
            ("p(theta)", 3.0),
            ("v(lift)", 4.0),
            ("velocity(theta)", 3.5),
            ("v(theta)", 3.5),
            ("force(pin.x)", 50.0),
            ("pin.x", 50.0),
            ("tau", 8.0),
            ("u(lift)", 8.5),
            ("y(tip.x)", 1.5),
            ("tip.x", 1.5),
            ("kinetic", 6.0),
            ("energy", 13.0),
            ("error.theta", 0.5),
            ("error.p(theta)", 3.0),
            ("ref.u(tau)", 9.0),
            ("ref.tau", 9.0),
        ] {
            assert_eq!(samples.signal(name), Ok(vec![value]), "{name}");
        }
        assert_eq!(samples.time_s(), [0.5]);
        assert!(samples.signal("error.tau").unwrap_err().contains("`error.tau`"));
    }

    #[test]
    fn what_was_not_sent_is_not_a_number() {
        let columns = Columns::new(&model(), &[], false, true);
        let mut samples = columns.empty();
        let state = v1::State { q: vec![1.0], ..Default::default() };
        let sample = Sample {
            state: &state,
            time_step_s: 0.1,
            u: &[],
            y: &[],
            energy: None,
            reference: None,
        };
        columns.push(&mut samples, sample);
        for name in ["lift", "p(theta)", "tau", "energy"] {
            assert!(samples.signal(name).unwrap()[0].is_nan(), "{name}");
        }
        assert_eq!(samples.signal("pin.x"), Ok(vec![0.0]));
    }
}
