"""Starts the server that `PLANTD_SERVER` names."""

import json
import os
import subprocess
import time

import pytest

import plantd


@pytest.fixture(scope="session")
def addresses(tmp_path_factory):
    """Addresses of a running server: ``grpc`` and ``unix``."""
    binary = os.environ.get("PLANTD_SERVER")
    if not binary:
        pytest.exit("PLANTD_SERVER must name the plantd binary", returncode=2)
    folder = tmp_path_factory.mktemp("server")
    ready, log = folder / "ready.json", folder / "log"
    # Other tests share the processors; workers that take what others leave would starve.
    environment = {**os.environ, "PLANTD_WORKER_PRIORITY": "normal"}
    arguments = ["serve", "--grpc", "127.0.0.1:0", "--unix", str(folder / "plantd.sock")]
    arguments += ["--recordings", str(folder / "recordings")]
    with log.open("w") as output:
        server = subprocess.Popen(
            [binary, *arguments, "--ready-file", str(ready)],
            env=environment,
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=output,
        )
    try:
        deadline = time.monotonic() + 30
        while not ready.exists():
            assert server.poll() is None and time.monotonic() < deadline, log.read_text()
            time.sleep(0.01)
        yield json.loads(ready.read_text())
    finally:
        server.terminate()
        try:
            server.wait(timeout=30)
        except subprocess.TimeoutExpired:
            server.kill()
            server.wait()


@pytest.fixture(scope="session")
def local_client(tmp_path_factory):
    """A client of a server in this process."""
    pytest.importorskip("plantd._native", reason="the package is installed without the server in it")
    with plantd.local(recordings=tmp_path_factory.mktemp("local")) as client:
        yield client


@pytest.fixture(params=["grpc", "unix", "local"])
def client(request):
    """A client: over TCP, over the Unix-domain socket, and of a server in this process."""
    if request.param == "local":
        client = request.getfixturevalue("local_client")
        yield client
        for plant in client.list_plants():
            client.delete_plant(plant.id)
        return
    with plantd.connect(request.getfixturevalue("addresses")[request.param]) as client:
        yield client
        for plant in client.list_plants():
            client.delete_plant(plant.id)
