"""Plants that outlive connections and servers, and go from one server to another."""

import math
import pickle
import signal
import threading
import time

import plantd
import pytest
from plantd._connect import Credentials
from plantd.v1 import plant_service_pb2 as pb
from processes import PATIENCE, Gateway, processes

SCENE = """
format = 1
name = "traveller"
gravity = [0.0, -9.81, 0.0]

[[frames]]
name = "arm"
joint = { type = "revolute", axis = [0.0, 0.0, 1.0] }
body = { mass = 1.5, center_of_mass = [0.0, -0.5, 0.0], inertia = [0.1, 0.1, 0.2] }

[[frames]]
name = "hand"
parent = "arm"
translation = [0.0, -1.0, 0.0]
joint = { type = "revolute", axis = [0.0, 0.0, 1.0] }
body = { mass = 0.5, center_of_mass = [0.0, -0.3, 0.0], inertia = [0.02, 0.02, 0.03] }

[[inputs]]
name = "shoulder"
coordinate = "arm"
"""


def everything(client, id):
    """A plant with all that a plant can have."""
    plant = client.create_plant("traveller", id=id, q=[0.3, -0.2], dt=0.01)
    client.set_parameters(plant.id, {"frames[hand].body.mass": 0.7})
    sensors = [
        dict(name="elbow", coordinate="hand", noise=0.01, latency_s=0.05),
        dict(name="tip", position=dict(frame="hand", at=[0.0, -0.6, 0.0])),
    ]
    client.set_channels(plant.id, sensors, [dict(input="shoulder", delay_s=0.03)], seed=11)
    client.inject_fault(plant.id, output="elbow", noise=dict(deviation=0.02), start_step=40, duration_s=5.0)
    push = dict(point=dict(frame="hand"), force=[2.0, 0.0, 0.0])
    client.inject_fault(plant.id, push=push, start_step=60, duration_s=2.0)
    client.set_feedback(plant.id, at="initial", q=[10, 10, 1, 1], r=[1], mode="add")
    client.set_safety(plant.id, [dict(quantity="arm", min=-50.0, max=50.0)])
    return plant


def input_of(step):
    return [math.sin(0.05 * step)]


def seen(driver, state):
    """Everything that a driver sees of a step, as bytes."""
    return (
        state.step,
        state.x.tobytes(),
        state.velocity.tobytes(),
        state.multipliers.tobytes(),
        driver.u.tobytes(),
        driver.outputs.y.tobytes(),
        driver.outputs.lost,
    )


@pytest.fixture
def two(tmp_path):
    with processes(tmp_path, "one", "two") as servers:
        yield servers


def test_a_server_says_which_it_is(two, local_client):
    one, two = two
    info = one.client.get_server()
    assert (info.name, info.address, info.plants, info.draining) == ("one", one.address, 0, False)
    assert info.build == two.client.get_server().build and info.version
    with one.client.plant("pendulum") as plant:
        assert (plant.server, plant.address) == ("one", one.address)
        assert one.client.get_server().plants == 1
    assert local_client.get_server().address == ""
    with pytest.raises(AttributeError):
        info.name = "three"


