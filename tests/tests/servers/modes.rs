//! What the server makes and what it asks of the system: modes of files whatever the umask, and permissions
//! for real time.

use std::collections::BTreeSet;
use std::fs;
use std::os::unix::fs::PermissionsExt as _;
use std::os::unix::process::CommandExt as _;
use std::path::Path;
use std::process::Command;
use std::sync::atomic::{AtomicBool, Ordering};

use plantd_client::v1;
use plantd_server::core::modes::Mode;
use plantd_server::listen::UnixSocket;
use plantd_tests::server::ServerProcess;
use rustix::process::{Resource, Rlimit, setrlimit, umask};
use rustix::thread::CapabilitySet;

/// Does something in the process of a command before it begins.
fn before(command: &mut Command, act: impl Fn() + Send + Sync + 'static) {
    let act = move || {
        act();
        Ok(())
    };
    // SAFETY: what is done makes system calls alone, and allocates nothing.
    unsafe { command.pre_exec(act) };
}

/// Mode of a file, in octal.
fn mode(path: &Path) -> std::io::Result<String> {
    Ok(format!("{:04o}", fs::metadata(path)?.permissions().mode() & 0o7777))
}

/// Modes of a server's socket, a saved plant, a recording, their directories and the ready file, with an umask
/// and further arguments.
async fn modes(mask: u32, arguments: &[&str]) -> [String; 6] {
    let folder = tempfile::tempdir().unwrap();
    let (state, recordings) = (folder.path().join("deep/state"), folder.path().join("recordings"));
    let mut server = ServerProcess::start_with(|command| {
        before(command, move || {
            umask(rustix::fs::Mode::from_raw_mode(mask));
        });
        command.arg("--state-directory").arg(&state).arg("--recordings").arg(&recordings);
        command.args(["--drain-s", "0"]).args(arguments);
    })
    .unwrap();
    let socket = server.directory().join("plantd.sock");
    let ready = server.directory().join("ready.json");
    let served = [&socket, &ready].map(|path| mode(path).unwrap());
    let client = server.client().await;
    let id = "kept".to_owned();
    let model = "pendulum".to_owned();
    let request = v1::CreatePlantRequest { id: id.clone(), model, ..Default::default() };
    client.create_plant(request).await.unwrap();
    let request = v1::StartRecordingRequest { id, name: "r".to_owned(), ..Default::default() };
    client.start_recording(request).await.unwrap();
    client.stop_recording("r").await.unwrap();
    drop(client);
    let stopped = tokio::task::spawn_blocking(move || server.stop()).await.unwrap();
    assert!(stopped.unwrap().success());
    let (plant, recording) = (state.join("kept.plant"), recordings.join("r.mcap"));
    let [socket, ready] = served;
    let kept = [&plant, &recording, &state, &recordings].map(|path| mode(path).unwrap());
    let [plant, recording, state, recordings] = kept;
    [socket, plant, recording, state, recordings, ready]
}

#[tokio::test]
async fn a_loose_umask_opens_nothing() {
    let made = modes(0, &[]).await;
    assert_eq!(made, ["0660", "0600", "0600", "0700", "0700", "0644"]);
}

#[tokio::test]
async fn modes_are_what_the_configuration_says_whatever_the_umask() {
    let arguments = ["--unix-mode", "0666", "--file-mode", "0640"];
    let made = modes(0o027, &arguments).await;
    assert_eq!(made, ["0666", "0640", "0640", "0750", "0750", "0644"]);
}

/// Somebody who looks all the time never sees the socket with another mode.
#[tokio::test]
async fn a_socket_is_at_no_time_open_to_others() {
    umask(rustix::fs::Mode::empty());
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("socket");
    let is_over = AtomicBool::new(false);
    let seen = std::thread::scope(|scope| {
        let looks = scope.spawn(|| {
            let mut seen = BTreeSet::new();
            while !is_over.load(Ordering::Relaxed) {
                seen.extend(mode(&path));
            }
            seen
        });
        futures::executor::block_on(async {
            // As a rule it is seen after a few; a machine that is busy needs more.
            for _ in 0..2000 {
                drop(UnixSocket::bind(&path, Mode::PRIVATE).await.unwrap());
            }
        });
        is_over.store(true, Ordering::Relaxed);
        looks.join().unwrap()
    });
    assert!(seen.iter().all(|mode| mode == "0600"), "{seen:?}");
}

/// Said when the server starts, before any plant is paced: the key, the limit that the process has, and how to
/// raise it.
#[test]
fn what_real_time_needs_and_does_not_get_is_said_at_the_start() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("plantd.toml");
    let keys = "scheduling = { fifo = 80 }\nlock_memory = true\ncpus = [0, 1000]\n";
    fs::write(&file, format!("[realtime]\n{keys}")).unwrap();
    let server = ServerProcess::start_with(|command| {
        before(command, || {
            // Who has no capabilities cannot give them away, and need not.
            for capability in [CapabilitySet::SYS_NICE, CapabilitySet::IPC_LOCK] {
                let _ = rustix::thread::remove_capability_from_bounding_set(capability);
            }
            for (resource, most) in [(Resource::Rtprio, 0), (Resource::Memlock, 65_536)] {
                let _ = setrlimit(resource, Rlimit { current: Some(most), maximum: Some(most) });
            }
        });
        command.arg("--config").arg(&file);
    })
    .unwrap();
    let log = server.log();
    for said in [
        "realtime.scheduling",
        "RLIMIT_RTPRIO of this process is 0;",
        "LimitRTPRIO",
        "realtime.lock_memory",
        "RLIMIT_MEMLOCK of this process is 65536",
        "LimitMEMLOCK",
        "realtime.cpus",
        "[1000]",
    ] {
        assert!(log.contains(said), "no `{said}` in\n{log}");
    }
}
