//! How a plant is stepped: the list of its settings.

use clap::Args;
use plantd_client::v1;

/// How a plant is stepped. Commands flatten it; scenarios and problems, which are files with keys of
/// their own, are turned into it.
#[derive(Debug, Default, Args)]
pub(crate) struct Settings {
    /// Time step in seconds; the scene's if not given. `time_step_s` in files and in the contract.
    #[arg(long, value_name = "SECONDS", visible_alias = "time-step", alias = "time-step-s")]
    pub(crate) dt: Option<f64>,
    /// Put all forces at the start of a step, as the paper does.
    #[arg(long)]
    pub(crate) paper: bool,
    /// Order of accuracy: 2, 4, 6, 8, 12 or 16; 2 if not given.
    #[arg(long, value_name = "ORDER")]
    pub(crate) order: Option<u32>,
    /// Steps of the method in a time step.
    #[arg(long, value_name = "N")]
    pub(crate) substeps: Option<u32>,
    /// How often a time step that cannot be solved is halved; 8 if not given.
    #[arg(long, value_name = "N")]
    pub(crate) halvings: Option<u32>,
    /// Stop the solver at eleven digits instead of at round-off.
    #[arg(long)]
    pub(crate) fast: bool,
    /// Stop it at seven digits: for errors of 1e-6 and more, by long steps of high order.
    #[arg(long, conflicts_with = "fast")]
    pub(crate) coarse: bool,
    /// Newton iterations before a step is given up.
    #[arg(long, value_name = "N")]
    pub(crate) max_iterations: Option<u32>,
    /// Reciprocal condition below which a step is refused.
    #[arg(long, value_name = "NUMBER")]
    pub(crate) singular_below: Option<f64>,
}

impl From<Settings> for v1::PlantSettings {
    fn from(settings: Settings) -> Self {
        let split =
            if settings.paper { v1::ForceSplit::Paper } else { v1::ForceSplit::Unspecified };
        let precision = match settings {
            Settings { coarse: true, .. } => v1::Precision::Coarse,
            Settings { fast: true, .. } => v1::Precision::Fast,
            _ => v1::Precision::Unspecified,
        };
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
