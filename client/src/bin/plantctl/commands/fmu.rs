//! `fmu`: a plant as a Functional Mock-up Unit.

use std::collections::BTreeMap;
use std::ffi::{CStr, CString, c_char};
use std::io::{Cursor, Write as _};
use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result, bail, ensure};
use clap::Args;
use plantd_import::Options;
use serde::Deserialize;
use serde_json::json;
use zip::ZipWriter;
use zip::write::SimpleFileOptions;

use crate::input::files::{beside, read_text, write};
use crate::input::settings::Settings;
use crate::server::context::Context;

/// Makes an FMU (FMI 3.0, co-simulation) with the mechanics of a scene inside. Needs no server.
///
/// Its inputs are `u(NAME)`, its outputs `q(NAME)`, `velocity(NAME)`, `energy`, `kinetic` and
/// `potential`; numbers of the scene are tunable parameters by their paths. Not there: model exchange and
/// scheduled execution.
#[derive(Debug, Args)]
pub(crate) struct Fmu {
    /// File of a scene (TOML, JSON) or a robot (URDF, MJCF), `-` for standard input, or the name of a
    /// built-in model; with `--address` that of any model of the server.
    scene: String,
    /// File to write; the scene's name with `.fmu` if not given.
    #[arg(long, short, value_name = "FILE")]
    out: Option<PathBuf>,
    /// Operating point at which it starts; the scene's initial configuration if not given.
    #[arg(long)]
    at: Option<String>,
    #[command(flatten)]
    settings: Settings,
    /// The library that the FMU gets; the one beside this program if not given.
    #[arg(long, value_name = "FILE")]
    library: Option<PathBuf>,
    /// The same library, built for another platform: `x86_64-windows=plantd_fmi.dll`.
    #[arg(long, value_name = "PLATFORM=FILE", value_parser = platform)]
    also: Vec<(String, PathBuf)>,
}

/// What the library says that an FMU is made of.
#[derive(Debug, Deserialize)]
#[serde(untagged)]
enum Package {
    Error { error: String },
    Files { identifier: String, files: BTreeMap<String, String> },
}

impl Fmu {
    pub(crate) async fn run(self, context: &Context) -> Result<()> {
        let scene = self.scene_text(context).await?;
        let library = match &self.library {
            Some(library) => library.clone(),
            None => library_beside()?,
        };
        let package = ask(&library, &scene, &self.recipe().to_string())
            .with_context(|| format!("cannot use {}", library.display()))?;
        let (identifier, files) = match package {
            Package::Error { error } => bail!("{}: {error}", self.scene),
            Package::Files { identifier, files } => (identifier, files),
        };
        let own = format!("{}-{}", std::env::consts::ARCH, std::env::consts::OS);
        let mut binaries = vec![(own, library)];
        binaries.extend(self.also);
        let mut contents: Vec<(String, Vec<u8>)> =
            files.into_iter().map(|(path, text)| (path, text.into_bytes())).collect();
        for (platform, file) in binaries {
            let end = if platform.ends_with("windows") {
                "dll"
            } else if platform.ends_with("darwin") {
                "dylib"
            } else {
                "so"
            };
            let bytes =
                std::fs::read(&file).with_context(|| format!("cannot read {}", file.display()))?;
            contents.push((format!("binaries/{platform}/{identifier}.{end}"), bytes));
        }
        let out = self.out.unwrap_or_else(|| PathBuf::from(format!("{identifier}.fmu")));
        let fmu = archive(&contents)?;
        write(&out, &fmu)?;
        let (path, bytes) = (out.display().to_string(), fmu.len());
        let said = format!("{path}: {bytes} bytes, model identifier {identifier}");
        context.output.done(json!({ "fmu": &path, "bytes": bytes }), &said)
    }

    async fn scene_text(&self, context: &Context) -> Result<String> {
        let path = Path::new(&self.scene);
        if path.is_file() || self.scene == "-" {
            let text = read_text(path)?;
            if !plantd_import::is_xml(&text) {
                return Ok(text);
            }
            let robot =
                plantd_import::import_with_files(&text, &Options::default(), &mut beside(path))
                    .with_context(|| format!("{} cannot be imported", self.scene))?;
            eprint!("{}", robot.report);
            robot.check().context("what the file says is no mechanism that can be simulated")?;
            return Ok(robot.scene.to_toml());
        }
        match context.address {
            Some(_) => Ok(context.connect().await?.get_model(&self.scene).await?.scene_toml),
            None => Ok(self.scene.clone()),
        }
    }