def test_a_plant_moves_under_its_driver(two):
    one, two = two
    one.client.create_model(SCENE)
    for id in ("mover", "twin"):
        everything(one.client, id)
    moved, steps = [], 300

    def move():
        moved.append(one.client.move("mover", two.client))

    mover = threading.Thread(target=move)
    with one.client.drive("mover", reconnect=True) as driver, one.client.drive("twin") as twin:
        for k in range(steps):
            if k == 100:
                mover.start()
            u = input_of(k)
            here, there = seen(driver, driver.step(u)), seen(twin, twin.step(u))
            assert here == there and here[0] == k + 1
            if k == 200:
                # However busy the machine is, a part of the way is made there.
                mover.join()
        assert driver.reconnections >= 1
        assert driver.address == two.address and driver.plant.server == "two"
    assert moved[0].address == two.address and 100 <= moved[0].state.step <= 201
    assert [f.beginnings for f in two.client.list_faults("mover")] == [1, 1]
    assert two.client.get_plant("mover").parameters == {"frames[hand].body.mass": 0.7}
    assert two.client.get_plant("mover").safety == one.client.get_plant("twin").safety

    # The old server tells where it is, in its own words.
    with pytest.raises(plantd.PlantdError) as refused:
        one.client._ask(one.client.plants.GetPlant, pb.GetPlantRequest(id="mover"), True)
    assert refused.value.code == "FAILED_PRECONDITION" and refused.value.reason == "PLANT_ELSEWHERE"
    assert refused.value.elsewhere == two.address == refused.value.metadata["address"]

    # A client that knows the old address alone finds it: calls, streams, drivers and laws.
    with plantd.connect(one.address) as client:
        assert client.get_plant("mover").state.step == steps
        assert next(client.watch("mover")).step == steps
        assert len(client.list_faults("mover")) == 2
        assert client.linearize(plant="mover").a.shape == (4, 4)
        with client.follow_gains("mover") as law:
            assert law(client.get_plant("mover").state).shape == (1,)
        for keywords in ({}, {"reconnect": 5}):
            with client.drive("mover", **keywords) as driver:
                driver.step(input_of(0))
        assert client.step_many(["mover"]).states[0].step == steps + 3
        # Of many it cannot be said where.
        with pytest.raises(plantd.PlantdError, match="PLANT_ELSEWHERE"):
            client.step_many(["mover", "twin"])
        # Where it went is known when the old server has ended.
        one.kill()
        client.delete_plant("mover")
    assert two.client.list_plants() == []


def test_a_handle_goes_with_its_plant(two):
    one, two = two
    with one.client.plant("cart-pole", at="upright") as plant:
        plant.step(count=3)
        assert plant.move(two.address).server == "two"
        assert plant.server == "two" and plant.state.step == 3
        assert one.client.list_plants() == []
        # And back, by way of a client.
        plant.move(one.client)
        assert plant.client is one.client and plant.server == "one"
        assert two.client.list_plants() == []
        plant.step()
    assert one.client.list_plants() == []


def test_a_plant_that_moves_on_and_on_is_found(two, tmp_path):
    one, two = two
    with processes(tmp_path, "three") as (three,), plantd.connect(one.address) as client:
        servers = [one, two, three]
        one.client.create_plant("pendulum", id="p")
        with client.drive("p", reconnect=True) as driver:
            for k in range(9):
                assert driver.step([0.1]).step == k + 1
                servers[k % 3].client.move("p", servers[(k + 1) % 3].client)
            assert driver.step([0.1]).step == 10
            assert driver.reconnections == 9 and driver.address == one.address
            # Each server has one connection, however often the plant has been there.
            assert set(client._others) == {two.address, three.address}
            assert not any(other._others for other in client._others.values())
        assert client.get_plant("p").server == "one"
        one.client.move("p", two.client)
        two.client.move("p", three.client)
        assert client.get_plant("p").server == "three"
        one.kill()
        two.kill()
        assert client.get_plant("p").server == "three"


def test_a_plant_that_runs_by_itself_moves(two):
    one, two = two
    one.client.create_plant("pendulum", id="p")
    one.client.run("p", "free")
    with one.client.drive("p", reconnect=True) as driver:
        driver.offer([0.1])
        before = driver.next()
        one.client.move("p", two.client)
        deadline = time.monotonic() + PATIENCE
        while driver.address != two.address:
            assert time.monotonic() < deadline
            state = driver.next()
            assert state.step >= before.step
            before = state
        # It runs on there, under the input that it had.
        assert driver.next().step > before.step
        assert driver.step([0.2]).step > before.step


def test_a_plant_that_is_refused_stays(two):
    one, two = two
    one.client.create_plant("pendulum", id="p")
    two.client.create_plant("pendulum", id="p")
    one.client.run("p", "free")
    with pytest.raises(plantd.PlantdError, match="PLANT_EXISTS"):
        one.client.move("p", two.client)
    # It runs on.
    before = one.client.get_plant("p").state.step
    deadline = time.monotonic() + PATIENCE
    while one.client.get_plant("p").state.step == before:
        assert time.monotonic() < deadline
    with pytest.raises(TypeError, match="`to` is 7; a client or an address is needed"):
        one.client.move("p", 7)
    with pytest.raises(plantd.PlantdError, match="PLANT_NOT_FOUND"):
        one.client.move("q", two.client)


