"""The driver over shared memory against a real server."""

import json
import math
import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np
import pytest

import plantd

pytest.importorskip("iceoryx2", reason="there is no iceoryx2 wheel for this platform")
from plantd.link import LinkDriver, LinkError  # noqa: E402

VICTIM = """
import sys, time
from plantd.link import LinkDriver
driver = LinkDriver(sys.argv[1], root=sys.argv[2])
driver.step([0.0])
print("stepped", flush=True)
time.sleep(600)
"""


@pytest.fixture(autouse=True)
def over_connections_only(request):
    """A server in this process has no shared memory."""
    case = getattr(request.node, "callspec", None)
    if case is not None and case.params.get("client") == "local":
        pytest.skip("a server in this process has no shared memory")


@pytest.fixture
def connect(client):
    """Makes a plant with an open link; gives its id and what connects a driver to it."""

    def connect(model, **options):
        plant = client.create_plant(model, open_link=True).id
        root = client.open_link(plant).root_path
        return plant, lambda: LinkDriver(plant, root=root, connect_timeout_s=10, timeout_s=10, **options)

    return connect


@pytest.mark.parametrize("poll_s", [0.0, 50e-6, None])
def test_shared_memory_and_grpc_give_the_same_bits(client, connect, poll_s):
    for model in ["cart-pole", "marionette"]:
        plant, driver = connect(model, poll_s=poll_s)
        start = client.get_plant(plant).state
        with driver() as link, client.drive(client.create_plant(model).id) as stream:
            assert link.state.x.tobytes() == start.x.tobytes()
            assert link.state.velocity.tobytes() == start.velocity.tobytes()
            inputs = link.input_len - len(start.v)
            for k in range(20):
                u = np.concatenate((0.1 * np.sin(k + np.arange(inputs)), start.q[len(start.p) :]))
                a, b = link.step(u), stream.step(u)
                assert (a.step, a.time) == (b.step, b.time)
                assert a.x.tobytes() == b.x.tobytes()
                assert a.multipliers.tobytes() == b.multipliers.tobytes()
                assert a.velocity.shape == a.q.shape
                assert a.velocity.tobytes() == b.velocity.tobytes()
            assert link.report == stream.report


def test_a_gain_of_another_time_step_is_refused(client, connect):
    _, driver = connect("pendulum")
    with driver() as link:
        own = link.state.time_step
        gain, other = (
            client.solve_lqr("pendulum", at="upright", q=[9, 1], r=[1], dt=dt)
            for dt in (own, own / 2)
        )
        assert gain(link.state).shape == (1,)
        with pytest.raises(ValueError, match=f"whose time step is {own} s"):
            other(link.state)


def test_failures_come_in_band_and_move_nothing(client, connect):
    plant, driver = connect("pendulum")
    with driver() as link:
        for u, reason in [([math.nan], "INPUT_NOT_FINITE"), ([0.0, 0.0], "INPUT_DIMENSION")]:
            with pytest.raises(plantd.StepError) as error:
                link.step(u)
            assert (error.value.code, error.value.reason) == ("INVALID_ARGUMENT", reason)
        assert client.get_plant(plant).state.step == 0
        assert link.step(0.1).step == 1


def test_a_watchdog_says_what_it_holds(client, connect):
    plant, driver = connect("cart-pole")
    client.set_safety(plant, [dict(quantity="v(x)", max=0.5)])
    with driver() as link, pytest.raises(plantd.StepError) as held:
        while True:
            link.step([20.0])
    assert held.value.reason == "WATCHDOG"
    for part in ["the velocity of coordinate 0 is ", "the bound 0.5", "Reset"]:
        assert part in held.value.message


def test_one_driver_at_a_time(client, connect):
    plant, driver = connect("pendulum")
    with driver():
        with pytest.raises(LinkError, match="LEASE_HELD"):
            driver()
        with pytest.raises(plantd.PlantdError, match="LEASE_HELD"):
            client.drive(plant)
    with driver() as link:
        assert link.step(0.0).step == 1


def test_a_killed_driver_gives_way(client, connect):
    plant, driver = connect("pendulum")
    root = client.open_link(plant).root_path
    victim = subprocess.Popen(
        [sys.executable, "-c", VICTIM, plant, root], stdout=subprocess.PIPE, text=True
    )
    try:
        assert victim.stdout.readline() == "stepped\n"
    finally:
        victim.kill()
        victim.wait()
    with driver() as link:
        assert link.step(0.0).step == 2


