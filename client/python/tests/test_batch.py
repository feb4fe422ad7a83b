"""Batches over processes and servers: the bits of one server, whatever is lost on the way."""

import hashlib
import math
import multiprocessing
import os
import pickle
import secrets
import signal
import subprocess
import sys
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path

import numpy as np
import plantd
import pytest
from plantd import batch
from plantd.v1 import control_service_pb2
from processes import processes
from test_travel import SCENE

COUNT, STEPS, SIZE = 240, 300, 10


def cases(count=COUNT, steps=STEPS):
    for k in range(count):
        q = [0.01 * k, math.sin(k)]
        yield batch.case([[0.1 * (k % 7)]], steps=steps - 1, q=q, velocity=[0.0, 0.001 * k])


def digest(x):
    assert not np.isnan(x).any()
    return hashlib.sha256(np.ascontiguousarray(x).tobytes()).hexdigest()


@pytest.fixture
def program(monkeypatch):
    """What workers start, and this process."""
    monkeypatch.setenv("PLANTD", os.environ["PLANTD_SERVER"])
    yield os.environ["PLANTD_SERVER"]
    for key in list(batch._servers):
        batch._servers.pop(key).close()


@pytest.fixture(scope="module")
def expected(tmp_path_factory):
    """The last states of all cases, by one call of the contract."""
    with processes(tmp_path_factory.mktemp("direct"), "direct") as (server,):
        request = control_service_pb2.RolloutRequest(model="cart-pole", cases=cases())
        x = [None] * COUNT
        for answer in server.client.control.Rollout(request):
            state = answer.states[-1]
            x[answer.case_index] = [*state.q, *state.p, *state.v]
    return digest(np.array(x))


@pytest.fixture
def two(tmp_path):
    with processes(tmp_path, "one", "two") as servers:
        yield servers


def test_the_same_bits_everywhere(program, expected, two):
    one, two = two
    spawned = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(2, mp_context=spawned) as pool, plantd.connect(one.address) as client:
        for over in [
            None,
            pool,
            one.address,
            f"{one.address}, {two.address}",
            [one.address] * 3,
            [client, two.address],
            client,
        ]:
            done = batch.rollout("cart-pole", cases(), over, size=SIZE)
            assert digest(done.x) == expected, over
            assert done.cases.tolist() == list(range(COUNT)) and done.errors == {}
            assert (done.steps == STEPS).all() and (done.end == 0).all()
        # As any other engine would.
        cut = list(batch.pieces("cart-pole", cases(), size=SIZE))
        assert pickle.loads(pickle.dumps(cut)) == cut and len(cut) == COUNT / SIZE
        done = batch.together(reversed(list(pool.map(batch.run, cut))))
        assert digest(done.x) == expected and done.build == one.client.get_server().build
        # A client that was given is not closed.
        assert client.list_plants() == []


def test_a_client_does_a_batch(client, expected):
    assert digest(batch.rollout("cart-pole", cases(), client, size=SIZE).x) == expected


def test_a_server_that_is_killed_changes_nothing(expected, two):
    one, two = two

    def killing():
        for k, case in enumerate(cases()):
            if k == COUNT // 2:
                one.kill()
            yield case

    done = batch.rollout("cart-pole", killing(), [one.address, two.address], size=SIZE)
    assert one.process.returncode == -signal.SIGKILL
    assert digest(done.x) == expected


def test_a_server_that_comes_back_is_taken_again(expected, two):
    one, two = two

    def restarting():
        for k, case in enumerate(cases()):
            if k == COUNT // 4:
                one.signal(signal.SIGTERM)
                one.wait()
            if k == COUNT // 2:
                # One is alone from here on.
                one.start()
                two.kill()
            yield case

    done = batch.rollout("cart-pole", restarting(), [one.address, two.address], size=SIZE)
    assert digest(done.x) == expected


def test_a_server_that_hangs_is_left(expected, two, monkeypatch):
    one, two = two
    monkeypatch.setattr(batch, "_SLOW_SECONDS", 0.5)

    def hanging():
        for k, case in enumerate(cases()):
            if k == COUNT // 2:
                one.hang()
            yield case

    done = batch.rollout("cart-pole", hanging(), [one.address, two.address], size=SIZE)
    assert digest(done.x) == expected


