//! Recordings for people: plots, and the page with a recording.

use std::io::{BufRead as _, BufReader, Read as _, Write as _};
use std::net::TcpStream;
use std::process::{Child, Command, Stdio};

use plantd_tests::server::binary;

use super::{Setup, plantctl, setup};

/// A recording of a pendulum.
async fn recorded(setup: &Setup, name: &str) -> std::path::PathBuf {
    let id = setup.plant("pendulum").await.id;
    setup.record(&id, name).await;
    setup.step(&id, 60, 1).await;
    setup.client.stop_recording(name).await.unwrap();
    setup.file(name)
}

#[tokio::test]
async fn signals_are_plotted_in_the_terminal_and_as_pictures() {
    let setup = setup(&[]).await;
    let file = recorded(&setup, "plotted").await;
    let text = |more: &[&str]| {
        let output = plantctl("plot", &file, more);
        assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
        String::from_utf8(output.stdout).unwrap()
    };
    let plot = text(&["q.theta", "u.tau", "energy.total"]);
    for title in ["q.theta, rad", "u.tau, N m", "energy.total, J"] {
        assert!(plot.lines().any(|line| line.starts_with(title)), "{plot}");
    }
    assert!(plot.lines().all(|line| line.chars().count() <= 80), "{plot}");
    assert!(plot.chars().filter(|c| ('\u{2801}'..='\u{28ff}').contains(c)).count() > 150, "{plot}");
    let names = text(&[]);
    assert!(
        ["q.theta", "velocity.theta", "u.tau"].iter().all(|name| names.contains(name)),
        "{names}"
    );
    let picture = setup.recordings.path().join("plot.svg");
    text(&["theta", "velocity.theta", "--until", "3", "--out", picture.to_str().unwrap()]);
    let svg = std::fs::read_to_string(&picture).unwrap();
    assert!(svg.starts_with("<svg ") && svg.contains("velocity.theta, rad/s"), "{svg}");
    // What is asked for wrongly is told, and how it is right.
    let wrong = plantctl("plot", &file, &["q.tehta"]);
    let message = String::from_utf8_lossy(&wrong.stderr).into_owned();
    assert!(!wrong.status.success() && message.contains("did you mean `q.theta`?"), "{message}");
}

/// A process that ends with this value.
struct Served(Child);

impl Drop for Served {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

#[tokio::test]
async fn a_recording_is_shown_without_another_server() {
    let setup = setup(&[]).await;
    let file = recorded(&setup, "shown").await;
    let mut command = Command::new(binary("plantctl").unwrap());
    command.args(["view", "--no-open"]).arg(&file).stdin(Stdio::null()).stdout(Stdio::piped());
    let mut served = Served(command.spawn().unwrap());
    let mut url = String::new();
    BufReader::new(served.0.stdout.take().unwrap()).read_line(&mut url).unwrap();
    let (host, path) = url.trim().strip_prefix("http://").unwrap().split_once('/').unwrap();
    let path = path.strip_prefix("?recording=").expect("the page is told which");
    let ask = |address: &str, request: &str| {
        let mut connection = TcpStream::connect(address).unwrap();
        connection.write_all(format!("{request}Connection: close\r\n\r\n").as_bytes()).unwrap();
        let mut answer = Vec::new();
        connection.read_to_end(&mut answer).unwrap();
        let end = answer.windows(4).position(|bytes| bytes == b"\r\n\r\n").unwrap();
        (String::from_utf8(answer[..end].to_vec()).unwrap(), answer[end + 4..].to_vec())
    };
    let get = |path: &str, more: &str| {
        ask(host, &format!("GET {path} HTTP/1.1\r\nHost: {host}\r\n{more}"))
    };
    let bytes = std::fs::read(&file).unwrap();
    let (head, body) = get(path, "");
    assert!(head.starts_with("HTTP/1.1 200") && body == bytes, "{head}");
    let (head, body) = get(path, "Range: bytes=8-99\r\n");
    assert!(head.starts_with("HTTP/1.1 206") && body == bytes[8..100], "{head}");
    assert!(head.contains(&format!("content-range: bytes 8-99/{}", bytes.len())), "{head}");
    assert!(get("/etc/passwd", "").0.starts_with("HTTP/1.1 404"));
    let (page, _) = get("/", "");
    assert!(page.starts_with("HTTP/1.1 200") && page.contains("text/html"), "{page}");
    // Other names and other pages get nothing.
    let foreign = ask(host, &format!("GET {path} HTTP/1.1\r\nHost: rebound.example\r\n"));
    assert!(foreign.0.starts_with("HTTP/1.1 403"), "{}", foreign.0);
    assert!(get(path, "Origin: http://foreign.example\r\n").0.starts_with("HTTP/1.1 403"));
    // The policy of the page is that of the server's.
    let policy = |head: &str| {
        let line = head.lines().find(|line| line.starts_with("content-security-policy: "));
        line.expect("a policy").to_owned()
    };
    let server = setup.server.address().strip_prefix("http://").unwrap();
    let (theirs, _) = ask(server, &format!("GET / HTTP/1.1\r\nHost: {server}\r\n"));
    assert_eq!(policy(&page), policy(&theirs));
}
