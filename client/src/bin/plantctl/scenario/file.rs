//! Scenario files, and the cases that they stand for.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, ensure};
use plantd_scene::{in_plain_words, line_of};
use schemars::JsonSchema;
use serde::Deserialize;

use crate::input::numbers::Vector;
use crate::scenario::distribution::{Distribution, case_seed};
use plantd_expect::Expectation;
use plantd_expect::Expression;

/// Most cases of one scenario.
const CASES_MAX: usize = 100_000;
/// Most samples that are kept of one case.
const STEPS_MAX: f64 = 1e7;

/// A plant, a controller, what happens to them, and what is expected.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct Scenario {
    /// Name in reports; that of the file if not given.
    pub(crate) name: Option<String>,
    /// One sentence for people.
    #[serde(default)]
    pub(crate) description: String,
    /// Seed of all random numbers.
    #[serde(default)]
    pub(crate) seed: u64,
    /// Plant time to run for, s.
    pub(crate) duration_s: f64,
    /// Time on the clock after which a case is given up, s.
    #[serde(default = "default_timeout")]
    pub(crate) timeout_s: f64,
    /// Who decides when the plant takes a step.
    #[serde(default)]
    pub(crate) pace: Pace,
    /// Seconds of plant time in a second on the clock. If not given: in lockstep as fast as possible, else
    /// 1.
    pub(crate) speed: Option<f64>,
    /// What a paced plant does without a valid input: a message `InputPolicy` of the contract.
    #[serde(default)]
    #[schemars(with = "BTreeMap<String, serde_json::Value>")]
    pub(crate) input_policy: toml::Table,
    /// Judge a run although samples of it were lost.
    #[serde(default)]
    pub(crate) may_lose_samples: bool,
    /// The plant.
    pub(crate) plant: Plant,
    /// What the motion is compared with: the signals `ref(...)` and `error(...)`.
    pub(crate) reference: Option<Reference>,
    /// Who gives the inputs; nobody if not given.
    #[serde(default)]
    pub(crate) controller: Controller,
    /// Sensors and actuators: a message `Channels` of the contract. Its seed is the case's unless given.
    #[serde(default)]
    #[schemars(with = "BTreeMap<String, serde_json::Value>")]
    pub(crate) channels: toml::Table,
    /// What happens on the way.
    #[serde(default)]
    pub(crate) events: Vec<Event>,
    /// A table of cases.
    #[serde(default)]
    pub(crate) cases: Vec<Row>,
    /// Cases with random initial states and parameters.
    pub(crate) random: Option<Random>,
    /// What must come true in every case.
    pub(crate) expect: Vec<Expectation>,
    /// Further signals for the plots of a report.
    #[serde(default)]
    pub(crate) plot: Vec<Expression>,
}

fn default_timeout() -> f64 {
    60.0
}

/// Who decides when a plant takes a step.
#[derive(Clone, Copy, Debug, Default, Deserialize, JsonSchema, PartialEq, Eq)]
#[serde(rename_all = "snake_case")]
pub(crate) enum Pace {
    /// Its driver: the plant waits for each input.
    #[default]
    Lockstep,
    /// The wall clock: the plant waits for nobody.
    Paced,
}

/// The plant.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub(crate) struct Plant {
    /// Name of a model of the server.
    pub(crate) model: Option<String>,
    /// Instead: file of a scene, beside the scenario.
    pub(crate) scene: Option<PathBuf>,
    /// Time step, s; the scene's if not given. `dt` is the same.
    #[serde(alias = "dt")]
    pub(crate) time_step_s: Option<f64>,
    /// All forces at the start of a step.
    pub(crate) paper: bool,
    /// Order of accuracy.
    pub(crate) order: Option<u32>,
    /// Steps of the method in a time step.
    pub(crate) substeps: Option<u32>,
    /// How often a time step that cannot be solved is halved.
    pub(crate) halvings: Option<u32>,
    /// Stop the solver at eleven digits.
    pub(crate) fast: bool,
    /// Where it starts; the scene's initial configuration at rest if not given.
    pub(crate) initial: Initial,
    /// Numbers of the scene by their paths.
    pub(crate) parameters: BTreeMap<String, f64>,
}

