//! The command line.

use std::path::PathBuf;

use clap::{Args as Group, Parser, Subcommand, ValueEnum};
use plantd_client::v1;

use crate::replay::RecordCommand;
use crate::{channels, run, test};

const EXAMPLES: &str = "\
Examples:
  plantctl list                                     models and plants of the server
  plantctl create pendulum --id p1 --at upright     a plant at a named operating point
  plantctl step p1 --u 0.1 --count 100              100 steps with the input 0.1
  plantctl watch p1 --fields state,energy --json    one JSON object per step
  plantctl linearize cart-pole --at upright         A and B of x[k+1] = f(x[k], u[k])
  plantctl lqr cart-pole --at upright --q 100,1,1,1 --r 0.1
  plantctl analyze cart-pole --at hanging --outputs theta --frequencies 0.1,0.5,1
  plantctl optimize swing-up.toml --save best.json  one line per iteration, then the result
  plantctl kalman cart-pole --at upright --outputs x,theta --measurement 1e-4 --process 1e-6
  plantctl set-parameter p1 'frames[pole].body.mass=1.2'
  plantctl feedback set p1 --at upright --q 100,1 --r 1 --mode replace
  plantctl channels set p1 sensors.toml             sensors and actuators of a plant
  plantctl fault inject p1 input=tau stuck=true start_s=2 duration_s=0.5
  plantctl settle four-bar --guess crank=0.3 --toml  an operating point to paste into the scene
  plantctl validate arm.toml                        all errors of a scene, with their paths
  plantctl record start p1 --name trial             then `record stop trial`, `record get trial`
  plantctl replay trial.mcap                        the same steps again, compared bit for bit
  plantctl export trial.mcap --csv trial.csv
  plantctl test scenarios --junit junit.xml         scenarios with their expectations
  plantctl --address unix:/run/plantd/plantd.sock list plants";

const EXIT_CODES: &str = "\
Data goes to standard output, messages to standard error.

Exit codes:
  0  done
  1  refused by the server, or failed; `validate`: the scene has errors; `replay`: a step differs
  2  wrong usage
  3  no server at the address";

