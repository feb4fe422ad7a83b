"""The examples run, and close their loops in fewer than 50 lines."""

import os
import subprocess
import sys
import threading
from pathlib import Path

import plantd
import pytest

EXAMPLES = Path(__file__).parents[1] / "examples"


def run(name, *arguments):
    command = [sys.executable, str(EXAMPLES / name), *arguments]
    return subprocess.run(command, capture_output=True, text=True, check=True, timeout=200).stdout


def test_balance(tmp_path):
    environment = {**os.environ, "PLANTD": os.environ["PLANTD_SERVER"], "MPLBACKEND": "Agg"}
    command = [sys.executable, str(EXAMPLES / "balance.py")]
    subprocess.run(command, cwd=tmp_path, env=environment, check=True, timeout=200)
    assert (tmp_path / "cart-pole.png").stat().st_size > 10_000


def test_pendulum_lqr(addresses):
    last = run("pendulum_lqr.py", addresses["grpc"]).splitlines()[-1]
    assert abs(float(last.split()[-2])) < 1e-3


def test_marionette(addresses):
    assert len(run("marionette.py", addresses["unix"]).splitlines()) == 10


def test_watch(addresses):
    with plantd.connect(addresses["grpc"]) as client:
        plant = client.create_plant("pendulum").id
        command = [sys.executable, str(EXAMPLES / "watch.py"), plant, addresses["grpc"]]
        watch = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
        # A guard against a watch that says nothing.
        guard = threading.Timer(60, watch.kill)
        guard.start()
        line = []
        reader = threading.Thread(target=lambda: line.append(watch.stdout.readline()))
        reader.start()
        with client.drive(plant) as driver:
            while reader.is_alive():
                driver.step(0.0)
        guard.cancel()
        client.delete_plant(plant)
        watch.wait(60)
        assert " J " in line[0]


def test_swing_up(addresses):
    assert "the error is" in run("swing_up.py", addresses["grpc"])


def test_cart_pole_swing_up(addresses):
    assert "off upright" in run("cart_pole_swing_up.py", addresses["unix"])


def test_marionette_optimization(addresses):
    assert "cost" in run("marionette_optimization.py", addresses["grpc"])


def test_cart_pole_lqg(addresses):
    assert "estimated to" in run("cart_pole_lqg.py", addresses["unix"])


def test_monte_carlo_ray():
    pytest.importorskip("ray")
    environment = {**os.environ, "PLANTD": os.environ["PLANTD_SERVER"], "RAY_USAGE_STATS_ENABLED": "0"}
    command = [sys.executable, str(EXAMPLES / "monte_carlo_ray.py")]
    told = subprocess.run(command, env=environment, capture_output=True, text=True, check=True, timeout=200).stdout
    assert "2000 cases, of which" in told and "the cart strays by" in told


@pytest.mark.parametrize(
    ("example", "needs", "told"),
    [("worst_case.py", "numpy", "the worst case: a pole of"), ("gains_cma.py", "cma", "the best gain")],
)
def test_searches(example, needs, told):
    pytest.importorskip(needs)
    environment = {**os.environ, "PLANTD": os.environ["PLANTD_SERVER"]}
    command = [sys.executable, str(EXAMPLES / example)]
    assert told in subprocess.run(command, env=environment, capture_output=True, text=True, check=True, timeout=200).stdout


def test_examples_are_short():
    for file in EXAMPLES.glob("*.py"):
        assert len(file.read_text().splitlines()) < 50, file.name
