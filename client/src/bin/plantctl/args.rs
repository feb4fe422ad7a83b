//! The command line.

use std::path::PathBuf;

use clap::{Args as Group, Parser, Subcommand, ValueEnum};
use plantd_client::{DEFAULT_ADDRESS, v1};

const EXAMPLES: &str = "\
Examples:
  plantctl list                                     models and plants of the server
  plantctl create pendulum --id p1 --at upright     a plant at a named operating point
  plantctl step p1 --u 0.1 --count 100              100 steps with the input 0.1
  plantctl watch p1 --fields state,energy --json    one JSON object per step
  plantctl linearize cart-pole --at upright         A and B of x[k+1] = f(x[k], u[k])
  plantctl lqr cart-pole --at upright --q 100,1,1,1 --r 0.1
  plantctl analyze cart-pole --at hanging --outputs theta --frequencies 0.1,0.5,1
  plantctl settle four-bar --guess crank=0.3 --toml  an operating point to paste into the scene
  plantctl validate arm.toml                        all errors of a scene, with their paths
  plantctl --address unix:/run/plantd/plantd.sock list plants";

const EXIT_CODES: &str = "\
Data goes to standard output, messages to standard error.

Exit codes:
  0  done
  1  refused by the server, or failed; `validate`: the scene has errors
  2  wrong usage
  3  no server at the address";

/// Looks at, drives and asks a plantd server.
#[derive(Debug, Parser)]
#[command(version, before_help = EXAMPLES, after_help = EXIT_CODES, max_term_width = 100)]
pub(crate) struct Args {
    /// Server: http://host:port or unix:/path.
    #[arg(long, global = true, env = "PLANTD_ADDRESS", default_value = DEFAULT_ADDRESS)]
    pub(crate) address: String,
    /// Print JSON, in the field names of the contract; streams print one object per line.
    #[arg(long, global = true)]
    pub(crate) json: bool,
    #[command(subcommand)]
    pub(crate) command: Command,
}