/// An initial state: that of an operating point, or of the scene, with some entries changed.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub(crate) struct Initial {
    /// Operating point.
    pub(crate) at: Option<String>,
    /// Coordinates, m or rad.
    pub(crate) q: BTreeMap<String, f64>,
    /// Velocities, m/s or rad/s.
    pub(crate) v: BTreeMap<String, f64>,
    /// Instead: discrete momenta of dynamic coordinates.
    pub(crate) p: BTreeMap<String, f64>,
    /// Move the configuration onto the constraints; the coordinates given in `q` keep their values.
    pub(crate) project: bool,
}

/// What the motion is compared with.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub(crate) enum Reference {
    /// An operating point of the scene.
    At(String),
    /// The trajectory of this file, beside the scenario: a result of `plantctl optimize --save`. After
    /// its end it stays at its last state.
    Trajectory(PathBuf),
}

/// Who gives the inputs.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case", deny_unknown_fields)]
pub(crate) enum Controller {
    /// Inputs by name: constants, or columns of a table.
    Inputs(Inputs),
    /// Linear-quadratic regulator about the reference, in the plant's own loop.
    Lqr(Lqr),
    /// A process, started for each case.
    Command(Command),
    /// Somebody else: drives the plants whose ids begin with the name of the scenario.
    External(External),
}

impl Default for Controller {
    fn default() -> Self {
        Self::Inputs(Inputs::default())
    }
}

/// Inputs that do not depend on the state. Forces that are not named are zero, prescribed coordinates stay.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub(crate) struct Inputs {
    /// Constant values.
    pub(crate) constant: BTreeMap<String, f64>,
    /// File beside the scenario: comma-separated values, a head of names, a row per step; the last row
    /// holds on.
    pub(crate) table: Option<PathBuf>,
}

/// Weights of a regulator.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct Lqr {
    /// Diagonal of the state weight: a list, in which one number stands for all, or a table by name, in which what is
    /// not named has 1.
    pub(crate) q: Vector,
    /// Diagonal of the input weight, in the same way.
    pub(crate) r: Vector,
    /// Compute the gain anew when parameters change. Along a trajectory it always is.
    #[serde(default)]
    pub(crate) adapts: bool,
    /// Weigh the projected momentum in place of the state's own.
    #[serde(default)]
    pub(crate) projected_momentum: bool,
}

/// A process that drives the plant.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct Command {
    /// Program and arguments, run in the scenario's folder. `{address}`, `{plant}`, `{seed}`, `{steps}`,
    /// `{duration_s}` and `{link_root}` are replaced.
    pub(crate) run: Vec<String>,
    /// Open the shared-memory link of the plant.
    #[serde(default)]
    pub(crate) link: bool,
    /// Further environment variables.
    #[serde(default)]
    pub(crate) env: BTreeMap<String, String>,
}

/// A controller that is there already.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct External {
    /// Open the shared-memory link of the plant.
    #[serde(default)]
    pub(crate) link: bool,
}

/// Something that happens at a time: new parameters, forces that add to the inputs, or a fault.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct Event {
    /// When, s of plant time; from the step that begins then.
    pub(crate) at_s: f64,
    /// For how long, s; not of parameters. To the end if not given.
    pub(crate) for_s: Option<f64>,
    /// Numbers of the scene by their paths.
    #[serde(default)]
    pub(crate) parameters: BTreeMap<String, f64>,
    /// Forces that are added to inputs.
    #[serde(default)]
    pub(crate) inputs: BTreeMap<String, f64>,
    /// A fault of a sensor or an actuator, or a push: a message `FaultSpec` of the contract without its
    /// times.
    #[serde(default)]
    #[schemars(with = "BTreeMap<String, serde_json::Value>")]
    pub(crate) fault: toml::Table,
}

