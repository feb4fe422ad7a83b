//! What was seen of a plant: named columns over time.

use std::collections::BTreeMap;

/// Columns of equal length: `q(theta)`, `p(theta)`, `v(lift)`, `velocity(theta)`, `u(tau)`,
/// `force(pin.x)`, `kinetic`, `potential`, `y(tip.x)`; with a reference also `ref.q(theta)` and
/// `error.q(theta)`, and so on.
///
/// A column of inputs holds at each sample the input of the step that led there.
#[derive(Clone, Debug, Default)]
pub struct Samples {
    time_s: Vec<f64>,
    columns: BTreeMap<String, Vec<f64>>,
}

/// Quantities for which a bare name stands, the first that there is.
const BARE: [&str; 4] = ["q", "u", "force", "y"];

impl Samples {
    /// Number of samples.
    pub fn count(&self) -> usize {
        self.time_s.len()
    }

    /// Time of each sample, s.
    pub fn time_s(&self) -> &[f64] {
        &self.time_s
    }

    /// A column by the name that an expression has for it.
    pub fn signal(&self, name: &str) -> Result<Vec<f64>, String> {
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
    pub fn push(&mut self, name: &str, value: f64) {
        match self.columns.get_mut(name) {
            Some(column) => column.push(value),
            None => self.put(name, vec![value]),
        }
    }

    /// Adds the time of a sample, s.
    pub fn push_time(&mut self, time_s: f64) {
        self.time_s.push(time_s);
    }

    /// Sets a column.
    pub fn put(&mut self, name: &str, values: Vec<f64>) {
        self.columns.insert(name.to_owned(), values);
    }

    #[cfg(test)]
    pub(crate) fn put_time(&mut self, time_s: Vec<f64>) {
        self.time_s = time_s;
    }
}

/// Names of the entries of a plant's vectors, in their order.
#[derive(Clone, Debug, Default)]
pub struct Names {
    /// Of all coordinates.
    pub coordinates: Vec<String>,
    /// Of those with a momentum.
    pub dynamic: Vec<String>,
    /// Of those that are prescribed.
    pub prescribed: Vec<String>,
    /// Of the inputs, without prescribed coordinates.
    pub inputs: Vec<String>,
    /// Of the constraints.
    pub constraints: Vec<String>,
    /// Of what sensors deliver.
    pub outputs: Vec<String>,
}

/// The columns of a plant.
#[derive(Clone, Debug, Default)]
pub struct Columns {
    x: Vec<String>,
    velocity: Vec<String>,
    u: Vec<String>,
    force: Vec<String>,
    y: Vec<String>,
    has_reference: bool,
    has_energy: bool,
}

/// One sample.
#[derive(Clone, Copy, Debug)]
pub struct Sample<'a> {
    /// The plant's time, s.
    pub time_s: f64,
    /// Time step, s.
    pub time_step_s: f64,
    /// State `(q, p, v)`.
    pub x: &'a [f64],
    /// Velocities of all coordinates.
    pub velocity: &'a [f64],
    /// Impulses of the constraints; none before the first step.
    pub multipliers: &'a [f64],
    /// Input of the step that led here.
    pub u: &'a [f64],
    /// What sensors deliver.
    pub y: &'a [f64],
    /// Kinetic and potential energy, J.
    pub energy: Option<[f64; 2]>,
    /// Where the plant should be.
    pub reference: Option<Reference<'a>>,
}

/// Where a plant should be.
#[derive(Clone, Copy, Debug, Default)]
pub struct Reference<'a> {
    /// State.
    pub x: &'a [f64],
    /// Input.
    pub u: &'a [f64],
    /// The plant's state seen from there, on the group for rotations.
    pub error: &'a [f64],
}

impl Columns {
    /// The columns of a plant with these names.
    pub fn new(names: &Names, has_reference: bool, has_energy: bool) -> Self {
        fn named(quantity: &str, names: &[String]) -> Vec<String> {
            names.iter().map(|name| format!("{quantity}({name})")).collect()
        }
        let Names { coordinates, dynamic, prescribed, inputs, constraints, outputs } = names;
        let x = [named("q", coordinates), named("p", dynamic), named("v", prescribed)].concat();
        Self {
            x,
            velocity: named("velocity", coordinates),
            u: [named("u", inputs), named("u", prescribed)].concat(),
            force: named("force", constraints),
            y: named("y", outputs),
            has_reference,
            has_energy,
        }
    }

