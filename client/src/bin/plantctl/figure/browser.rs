//! Pictures made by a browser without a window, where there is one.

use std::path::{Path, PathBuf};
use std::process::{Command, Stdio};

use anyhow::{Context as _, Result, bail};

/// Browsers that do as Chromium does, by the names under which they are installed.
const BROWSERS: [&str; 4] =
    ["chromium", "chromium-browser", "google-chrome", "google-chrome-stable"];

/// The browser to use: the one that was asked for, or the first on the path.
pub(crate) fn find(asked: Option<&Path>) -> Result<PathBuf> {
    if let Some(asked) = asked {
        let is_path = asked.components().count() > 1;
        let found = if is_path { Some(asked.to_owned()) } else { on_path(&[asked]) };
        return found
            .filter(|program| program.is_file())
            .with_context(|| format!("there is no browser {}", asked.display()));
    }
    on_path(&BROWSERS.map(Path::new)).with_context(|| {
        format!(
            "there is no browser to draw with: none of {} on the path. Install Chromium (Debian: \
             `apt install chromium`) or Chrome, or say where one is with --browser or CHROME",
            BROWSERS.join(", ")
        )
    })
}

/// The first of these programs on the path.
fn on_path(names: &[&Path]) -> Option<PathBuf> {
    let path = std::env::var_os("PATH")?;
    let places: Vec<PathBuf> = std::env::split_paths(&path).collect();
    let all = names.iter().flat_map(|name| places.iter().map(move |place| place.join(name)));
    all.into_iter().find(|program| program.is_file())
}

/// Writes what an SVG file of this size, pixels, looks like as PNG.
pub(crate) fn png_of_svg(
    browser: &Path,
    svg: &str,
    (width, height): (u32, u32),
    path: &Path,
) -> Result<()> {
    let directory = tempfile::Builder::new().prefix("plantctl-").tempdir()?;
    let source = directory.path().join("plot.svg");
    let picture = directory.path().join("plot.png");
    std::fs::write(&source, svg)?;
    let of = |name: &str, value: &Path| format!("--{name}={}", value.display());
    let mut command = Command::new(browser);
    command
        .args(["--headless", "--disable-gpu", "--hide-scrollbars", "--force-device-scale-factor=1"])
        .arg(of("user-data-dir", &directory.path().join("profile")))
        .arg(of("screenshot", &picture))
        .arg(format!("--window-size={width},{height}"))
        .arg(format!("file://{}", source.display()));
    // Its sandbox refuses to begin as root; what it shows is ours.
    if rustix::process::getuid().is_root() {
        command.arg("--no-sandbox");
    }
    let output = command.stdin(Stdio::null()).output();
    let output = output.with_context(|| format!("cannot start {}", browser.display()))?;
    if !output.status.success() || !picture.is_file() {
        let complaint = String::from_utf8_lossy(&output.stderr).into_owned();
        bail!("{} has made no picture: {}", browser.display(), complaint.trim());
    }
    std::fs::copy(&picture, path).with_context(|| format!("cannot write {}", path.display()))?;
    Ok(())
}