pub(crate) const PROBLEM: &str = "\
The problem, here the swing-up of a pendulum; only model, steps and cost must be there:

  model = \"pendulum\"
  steps = 100
  time_step_s = 0.1                 # the scene's if not given
  paper = false                     # all forces at the start of a step
  order = 2                         # of accuracy
  substeps = 1                      # steps in a time step
  halvings = 8                      # how often a time step that cannot be solved is halved
  fast = false                      # stop the solver at eleven digits

  [initial]                         # the scene's initial configuration if not given
  q = [0.0]                         # with p and v; or an operating point: at = \"hanging\"

  [cost]                            # 1/2 dx' q dx + dx' s du + 1/2 du' r du
  q = [1000.0, 1.0]                 # a diagonal, or a matrix as a list of rows
  r = [50.0]
  q_final = [1000.0, 1.0]           # q if not given
  x = [[0.0, 0.0]]                  # desired states, one row per step; the last one holds on
  u = [[0.0]]                       # desired inputs, the same way; zero if not given
  changes = [{ step = 50, x = [3.141592653589793, 0.0] }]   # other desired states from there on

  [guess]
  u = [[0.0]]                       # inputs, the last row holds on; if not given no forces, and
                                    # prescribed coordinates stay
  [bounds]
  state = { theta = [-4.0, 4.0] }   # inf and -inf for no bound
  input = { tau = [-5.0, 5.0] }
  final_state = { theta = [3.14, 3.15] }

  [free_initial]
  entries = [\"theta\"]
  weight = [1.0, 1.0]

  [options]                         # names and defaults of OptimizationOptions in the contract
  first_method = \"quasi-newton\"
  first_iterations = 4
  max_iterations = 50
  projection = { q = [1.0, 1.0], r = [1.0] }";

const CHANNELS: &str = "\
The file, in the field names of the contract, TOML or JSON; here for a pendulum:

  seed = 7                          # of all noise and chance

  [[outputs]]
  name = \"encoder\"                  # source -> sampled -> + bias + noise -> quantised -> limited
  coordinate = \"theta\"              #   -> lost at times -> late
  sample_period_s = 0.1
  latency_s = 0.2
  noise = 0.001                     # standard deviation
  quantum = 0.0015
  drop_out = 0.01                   # probability

  [[outputs]]
  name = \"tip\"                      # others: velocity, acceleration, orientation,
  position = { frame = \"rod\", at = [0.0, -1.0, 0.0] }     # constraint_force, input, energy

  [[inputs]]
  input = \"tau\"                     # sampled and held -> late -> dead band -> limited
  delay_s = 0.1                     #   -> rate limited -> quantised
  min = -5.0
  max = 5.0
  max_rate = 50.0

Times become whole steps; the answer says which.";

const RUN: &str = "\
Examples:
  plantctl run arm --pace paced                     by the wall clock; its driver's latest input acts
  plantctl run arm --pace paced --speed 0.1         ten times slower
  plantctl run arm --pace paced --timeout 0.05 --action ramp --ramp 0.2 --safe 0,0
  plantctl pause arm
  plantctl run arm -n 1                             a single step";

const GUARD: &str = "\
Quantities are coordinates, v(coordinate), force(constraint) and energy; actions are freeze (if none is
given), reset and disconnect.
Examples:
  plantctl guard cart 'x<2' 'x>-2' 'energy<50:reset'
  plantctl guard cart";

const FAULTS: &str = "\
Examples:
  plantctl fault inject p1 input=tau stuck=true
  plantctl fault inject p1 input=tau offset.value=0.3 start_s=2 duration_s=0.5
  plantctl fault inject p1 output=encoder noise.deviation=0.05 chance.window_s=1 chance.probability=0.2
  plantctl fault inject p1 output=encoder loss.probability=0.1
  plantctl fault inject p1 push.point.frame=rod 'push.force=[5, 0, 0]' start_step=100 duration_s=0.1
  plantctl fault inject p1 'parameters.parameters=[{path=\"gravity[1]\", value=-1.6}]' start_s=3
  plantctl fault list p1
  plantctl fault clear p1 3";

/// Looks at, drives and asks a plantd server.
#[derive(Debug, Parser)]
#[command(version, before_help = EXAMPLES, after_help = EXIT_CODES, max_term_width = 100)]
pub(crate) struct Args {
    /// Server: http://host:port or unix:/path.
    /// http://127.0.0.1:50051 if not given; `test` then starts a server of its own.
    #[arg(long, global = true, env = "PLANTD_ADDRESS")]
    pub(crate) address: Option<String>,
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
        /// Choose order and substeps: largest error of a coordinate over the next 50 steps, rad or m.
        #[arg(long, value_name = "ERROR", conflicts_with_all = ["order", "substeps"])]
        tolerance: Option<f64>,
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
        /// Messages that may wait to be printed; of more, the oldest are lost.
        #[arg(long, value_name = "N", default_value_t = 1)]
        queue: u32,
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
    /// Finds a trajectory of least cost: prints one line per iteration, then the result.
    #[command(after_help = PROBLEM)]
    Optimize {
        /// File with the problem, TOML or JSON; `-` reads standard input.
        problem: PathBuf,
        /// Write the result to this file, as JSON.
        #[arg(long, value_name = "FILE")]
        save: Option<PathBuf>,
        /// Go on, bit for bit, where the search of this file left off: a result or a checkpoint.
        #[arg(long, value_name = "FILE", conflicts_with = "guess")]
        resume: Option<PathBuf>,
        /// Begin with the trajectory of this result.
        #[arg(long, value_name = "FILE")]
        guess: Option<PathBuf>,
        /// How a direction of descent is found, in place of the problem's `options.method`.
        #[arg(long)]
        method: Option<Method>,
        /// Iterations at most, in place of the problem's `options.max_iterations`.
        #[arg(long, value_name = "N")]
        iterations: Option<u32>,
    },
    /// Finds a motion of a model that follows configurations from elsewhere. The configurations come,
    /// and the motion goes, as comma-separated values, one row per step; what the reference is like
    /// goes to standard error.
    ProjectReference {
        /// Name of a model.
        model: String,
        /// File of configurations, a column per coordinate, with or without a head; `-` reads
        /// standard input.
        reference: PathBuf,
        /// File of planned inputs, one row less; those that fit best if not given.
        #[arg(long, value_name = "FILE")]
        u: Option<PathBuf>,
        #[command(flatten)]
        settings: Settings,
        /// Weights of the regulator that pulls the plant along the reference.
        #[command(flatten)]
        weights: Weights,
        /// Error in an acceleration or a constraint up to which the reference is a motion.
        #[arg(long, value_name = "NUMBER", default_value_t = 0.0)]
        tolerance: f64,
        /// Refuse a reference that is not a motion.
        #[arg(long)]
        strict: bool,
    },
    /// Solves the steady-state Kalman filter about an equilibrium.
    Kalman {
        #[command(flatten)]
        point: Point,
        #[command(flatten)]
        settings: Settings,
        /// What is measured, comma-separated entries of x such as `theta` or `p(theta)`; all if not
        /// given.
        #[arg(long, value_delimiter = ',')]
        outputs: Vec<String>,
        /// Variances of the measurements' noise, comma-separated; one number stands for all.
        #[arg(long, value_name = "R", value_parser = numbers, default_value = "1")]
        measurement: Numbers,
        /// Variances of the state's noise per step, comma-separated; one number stands for all.
        #[arg(long, value_name = "Q", value_parser = numbers)]
        process: Option<Numbers>,
        /// Variances of the inputs' noise, comma-separated; one number stands for all.
        #[arg(long, value_name = "W", value_parser = numbers)]
        input: Option<Numbers>,
        /// Solve on the full state of a constrained model instead of on its manifold.
        #[arg(long)]
        full: bool,
    },
    /// Changes numbers of a plant's scene, or its time step, while it runs.
    SetParameter {
        /// Plant.
        id: String,
        /// Where a number stands, and its value: `gravity[1]=-1.6`, `frames[pole].body.mass=2`.
        #[arg(value_name = "PATH=VALUE", value_parser = assignment, required_unless_present = "dt")]
        parameters: Vec<Assignment>,
        /// Time step, seconds.
        #[arg(long, value_name = "SECONDS")]
        dt: Option<f64>,
    },
    /// Gives a plant a reference with its regulator, or takes it away.
    #[command(subcommand)]
    Feedback(Feedback),
    /// Sensors and actuators of a plant.
    #[command(subcommand)]
    Channels(ChannelsCommand),
    /// Runs a plant: by the wall clock, as fast as possible, or in lockstep. `plantctl run ID` goes on
    /// after a pause.
    #[command(after_help = RUN)]
    Run(RunArgs),
    /// Pauses a plant between two steps.
    Pause {
        /// Plant.
        id: String,
    },
    /// Sets bounds that protect a plant, in place of those before.
    #[command(after_help = GUARD)]
    Guard {
        /// Plant.
        id: String,
        /// Bounds; none takes the protection away.
        #[arg(value_name = "QUANTITY<VALUE[:ACTION]", value_parser = run::watchdog)]
        bounds: Vec<WatchdogArg>,
    },
    /// Prints what the loop of a plant that runs by itself has counted.
    Timing {
        /// Plant.
        id: String,
        /// Begin to count anew.
        #[arg(long)]
        clear: bool,
    },
    /// Prints what happens to a plant besides its steps. Ends with Ctrl-C or after `--count`.
    Events {
        /// Plant.
        id: String,
        /// Begin with the event of this number; a plant keeps 256 of them. From now on if not given.
        #[arg(long)]
        since: Option<u64>,
        /// End after this many events.
        #[arg(long, short = 'n')]
        count: Option<u64>,
    },
    /// Lets something go wrong on a plant.
    #[command(subcommand, after_help = FAULTS)]
    Fault(FaultCommand),
    /// Prints the gains of a plant's feedback. Ends with Ctrl-C or after `--count`.
    Gains {
        /// Plant.
        id: String,
        /// End after this many messages.
        #[arg(long, short = 'n')]
        count: Option<u64>,
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
    /// Records plants into files of the server.
    #[command(subcommand)]
    Record(RecordCommand),
    /// Takes the steps of a recording again and compares them, bit for bit.
    ///
    /// The server that it starts for this has no other plants; with an address, the one there is used. The
    /// exit code is 1 when a step differs, and when no step could be compared.
    Replay {
        /// Recording.
        file: PathBuf,
    },
    /// Writes the steps of a recording as a table.
    Export {
        /// Recording.
        file: PathBuf,
        /// Table with comma-separated values; `-` is standard output.
        #[arg(long, value_name = "FILE")]
        csv: PathBuf,
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
    /// Runs scenarios and judges them, for tests of controllers.
    #[command(after_help = test::EXAMPLE)]
    Test(test::Options),
    /// Deletes a plant or an uploaded model.
    Delete {
        /// What it is.
        what: Singular,
        /// Name of the model or id of the plant.
        name: String,
    },
}

#[derive(Debug, Subcommand)]
pub(crate) enum Feedback {
    /// Sets the feedback: about an operating point, where the plant is now, or along a trajectory.
    Set {
        /// Plant.
        id: String,
        #[command(flatten)]
        reference: Reference,
        #[command(flatten)]
        weights: Weights,
        /// Solve on the full state of a constrained model instead of on its manifold.
        #[arg(long)]
        full: bool,
        /// What it does in the plant's own loop.
        #[arg(long, default_value = "watch-only")]
        mode: Mode,
        /// Step of the plant at which a trajectory begins; the present one if not given.
        #[arg(long, value_name = "STEP", requires = "trajectory")]
        first_step: Option<u64>,
        /// Bounds of entries of x - x_reference, for the mode `guard`; an end may be left out.
        #[arg(long, num_args = 1.., value_name = "ENTRY=MIN:MAX", value_parser = bound)]
        guard: Vec<v1::Bound>,
    },
    /// Takes the feedback away.
    Clear {
        /// Plant.
        id: String,
    },
}

/// Arguments of `run`.
#[derive(Debug, clap::Args)]
pub(crate) struct RunArgs {
    /// Plant.
    pub(crate) id: String,
    /// Who decides when it takes a step; as before if not given.
    #[arg(long, value_enum)]
    pub(crate) pace: Option<Pace>,
    /// Seconds of the plant's clock in a second of the wall clock.
    #[arg(long, requires = "pace")]
    pub(crate) speed: Option<f64>,
    /// Pause again after this many steps.
    #[arg(long, short = 'n')]
    pub(crate) steps: Option<u64>,
    /// How long an input is valid, seconds on the plant's clock; for ever if not given.
    #[arg(long, value_name = "SECONDS", requires = "pace")]
    pub(crate) timeout: Option<f64>,
    /// What to do without a valid input.
    #[arg(long, value_enum, requires = "pace")]
    pub(crate) action: Option<InputAction>,
    /// Duration of a ramp, seconds on the plant's clock.
    #[arg(long, value_name = "SECONDS", requires = "action")]
    pub(crate) ramp: Option<f64>,
    /// The safe input, comma-separated.
    #[arg(long, value_parser = numbers, allow_hyphen_values = true, requires = "pace")]
    pub(crate) safe: Option<Numbers>,
    /// Once the safe input acts, it acts until `run` is called again.
    #[arg(long, requires = "pace")]
    pub(crate) latch: bool,
}

/// Who decides when a plant takes a step.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub(crate) enum Pace {
    /// The driver, one step for each input.
    Lockstep,
    /// The wall clock.
    Paced,
    /// Nobody: as fast as possible.
    Free,
}

/// What to do without a valid input.
#[derive(Clone, Copy, Debug, ValueEnum)]
pub(crate) enum InputAction {
    /// The last input acts on.
    Hold,
    /// The safe input acts at once.
    Safe,
    /// The safe input acts after a ramp.
    Ramp,
    /// The plant stands still.
    Stop,
}

/// A watchdog.
#[derive(Clone, Debug)]
pub(crate) struct WatchdogArg(pub(crate) v1::Watchdog);

#[derive(Debug, Subcommand)]
pub(crate) enum ChannelsCommand {
    /// Declares the channels, in place of those before.
    #[command(after_help = CHANNELS)]
    Set {
        /// Plant.
        id: String,
        /// File; `-` reads standard input.
        file: PathBuf,
    },
    /// Shows the channels with their present numbers.
    Show {
        /// Plant.
        id: String,
    },
    /// Takes the channels away.
    Clear {
        /// Plant.
        id: String,
    },
}

#[derive(Debug, Subcommand)]
pub(crate) enum FaultCommand {
    /// Injects a fault; it begins with the next step if no start is given.
    #[command(after_help = FAULTS)]
    Inject {
        /// Plant.
        id: String,
        /// Fields of the fault, in the names of the contract.
        #[arg(value_name = "FIELD=VALUE", value_parser = channels::assignment, required = true)]
        fault: Vec<String>,
    },
    /// Lists the faults.
    List {
        /// Plant.
        id: String,
    },
    /// Ends a fault.
    Clear {
        /// Plant.
        id: String,
        /// Its number.
        #[arg(required_unless_present = "all")]
        fault: Option<u64>,
        /// All faults.
        #[arg(long, conflicts_with = "fault")]
        all: bool,
    },
}

/// What a feedback keeps a plant at.
#[derive(Debug, Group)]
#[group(required = true, multiple = false)]
pub(crate) struct Reference {
    /// Operating point of the plant's scene.
    #[arg(long, value_name = "POINT")]
    pub(crate) at: Option<String>,
    /// Where the plant is now.
    #[arg(long)]
    pub(crate) here: bool,
    /// The trajectory of this file: a result of `optimize --save`.
    #[arg(long, value_name = "FILE")]
    pub(crate) trajectory: Option<PathBuf>,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub(crate) enum Mode {
    /// Nothing: the gains are for those who watch them.
    WatchOnly,
    /// u = law; what the driver sends is not used.
    Replace,
    /// u = law + what the driver sends.
    Add,
    /// u = law once an entry has left its bounds.
    Guard,
}

impl From<Mode> for v1::FeedbackMode {
    fn from(mode: Mode) -> Self {
        match mode {
            Mode::WatchOnly => Self::WatchOnly,
            Mode::Replace => Self::Replace,
            Mode::Add => Self::Add,
            Mode::Guard => Self::Guard,
        }
    }
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum, serde::Deserialize)]
#[serde(rename_all = "kebab-case")]
pub(crate) enum Method {
    /// Identity in place of second derivatives.
    Steepest,
    /// Second derivatives of the cost, first derivatives of the map.
    QuasiNewton,
    /// Second derivatives of the cost and of the map.
    Newton,
}

impl From<Method> for v1::DescentMethod {
    fn from(method: Method) -> Self {
        match method {
            Method::Steepest => Self::Steepest,
            Method::QuasiNewton => Self::QuasiNewton,
            Method::Newton => Self::Newton,
        }
    }
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
    Input,
    Outputs,
}

impl From<Field> for v1::WatchField {
    fn from(field: Field) -> Self {
        match field {
            Field::State => Self::State,
            Field::Report => Self::Report,
            Field::Energy => Self::Energy,
            Field::Linearization => Self::Linearization,
            Field::Gain => Self::Gain,
            Field::Input => Self::Input,
            Field::Outputs => Self::Outputs,
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
    /// Order of accuracy: 2, 4, 6, 8, or 12 without constraints and ball joints; 2 if not given.
    #[arg(long, value_name = "ORDER")]
    order: Option<u32>,
    /// Steps of the method in a time step.
    #[arg(long, value_name = "N")]
    substeps: Option<u32>,
    /// How often a time step that cannot be solved is halved; 8 if not given.
    #[arg(long, value_name = "N")]
    halvings: Option<u32>,
    /// Stop the solver at eleven digits instead of at round-off.
    #[arg(long)]
    fast: bool,
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
        let precision =
            if settings.fast { v1::Precision::Fast } else { v1::Precision::Unspecified };
        Self {
            time_step_s: settings.dt.unwrap_or(0.0),
            force_split: split.into(),
            max_iterations: settings.max_iterations.unwrap_or(0),
            singular_below: settings.singular_below.unwrap_or(0.0),
            order: settings.order.unwrap_or(0),
            substeps: settings.substeps.unwrap_or(0),
            halvings: settings.halvings,
            precision: precision.into(),
            tolerance: 0.0,
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
    #[arg(long, value_name = "ID", conflicts_with_all = ["model", "at", "Settings"])]
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
        let states = 2 * model.coordinates.len();
        let inputs = model.inputs.len() + prescribed;
        plantd_client::weights(self.q.diagonal(states), self.r.diagonal(inputs))
    }
}

/// Comma-separated numbers.
#[derive(Clone, Debug)]
pub(crate) struct Numbers(pub(crate) Vec<f64>);

impl Numbers {
    /// A diagonal weight; one number stands for all entries.
    pub(crate) fn diagonal(&self, count: usize) -> v1::Weight {
        match self.0.as_slice() {
            [value] => plantd_client::diagonal(vec![*value; count]),
            values => plantd_client::diagonal(values),
        }
    }
}

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

fn bound(text: &str) -> Result<v1::Bound, String> {
    let (entry, ends) =
        text.split_once('=').ok_or("an entry and its bounds with `=` are needed")?;
    let (min, max) = ends.split_once(':').ok_or("two ends with `:` between are needed")?;
    let end = |text: &str| match text.trim() {
        "" => Ok(None),
        text => text.parse().map(Some).map_err(|_| format!("`{text}` is not a number")),
    };
    Ok(v1::Bound { entry: entry.trim().to_owned(), min: end(min)?, max: end(max)? })
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
    fn an_end_of_a_bound_may_be_left_out() {
        let both = bound("p(theta)=-1:2").unwrap();
        assert_eq!((both.entry.as_str(), both.min, both.max), ("p(theta)", Some(-1.0), Some(2.0)));
        assert_eq!(bound("theta=:3").unwrap().min, None);
        assert!(bound("theta=3").is_err() && bound("theta=a:3").unwrap_err().contains("`a`"));
    }

    #[test]
    fn numbers_may_be_negative_and_name_the_culprit() {
        let args = Args::try_parse_from(["plantctl", "step", "p", "--u", "-1,2e-3", "--u", "0,0"]);
        let Command::Step { u, .. } = args.unwrap().command else { panic!("not a step") };
        assert_eq!((u[0].0.as_slice(), u.len()), ([-1.0, 2e-3].as_slice(), 2));
        assert!(numbers("1,x").unwrap_err().contains("`x`"));
    }
}
