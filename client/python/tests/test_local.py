"""The server in this process: the same calls, the same bits, the same refusals as over a connection."""

import math
import os
import signal
import subprocess
import sys
import threading
import time

import numpy as np
import plantd
import pytest

pytest.importorskip("plantd._native", reason="the package is installed without the server in it")


@pytest.fixture
def local():
    with plantd.local(limits={"plants": 20}) as client:
        yield client


@pytest.fixture
def launched():
    with plantd.launch(os.environ["PLANTD_SERVER"]) as client:
        yield client


def bits(*arrays):
    return [np.asarray(array).tobytes() for array in arrays]


def state_bits(state):
    return bits(state.q, state.p, state.v, state.multipliers, state.velocity, state.time), state.step


def script(client, model, at):
    """What a user does with a plant: whoever the client is, all that comes out, as bytes."""
    seen = []
    with client.plant(model, at=at) as plant:
        lin = plant.linearize()
        seen += bits(lin.a, lin.b, lin.u)
        law = lambda state: lin.u  # noqa: E731
        if at is not None:
            law = client.solve_lqr(model, at=at, q=np.ones(len(lin.state.x)), r=np.ones(len(lin.u)))
            seen += bits(law.k)
        with plant.drive() as driver:
            state = driver.plant.state
            for k in range(60):
                u = law(state) + 0.001 * math.sin(k)
                state = driver.step(u)
                seen.append((state_bits(state), driver.report, state.time_step))
        energy = plant.energy
        seen += [energy.kinetic, energy.potential]
        snapshot = plant.snapshot()
        there = state_bits(plant.step([u])[-1])
        plant.restore(snapshot)
        seen.append(there)
        assert state_bits(plant.step([u])[-1]) == there
    return seen


@pytest.mark.parametrize(("model", "at"), [("pendulum", "upright"), ("cart-pole", "upright"), ("marionette", None)])
def test_a_script_has_the_same_bits_here_and_there(local, launched, model, at):
    here, there = script(local, model, at), script(launched, model, at)
    assert here == there


def test_a_search_has_the_same_bits_here_and_there(local, launched):
    steps = 40
    desired = np.zeros((steps + 1, 4))
    desired[:, 1] = np.linspace(0, math.pi, steps + 1)
    guess = plantd.Trajectory(None, np.full((steps, 1), 0.1))

    def search(client):
        progress = client.optimize_trajectory(
            "cart-pole", guess, x=desired, q=np.ones(4), r=[0.1], input_bounds={"force": (-20, 20)}, max_iterations=8
        )
        costs = [step.cost for step in progress]
        return costs, bits(progress.result.x, progress.result.u)

    assert search(local) == search(launched)


def test_a_refusal_reads_the_same_here_and_there(local, launched):
    def refusals(client):
        for call in (
            lambda: client.create_plant("pendulm"),
            lambda: client.create_plant("pendulum", q=[1.0, 2.0]),
            lambda: client.linearize("pendulum", at="upsidedown"),
            lambda: list(client.linearize_trajectory("pendulum", None, np.zeros((3, 7)))),
            lambda: client.create_model("[scene]\nname = 1"),
        ):
            with pytest.raises((plantd.PlantdError, TypeError)) as raised:
                call()
            error = raised.value
            yield str(error), getattr(error, "reason", ""), getattr(error, "violations", "")

    assert list(refusals(local)) == list(refusals(launched))


def test_a_driver_holds_the_lease(local):
    with local.plant("pendulum") as plant:
        with plant.drive() as driver:
            with pytest.raises(plantd.PlantdError, match="LEASE_HELD"):
                plant.drive()
            with pytest.raises(plantd.StepError, match="input"):
                driver.step([1.0, 2.0])
            assert driver.step([1.0]).step == 1
        with pytest.raises(plantd.PlantdError, match="the driver is closed"):
            driver.step([1.0])
        with plant.drive() as driver:
            plant.delete()
            with pytest.raises(plantd.PlantdError, match="PLANT_DELETED"):
                driver.step([1.0])