/// What differs in one case.
#[derive(Clone, Debug, Default, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields, default)]
pub(crate) struct Row {
    /// Name of the case.
    pub(crate) name: String,
    /// Initial coordinates, m or rad.
    pub(crate) q: BTreeMap<String, f64>,
    /// Initial velocities, m/s or rad/s.
    pub(crate) v: BTreeMap<String, f64>,
    /// Initial discrete momenta.
    pub(crate) p: BTreeMap<String, f64>,
    /// Numbers of the scene by their paths.
    pub(crate) parameters: BTreeMap<String, f64>,
}

/// Random cases.
#[derive(Clone, Debug, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub(crate) struct Random {
    /// How many.
    pub(crate) cases: u32,
    /// Initial coordinates, m or rad.
    #[serde(default)]
    pub(crate) q: BTreeMap<String, Distribution>,
    /// Initial velocities, m/s or rad/s.
    #[serde(default)]
    pub(crate) v: BTreeMap<String, Distribution>,
    /// Initial discrete momenta.
    #[serde(default)]
    pub(crate) p: BTreeMap<String, Distribution>,
    /// Numbers of the scene by their paths.
    #[serde(default)]
    pub(crate) parameters: BTreeMap<String, Distribution>,
}

/// A case to run.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Case {
    /// Name within the scenario; empty for the only one.
    pub(crate) name: String,
    /// Seed for whatever else is random in it.
    pub(crate) seed: u64,
    /// Initial coordinates.
    pub(crate) q: BTreeMap<String, f64>,
    /// Initial velocities.
    pub(crate) v: BTreeMap<String, f64>,
    /// Initial momenta.
    pub(crate) p: BTreeMap<String, f64>,
    /// Parameters.
    pub(crate) parameters: BTreeMap<String, f64>,
}

impl Scenario {
    /// Reads a file. Errors name the file and the key.
    pub(crate) fn read(path: &Path) -> Result<Self> {
        let text = std::fs::read_to_string(path)
            .with_context(|| format!("cannot read {}", path.display()))?;
        Self::parse(&text).with_context(|| path.display().to_string())
    }

    /// Reads a text.
    pub(crate) fn parse(text: &str) -> Result<Self> {
        let deserializer =
            toml::Deserializer::parse(text).map_err(|error| located("", &error, text))?;
        let scenario: Self = serde_path_to_error::deserialize(deserializer)
            .map_err(|error| located(&error.path().to_string(), error.inner(), text))?;
        scenario.check()?;
        Ok(scenario)
    }

