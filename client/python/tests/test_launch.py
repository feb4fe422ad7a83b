"""A server of one's own: it ends with whoever started it."""

import gc
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import plantd
import pytest


@pytest.fixture
def program():
    return os.environ["PLANTD_SERVER"]


def ended(pid):
    deadline = time.monotonic() + 30
    while Path(f"/proc/{pid}").exists() and "zombie" not in Path(f"/proc/{pid}/status").read_text():
        assert time.monotonic() < deadline, f"server {pid} lives on"
        time.sleep(0.02)
    return True


def test_a_server_ends_with_its_block(program):
    with plantd.launch(program, arguments=["--limit", "plants=1"]) as client:
        server = client.server
        assert server.is_running and client.get_model("pendulum").builtin
        client.create_plant("pendulum")
        with pytest.raises(plantd.PlantdError, match="limit `plants` is 1"):
            client.create_plant("pendulum")
        socket = Path(server.address.removeprefix("unix:"))
        assert socket.exists()
    assert not server.is_running and not socket.parent.exists()


def test_a_server_ends_with_its_object(program):
    client = plantd.launch(program)
    pid = client.server.pid
    del client
    gc.collect()
    assert ended(pid)


# Whoever starts the tests may ignore Ctrl-C, which is inherited.
SCRIPT = """
import signal, sys, time, plantd
signal.signal(signal.SIGINT, signal.default_int_handler)
client = plantd.launch(sys.argv[1])
print(client.server.pid, flush=True)
if sys.argv[2] == "return":
    sys.exit(0)
time.sleep(600)
"""


@pytest.mark.parametrize("end", ["return", "kill", "interrupt"])
def test_a_server_ends_with_its_process(program, end):
    command = [sys.executable, "-c", SCRIPT, program, end]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True) as script:
        pid = int(script.stdout.readline())
        if end != "return":
            assert Path(f"/proc/{pid}").exists()
            script.send_signal(signal.SIGKILL if end == "kill" else signal.SIGINT)
        script.wait()
    assert ended(pid)


def test_where_the_program_is_looked_for(program, monkeypatch, tmp_path):
    monkeypatch.setenv("PLANTD", program)
    with plantd.launch() as client:
        assert client.list_plants() == []
    monkeypatch.setenv("PLANTD", "/no/such/plantd")
    with pytest.raises(plantd.PlantdError, match="the variable PLANTD names `/no/such/plantd`"):
        plantd.launch()
    monkeypatch.delenv("PLANTD")
    with pytest.raises(plantd.PlantdError, match="`program` names `nowhere`, which is no program"):
        plantd.launch("nowhere")
    # The installed package may have brought one.
    monkeypatch.setattr("plantd._launch._places", lambda: iter([tmp_path / "plantd"]))
    monkeypatch.setenv("PATH", str(tmp_path))
    with pytest.raises(plantd.PlantdError, match="there is no program `plantd` in PATH.*cargo build"):
        plantd.launch()
    monkeypatch.setenv("PATH", os.path.dirname(program))
    with plantd.launch() as client:
        assert client.list_plants() == []


def test_a_server_that_does_not_start_says_why(program):
    with pytest.raises(plantd.PlantdError, match="there is no limit `plant`; did you mean `plants`?"):
        plantd.launch(program, arguments=["--limit", "plant=1"])


def test_a_server_that_has_ended_is_told_of(program):
    with plantd.launch(program) as client:
        os.kill(client.server.pid, signal.SIGKILL)
        ended(client.server.pid)
        with pytest.raises(plantd.PlantdError, match="the server does not answer any more"):
            client.list_plants()