def test_servers_that_are_all_lost_are_an_error(two, monkeypatch):
    monkeypatch.setattr(batch, "_PATIENCE_SECONDS", 0.2)
    monkeypatch.setattr("plantd._connect._CONNECT_SECONDS", 0.5)
    for server in two:
        server.kill()
    with pytest.raises(plantd.PlantdError) as told:
        batch.rollout("cart-pole", cases(), [server.address for server in two])
    assert told.value.code == "UNAVAILABLE"


def test_a_worker_that_is_killed_changes_nothing(program, expected):
    pool = ProcessPoolExecutor(2, mp_context=multiprocessing.get_context("spawn"))

    def killing():
        # More than wait for the workers at a time, so that some are done.
        for k, case in enumerate(cases()):
            if k == COUNT // 2:
                os.kill(next(iter(pool._processes)), signal.SIGKILL)
            yield case

    with pool, pytest.warns(UserWarning, match="the rest is done here"):
        done = batch.rollout("cart-pole", killing(), pool, size=SIZE)
    assert digest(done.x) == expected


# Ray reads its variables when it is imported.
OVER_RAY = """
import hashlib, os, signal, sys
import psutil, ray
from plantd import batch
from test_batch import COUNT, SIZE, cases, digest

def is_own(process):
    try:
        token = process.environ().get("RAY_AUTH_TOKEN")
        return process.name().startswith("ray::") and token == os.environ["RAY_AUTH_TOKEN"]
    except psutil.Error:
        return False

def killing():
    for k, case in enumerate(cases()):
        if k == COUNT // 2:
            next(worker for worker in psutil.process_iter() if is_own(worker)).send_signal(signal.SIGKILL)
            print("killed")
        yield case

ray.init(num_cpus=2, log_to_driver=False)
try:
    batch._WAITING = 2
    print(digest(batch.rollout("cart-pole", killing(), ray, size=SIZE).x))
finally:
    ray.shutdown()
"""


def test_a_worker_of_ray_that_is_killed_changes_nothing(program, expected):
    for package in ("ray", "psutil"):
        pytest.importorskip(package)
    environment = {**os.environ, "RAY_AUTH_MODE": "token", "RAY_AUTH_TOKEN": secrets.token_hex(32)}
    environment |= {"RAY_USAGE_STATS_ENABLED": "0", "PYTHONPATH": str(Path(__file__).parent)}
    command = [sys.executable, "-c", OVER_RAY]
    told = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=200)
    assert told.returncode == 0, told.stderr
    assert "killed" in told.stdout.split() and told.stdout.split()[-1] == expected


def test_over_dask(program, expected):
    distributed = pytest.importorskip("distributed")
    options = {"processes": False, "n_workers": 2, "threads_per_worker": 1, "dashboard_address": None}
    with distributed.Client(**options) as cluster:
        assert digest(batch.rollout("cart-pole", cases(), cluster.get_executor(), size=SIZE).x) == expected
        done = cluster.gather(cluster.map(batch.run, list(batch.pieces("cart-pole", cases(), size=SIZE))))
        assert digest(batch.together(done).x) == expected


def test_an_own_server_that_is_killed_changes_nothing(program, expected):
    killed = []

    def killing():
        for k, case in enumerate(cases()):
            if k == COUNT // 2:
                killed.append(batch._own(0).server.pid)
                os.kill(killed[0], signal.SIGKILL)
            yield case

    assert digest(batch.rollout("cart-pole", killing(), size=SIZE).x) == expected
    assert batch._own(0).server.pid != killed[0]


def test_limits_of_a_server_are_kept(program, expected):
    # Both are less than a call has otherwise.
    assert sum(case.ByteSize() for case in cases()) > 2 * 4096
    for limit in ["rollout_cases=9", "message_bytes=4096"]:
        with plantd.launch(program, arguments=["--limit", limit]) as client:
            done = batch.rollout("cart-pole", cases(), client)
            assert digest(done.x) == expected
            # Of the other calls, too; answers come by their cases.
            ends = {end.case: end for end in client.rollout_cases("cart-pole", cases())}
            assert digest(np.array([ends[k].states[-1].x for k in range(COUNT)])) == expected
            bad = [*cases(25), batch.case(q=[1.0], steps=1)]
            errors = {end.case: end.error for end in client.rollout_cases("cart-pole", bad) if end.error}
            assert list(errors) == [25] and "cases[25].initial" in str(errors[25])
    # What no part can keep is told.
    with plantd.launch(program, arguments=["--limit", "horizon=10"]) as client:
        with pytest.raises(plantd.PlantdError, match="limit `horizon` is 10"):
            batch.rollout("cart-pole", cases(), client)