    /// Refuses what needs no server to be known as wrong.
    fn check(&self) -> Result<()> {
        let positive = |key: &str, x: f64| {
            ensure!(x > 0.0 && x.is_finite(), "{key} is {x}; it must be greater than zero");
            Ok(())
        };
        positive("duration_s", self.duration_s)?;
        positive("timeout_s", self.timeout_s)?;
        self.speed.map_or(Ok(()), |speed| positive("speed", speed))?;
        let Plant { model, scene, initial, .. } = &self.plant;
        ensure!(model.is_some() != scene.is_some(), "plant: give either `model` or `scene`");
        ensure!(
            initial.v.is_empty() || initial.p.is_empty(),
            "plant.initial: give either `v` or `p`"
        );
        ensure!(
            !initial.project || (initial.v.is_empty() && initial.p.is_empty()),
            "plant.initial.project: a plant that is projected starts at rest"
        );
        match &self.controller {
            Controller::Lqr(_) => {
                ensure!(self.reference.is_some(), "controller.lqr: a `reference` is needed");
            }
            Controller::Command(command) => {
                ensure!(!command.run.is_empty(), "controller.command.run: a program is needed");
            }
            Controller::Inputs(inputs) => ensure!(
                self.pace == Pace::Lockstep || inputs.table.is_none(),
                "controller.inputs.table: a table needs lockstep"
            ),
            Controller::External(_) => {}
        }
        let is_paced = self.pace == Pace::Paced;
        ensure!(is_paced || self.input_policy.is_empty(), "input_policy: is for paced plants");
        let wall_s = self.duration_s / self.speed.unwrap_or(1.0);
        ensure!(
            !(is_paced || self.speed.is_some()) || wall_s < self.timeout_s,
            "timeout_s is {}; the run takes {wall_s} s on the clock",
            self.timeout_s
        );
        ensure!(!self.expect.is_empty(), "expect: at least one expectation is needed");
        for (i, expectation) in self.expect.iter().enumerate() {
            let key = || format!("expect[{i}].{}", expectation.key());
            expectation.check(self.duration_s).map_err(anyhow::Error::msg).with_context(key)?;
        }
        for (i, event) in self.events.iter().enumerate() {
            let Event { at_s, for_s, parameters, inputs, fault } = event;
            let is_inside = |t: f64| (0.0..=self.duration_s).contains(&t);
            ensure!(
                is_inside(*at_s),
                "events[{i}].at_s is {at_s}; it must lie within the duration"
            );
            ensure!(
                for_s.is_none_or(|for_s| for_s > 0.0),
                "events[{i}].for_s must be greater than zero"
            );
            let given = [parameters.is_empty(), inputs.is_empty(), fault.is_empty()];
            ensure!(
                given.into_iter().filter(|is_empty| !is_empty).count() == 1,
                "events[{i}]: give one of `parameters`, `inputs` and `fault`"
            );
            ensure!(
                for_s.is_none() || parameters.is_empty(),
                "events[{i}].for_s: parameters stay; change them back by another event"
            );
        }
        let mut names: Vec<_> = self.cases.iter().map(|row| &row.name).collect();
        names.sort();
        ensure!(names.iter().all(|name| !name.is_empty()), "cases: every case needs a name");
        if let Some(pair) = names.windows(2).find(|pair| pair[0] == pair[1]) {
            anyhow::bail!("cases: `{}` is the name of two", pair[0]);
        }
        let count =
            self.cases.len() + self.random.as_ref().map_or(0, |random| random.cases as usize);
        ensure!(count <= CASES_MAX, "{count} cases; at most {CASES_MAX} are run");
        if let Some(random) = &self.random {
            ensure!(random.cases > 0, "random.cases: at least one case is needed");
            let all = [&random.q, &random.v, &random.p, &random.parameters];
            for (name, distribution) in all.into_iter().flatten() {
                let checked = distribution.check().map_err(anyhow::Error::msg);
                checked.with_context(|| format!("random, `{name}`"))?;
            }
        }
        Ok(())
    }

    /// Whether the plant is stepped by the one who runs the scenario, rather than watched.
    pub(crate) fn is_stepped(&self) -> bool {
        let is_own = matches!(self.controller, Controller::Inputs(_) | Controller::Lqr(_));
        is_own && self.pace == Pace::Lockstep
    }

    /// Number of steps of so many seconds.
    pub(crate) fn steps(&self, time_step_s: f64) -> Result<u64> {
        let steps = (self.duration_s / time_step_s).round();
        ensure!(
            (1.0..=STEPS_MAX).contains(&steps),
            "duration_s is {}: {steps} steps of {time_step_s} s; 1 to {STEPS_MAX} can be run",
            self.duration_s
        );
        Ok(steps as u64)
    }

