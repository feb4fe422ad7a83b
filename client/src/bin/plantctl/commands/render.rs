//! `render`: films and pictures of plants and recordings.

use std::path::{Path, PathBuf};
use std::time::Duration;

use anyhow::{Context as _, Result, bail, ensure};
use clap::{Args, ValueEnum};
use plantd_client::{RecordingReader, v1};
use serde_json::{Value, json};

use crate::commands::view::{is_recording, page_of};
use crate::figure::browser;
use crate::figure::film::Film;
use crate::figure::tab::Tab;
use crate::server::context::{Context, plant};
use crate::server::page::PageServer;

/// Length of a plant's film where none is given, s.
const DURATION_S: f64 = 5.0;
/// Bytes of all pictures together, four a pixel.
const BYTES_MAX: f64 = 1e9;
/// Longest wait for a picture to be drawn.
const PICTURE: Duration = Duration::from_secs(60);
/// Longest wait for a plant to move for as long as is filmed; the page ends it when the plant stands still.
const SEEN: Duration = Duration::from_secs(24 * 3600);

/// Makes a film, or a picture, of a plant or a recording: GIF or PNG, for documents.
///
/// Drawn by a browser without a window: Chromium or Chrome. A plant is filmed as it moves, over the TCP address of
/// its server; a recording needs no server. Times are those of the plant, and the film plays at that speed.
#[derive(Debug, Args)]
pub(crate) struct Render {
    /// Plant, or the file of a recording.
    #[arg(value_name = "PLANT|FILE")]
    what: String,
    /// FILE.gif, or FILE.png: one picture, and with --duration an animated one.
    #[arg(long, value_name = "FILE")]
    out: PathBuf,
    /// Width and height, pixels; each from 64 to 4096.
    #[arg(long, value_name = "WIDTHxHEIGHT", default_value = "640x400", value_parser = size)]
    size: (u16, u16),
    /// Length, s. If not given: the whole recording, 5 s of a plant.
    #[arg(long, value_name = "SECONDS")]
    duration: Option<f64>,
    /// Begin at this time of a recording, s.
    #[arg(long, value_name = "SECONDS")]
    from: Option<f64>,
    /// Pictures a second, from 1 to 50.
    #[arg(long, value_name = "HZ", default_value_t = 20.0)]
    fps: f64,
    /// What is seen.
    #[arg(long, value_enum, default_value_t = Seen::Scene)]
    view: Seen,
    /// Turn the camera from the first view, to the right and up, degrees.
    #[arg(long, value_name = "RIGHT,UP", default_value = "0,0", value_parser = angles, allow_hyphen_values = true)]
    turn: (f64, f64),
    /// Bring the camera nearer by this factor.
    #[arg(long, value_name = "FACTOR", default_value_t = 1.0)]
    zoom: f64,
    /// Dark colours.
    #[arg(long)]
    dark: bool,
    /// Browser to draw with; the first on the path if not given.
    #[arg(long, value_name = "PROGRAM", env = "CHROME")]
    browser: Option<PathBuf>,
}

/// What is seen in a film.
#[derive(Clone, Copy, Debug, ValueEnum)]
enum Seen {
    /// The mechanism alone.
    Scene,
    /// The page as it is in a browser: with plots and poles.
    Page,
}

/// What a film is written as.
#[derive(Clone, Copy, PartialEq)]
enum Kind {
    Gif,
    Png,
}

impl Render {
    pub(crate) async fn run(self, context: &Context) -> Result<()> {
        let kind = self.check()?;
        let browser = browser::find(self.browser.as_deref())?;
        let film = if is_recording(&self.what) {
            // What is no recording is better told here than by the page.
            RecordingReader::open(&self.what)?;
            let server = PageServer::bind(Path::new(&self.what)).await?;
            let url = format!("{}&{}", server.url(), self.query());
            tokio::select! {
                served = server.serve() => return served,
                film = self.film(&browser, &url, kind) => film?,
            }
        } else {
            self.check_plant(context, kind).await?;
            let url = format!("{}/?plant={}&{}", page_of(context)?, self.what, self.query());
            self.film(&browser, &url, kind).await?
        };
        let bytes = match kind {
            Kind::Gif => film.gif(self.fps)?,
            Kind::Png => film.png(self.fps)?,
        };
        std::fs::write(&self.out, bytes)
            .with_context(|| format!("cannot write {}", self.out.display()))?;
        let said = format!("{} pictures are in {}", film.len(), self.out.display());
        context.output.done(json!({ "file": self.out, "pictures": film.len() }), &said)
    }

    /// Checks what was asked for, before anything is started.
    fn check(&self) -> Result<Kind> {
        let extension = self.out.extension().and_then(|extension| extension.to_str());
        let kind = match extension {
            Some("gif") => Kind::Gif,
            Some("png") => Kind::Png,
            _ => bail!("{}: films are written as .gif or .png", self.out.display()),
        };
        ensure!((1.0..=50.0).contains(&self.fps), "--fps is {}; from 1 to 50", self.fps);
        ensure!((0.1..=100.0).contains(&self.zoom), "--zoom is {}; from 0.1 to 100", self.zoom);
        if let Some(duration) = self.duration {
            ensure!(
                duration > 0.0 && duration.is_finite(),
                "--duration is {duration}; a number over 0 is needed"
            );
            self.check_pictures(duration)?;
        }
        Ok(kind)
    }

    /// Number of pictures in a time.
    fn pictures(&self, duration_s: f64) -> f64 {
        (duration_s * self.fps).round().max(1.0)
    }

