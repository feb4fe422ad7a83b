"""One closed loop in every language and over every link: the same bits in each state.

The law is `u = -3 q - p` on the pendulum, in floating-point numbers the same everywhere. Programs print q, p and the
velocity after each step, with all digits. What a machine has no tools for is skipped by name.
"""

import json
import os
import shutil
import subprocess
from pathlib import Path

import fmpy
import numpy as np
import plantd
import pytest

STEPS = 200
ROOT = Path(__file__).resolve().parents[3]


def binaries():
    return Path(os.environ["PLANTD_SERVER"]).resolve().parent


def row(state):
    return [state.q[0], state.p[0], state.velocity[0]]


def torque(q, p):
    return -3.0 * q - p


def driven(client):
    """The loop in Python, whoever the client is."""
    with client.plant("pendulum") as plant, plant.drive() as driver:
        state, rows = driver.plant.state, []
        for _ in range(STEPS):
            state = driver.step([torque(state.q[0], state.p[0])])
            rows.append(row(state))
    return np.array(rows)


def printed(*command, **environment):
    """What a program prints."""
    command = [os.fspath(word) for word in command]
    run = subprocess.run(
        command, env={**os.environ, **environment}, capture_output=True, text=True, timeout=300
    )
    assert run.returncode == 0, run.stdout + run.stderr
    return np.array([[float(word) for word in line.split()] for line in run.stdout.splitlines()])


def needs(*programs):
    for program in programs:
        if shutil.which(program) is None:
            pytest.skip(f"there is no {program}")


@pytest.fixture(scope="module")
def server(tmp_path_factory):
    """A server with shared memory; a client of it."""
    addresses = ["--grpc", "127.0.0.1:0"]
    with plantd.launch(os.environ["PLANTD_SERVER"], arguments=addresses) as client:
        yield client


@pytest.fixture(scope="module")
def expected(server):
    """The loop over gRPC, in Python."""
    rows = driven(server)
    assert rows.shape == (STEPS, 3) and np.all(np.isfinite(rows)) and np.ptp(rows[:, 0]) > 0.1
    return rows


def over_local(server, folder):
    pytest.importorskip("plantd._native", reason="the package is installed without the server in it")
    with plantd.local() as client:
        return driven(client)


def over_shared_memory(server, folder):
    link = pytest.importorskip("plantd.link", reason="there is no iceoryx2 wheel for this platform")
    with server.plant("pendulum") as plant, link.LinkDriver(plant) as driver:
        state, rows = driver.state, []
        for _ in range(STEPS):
            state = driver.step([torque(state.q[0], state.p[0])])
            rows.append(row(state))
    return np.array(rows)


def through_the_fmu(server, folder):
    path = folder / "pendulum.fmu"
    subprocess.run([binaries() / "plantctl", "fmu", "pendulum", "-o", path], check=True)
    description = fmpy.read_model_description(str(path))
    reference = {v.name: v.valueReference for v in description.modelVariables}
    (coordinate,) = server.get_model("pendulum").coordinates
    (input,) = server.get_model("pendulum").inputs
    fmu = fmpy.instantiate_fmu(fmpy.extract(str(path)), description, "CoSimulation")
    fmu.enterInitializationMode()
    fmu.exitInitializationMode()
    names = [reference[f"{what}({coordinate.name})"] for what in ("q", "p", "velocity")]
    h, rows = server.get_model("pendulum").time_step_s, []
    q, p, _ = fmu.getFloat64(names)
    for k in range(STEPS):
        fmu.setFloat64([reference[f"u({input})"]], [torque(q, p)])
        fmu.doStep(currentCommunicationPoint=k * h, communicationStepSize=h)
        rows.append(fmu.getFloat64(names))
        q, p, _ = rows[-1]
    fmu.terminate()
    fmu.freeInstance()
    return np.array(rows)


def tcp(server):
    """The address of the server that other languages are told."""
    ready = Path(server.server.address.removeprefix("unix:")).with_name("ready.json")
    return json.loads(ready.read_text())["grpc"].removeprefix("http://")


def in_node(server, folder):
    needs("node", "npm")
    for name in ("package.json", "pendulum.js"):
        shutil.copy(ROOT / "client/node" / name, folder / name)
    install = ["npm", "install", "--silent", "--no-audit", "--no-fund", "--no-package-lock"]
    if subprocess.run(install, cwd=folder).returncode != 0:
        pytest.skip("npm cannot install what the example needs")
    return printed("node", folder / "pendulum.js", tcp(server), str(STEPS), PLANTD_PROTO=str(ROOT / "proto"))


def in_go(server, folder):
    packages = Path("/usr/share/gocode")
    needs("go", "protoc", "protoc-gen-go", "protoc-gen-go-grpc")
    if not (packages / "src/google.golang.org/grpc").exists():
        pytest.skip("gRPC for Go is not where Debian puts it")
    package = folder / "src/plantd-example"
    package.mkdir(parents=True)
    shutil.copy(ROOT / "client/go/pendulum.go", package)
    subprocess.run([ROOT / "client/go/generate.sh", package], check=True)
    go = {**os.environ, "GO111MODULE": "off", "GOPATH": f"{folder}:{packages}"}
    subprocess.run(["go", "build", "-o", folder / "pendulum", "."], cwd=package, env=go, check=True)
    return printed(folder / "pendulum", tcp(server), str(STEPS))


def in_rust(server, folder):
    """The example of the Rust library, which the build has made."""
    program = binaries() / "examples" / "pendulum"
    if not program.exists():
        pytest.skip("the examples of the Rust library are not built")
    return printed(program, f"http://{tcp(server)}", str(STEPS))


def compiled(compiler, standard, source):
    """Compiles an example of the library for C and C++, and runs it over shared memory."""

    def run(server, folder):
        needs(compiler)
        if not (binaries() / "libplantd.so").exists():
            pytest.skip("the library for C is not built")
        prefix = folder / "usr"
        subprocess.run([ROOT / "client/c/install.sh", prefix, binaries()], check=True)
        program = folder / "pendulum"
        command = [compiler, f"-std={standard}", "-pthread", ROOT / "client/c/examples" / source, "-o", program]
        subprocess.run([*command, f"-I{prefix}/include", f"-L{prefix}/lib", "-lplantd"], check=True)
        plant = server.create_plant("pendulum", open_link=True)
        root = server.server.link_root
        return printed(program, plant.id, root, str(STEPS), LD_LIBRARY_PATH=str(prefix / "lib"))

    return run


WAYS = {
    "python over shared memory": over_shared_memory,
    "python in process": over_local,
    "fmu": through_the_fmu,
    "node": in_node,
    "go": in_go,
    "rust": in_rust,
    "c": compiled("cc", "c11", "pendulum.c"),
    "c++": compiled("c++", "c++20", "pendulum.cpp"),
}


@pytest.mark.parametrize("way", WAYS)
def test_every_way_has_the_same_bits(server, expected, way, tmp_path):
    rows = WAYS[way](server, tmp_path)
    assert rows.shape == expected.shape
    assert np.array_equal(rows.view(np.uint64), expected.view(np.uint64))
