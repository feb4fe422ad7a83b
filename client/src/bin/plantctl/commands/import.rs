//! `import`: robots in other formats as scenes.

use std::path::PathBuf;

use anyhow::{Context as _, Result};
use clap::{Args, ValueEnum};
use plantd_client::v1;
use plantd_import::{Kind, Note, Options};
use serde_json::json;

use crate::input::files::{beside, read_text};
use crate::input::numbers::{Numbers, numbers};
use crate::server::context::Context;

/// Turns a robot in URDF or MJCF into a scene, on standard output; what became of the file goes to
/// standard error. Needs no server.
#[derive(Debug, Args)]
pub(crate) struct Import {
    /// File; `-` reads standard input.
    robot: PathBuf,
    /// What holds the root link of a URDF: the world, or nothing.
    #[arg(long, value_enum, default_value_t)]
    base: Base,
    /// What gets an input: the joints that the transmissions and command interfaces of a URDF name (all,
    /// if there are none of these) and the actuators of an MJCF, all joints that mimic no other, or
    /// nothing.
    #[arg(long, value_enum, default_value_t)]
    inputs: Inputs,
    /// Name of the scene; the robot's if not given.
    #[arg(long)]
    name: Option<String>,
    /// Acceleration of gravity, m/s²; if not given that of the file, or 0,0,-9.81.
    #[arg(long, value_name = "X,Y,Z", value_parser = numbers, allow_hyphen_values = true)]
    gravity: Option<Numbers>,
    /// Time step that the scene suggests, s; if not given that of the file, or 0.001.
    #[arg(long, value_name = "SECONDS", visible_alias = "time-step", alias = "time-step-s")]
    dt: Option<f64>,
    /// Velocity at which 76 % of dry friction are reached, m/s or rad/s.
    #[arg(long, value_name = "V", default_value_t = 0.01)]
    friction_velocity: f64,
    /// Stop joints at their limits: depth and time in which one that is held there settles, m or rad and s.
    #[arg(long, value_name = "DEPTH,TIME", value_parser = numbers)]
    stops: Option<Numbers>,
    /// Folder of a package, for paths of meshes that begin with `package://NAME`.
    #[arg(long, value_name = "NAME=FOLDER", value_parser = package)]
    package: Vec<(String, String)>,
    /// Leave out what cannot be expressed, and take inertias that no body has, with a warning.
    #[arg(long)]
    lenient: bool,
}

#[derive(Clone, Copy, Debug, Default, ValueEnum)]
enum Base {
    #[default]
    Fixed,
    Free,
}

#[derive(Clone, Copy, Debug, Default, ValueEnum)]
enum Inputs {
    #[default]
    AsTold,
    All,
    None,
}

impl Import {
    pub(crate) fn run(self, context: &Context) -> Result<()> {
        let gravity = self.gravity.map(|gravity| <[f64; 3]>::try_from(gravity.0)).transpose();
        let stops = self.stops.map(|stops| <[f64; 2]>::try_from(stops.0)).transpose();
        let options = Options {
            base: match self.base {
                Base::Fixed => plantd_import::Base::Fixed,
                Base::Free => plantd_import::Base::Free,
            },
            inputs: match self.inputs {
                Inputs::AsTold => plantd_import::Inputs::AsTold,
                Inputs::All => plantd_import::Inputs::All,
                Inputs::None => plantd_import::Inputs::None,
            },
            gravity: gravity.ok().context("--gravity takes three numbers")?,
            time_step_s: self.dt,
            friction_velocity: self.friction_velocity,
            stops: stops.ok().context("--stops takes two numbers")?,
            packages: self.package.into_iter().collect(),
            lenient: self.lenient,
        };
        let file = self.robot.display().to_string();
        let text = read_text(&self.robot)?;
        let mut robot = plantd_import::import_with_files(&text, &options, &mut beside(&self.robot))
            .with_context(|| format!("{file} cannot be imported"))?;
        if let Some(name) = self.name {
            robot.scene.name = name;
        }
        eprint!("{}", robot.report);
        robot.check().context("what the file says is no mechanism that can be simulated")?;
        let scene = robot.scene.to_toml();
        context.output.print(|| json!({ "scene_toml": &scene }), || scene.clone())
    }
}

/// A name and a folder.
pub(crate) fn package(text: &str) -> Result<(String, String), &'static str> {
    let (name, folder) = text.split_once('=').ok_or("a name and a folder with `=` are needed")?;
    Ok((name.to_owned(), folder.to_owned()))
}

/// Says on standard error what became of a robot that the server has imported.
pub(crate) fn tell(report: Option<&v1::ImportReport>) {
    let Some(report) = report else { return };
    for note in &report.notes {
        let kind = match note.kind() {
            v1::ImportKind::Contact => Kind::Contact,
            v1::ImportKind::Approximated => Kind::Approximated,
            v1::ImportKind::NoEffect => Kind::NoEffect,
            v1::ImportKind::Warning | v1::ImportKind::Unspecified => Kind::Warning,
        };
        let v1::ImportNote { line, column, message, count, .. } = note.clone();
        let (file, count) = (String::new(), count as usize);
        eprintln!("{}", Note { kind, file, line, column, message, count });
    }
    for v1::ImportName { of, from, to } in &report.names {
        eprintln!("{of} `{from}` is named `{to}`");
    }
}