    /// How many there are.
    pub fn count(&self) -> usize {
        let x = self.x.len() * if self.has_reference { 3 } else { 1 };
        let u = self.u.len() * if self.has_reference { 2 } else { 1 };
        let energy = if self.has_energy { 2 } else { 0 };
        1 + x + u + energy + self.velocity.len() + self.force.len() + self.y.len()
    }

    /// Samples that have all columns and no rows.
    pub fn empty(&self) -> Samples {
        let mut samples = Samples::default();
        let others = [&self.velocity, &self.u, &self.force, &self.y];
        for name in self.x.iter().chain(others.into_iter().flatten()) {
            samples.put(name, Vec::new());
        }
        if self.has_energy {
            samples.put("kinetic", Vec::new());
            samples.put("potential", Vec::new());
        }
        if self.has_reference {
            for name in &self.x {
                samples.put(&format!("ref.{name}"), Vec::new());
                samples.put(&format!("error.{name}"), Vec::new());
            }
            for name in &self.u {
                samples.put(&format!("ref.{name}"), Vec::new());
            }
        }
        samples
    }

    /// Adds a sample. What is not known is NaN, which no expectation takes for good.
    pub fn push(&self, samples: &mut Samples, sample: Sample<'_>) {
        let Sample { time_s, time_step_s, x, velocity, multipliers, u, y, energy, reference } =
            sample;
        let entry = |values: &[f64], i: usize| values.get(i).copied().unwrap_or(f64::NAN);
        samples.push_time(time_s);
        let given = [(&self.x, x), (&self.velocity, velocity), (&self.u, u), (&self.y, y)];
        for (names, values) in given {
            for (i, name) in names.iter().enumerate() {
                samples.push(name, entry(values, i));
            }
        }
        for (i, name) in self.force.iter().enumerate() {
            // Before the first step there are none.
            let impulse = if multipliers.is_empty() { 0.0 } else { entry(multipliers, i) };
            samples.push(name, impulse / time_step_s);
        }
        if self.has_energy {
            let [kinetic, potential] = energy.unwrap_or([f64::NAN; 2]);
            samples.push("kinetic", kinetic);
            samples.push("potential", potential);
        }
        if !self.has_reference {
            return;
        }
        let reference = reference.unwrap_or_default();
        for (i, name) in self.x.iter().enumerate() {
            samples.push(&format!("ref.{name}"), entry(reference.x, i));
            samples.push(&format!("error.{name}"), entry(reference.error, i));
        }
        for (i, name) in self.u.iter().enumerate() {
            samples.push(&format!("ref.{name}"), entry(reference.u, i));
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(output: &str) -> Names {
        let names = |names: &[&str]| names.iter().map(|name| (*name).to_owned()).collect();
        Names {
            coordinates: names(&["theta", "lift"]),
            dynamic: names(&["theta"]),
            prescribed: names(&["lift"]),
            inputs: names(&["tau"]),
            constraints: names(&["pin.x"]),
            outputs: names(&[output]),
        }
    }

    #[test]
    fn every_entry_of_a_sample_has_its_name() {
        let columns = Columns::new(&names("tip.x"), true, true);
        let mut samples = columns.empty();
        let sample = Sample {
            time_s: 0.5,
            time_step_s: 0.1,
            x: &[1.0, 2.0, 3.0, 4.0],
            velocity: &[3.5, 4.0],
            multipliers: &[5.0],
            u: &[8.0, 8.5],
            y: &[1.5],
            energy: Some([6.0, 7.0]),
            reference: Some(Reference {
                x: &[0.5, 0.0, 0.0, 0.0],
                u: &[9.0, 9.5],
                error: &[0.5, 2.0, 3.0, 4.0],
            }),
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
        // Each of them, and the time.
        assert_eq!(samples.columns.len() + 1, columns.count());
        assert!(samples.signal("error.tau").unwrap_err().contains("`error.tau`"));
    }

    #[test]
    fn what_was_not_sent_is_not_a_number() {
        let columns = Columns::new(&names("tip.x"), false, true);
        let mut samples = columns.empty();
        let sample = Sample {
            time_s: 0.0,
            time_step_s: 0.1,
            x: &[1.0],
            velocity: &[],
            multipliers: &[],
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