def test_a_plant_of_another_build(two):
    one, two = two
    one.client.create_plant("pendulum", id="p")
    # A record says of which build it is; this one is made to say something else.
    record = one.client._call(one.client.plants.ExportPlant, pb.ExportPlantRequest(id="p")).record
    build = one.client.get_server().build.encode()
    assert build in record
    other = record[:-8].replace(build, b"x" * len(build))
    value = 0xCBF29CE484222325
    for byte in other:
        value = (value ^ byte) * 0x100000001B3 % 2**64
    other += value.to_bytes(8, "little")
    create = two.client.plants.CreatePlant
    with pytest.raises(plantd.PlantdError) as refused:
        two.client._call(create, pb.CreatePlantRequest(record=other))
    assert refused.value.reason == "OTHER_BUILD"
    assert refused.value.metadata["server"] == two.client.get_server().build
    assert two.client._call(create, pb.CreatePlantRequest(record=other, any_build=True)).plant.id == "p"


def test_a_plant_moves_out_of_this_process(two, local_client):
    one = two[0]
    local_client.create_plant("pendulum", id="home", q=[0.5])
    with local_client.drive("home") as driver:
        expected = [driver.step([0.1]).x.tobytes() for _ in range(6)]
    local_client.reset("home", q=[0.5])
    with local_client.drive("home", reconnect=True) as driver:
        states = [driver.step([0.1]) for _ in range(3)]
        local_client.move("home", one.client)
        states += [driver.step([0.1]) for _ in range(3)]
        assert driver.reconnections == 1 and driver.address == one.address
    assert [state.x.tobytes() for state in states] == expected
    # It is here no more; the old server follows as every other does.
    assert one.client.get_plant("home").state.step == 6
    one.client.move("home", local_client)
    assert local_client.get_plant("home").server == local_client.get_server().name


def test_a_token_is_not_sent_in_clear(two, tmp_path):
    one, two = two
    one.client.create_plant("pendulum", id="p")
    one.client.move("p", two.client)
    with plantd.connect(one.address, token="secret") as client:
        # In clear it has been already.
        assert client.get_plant("p").server == "two"
        for hidden in ("https://one.example", "unix:/run/plantd.sock"):
            client.address = hidden
            with pytest.raises(plantd.PlantdError, match="the token is not sent to http://"):
                client.at(two.address)
            with pytest.raises(plantd.PlantdError, match="the token is not sent to http://"):
                client.move("p", one.address)
    with plantd.Client(one.address, credentials=Credentials()) as client:
        client.address = "unix:/run/plantd.sock"
        client.at(two.address).close()


def test_a_server_that_is_killed_rolls_back(two, tmp_path):
    saving = ["--state-directory", str(tmp_path / "state"), "--state-interval-s", "0.2"]
    quiet = two[1]
    with processes(tmp_path, "killed", arguments=["--drain-s", "0", *saving]) as (killed,):
        for server in (quiet, killed):
            server.client.create_model(SCENE)
            everything(server.client, "p")
        file = tmp_path / "state/p.plant"
        losses, threads, expected = [], [], []

        def restart():
            killed.kill()
            killed.start()

        with quiet.client.drive("p") as twin, killed.client.drive("p", reconnect=PATIENCE, grace=5.0) as driver:
            step, kills = 0, 2
            # Steps at which a new file was seen, the last ones.
            stamp, seen_at = 0, []
            while kills or driver.reconnections < 2 or step < 300:
                assert step < 1_000_000
                if file.exists() and file.stat().st_mtime_ns != stamp:
                    stamp = file.stat().st_mtime_ns
                    seen_at.append(step)
                if kills and len(seen_at) > 3 and step > seen_at[-1] + 20 and not any(t.is_alive() for t in threads):
                    kills -= 1
                    threads.append(threading.Thread(target=restart))
                    threads[-1].start()
                    seen_at, before = [], seen_at
                try:
                    now = seen(driver, driver.step(input_of(step)))
                except plantd.RolledBack as loss:
                    assert loss.reason == "ROLLED_BACK" and loss.from_step == step
                    # No more than since the beginning of a saving of which the end was seen.
                    assert before[-2] - 1 <= loss.to_step < step
                    again = pickle.loads(pickle.dumps(loss))
                    assert (again.from_step, again.to_step) == (step, loss.to_step)
                    losses.append(loss)
                    step = loss.to_step
                    continue
                while len(expected) <= step:
                    k = len(expected)
                    expected.append(seen(twin, twin.step(input_of(k))))
                assert now == expected[step]
                step = now[0]
        for thread in threads:
            thread.join()
        assert killed.client.get_plant("p").state.step == step
        assert losses