def test_a_deleted_plant_says_so(client, connect):
    plant, driver = connect("pendulum")
    with driver() as link:
        client.delete_plant(plant)
        with pytest.raises(LinkError) as error:
            link.step(0.0)
    assert (error.value.code, error.value.reason) == ("NOT_FOUND", "PLANT_DELETED")
    with pytest.raises(LinkError, match="NOT_OPEN"):
        LinkDriver(plant, connect_timeout_s=0.05, root=link._root)


def test_streamed_gains_drive_over_shared_memory(client, connect):
    plant, driver = connect("pendulum")
    client.reset(plant, q=[math.pi - 0.2])
    client.set_feedback(plant, at="upright", q=[100, 1], r=[1])
    with driver() as driver, client.follow_gains(plant) as law:
        for _ in range(100):
            driver.step(law(driver.state))
        assert abs(driver.state.q[0] - math.pi) < 1e-9


@pytest.fixture
def serve(tmp_path_factory):
    """Starts servers with the same plants under the same root path."""
    folder = tmp_path_factory.mktemp("l")
    servers = []

    def serve():
        ready = folder / f"ready-{len(servers)}"
        arguments = ["serve", "--grpc", "127.0.0.1:0", "--unix", str(folder / "plantd.sock")]
        arguments += ["--link-root", str(root), "--state-directory", str(folder / "state")]
        arguments += ["--state-interval-s", "0.05", "--ready-file", str(ready)]
        with (folder / "log").open("a") as log:
            server = subprocess.Popen([os.environ["PLANTD_SERVER"], *arguments], stdout=log, stderr=log)
        servers.append(server)
        deadline = time.monotonic() + 30
        while not ready.exists():
            assert server.poll() is None and time.monotonic() < deadline, (folder / "log").read_text()
            time.sleep(0.01)
        return server, root, json.loads(ready.read_text())["grpc"]

    with tempfile.TemporaryDirectory(prefix="plantd-") as short:
        root = Path(short) / "link"
        yield serve
        for server in servers:
            server.kill()
            server.wait()
        # The next one removes what is left of them.
        server, _, _ = serve()
        server.terminate()
        assert server.wait(30) == 0
        assert not list(root.iterdir())


def test_a_driver_finds_the_next_server_and_the_last_one_to_leave_removes_what_is_left(serve):
    server, root, address = serve()
    with plantd.connect(address) as client:
        client.create_plant("pendulum", id="arm", open_link=True)
    server.terminate()
    assert server.wait(30) == 0
    assert not list(root.iterdir())

    server, _, _ = serve()
    driver = LinkDriver("arm", root=root, connect_timeout_s=10, timeout_s=10)
    assert driver.step(0.0).step == 1
    prefix = driver._prefix()
    server.kill()
    server.wait()
    with pytest.raises(LinkError, match="SERVER_GONE"):
        driver.step(0.0)
    server, _, _ = serve()
    with pytest.raises(LinkError, match="SERVER_RESTARTED"):
        driver.step(0.0)
    with LinkDriver("arm", root=root, connect_timeout_s=10, timeout_s=10) as again:
        again.step(0.0)
    assert list(Path("/dev/shm").glob(f"{prefix}*"))
    driver.close()
    assert not list(Path("/dev/shm").glob(f"{prefix}*"))
    assert not (root / prefix.split("_")[1]).exists()


def test_segments_and_roots_that_are_not_what_they_must_be_are_refused_by_name(serve):
    _, root, address = serve()
    with plantd.connect(address) as client:
        client.create_plant("pendulum", id="arm", open_link=True)
    size, name = (root / "arm.link").read_text().splitlines()[1].split()
    segment = Path("/dev/shm") / name
    segment.chmod(0o666)
    with pytest.raises(LinkError, match=f"SEGMENT_NOT_PRIVATE.*{name}"):
        LinkDriver("arm", root=root)
    segment.chmod(0o600)
    os.truncate(segment, 0)
    with pytest.raises(LinkError, match=f"{name} has 0 bytes, not the {size}"):
        LinkDriver("arm", root=root, connect_timeout_s=0.1)
    other = root.parent / "other"
    other.symlink_to(root)
    with pytest.raises(LinkError, match=f"ROOT_NOT_PRIVATE.*{other} is a symbolic link"):
        LinkDriver("arm", root=other)
