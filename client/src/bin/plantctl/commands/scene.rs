//! `upload`, `validate` and `explain`: scenes as files.

use std::path::{Path, PathBuf};
use std::process::ExitCode;

use anyhow::{Context as _, Result};
use clap::Args;
use plantd_client::v1;
use serde_json::json;

use crate::commands::import;
use crate::input::files::{read_scene, read_text};
use crate::input::meshes::Meshes;
use crate::output::failure::FAILED;
use crate::output::model;
use crate::output::page::{Page, table};
use crate::server::context::Context;

/// Uploads a scene (TOML, JSON) or a robot (URDF, MJCF) as a model, with the meshes that show it.
///
/// Meshes are looked for where the file stands; those of packages in the folder that `--package` names, or in one
/// of that name around the file.
#[derive(Debug, Args)]
pub(crate) struct Upload {
    /// File; `-` reads standard input.
    scene: PathBuf,
    /// Name; the scene's own if not given.
    #[arg(long)]
    name: Option<String>,
    /// Folder of a package, for meshes whose paths begin with `package://NAME`.
    #[arg(long, value_name = "NAME=FOLDER", value_parser = import::package)]
    package: Vec<(String, String)>,
    /// Take the place of an uploaded model of that name; its plants live on.
    #[arg(long)]
    replace: bool,
}

/// Checks a scene (TOML, JSON) or a robot (URDF) and prints all its errors.
#[derive(Debug, Args)]
pub(crate) struct Validate {
    /// File; `-` reads standard input.
    scene: PathBuf,
}

/// Prints what a step of a model evaluates and what it skips.
#[derive(Debug, Args)]
pub(crate) struct Explain {
    /// File of a scene, or name of a model.
    scene: String,
}

impl Upload {
    pub(crate) async fn run(self, context: &Context) -> Result<()> {
        let client = context.connect().await?;
        let (scene, files) = read_scene(&self.scene)?;
        let request = v1::CreateModelRequest {
            name: self.name.unwrap_or_default(),
            scene,
            replace: self.replace,
            files,
            ..Default::default()
        };
        let answer = client.import_model(request).await?;
        import::tell(answer.import_report.as_ref());
        let model = answer.model.context("an answer without a model")?;
        let folder = self.scene.parent().unwrap_or(Path::new(""));
        Meshes::new(folder, self.package).send(&client, &model.name).await?;
        context.output.success(&format!("model `{}` is uploaded", model.name));
        context.output.message("Model", &model, || model::known(&model))
    }
}

impl Validate {
    pub(crate) async fn run(self, context: &Context) -> Result<ExitCode> {
        let client = context.connect().await?;
        let answer = {
            let (scene, files) = read_scene(&self.scene)?;
            let request = v1::ValidateSceneRequest { scene, files, ..Default::default() };
            client.validate_scene_as(request).await?
        };
        import::tell(answer.import_report.as_ref());
        context.output.message("ValidateSceneResponse", &answer, || match &answer.model {
            Some(model) if answer.problems.is_empty() => model::validated(model),
            _ => problems(&answer.problems),
        })?;
        Ok(verdict(&answer))
    }
}

impl Explain {
    pub(crate) async fn run(self, context: &Context) -> Result<ExitCode> {
        let client = context.connect().await?;
        let output = &context.output;
        let print_plan = |plan: &str| {
            output.print(|| json!({ "plan": plan }), || format!("{}\n", plan.trim_end()))
        };
        let path = Path::new(&self.scene);
        // A file goes before a model of the same name.
        if !path.is_file() && self.scene != "-" {
            print_plan(&client.get_model(&self.scene).await?.plan)?;
            return Ok(ExitCode::SUCCESS);
        }
        let answer = client.validate_scene(read_text(path)?).await?;
        match &answer.model {
            Some(model) => print_plan(&model.plan)?,
            None => {
                output.message("ValidateSceneResponse", &answer, || problems(&answer.problems))?
            }
        }
        Ok(verdict(&answer))
    }
}

fn verdict(answer: &v1::ValidateSceneResponse) -> ExitCode {
    if answer.problems.is_empty() { ExitCode::SUCCESS } else { ExitCode::from(FAILED) }
}

/// The problems of a scene, a line each.
fn problems(problems: &[v1::SceneProblem]) -> Page {
    let mut page = Page::default();
    problems.iter().for_each(|p| page.append(format!("{}: {}\n", p.path, p.message)));
    let rows = problems.iter().map(|p| vec![p.path.clone(), p.message.clone()]);
    page.data(table(&["path", "problem"], rows));
    page
}