def test_a_server_that_ends_is_driven_on(tmp_path):
    with processes(tmp_path, "one", "two", arguments=["--drain-s", "600"]) as (one, two):
        one.client.create_plant("pendulum", id="p", q=[0.4])
        two.client.create_plant("pendulum", id="twin", q=[0.4])
        with one.client.drive("p", reconnect=True) as driver, two.client.drive("twin") as twin:
            for k in range(50):
                assert driver.step(input_of(k)).x.tobytes() == twin.step(input_of(k)).x.tobytes()
            one.signal(signal.SIGTERM)
            deadline = time.monotonic() + PATIENCE
            while not one.client.get_server().draining:
                assert time.monotonic() < deadline
            with pytest.raises(plantd.PlantdError) as refused:
                one.client.create_plant("pendulum")
            assert (refused.value.code, refused.value.reason) == ("UNAVAILABLE", "DRAINING")
            assert one.client.drain(600.0) == 1
            for k in range(50, 150):
                assert driver.step(input_of(k)).x.tobytes() == twin.step(input_of(k)).x.tobytes()
            # What drains is moved away, and nobody is left.
            one.client.move("p", two.address)
            for k in range(150, 200):
                assert driver.step(input_of(k)).x.tobytes() == twin.step(input_of(k)).x.tobytes()
            one.wait()
            assert driver.reconnections == 1
        assert two.client.get_plant("p").state.step == 200


@pytest.mark.parametrize("grace", [0.0, 60.0])
def test_connections_that_break_cost_no_step(two, grace):
    one = two[0]
    one.client.create_model(SCENE)
    for id in ("p", "twin"):
        everything(one.client, id)
    gateway = Gateway(one.place)
    is_over = threading.Event()

    def cut():
        while not is_over.wait(0.15):
            gateway.cut()

    cutting = threading.Thread(target=cut)
    try:
        with plantd.connect(gateway.address) as client, one.client.drive("twin") as twin:
            with client.drive("p", reconnect=PATIENCE, grace=grace) as driver:
                cutting.start()
                step = 0
                while step < 300 or driver.reconnections < 6:
                    u = input_of(step)
                    here, there = seen(driver, driver.step(u)), seen(twin, twin.step(u))
                    assert here == there and here[0] == step + 1
                    step += 1
                is_over.set()
                cutting.join()
                if grace:
                    # Nobody comes in between.
                    gateway.cut()
                    with pytest.raises(plantd.PlantdError, match="LEASE_HELD"):
                        one.client.step("p")
                assert driver.step(input_of(step)).step == step + 1
    finally:
        is_over.set()
        gateway.close()


class Lossy:
    """Stubs whose first Drive stream is reset when it has answered so many times: the next answer is lost."""

    def __init__(self, stubs, answers):
        self._stubs, self._answers = stubs, answers

    def Drive(self, requests):
        call = self._stubs.Drive(requests)
        answers, self._answers = self._answers, None
        return call if answers is None else self._reset_after(call, answers)

    @staticmethod
    def _reset_after(call, answers):
        for _ in range(answers):
            yield next(call)
        # It has come as far as this client.
        next(call)
        call.cancel()
        raise plantd.PlantdError("INTERNAL", "the stream was reset")


@pytest.mark.parametrize("grace", [0.0, 20.0])
def test_an_answer_that_is_lost_is_read(client, grace):
    client.create_plant("pendulum", id="p", q=[0.4])
    client.create_plant("pendulum", id="twin", q=[0.4])
    stubs = client.plants
    client.plants = Lossy(stubs, 5)
    try:
        with client.drive("p", reconnect=True, grace=grace) as driver:
            states = [driver.step([0.2]) for _ in range(10)]
            assert driver.reconnections == 1
    finally:
        client.plants = stubs
    assert [state.step for state in states] == list(range(1, 11))
    with client.drive("twin") as twin:
        for state in states:
            assert state.x.tobytes() == twin.step([0.2]).x.tobytes()


