//! The command line.

mod groups;
mod help;

use std::path::PathBuf;

use clap::{Parser, Subcommand};
use plantd_client::v1;

pub(crate) use self::groups::*;
pub(crate) use self::help::PROBLEM;
use self::help::{CHANNELS, EXAMPLES, EXIT_CODES, FAULTS, GUARD, RUN};
use crate::replay::RecordCommand;
use crate::run::{RunArgs, WatchdogArg};
use crate::{channels, run, test};

/// Looks at, drives and asks a plantd server.
#[derive(Debug, Parser)]
#[command(name = "plantctl", version, before_help = EXAMPLES, after_help = EXIT_CODES, max_term_width = 100)]
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
        #[arg(long, short = 'n', value_parser = clap::value_parser!(u32).range(1..))]
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
        #[arg(long, short = 'n', value_parser = clap::value_parser!(u64).range(1..))]
        count: Option<u64>,
        /// Messages that may wait to be printed; of more, the oldest are lost.
        #[arg(long, value_name = "N", default_value_t = 1)]
        queue: u32,
        #[command(flatten)]
        weights: RegulatorWeights,
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
        weights: RegulatorWeights,
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
        #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
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
        #[arg(long, short = 'n', value_parser = clap::value_parser!(u64).range(1..))]
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
        #[arg(long, short = 'n', value_parser = clap::value_parser!(u64).range(1..))]
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
        weights: RegulatorWeights,
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