    /// All cases: those of the table, then random ones; a single one if there are neither.
    pub(crate) fn cases(&self) -> Vec<Case> {
        let initial = &self.plant.initial;
        let base = |name: &str, number: u64| Case {
            name: name.to_owned(),
            seed: case_seed(self.seed, number),
            q: initial.q.clone(),
            v: initial.v.clone(),
            p: initial.p.clone(),
            parameters: self.plant.parameters.clone(),
        };
        let mut cases = Vec::new();
        for (number, row) in (0..).zip(&self.cases) {
            let mut case = base(&row.name, number);
            for (all, changed) in [
                (&mut case.q, &row.q),
                (&mut case.v, &row.v),
                (&mut case.p, &row.p),
                (&mut case.parameters, &row.parameters),
            ] {
                all.extend(changed.iter().map(|(name, value)| (name.clone(), *value)));
            }
            cases.push(case);
        }
        if let Some(random) = &self.random {
            for draw in 0..random.cases {
                let number = self.cases.len() as u64 + u64::from(draw);
                let mut case = base(&format!("random-{draw}"), number);
                for (all, what, drawn) in [
                    (&mut case.q, "q", &random.q),
                    (&mut case.v, "v", &random.v),
                    (&mut case.p, "p", &random.p),
                    (&mut case.parameters, "parameters", &random.parameters),
                ] {
                    for (name, distribution) in drawn {
                        let value = distribution.draw(case.seed, &format!("{what}.{name}"));
                        all.insert(name.clone(), value);
                    }
                }
                cases.push(case);
            }
        }
        if cases.is_empty() {
            cases.push(base("", 0));
        }
        cases
    }

    /// The JSON Schema of the format.
    pub(crate) fn schema() -> serde_json::Value {
        schemars::schema_for!(Scenario).to_value()
    }
}

/// An error of the text, with its key and its place.
fn located(key: &str, error: &toml::de::Error, text: &str) -> anyhow::Error {
    let key = if key.is_empty() || key == "." { String::new() } else { format!("{key}: ") };
    let problem = in_plain_words(error.message());
    let Some(span) = error.span() else { return anyhow::anyhow!("{key}{problem}") };
    anyhow::anyhow!("line {}: {key}{problem}", line_of(text, span.start))
}

#[cfg(test)]
mod tests {
    use super::*;

    const LEAST: &str = "duration_s = 2\nplant.model = 'pendulum'\n";
    const EXPECT: &str = "[[expect]]\nno_failures = true\n";

    #[track_caller]
    fn parse(rest: &str) -> Scenario {
        Scenario::parse(&format!("{LEAST}{rest}\n{EXPECT}")).unwrap()
    }

