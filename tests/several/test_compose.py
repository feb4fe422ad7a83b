"""deploy/compose.yaml: good by the specification of Compose files, and its servers and its gateway do what it says, as
processes on this machine in place of containers."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest
from envoys import SCRIPT, Envoy, again
from processes import Process

FILE = SCRIPT.with_name("compose.yaml")
KEPT = "/var/lib/plantd"
yaml = pytest.importorskip("yaml")


def problems(text, folder):
    """What the schema of the specification finds."""
    pytest.importorskip("check_jsonschema")
    file = folder / "compose.yaml"
    file.write_text(text)
    command = [sys.executable, "-m", "check_jsonschema", "--builtin-schema", "vendor.compose-spec", file]
    told = subprocess.run([*command, "--output-format", "json"], capture_output=True, text=True)
    assert told.stdout, told.stderr
    return json.loads(told.stdout).get("errors", [])


def composed():
    whole = yaml.safe_load(FILE.read_text())
    services = whole["services"]
    servers = {name: one for name, one in services.items() if one["image"] == "plantd"}
    return whole, services, servers


def test_it_is_good_by_the_specification(tmp_path):
    text = FILE.read_text()
    assert problems(text, tmp_path) == []
    for right, wrong in [("stop_grace_period:", "stop_grace:"), ("read_only: true", "read_only: [1]")]:
        assert right in text and problems(text.replace(right, wrong), tmp_path), wrong


def test_its_servers_are_configured(server, tmp_path):
    whole, services, servers = composed()
    assert len(servers) == 3
    (gateway,) = services["envoy"]["ports"]
    host, outside, inside = gateway.split(":")
    assert host == "127.0.0.1" and outside == inside
    names = []
    for service, one in servers.items():
        # Nobody but the gateway reaches it: its image listens everywhere and asks nobody.
        assert "ports" not in one and one["read_only"] and one["cap_drop"] == ["ALL"]
        # Of its own, and there after it.
        (volume,) = one["volumes"]
        assert volume == f"{service}:{KEPT}" and service in whole["volumes"]
        containers = {"PLANTD_GRPC": "0.0.0.0:50051", "PLANTD_INSECURE": "true", "PLANTD_METRICS": "off"}
        kept = {name: value for name, value in os.environ.items() if not name.startswith("PLANTD")}
        command = [server, "serve", "--config", FILE.with_name("plantd.toml"), "--print-config"]
        environment = {**kept, **containers, **one["environment"]}
        told = subprocess.run(command, env=environment, capture_output=True, text=True)
        assert told.returncode == 0, told.stderr
        name = one["environment"]["PLANTD_NAME"]
        for line in [
            f'name = "{name}"',
            f'advertise = "http://{name}:{outside}"',
            f'state_directory = "{KEPT}/plants"',
            f'recordings = "{KEPT}/recordings"',
            "drain_s = 20.0",
        ]:
            assert line in told.stdout.splitlines(), line
        # The server ends by itself before it is ended.
        assert float(one["environment"]["PLANTD_DRAIN_S"]) + 15 <= float(one["stop_grace_period"].removesuffix("s"))
        names.append(name)
    command = services["names"]["command"]
    places = dict(word.split("=") for word in command if not word.startswith("-") and "=" in word)
    assert places == {name: f"{service}:50051" for name, service in zip(names, servers)}
    (placing,) = [word.removeprefix("--new=") for word in command if word.startswith("--new=")]
    assert services["envoy"]["networks"]["default"]["aliases"] == [*names, placing]
    assert "EXPOSE 50051" in FILE.with_name("Containerfile").read_text()


class Composed(Envoy):
    """The gateway with the configuration that the service `names` writes."""

    def publish(self, servers):
        _, services, _ = composed()
        places = {f"{service}:50051": server.place for service, server in servers.items()}
        words = {"/deploy/envoy.py": str(SCRIPT), "--listen=0.0.0.0:8080": f"--listen={self.place}"}
        words["--output=/names/envoy.json"] = f"--output={self.folder / 'written.json'}"
        words["python3"] = sys.executable

        def here(word):
            name, _, place = word.partition("=")
            return f"{name}={places[place]}" if place in places else words.get(word, word)

        subprocess.run(list(map(here, services["names"]["command"])), check=True)
        return (self.folder / "written.json").read_text()


def test_its_servers_keep_their_plants(server, tmp_path):
    _, services, servers = composed()
    running = {}
    gateway = None
    try:
        for service, one in servers.items():
            environment = one["environment"]
            folder = environment["PLANTD_STATE_DIRECTORY"].replace(KEPT, str(tmp_path / service))
            Path(folder).mkdir(parents=True)
            given = ["--advertise", environment["PLANTD_ADVERTISE"], "--state-directory", folder, "--drain-s", "0"]
            running[service] = Process(tmp_path / service, environment["PLANTD_NAME"], *given)
        gateway = Composed(tmp_path, running)
        with gateway.client("new.lab") as new:
            plants = [again(lambda: new.create_plant("pendulum", q=[0.1 * k])) for k in range(6)]
        # Its address is the one under which the gateway has it.
        assert {plant.address for plant in plants} <= {f"http://{one.name}:8080" for one in running.values()}
        one = next(one for one in running.values() if one.name == plants[0].server)
        with gateway.client(one.name) as client:
            *_, stepped = client.step(plants[0].id, count=7)
            one.signal(15)
            one.wait()
            one.start()
            assert again(lambda: client.get_plant(plants[0].id)).state.x.tobytes() == stepped.x.tobytes()
    finally:
        if gateway is not None:
            gateway.end()
        for one in running.values():
            one.end()
