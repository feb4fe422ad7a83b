//! A page in a browser without a window, led in the protocol of Chrome's developer tools over a pipe.

use std::fs::File;
use std::path::Path;
use std::process::Stdio;
use std::time::Duration;

use anyhow::{Context as _, Result, bail};
use base64::Engine as _;
use base64::engine::general_purpose::STANDARD;
use serde_json::{Value, json};
use tempfile::TempDir;
use tokio::io::{AsyncBufReadExt as _, AsyncWriteExt as _, BufReader};
use tokio::process::{Child, ChildStdin, ChildStdout, Command};

/// Longest wait for the browser to answer.
const PATIENCE: Duration = Duration::from_secs(60);
/// Longest wait for the browser to end, and for its files to be let go of.
const FAREWELL: Duration = Duration::from_secs(5);
/// From one look whether the page is there to the next.
const LOOK_PERIOD: Duration = Duration::from_millis(50);
/// The protocol goes over the descriptors 3 and 4, which are the pipes of the standard ones here.
const PIPED: &str = r#"exec "$0" "$@" 3<&0 4>&1 </dev/null >/dev/null"#;
/// Bytes of a browser's complaint that are told.
const COMPLAINT: usize = 2000;

/// A page; dropping it ends the browser.
pub(crate) struct Tab {
    child: Child,
    to: ChildStdin,
    from: BufReader<ChildStdout>,
    session: Option<String>,
    calls: u64,
    profile: TempDir,
}

impl Tab {
    /// Starts a browser with a page of this size, pixels.
    pub(crate) async fn open(browser: &Path, (width, height): (u32, u32)) -> Result<Self> {
        let profile = tempfile::Builder::new().prefix("plantctl-").tempdir()?;
        let log = File::create(profile.path().join("log"))?;
        let mut command = Command::new("sh");
        command
            .args(["-c", PIPED])
            .arg(browser)
            .args(["--headless", "--remote-debugging-pipe", "--hide-scrollbars", "--no-first-run"])
            .args(["--disable-background-networking", "--disable-component-update"])
            // Where there is no graphics card, the processor draws.
            .args(["--disable-sync", "--enable-unsafe-swiftshader"])
            .arg(format!("--user-data-dir={}", profile.path().join("profile").display()));
        // Its sandbox refuses to begin as root; what it shows is ours.
        if rustix::process::getuid().is_root() {
            command.arg("--no-sandbox");
        }
        let mut child = command
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(log)
            .kill_on_drop(true)
            .spawn()
            .with_context(|| format!("cannot start {}", browser.display()))?;
        let pipes = child.stdin.take().zip(child.stdout.take());
        let (to, from) = pipes.context("the browser has no pipes")?;
        let from = BufReader::new(from);
        let mut tab = Self { child, to, from, session: None, calls: 0, profile };
        let target = tab.call("Target.createTarget", json!({ "url": "about:blank" })).await?;
        let attach = json!({ "targetId": target["targetId"], "flatten": true });
        let session = tab.call("Target.attachToTarget", attach).await?;
        tab.session = session["sessionId"].as_str().map(str::to_owned);
        let size = json!({
            "width": width, "height": height, "deviceScaleFactor": 1, "mobile": false,
        });
        tab.call("Emulation.setDeviceMetricsOverride", size).await?;
        Ok(tab)
    }

    /// Goes to an address, and waits until the page there has been read and its script has run.
    pub(crate) async fn go(&mut self, url: &str) -> Result<()> {
        let answer = self.call("Page.navigate", json!({ "url": url })).await?;
        if let Some(error) = answer["errorText"].as_str() {
            bail!("the browser cannot open {url}: {error}");
        }
        // Until the page has come, the empty one before answers.
        const READ: &str = "location.href !== 'about:blank' && document.readyState === 'complete'";
        let deadline = tokio::time::Instant::now() + PATIENCE;
        while self.evaluate(READ, PATIENCE).await? != json!(true) {
            if tokio::time::Instant::now() > deadline {
                bail!("the browser does not get {url}");
            }
            tokio::time::sleep(LOOK_PERIOD).await;
        }
        Ok(())
    }

    /// The value of an expression in the page, waited for if it is a promise.
    pub(crate) async fn evaluate(&mut self, expression: &str, patience: Duration) -> Result<Value> {
        let asked =
            json!({ "expression": expression, "awaitPromise": true, "returnByValue": true });
        let mut answer = self.call_within(patience, "Runtime.evaluate", asked).await?;
        if let Some(thrown) = answer.get("exceptionDetails") {
            let description = thrown["exception"]["description"].as_str();
            let text = description.or_else(|| thrown["text"].as_str()).unwrap_or_default();
            let first = text.lines().next().unwrap_or_default();
            bail!("{}", first.trim_start_matches("Error: "));
        }
        Ok(answer["result"]["value"].take())
    }

    /// What the page looks like, as PNG.
    pub(crate) async fn picture(&mut self) -> Result<Vec<u8>> {
        let asked = json!({ "format": "png", "optimizeForSpeed": true });
        let answer = self.call("Page.captureScreenshot", asked).await?;
        Ok(STANDARD.decode(answer["data"].as_str().unwrap_or_default())?)
    }

    /// Ends the browser in good order, so that its profile can go.
    pub(crate) async fn close(mut self) {
        self.session = None;
        // It may have ended already; a process that stays is killed.
        let _ = tokio::time::timeout(FAREWELL, self.call("Browser.close", json!({}))).await;
        let _ = tokio::time::timeout(FAREWELL, self.child.wait()).await;
    }

    async fn call(&mut self, method: &str, parameters: Value) -> Result<Value> {
        self.call_within(PATIENCE, method, parameters).await
    }

    async fn call_within(
        &mut self,
        patience: Duration,
        method: &str,
        parameters: Value,
    ) -> Result<Value> {
        let answer = tokio::time::timeout(patience, self.ask(method, parameters)).await;
        answer.with_context(|| format!("the browser does not answer {method}"))?
    }

    async fn ask(&mut self, method: &str, parameters: Value) -> Result<Value> {
        self.calls += 1;
        let mut call = json!({ "id": self.calls, "method": method, "params": parameters });
        if let Some(session) = &self.session {
            call["sessionId"] = json!(session);
        }
        if self.to.write_all(format!("{call}\0").as_bytes()).await.is_err() {
            bail!("the browser has ended: {}", self.complaint());
        }
        loop {
            let mut message = Vec::new();
            if self.from.read_until(0, &mut message).await? == 0 {
                bail!("the browser has ended: {}", self.complaint());
            }
            message.pop();
            let mut message: Value = serde_json::from_slice(&message)?;
            // All else are events.
            if message["id"] != json!(self.calls) {
                continue;
            }
            if let Some(error) = message.get("error") {
                bail!("{method}: {}", error["message"].as_str().unwrap_or("refused"));
            }
            return Ok(message["result"].take());
        }
    }

    /// The end of what the browser has complained of.
    fn complaint(&self) -> String {
        let log = std::fs::read(self.profile.path().join("log")).unwrap_or_default();
        let end = &log[log.len().saturating_sub(COMPLAINT)..];
        String::from_utf8_lossy(end).trim().to_owned()
    }
}