    #[test]
    fn errors_name_their_key() {
        Scenario::parse(&format!("{LEAST}{EXPECT}")).unwrap();
        for (rest, part) in [
            ("durations = 3", "there is no key `durations`"),
            ("plant.modell = 'a'", "plant.modell: there is no key `modell`; did you mean `model`?"),
            (
                "plant.order = 'two'",
                "plant.order: string \"two\" is given; a whole number that is not negative is needed",
            ),
            ("plant.scene = 'a.toml'", "plant: give either"),
            ("speed = 0", "speed is 0"),
            ("timeout_s = inf", "timeout_s is inf"),
            ("plant.initial = { v = { a = 1 }, p = { a = 1 } }", "plant.initial: give either"),
            ("plant.initial = { v = { a = 1 }, project = true }", "plant.initial.project"),
            ("controller.lqr = { q = [1], r = [1] }", "a `reference` is needed"),
            ("controller.command = { run = [] }", "a program is needed"),
            ("controller.pid = { k = 1 }", "there is no `pid`"),
            ("pace = 'slow'", "pace: there is no `slow`; there are `lockstep`, `paced`"),
            ("pace = 'paced'\ntimeout_s = 2", "the run takes 2 s"),
            ("speed = 0.01", "the run takes 200 s"),
            ("input_policy = { timeout_s = 1 }", "input_policy: is for paced"),
            (
                "pace = 'paced'\ncontroller.inputs.table = 'a.csv'",
                "controller.inputs.table: a table needs lockstep",
            ),
            ("events = [{ at_s = 3, inputs = { tau = 1 } }]", "events[0].at_s is 3"),
            ("events = [{ at_s = 1 }]", "events[0]: give one of"),
            (
                "events = [{ at_s = 1, inputs = { a = 1 }, fault = { stuck = true } }]",
                "events[0]: give one of",
            ),
            ("events = [{ at_s = 1, for_s = 1, parameters = { a = 1 } }]", "events[0].for_s"),
            ("cases = [{ name = 'a' }, { name = 'b' }, { name = 'a' }]", "`a` is the name of two"),
            ("cases = [{ q = { theta = 1 } }]", "every case needs a name"),
            ("random = { cases = 0 }", "random.cases"),
            ("random = { cases = 200000 }", "200000 cases"),
            ("random = { cases = 1, q = { a = { uniform = [2, 1] } } }", "random, `a`"),
            ("plot = ['theta +']", "plot[0]: "),
        ] {
            let error = Scenario::parse(&format!("{LEAST}{rest}\n{EXPECT}")).unwrap_err();
            let error = format!("{error:#}");
            assert!(error.contains(part), "{rest}: {error}");
        }
        let none = Scenario::parse(&format!("{LEAST}expect = []")).unwrap_err().to_string();
        assert!(none.contains("at least one expectation"), "{none}");
        let late = "[[expect]]\nsettles = { signal = 'a', to = 1, within = 1, by_s = 3 }";
        let error = format!("{:#}", Scenario::parse(&format!("{LEAST}{late}")).unwrap_err());
        assert!(error.contains("expect[0].settles: by_s is 3"), "{error}");
        let typo = "[[expect]]\nsettles = { signal = 'a', to = 1, with = 1, by_s = 3 }";
        let error = format!("{:#}", Scenario::parse(&format!("{LEAST}{typo}")).unwrap_err());
        assert!(error.contains("expect[0].settles") && error.contains("line 4"), "{error}");
    }

    #[test]
    fn cases_are_the_rows_and_the_draws() {
        let single = parse("seed = 5\nplant.initial.q = { theta = 0.5 }").cases();
        assert_eq!((single.len(), single[0].name.as_str()), (1, ""));
        assert_eq!(single[0].q["theta"], 0.5);
        let text = "seed = 5\nplant.initial.q = { theta = 0.5 }\n\
                    cases = [{ name = 'far', q = { theta = 2 } }, { name = 'heavy' }]\n\
                    random = { cases = 3, q = { theta = { uniform = [1, 2] } } }";
        let cases = parse(text).cases();
        let names: Vec<_> = cases.iter().map(|case| case.name.as_str()).collect();
        assert_eq!(names, ["far", "heavy", "random-0", "random-1", "random-2"]);
        assert_eq!((cases[0].q["theta"], cases[1].q["theta"]), (2.0, 0.5));
        assert!(cases[2..].iter().all(|case| (1.0..2.0).contains(&case.q["theta"])));
        assert!(cases.windows(2).all(|pair| pair[0].seed != pair[1].seed));
        assert_eq!(parse(text).cases(), cases);
        let other = parse(&text.replace("seed = 5", "seed = 6")).cases();
        assert_ne!(other[2].q, cases[2].q);
    }

    #[test]
    fn steps_are_whole() {
        let scenario = parse("");
        assert_eq!(scenario.steps(0.1).unwrap(), 20);
        assert!(scenario.steps(5.0).is_err() && scenario.steps(1e-9).is_err());
    }

    /// `PLANTD_BLESS=1` rewrites the committed schema.
    #[test]
    fn committed_schema_is_current() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/scenarios/scenario.schema.json");
        let current = serde_json::to_string_pretty(&Scenario::schema()).unwrap() + "\n";
        if std::env::var_os("PLANTD_BLESS").is_some() {
            std::fs::write(path, &current).unwrap();
        }
        assert_eq!(std::fs::read_to_string(path).unwrap(), current, "run with PLANTD_BLESS=1");
    }
}