#[derive(Debug, Subcommand)]
pub(crate) enum Command {
    /// Lists models, plants, or both.
    List {
        /// What to list; both if not given.
        what: Option<Plural>,
    },
    /// Shows one model or plant.
    Show {
        /// What it is.
        what: Singular,
        /// Name of the model or id of the plant.
        name: String,
    },
    /// Uploads a scene (TOML or JSON) as a model.
    Upload {
        /// File; `-` reads standard input.
        scene: PathBuf,
        /// Name; the scene's own if not given.
        #[arg(long)]
        name: Option<String>,
    },
    /// Creates a plant.
    Create {
        /// Name of a model.
        model: String,
        /// Id; chosen by the server if not given.
        #[arg(long)]
        id: Option<String>,
        #[command(flatten)]
        settings: Settings,
        #[command(flatten)]
        initial: Initial,
        /// Open the shared-memory link at once.
        #[arg(long)]
        link: bool,
    },
    /// Takes steps.
    Step {
        /// Plant.
        id: String,
        /// Input of a step, comma-separated: input forces, then next prescribed positions. Repeat
        /// it for several steps. Without it there are no forces and prescribed coordinates stay.
        #[arg(long, value_parser = numbers, allow_hyphen_values = true)]
        u: Vec<Numbers>,
        /// Number of steps; those after the last `--u` repeat it.
        #[arg(long, short = 'n')]
        count: Option<u32>,
        /// Print every state, not only the last.
        #[arg(long)]
        all: bool,
    },
    /// Prints what a plant does while somebody drives it. Ends with Ctrl-C or after `--count`.
    Watch {
        /// Plant.
        id: String,
        /// What to print.
        #[arg(long, value_delimiter = ',', default_value = "state")]
        fields: Vec<Field>,
        /// Only steps divisible by this.
        #[arg(long, default_value_t = 1)]
        every: u32,
        /// Coordinates to print, comma-separated; all if not given.
        #[arg(long, value_delimiter = ',')]
        coordinates: Vec<String>,
        /// End after this many messages.
        #[arg(long, short = 'n')]
        count: Option<u64>,
        #[command(flatten)]
        weights: Weights,
    },
    /// Linearizes the discrete map of a model: `dx[k+1] = A dx[k] + B du[k]`.
    Linearize {
        #[command(flatten)]
        point: Point,
        #[command(flatten)]
        settings: Settings,
    },
    /// Solves the infinite-horizon linear-quadratic regulator about an equilibrium.
    Lqr {
        #[command(flatten)]
        point: Point,
        #[command(flatten)]
        settings: Settings,
        #[command(flatten)]
        weights: Weights,
        /// Solve on the full state of a constrained model instead of on its manifold.
        #[arg(long)]
        full: bool,
    },
    /// Second derivatives of the discrete map: all tensors, or contracted with weights.
    SecondOrder {
        #[command(flatten)]
        point: Point,
        #[command(flatten)]
        settings: Settings,
        /// Weights of the entries of x[k+1], comma-separated: print the contraction.
        #[arg(long, value_name = "Z", value_parser = numbers, allow_hyphen_values = true)]
        weights: Option<Numbers>,
        /// Weights of the constraint multipliers, comma-separated: print the contraction.
        #[arg(long, value_name = "Z", value_parser = numbers, allow_hyphen_values = true)]
        multiplier_weights: Option<Numbers>,
    },
    /// Accelerations and constraint forces of continuous time, and their derivatives.
    Dynamics {
        /// Name of a model.
        model: String,
        /// Operating point whose configuration and inputs hold where others are not given.
        #[arg(long, value_name = "POINT", default_value = "initial")]
        at: String,
        /// Configuration, comma-separated, dynamic coordinates first.
        #[arg(long, value_parser = numbers, allow_hyphen_values = true)]
        q: Option<Numbers>,
        /// Velocity, comma-separated; zero if not given.
        #[arg(long, value_parser = numbers, allow_hyphen_values = true)]
        v: Option<Numbers>,
        /// Input forces, comma-separated.
        #[arg(long, value_parser = numbers, allow_hyphen_values = true)]
        inputs: Option<Numbers>,
        /// Accelerations of the prescribed coordinates, comma-separated; zero if not given.
        #[arg(long, value_parser = numbers, allow_hyphen_values = true)]
        prescribed_acceleration: Option<Numbers>,
        /// Highest order of the derivatives to print.
        #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(0..=2))]
        order: u32,
    },
    /// Controllability, observability, modes and frequency response of the linearized map.
    Analyze {
        #[command(flatten)]
        point: Point,
        #[command(flatten)]
        settings: Settings,
        /// Outputs, comma-separated entries of x such as `theta` or `p(theta)`; all if not given.
        #[arg(long, value_delimiter = ',')]
        outputs: Vec<String>,
        /// Frequencies of the response, comma-separated, Hz.
        #[arg(long, value_name = "HZ", value_parser = numbers)]
        frequencies: Option<Numbers>,
        /// Look at the full state of a constrained model instead of at its manifold.
        #[arg(long)]
        full: bool,
    },
    /// Finds a configuration in which a model rests, from a guess.
    Settle {
        /// Name of a model.
        model: String,
        /// Coordinates that keep their value of the guess, comma-separated.
        #[arg(long, value_delimiter = ',')]
        hold: Vec<String>,
        /// Values of coordinates of the guess; the scene's initial ones if not given.
        #[arg(long, num_args = 1.., value_name = "NAME=VALUE", value_parser = assignment)]
        guess: Vec<Assignment>,
        /// Input forces that act.
        #[arg(long, num_args = 1.., value_name = "NAME=VALUE", value_parser = assignment)]
        inputs: Vec<Assignment>,
        /// Only satisfy the constraints.
        #[arg(long)]
        constraints: bool,
        /// Print an operating point in the notation of a scene.
        #[arg(long)]
        toml: bool,
    },
    /// Degrees of freedom, redundant constraints, energy, momenta and forces of a state.
    Diagnose {
        /// Name of a model.
        #[arg(required_unless_present = "plant")]
        model: Option<String>,
        /// Operating point of the model.
        #[arg(long, value_name = "POINT", default_value = "initial")]
        at: String,
        /// Instead: the present state of this plant.
        #[arg(long, value_name = "ID", conflicts_with_all = ["model", "at"])]
        plant: Option<String>,
    },
    /// Checks a scene and prints all its errors.
    Validate {
        /// File; `-` reads standard input.
        scene: PathBuf,
    },
    /// Prints what a step of a model evaluates and what it skips.
    Explain {
        /// File of a scene, or name of a model.
        scene: String,
    },
    /// Puts a plant back to step 0.
    Reset {
        /// Plant.
        id: String,
        #[command(flatten)]
        initial: Initial,
    },
    /// Writes a snapshot of a plant to a file.
    Snapshot {
        /// Plant.
        id: String,
        /// File.
        file: PathBuf,
    },
    /// Restores a plant from a snapshot.
    Restore {
        /// Plant.
        id: String,
        /// File.
        file: PathBuf,
    },
    /// Deletes a plant or an uploaded model.
    Delete {
        /// What it is.
        what: Singular,
        /// Name of the model or id of the plant.
        name: String,
    },
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Plural {
    Models,
    Plants,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Singular {
    Model,
    Plant,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Field {
    State,
    Report,
    Energy,
    Linearization,
    Gain,
}

impl From<Field> for v1::WatchField {
    fn from(field: Field) -> Self {
        match field {
            Field::State => Self::State,
            Field::Report => Self::Report,
            Field::Energy => Self::Energy,
            Field::Linearization => Self::Linearization,
            Field::Gain => Self::Gain,
        }
    }
}

/// How a plant is stepped.
#[derive(Debug, Group)]
pub(crate) struct Settings {
    /// Time step in seconds; the scene's if not given.
    #[arg(long, value_name = "SECONDS")]
    dt: Option<f64>,
    /// Put all forces at the start of a step, as the paper does.
    #[arg(long)]
    paper: bool,
    /// Newton iterations before a step is given up.
    #[arg(long, value_name = "N")]
    max_iterations: Option<u32>,
    /// Reciprocal condition below which a step is refused.
    #[arg(long, value_name = "NUMBER")]
    singular_below: Option<f64>,
}

impl From<Settings> for v1::PlantSettings {
    fn from(settings: Settings) -> Self {
        let split =
            if settings.paper { v1::ForceSplit::Paper } else { v1::ForceSplit::Unspecified };
        Self {
            time_step_s: settings.dt.unwrap_or(0.0),
            force_split: split.into(),
            max_iterations: settings.max_iterations.unwrap_or(0),
            singular_below: settings.singular_below.unwrap_or(0.0),
        }
    }
}

/// Where a plant starts; the scene's initial configuration at rest if nothing is given.
#[derive(Debug, Group)]
pub(crate) struct Initial {
    /// Operating point of the scene, at rest.
    #[arg(long, value_name = "POINT", conflicts_with_all = ["q", "v", "p"])]
    at: Option<String>,
    /// Configuration, comma-separated, dynamic coordinates first.
    #[arg(long, value_parser = numbers, allow_hyphen_values = true)]
    q: Option<Numbers>,
    /// Velocity, comma-separated; zero if only `--q` is given.
    #[arg(long, requires = "q", conflicts_with = "p", value_parser = numbers, allow_hyphen_values = true)]
    v: Option<Numbers>,
    /// Discrete momentum of the dynamic coordinates, comma-separated.
    #[arg(long, requires = "q", value_parser = numbers, allow_hyphen_values = true)]
    p: Option<Numbers>,
}

impl From<Initial> for Option<v1::InitialState> {
    fn from(initial: Initial) -> Self {
        use v1::initial_state::{Form, Momentum, Velocity};
        let form = match initial {
            Initial { at: Some(point), .. } => Form::OperatingPoint(point),
            Initial { q: Some(q), p: Some(p), .. } => {
                Form::Momentum(Momentum { q: q.0, p: p.0, v: Vec::new() })
            }
            Initial { q: Some(q), v, .. } => {
                let rest = || vec![0.0; q.0.len()];
                let v = v.map_or_else(rest, |v| v.0);
                Form::Velocity(Velocity { q: q.0, v })
            }
            _ => return None,
        };
        Some(v1::InitialState { form: Some(form) })
    }
}

/// A model and a point of its map.
#[derive(Debug, Group)]
pub(crate) struct Point {
    /// Name of a model.
    #[arg(required_unless_present = "plant")]
    pub(crate) model: Option<String>,
    /// Operating point.
    #[arg(long, value_name = "POINT", default_value = "initial")]
    pub(crate) at: String,
    /// Instead: the model, the settings and the present state of this plant.
    #[arg(long, value_name = "ID", conflicts_with_all = ["model", "at", "dt", "paper", "max_iterations", "singular_below"])]
    pub(crate) plant: Option<String>,
}

/// Weights of a regulator.
#[derive(Debug, Group)]
pub(crate) struct Weights {
    /// Diagonal of the state weight, comma-separated; one number stands for all.
    #[arg(long = "q", value_name = "Q", value_parser = numbers, default_value = "1")]
    pub(crate) q: Numbers,
    /// Diagonal of the input weight, comma-separated; one number stands for all.
    #[arg(long = "r", value_name = "R", value_parser = numbers, default_value = "1")]
    pub(crate) r: Numbers,
}

impl Weights {
    /// The weights for a model; lengths are for the server to judge.
    pub(crate) fn for_model(&self, model: &v1::Model) -> v1::LqrWeights {
        let prescribed = model.coordinates.iter().filter(|c| c.prescribed).count();
        let weight = |numbers: &Numbers, count| match numbers.0.as_slice() {
            [value] => plantd_client::diagonal(vec![*value; count]),
            values => plantd_client::diagonal(values),
        };
        v1::LqrWeights {
            q: Some(weight(&self.q, 2 * model.coordinates.len())),
            r: Some(weight(&self.r, model.inputs.len() + prescribed)),
            ..Default::default()
        }
    }
}

/// Comma-separated numbers.
#[derive(Clone, Debug)]
pub(crate) struct Numbers(pub(crate) Vec<f64>);

fn numbers(text: &str) -> Result<Numbers, String> {
    let number = |entry: &str| {
        entry.trim().parse().map_err(|_| format!("`{}` is not a number", entry.trim()))
    };
    text.split(',').map(number).collect::<Result<_, _>>().map(Numbers)
}

/// A named value.
#[derive(Clone, Debug)]
pub(crate) struct Assignment(pub(crate) String, pub(crate) f64);

fn assignment(text: &str) -> Result<Assignment, String> {
    let (name, value) = text.split_once('=').ok_or("a name and a value with `=` are needed")?;
    let number = value.trim().parse();
    let number = number.map_err(|_| format!("`{}` is not a number", value.trim()))?;
    Ok(Assignment(name.trim().to_owned(), number))
}

#[cfg(test)]
mod tests {
    use clap::CommandFactory as _;

    use super::*;

    #[test]
    fn the_command_line_is_consistent() {
        Args::command().debug_assert();
    }

    #[test]
    fn numbers_may_be_negative_and_name_the_culprit() {
        let args = Args::try_parse_from(["plantctl", "step", "p", "--u", "-1,2e-3", "--u", "0,0"]);
        let Command::Step { u, .. } = args.unwrap().command else { panic!("not a step") };
        assert_eq!((u[0].0.as_slice(), u.len()), ([-1.0, 2e-3].as_slice(), 2));
        assert!(numbers("1,x").unwrap_err().contains("`x`"));
    }
}