    /// The settings in the library's keys: those that were given.
    fn recipe(&self) -> serde_json::Value {
        let Settings {
            dt,
            paper,
            order,
            substeps,
            halvings,
            fast,
            coarse,
            max_iterations,
            singular_below,
        } = self.settings;
        let mut recipe = json!({
            "at": self.at, "time_step_s": dt, "order": order, "substeps": substeps,
            "halvings": halvings, "max_iterations": max_iterations, "singular_below": singular_below,
        });
        if let Some(recipe) = recipe.as_object_mut() {
            recipe.retain(|_, value| !value.is_null());
            let switches = [("fast", fast), ("coarse", coarse), ("paper", paper)];
            let switches = switches.into_iter().filter(|(_, on)| *on);
            recipe.extend(switches.map(|(name, on)| (name.to_owned(), on.into())));
        }
        recipe
    }
}

fn platform(text: &str) -> Result<(String, PathBuf), &'static str> {
    let (platform, file) =
        text.split_once('=').ok_or("a platform and a file with `=` are needed")?;
    let is_tuple = platform.split('-').count() == 2
        && platform.chars().all(|c| c.is_ascii_alphanumeric() || c == '_' || c == '-');
    if !is_tuple {
        return Err("a platform is an architecture and a system: `x86_64-windows`");
    }
    Ok((platform.to_owned(), file.into()))
}

/// The library where `cargo build` or an installation has put it.
fn library_beside() -> Result<PathBuf> {
    let name = libloading::library_filename("plantd_fmi");
    let program = std::env::current_exe().context("where is this program?")?;
    let folder = program.parent().context("this program is in no folder")?;
    let places = [folder.to_owned(), folder.join("../lib/plantd"), folder.join("../lib")];
    let found = places.iter().map(|place| place.join(&name)).find(|path| path.is_file());
    found.with_context(|| {
        format!(
            "{} is not beside plantctl in {}; `cargo build --release -p plantd-fmi` builds it, and \
             `--library` says where it is",
            name.display(),
            folder.display()
        )
    })
}

/// Asks the library what the FMU of a scene is made of. So the description is of the very library that
/// is in the FMU, and this program knows no mechanics.
fn ask(library: &Path, scene: &str, settings: &str) -> Result<Package> {
    type Describe = unsafe extern "C" fn(*const c_char, *const c_char) -> *mut c_char;
    type Free = unsafe extern "C" fn(*mut c_char);
    let scene = CString::new(scene).context("the scene has a zero character in it")?;
    let settings = CString::new(settings)?;
    // SAFETY: the file is the one that stands beside this program, or that its user has named. Loading it
    // runs no code but that of its runtime.
    let library = unsafe { libloading::Library::new(library) }?;
    // SAFETY: these are the types that `client/fmi/src/package.rs` gives the functions.
    let (describe, free) = unsafe {
        (
            library.get::<Describe>(b"plantd_fmi_package\0")?,
            library.get::<Free>(b"plantd_fmi_free\0")?,
        )
    };
    // SAFETY: both strings end with a zero.
    let answer = unsafe { describe(scene.as_ptr(), settings.as_ptr()) };
    ensure!(!answer.is_null(), "it gives no answer");
    // SAFETY: it is a string of the library's, which is there until it is freed.
    let text = unsafe { CStr::from_ptr(answer) }.to_owned();
    // SAFETY: the answer is given back once, to whom it came from.
    unsafe { free(answer) };
    Ok(serde_json::from_slice(text.as_bytes())?)
}

/// Packs files, without times: the same contents make the same bytes.
fn archive(files: &[(String, Vec<u8>)]) -> Result<Vec<u8>> {
    let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
    for (path, bytes) in files {
        zip.start_file(path, SimpleFileOptions::default().unix_permissions(0o644))?;
        zip.write_all(bytes)?;
    }
    Ok(zip.finish()?.into_inner())
}