def test_cases_have_what_a_plant_has(program):
    with plantd.launch(program) as client:
        client.create_model(SCENE)
        gain = client.solve_lqr("traveller", at="initial", q=[10, 10, 1, 1], r=[1])
        client.create_plant("traveller", id="p", q=[0.3, -0.2])
        client.set_parameters("p", {"frames[hand].body.mass": 0.8})
        client.reset("p", q=[0.3, -0.2])
        sensors = [dict(name="elbow", coordinate="hand", noise=0.01, latency_s=0.05)]
        actuators = [dict(input="shoulder", delay_s=0.03)]
        client.set_channels("p", sensors, actuators, seed=3)
        client.set_feedback("p", gain=gain, mode="add")
        client.inject_fault("p", input="shoulder", noise=dict(deviation=0.1), start_step=20)
        with client.drive("p") as driver:
            for _ in range(80):
                state = driver.step([0.5])
    common = batch.case(
        [[0.5]],
        steps=79,
        q=[0.3, -0.2],
        feedback=dict(gain=gain, mode="add"),
        outputs=sensors,
        inputs=actuators,
        faults=[dict(input="shoulder", noise=dict(deviation=0.1), start_step=20)],
    )
    masses = [0.7, 0.8, 0.9]
    given = [batch.case(parameters={"frames[hand].body.mass": mass}, seed=3) for mass in masses]
    given.append(batch.case(parameters={"frames[hand].body.mass": 0.8}, seed=4))
    given.append(batch.case(until=[dict(quantity="arm", max=0.31)]))
    done = batch.rollout(
        "",
        given,
        size=2,
        scene=SCENE,
        common=common,
        extremes=True,
        cost=dict(q=[1, 1, 0, 0], r=[0.1], end=[5, 5, 0, 0], x_reference=[0.1, 0, 0, 0]),
        expect='[[expect]]\nno_failures = true\n[[expect]]\nnever_exceeds = { signal = "|arm|", limit = 1e-9 }\n',
    )
    assert done.expectations == ("no failures", "|arm| never exceeds 1e-9")
    assert done.came_true.tolist() == [[True, False]] * 5
    assert done.errors == {} and done.columns[:3] == ("steps", "end", "arm")
    assert done.x[1].tobytes() == state.x.tobytes()
    assert len({row.tobytes() for row in done.x}) == 5
    assert (done.min <= done.x).all() and (done.x <= done.max).all()
    assert done.cost.shape == (5,) and (done.cost > 0).all()
    assert done.end.tolist()[:4] == [0] * 4 and done.steps.tolist()[:4] == [80] * 4


def test_a_thousand_masses_are_a_thousand_plants(two):
    """A sweep with noisy sensors and inputs, a feedback and seeds: states, outputs and all bits as of plants that are
    made and driven one by one."""
    count, steps = 1000, 12
    masses = np.geomspace(0.02, 5.0, count)
    path = "frames[pole].body.mass"
    sensors = [
        dict(name="angle", coordinate="theta", noise=0.01, latency_s=0.03),
        dict(name="place", coordinate="x", noise=0.02),
    ]
    jolts = dict(input="force", noise=dict(deviation=3.0))
    start = dict(q=[0.0, 3.0], dt=0.01)
    one, two = two
    gain = one.client.solve_lqr("cart-pole", at="upright", q=[1, 100, 1, 1], r=[0.01])
    given = [batch.case(parameters={path: mass}, seed=k) for k, mass in enumerate(masses)]
    common = batch.case(
        steps=steps,
        q=start["q"],
        feedback=dict(gain=gain, mode="replace"),
        outputs=sensors,
        faults=[jolts],
    )
    request = control_service_pb2.RolloutRequest(model="cart-pole", cases=given, common=common)
    request.settings.time_step_s = start["dt"]
    ends = {answer.case_index: answer for answer in one.client.control.Rollout(request)}
    assert sorted(ends) == list(range(count))

    # Of another process, which has never seen the batch.
    client, last = two.client, []
    for k, mass in enumerate(masses):
        plant = client.create_plant("cart-pole", **start)
        client.set_parameters(plant.id, {path: mass})
        client.reset(plant.id, q=start["q"])
        client.set_channels(plant.id, sensors, seed=k)
        client.set_feedback(plant.id, gain=gain, mode="replace")
        client.inject_fault(plant.id, **jolts)
        with client.drive(plant.id) as driver:
            for _ in range(steps):
                state = driver.step()
            (end,) = ends[k].states
            assert (end.step, list(end.q), list(end.p)) == (steps, state.q.tolist(), state.p.tolist()), k
            assert list(ends[k].outputs[-1].y) == driver.outputs.y.tolist(), k
        client.delete_plant(plant.id)
        last.append(state.x)
    # Everything matters: seeds, masses.
    assert len({answer.outputs[-1].SerializeToString() for answer in ends.values()}) == count
    assert len({x.tobytes() for x in last}) == count
    over = f"{one.address},{two.address}"
    done = batch.rollout("cart-pole", given, over, size=37, common=common, dt=start["dt"])
    assert done.errors == {} and digest(done.x) == digest(np.array(last))


