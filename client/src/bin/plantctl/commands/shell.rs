//! `completions` and `man`: what shells and readers of manuals are given.

use std::io::Write as _;
use std::path::PathBuf;

use anyhow::{Context as _, Result};
use clap::{Args, Command, ValueEnum};
use clap_complete::env::Shells;
use serde_json::json;

use crate::output::printer::Output;

/// Environment variable in which a shell asks for completions.
pub(crate) const ASKED_BY: &str = "PLANTCTL_COMPLETE";

/// Prints what makes a shell complete commands, plants, models and recordings; names come from the server at
/// PLANTD_ADDRESS. In bash: source <(plantctl completions bash).
#[derive(Debug, Args)]
pub(crate) struct Completions {
    /// Shell.
    shell: Shell,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
enum Shell {
    Bash,
    Elvish,
    Fish,
    Powershell,
    Zsh,
}

/// Writes manual pages, one for each command, into a folder.
#[derive(Debug, Args)]
pub(crate) struct Man {
    /// Folder, which is made if it is not there: `man -M FOLDER` looks into its `man1`.
    folder: PathBuf,
}

impl Completions {
    pub(crate) fn run(self) -> Result<()> {
        let shells = Shells::builtins();
        let name = self.shell.to_possible_value().context("a shell has a name")?;
        let shell = shells.completer(name.get_name()).context("no completions for this shell")?;
        let mut out = std::io::stdout().lock();
        shell.write_registration(ASKED_BY, "plantctl", "plantctl", "plantctl", &mut out)?;
        Ok(out.flush()?)
    }
}

impl Man {
    pub(crate) fn run(self, command: Command, output: &Output) -> Result<()> {
        let folder = self.folder.join("man1");
        let cannot = || format!("cannot write manual pages into {}", folder.display());
        std::fs::create_dir_all(&folder).with_context(cannot)?;
        clap_mangen::generate_to(command, &folder).with_context(cannot)?;
        let said = format!("manual pages are in {}", folder.display());
        output.done(json!({ "written": folder }), &said)
    }
}