def test_an_input_that_is_lost_is_sent_again(client):
    client.create_plant("pendulum", id="p", q=[0.4])
    with client.drive("p", reconnect=True) as driver:
        driver.step([0.2])
        # The stream breaks between two steps.
        driver._answers.cancel()
        assert driver.step([0.2]).step == 2
        assert driver.reconnections == 1


# In this process a step is taken by whoever asks for its answer: there it is not interrupted in between.
@pytest.mark.parametrize("client", ["grpc", "unix"], indirect=True)
def test_a_step_that_was_interrupted_is_not_taken_for_the_next(client):
    client.create_plant("pendulum", id="p", q=[0.4])
    with client.drive("p", reconnect=True) as driver:
        driver.step([0.2])
        # As Ctrl-C leaves it: the input is on its way, and nobody has read the answer.
        driver.offer([0.3])
        deadline = time.monotonic() + PATIENCE
        while client.get_plant("p").state.step < 2:
            assert time.monotonic() < deadline
        driver._answers.cancel()
        assert driver.step([0.2]).step == 3 and driver.reconnections == 1


def lose(client, driver):
    """Breaks the stream of a driver, and waits until its server knows."""
    driver._answers.cancel()
    deadline = time.monotonic() + PATIENCE
    while client.get_plant(driver.plant.id).driver:
        assert time.monotonic() < deadline


def test_steps_of_others_are_told(client):
    client.create_plant("pendulum", id="p", q=[0.4])
    with client.drive("p", reconnect=True) as driver:
        driver.step([0.2])
        lose(client, driver)
        client.step("p", count=5)
        with pytest.raises(plantd.SteppedByOthers) as told:
            driver.step([0.2])
        assert (told.value.from_step, told.value.to_step) == (1, 6)
        assert driver.step([0.2]).step == 7


def test_a_reset_is_a_roll_back(client):
    client.create_plant("pendulum", id="p")
    with client.drive("p", reconnect=True) as driver:
        for _ in range(4):
            driver.step([0.2])
        lose(client, driver)
        client.reset("p")
        with pytest.raises(plantd.RolledBack) as told:
            driver.step([0.2])
        assert (told.value.from_step, told.value.to_step) == (4, 0)
        assert driver.step([0.2]).step == 1


def test_a_plant_that_runs_by_itself_goes_on(client):
    client.create_plant("pendulum", id="p")
    client.run("p", "free")
    with client.drive("p", reconnect=True, grace=20.0) as driver:
        before = driver.step([0.2]).step
        driver._answers.cancel()
        assert driver.step([0.3]).step > before
        driver.offer([0.4])
        driver.next()
        driver._answers.cancel()
        assert driver.next().step > before
        assert driver.reconnections == 2


def test_what_no_attempt_can_mend_is_told(client):
    client.create_plant("pendulum", id="p")
    with client.drive("p", reconnect=True) as driver:
        driver.step([0.2])
        with pytest.raises(plantd.StepError):
            driver.step([0.2, 0.3])
        assert driver.step([0.2]).step == 2 and driver.reconnections == 0
        client.delete_plant("p")
        with pytest.raises(plantd.PlantdError, match="PLANT_DELETED"):
            driver.step([0.2])
    for wrong in ("yes", -1.0, math.nan):
        with pytest.raises(TypeError, match="`reconnect` is .*; True, False or a number of seconds"):
            client.drive("p", reconnect=wrong)


def test_patience_ends(tmp_path):
    with processes(tmp_path, "one") as (server,):
        server.client.create_plant("pendulum", id="p")
        driver = server.client.drive("p", reconnect=0.2)
        driver.step([0.1])
        server.kill()
        with pytest.raises(plantd.PlantdError) as told:
            driver.step([0.1])
        assert told.value.code == "UNAVAILABLE"
        # A client that is closed is not waited for.
        server.client.close()
        with pytest.raises(plantd.PlantdError):
            driver.step([0.1])
        driver.close()


def test_a_server_that_does_not_answer_is_left(tmp_path):
    with processes(tmp_path, "one") as (server,):
        server.client.create_plant("pendulum", id="p")
        with plantd.connect(server.address, timeout=0.5) as client:
            with client.drive("p", reconnect=PATIENCE) as driver:
                driver.step([0.1])
                server.hang()
                threading.Timer(2.0, lambda: server.signal(signal.SIGCONT)).start()
                assert driver.step([0.1]).step == 2
                assert driver.reconnections >= 1