def test_cases_end_early_and_fail(program):
    given = [
        batch.case(q=[0.2], velocity=[1.0], steps=50),
        batch.case(q=[0.2, 0.3], steps=50),
        batch.case(q=[0.2], velocity=[3.0], steps=50, until=[dict(quantity="theta", max=0.5)]),
    ]
    done = batch.rollout("pendulum", given, size=2)
    assert done.end.tolist() == [0, 2, 1] and list(done.errors) == [1]
    assert np.isnan(done.x[1]).all() and not np.isnan(done.x[[0, 2]]).any()
    assert done.steps[0] == 50 and 0 < done.steps[2] < 50 and done.x[2, 0] > 0.5
    with pytest.raises(plantd.PlantdError, match=r"cases\[1\]"):
        done.raise_errors()
    for name in ("min", "cost"):
        with pytest.raises(ValueError, match="the batch was not asked for"):
            getattr(done, name)
    again = pickle.loads(pickle.dumps(done))
    assert again.rows.tobytes() == done.rows.tobytes()
    assert str(again.errors[1]) == str(done.errors[1])


def test_pieces_that_do_not_fit_are_told(program):
    parts = [batch.run(piece) for piece in batch.pieces("pendulum", [batch.case(steps=1)] * 6, size=2)]
    assert len(batch.together(parts)) == 6
    with pytest.raises(ValueError, match="case 2 is missing"):
        batch.together([parts[0], parts[2]])
    with pytest.raises(ValueError, match="case 2 is there twice"):
        batch.together([*parts, parts[1]])
    other = batch.Done(**{**vars(parts[1]), "build": "another"})
    with pytest.raises(ValueError, match="several builds.*another"):
        batch.together([parts[0], other, parts[2]])
    assert len(batch.together([parts[0], other, parts[2]], any_build=True)) == 6
    assert len(batch.rollout("pendulum", [])) == len(batch.together([])) == 0


def test_long_cases_make_small_pieces():
    u = np.zeros((100_000, 1))
    cut = list(batch.pieces("pendulum", [batch.case(u)] * 12))
    assert [piece.count for piece in cut] == [5, 5, 2]
    assert [piece.first for piece in cut] == [0, 5, 10]


@pytest.mark.parametrize(
    "wrong, said",
    [
        (lambda: batch.pieces("pendulum", [], size=0), "`size` is 0; a whole number from 1 on"),
        (lambda: batch.pieces("pendulum", [], scene=SCENE), "`scene` is given, and `model` is 'pendulum'"),
        (lambda: list(batch.pieces("pendulum", [[0.1]])), r"`cases\[0\]` is \[0.1\]; a `plantd.batch.case`"),
        (lambda: batch.pieces("pendulum", [], dtt=0.1), "there is no argument `dtt`; did you mean `dt`?"),
        (lambda: batch.pieces("pendulum", [], cost={"qq": [1]}), "there is no `qq`; did you mean `q`?"),
        (lambda: batch.case(until=[dict(quantty="x")]), "there is no `quantty`; did you mean `quantity`?"),
        (lambda: batch.rollout("pendulum", [], 7), "`over` is 7; an executor, the module `ray`, or addresses"),
        (lambda: batch.rollout("pendulum", [], []), r"`over` is \[\]; an executor"),
        (lambda: batch.rollout("pendulum", [], math), "`over` is <module 'math'.*; an executor"),
    ],
)
def test_mistakes_are_told(wrong, said):
    with pytest.raises((TypeError, ValueError), match=said):
        wrong()