def test_a_driver_goes_on_when_the_plant_runs_by_itself(local):
    with local.plant("pendulum") as plant, plant.drive() as driver:
        assert driver.step([0.5]).step == 1
        plant.run("paced")
        assert driver.step([0.5]).step > 1 and driver.timing is not None
        assert driver.step([0.5]).step > 2
        plant.pause()


def test_a_watcher_sees_what_a_driver_does(local):
    with local.plant("pendulum") as plant, plant.drive() as driver:
        watch = plant.watch(queue=10)
        stepped = [driver.step([0.1]) for _ in range(5)]
        seen = [next(watch).state for _ in range(6)]
        assert [state_bits(state) for state in seen[-5:]] == [state_bits(state) for state in stepped]
        watch.close()


def test_steps_of_many_threads_do_not_wait_for_each_other(local):
    """Each drives a plant of its own: no deadlock, and no one's motion is another's."""
    results = {}

    def loop(k):
        with local.plant("chain-8") as plant, plant.drive() as driver:
            for _ in range(300):
                state = driver.step([0.1 * k])
            results[k] = bits(state.x)

    threads = [threading.Thread(target=loop, args=(k % 2,)) for k in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(60)
        assert not thread.is_alive()
    assert results[0] != results[1]


def test_one_driver_is_one_plants_whoever_steps_it(local):
    with local.plant("pendulum") as plant, plant.drive() as driver:
        def loop():
            for _ in range(500):
                driver.step([0.1])

        threads = [threading.Thread(target=loop) for _ in range(4)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(60)
            assert not thread.is_alive()
        assert driver.step([0.1]).step == 2001


def test_limits_and_the_end(tmp_path):
    with pytest.raises(ValueError, match="there is no limit `plant`; did you mean `plants`?"):
        plantd.local(limits={"plant": 1})
    with pytest.raises(ValueError, match="plants = -1"):
        plantd.local(limits={"plants": -1})
    client = plantd.local(limits={"plants": 1}, recordings=tmp_path)
    client.create_plant("pendulum")
    with pytest.raises(plantd.PlantdError, match="limit `plants` is 1"):
        client.create_plant("pendulum")
    client.close()
    with pytest.raises(plantd.PlantdError, match="the client is closed"):
        client.list_plants()
    client.close()


def test_two_servers_know_nothing_of_each_other():
    with plantd.local() as one, plantd.local() as other:
        one.create_plant("pendulum", id="mine")
        assert other.list_plants() == []


DROPPED = """
import gc, os, time, plantd

def threads():
    return len(os.listdir("/proc/self/task"))

before = threads()
for _ in range(3):
    client = plantd.local()
    client.create_plant("pendulum")
    assert threads() > before
    del client
    gc.collect()
deadline = time.monotonic() + 30
while threads() > before:
    assert time.monotonic() < deadline, "threads stay"
    time.sleep(0.05)
"""


def test_a_server_goes_with_its_client():
    subprocess.run([sys.executable, "-c", DROPPED], check=True, timeout=60)


FORKED = """
import os, sys, plantd
client = plantd.local()
client.create_plant("pendulum")
child = os.fork()
if child == 0:
    try:
        client.list_plants()
    except plantd.PlantdError as error:
        assert "forked" in str(error), error
        with plantd.local() as own:
            assert own.list_plants() == []
            os._exit(0)
    os._exit(1)
assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
assert len(client.list_plants()) == 1
"""


def test_a_forked_process_makes_its_own():
    subprocess.run([sys.executable, "-c", FORKED], check=True, timeout=60)


# Whoever starts the tests may ignore Ctrl-C, which is inherited.
INTERRUPTED = """
import signal
import plantd
signal.signal(signal.SIGINT, signal.default_int_handler)
client = plantd.local()
plant = client.create_plant("pendulum")
print("waiting", flush=True)
try:
    for _ in client.watch(plant.id):
        pass
except KeyboardInterrupt:
    print(client.get_plant(plant.id).state.step)
"""


def test_ctrl_c_ends_a_wait():
    with subprocess.Popen([sys.executable, "-c", INTERRUPTED], stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "waiting\n"
        time.sleep(0.2)
        process.send_signal(signal.SIGINT)
        assert process.communicate(timeout=60)[0] == "0\n"
        assert process.returncode == 0