    fn check_pictures(&self, duration_s: f64) -> Result<()> {
        let ((width, height), count) = (self.size, self.pictures(duration_s));
        ensure!(
            4.0 * f64::from(width) * f64::from(height) * count <= BYTES_MAX,
            "{count} pictures of {width}x{height} pixels are more than {BYTES_MAX:e} bytes: ask for fewer by \
             --duration or --fps, or smaller ones by --size"
        );
        Ok(())
    }

    /// A plant is there, and moves if it is to be filmed.
    async fn check_plant(&self, context: &Context, kind: Kind) -> Result<()> {
        ensure!(self.from.is_none(), "--from is a time of a recording; a plant is filmed as it is");
        let info = plant(&context.connect().await?, &self.what).await?;
        let run = info.run.unwrap_or_default();
        let pace = run.settings.unwrap_or_default().pace();
        // In lockstep it moves if somebody drives it.
        let may_move = run.running && (pace != v1::Pace::Lockstep || !info.driver.is_empty());
        if self.length_of_plant(kind) > 0.0 && !may_move {
            bail!(
                "{id} stands still: `plantctl run {id}` first, or a picture by --out FILE.png",
                id = self.what
            );
        }
        Ok(())
    }

    /// How long a plant is filmed, s.
    fn length_of_plant(&self, kind: Kind) -> f64 {
        self.duration.unwrap_or(if kind == Kind::Gif { DURATION_S } else { 0.0 })
    }

    /// What the page is asked for by its address.
    fn query(&self) -> String {
        let film = match self.view {
            Seen::Scene => "scene",
            Seen::Page => "page",
        };
        let theme = if self.dark { "dark" } else { "light" };
        format!("film={film}&theme={theme}&quality=best")
    }

    async fn film(&self, browser: &Path, url: &str, kind: Kind) -> Result<Film> {
        let (width, height) = self.size;
        let mut tab = Tab::open(browser, (width.into(), height.into())).await?;
        let film = self.shoot(&mut tab, url, kind).await;
        tab.close().await;
        film
    }

    /// Takes the pictures.
    async fn shoot(&self, tab: &mut Tab, url: &str, kind: Kind) -> Result<Film> {
        tab.go(url).await?;
        if tab.evaluate("typeof plantdFilm", PICTURE).await? != json!("object") {
            // The page says why it shows nothing, and a server without a page that it has none.
            let said = "document.getElementById('notice')?.textContent || document.body.innerText";
            let said = tab.evaluate(said, PICTURE).await?;
            bail!("there is no film of {url}: {}", said.as_str().unwrap_or_default().trim());
        }
        let gather = format!("plantdFilm.gather({})", self.length_of_plant(kind));
        let seen = tab.evaluate(&gather, SEEN).await?;
        let time = |value: &Value| value.as_f64().context("the page names no time");
        let (first, last) = (time(&seen[0])?, time(&seen[1])?);
        let from = self.from.unwrap_or(first);
        ensure!((first..=last).contains(&from), "--from is {from} s; from {first} to {last} s");
        let asked = self.duration.unwrap_or(if kind == Kind::Gif { f64::INFINITY } else { 0.0 });
        let duration = asked.min(last - from);
        self.check_pictures(duration)?;
        let frame = format!("plantdFilm.frame({from}, {})", from + duration);
        tab.evaluate(&frame, PICTURE).await?;
        let (right, up) = self.turn;
        let look =
            format!("plantdFilm.look({}, {}, {})", right.to_radians(), up.to_radians(), self.zoom);
        tab.evaluate(&look, PICTURE).await?;
        let (width, height) = self.size;
        let mut film = Film::new(width, height);
        for index in 0..self.pictures(duration) as usize {
            let at = from + index as f64 / self.fps;
            tab.evaluate(&format!("plantdFilm.at({at})"), PICTURE).await?;
            film.push(&tab.picture().await?)?;
        }
        Ok(film)
    }
}

/// A width and a height, pixels.
fn size(text: &str) -> Result<(u16, u16), String> {
    let size = text.split_once('x').and_then(|(width, height)| {
        Some((width.parse::<u16>().ok()?, height.parse::<u16>().ok()?))
    });
    let is_allowed = |pixels: u16| (64..=4096).contains(&pixels);
    size.filter(|(width, height)| is_allowed(*width) && is_allowed(*height))
        .ok_or_else(|| "a width and a height from 64 to 4096 pixels, such as 640x400".to_owned())
}

/// Two angles, degrees.
fn angles(text: &str) -> Result<(f64, f64), String> {
    let angles = text.split_once(',').and_then(|(right, up)| {
        Some((right.trim().parse::<f64>().ok()?, up.trim().parse::<f64>().ok()?))
    });
    let is_allowed = |angle: f64| angle.abs() <= 360.0;
    angles
        .filter(|(right, up)| is_allowed(*right) && is_allowed(*up))
        .ok_or_else(|| "two angles from -360 to 360 degrees, such as 30,-10".to_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sizes_and_angles_are_read() {
        assert_eq!(size("640x400"), Ok((640, 400)));
        assert_eq!(angles("30,-10.5"), Ok((30.0, -10.5)));
        for text in ["", "640", "640x", "63x100", "100x5000", "-1x100", "640x400x3"] {
            assert!(size(text).is_err(), "{text}");
        }
        for text in ["", "30", "a,b", "NaN,0", "0,361", "1,2,3"] {
            assert!(angles(text).is_err(), "{text}");
        }
    }
}
