"""Plants that run by themselves."""

import pytest

import plantd


def test_a_run_of_some_steps_is_waited_for(client):
    id = client.create_plant("cart-pole").id
    run = client.run(id, "paced", speed=10, steps=20, wait=True)
    assert (run.running, run.steps_left) == (False, 0)
    assert client.get_plant(id).state.step == 20
    assert client.timing(id, clear=True).steps == 20
    assert client.timing(id).steps == 0


def test_a_run_that_a_step_ends_raises_what_the_plant_says(client):
    # A guess of one iteration, of a step in which the pendulum turns over.
    hard = {"dt": 1.0, "newton_iterations": 1, "halvings": 0}
    with client.plant("double-pendulum", q=[1.0, 2.0], velocity=[9.0, -9.0], **hard) as plant:
        with pytest.raises(plantd.StepError) as failed:
            plant.run("free", steps=20, wait=True)
        assert failed.value.reason == "NOT_CONVERGED" and plant.state.step < 20


def test_the_same_loop_drives_a_plant_that_runs_by_itself(client):
    id = client.create_plant("cart-pole").id
    client.run(id, "paced", speed=10, timeout=0.5, action="ramp", ramp=0.1, safe=[0.0])
    with client.drive(id) as driver:
        before = driver.plant.state
        for force in (1.0, -2.0):
            state = driver.step([force])
            assert state.step > before.step and driver.u == [force]
            assert driver.timing.due_ns <= driver.timing.began_ns < driver.timing.ended_ns
            before = state
        assert driver.timing.input_sequence == 2 and not driver.timing.input_safe
        driver.offer([3.0])
        assert driver.next().step > before.step
    with pytest.raises(plantd.PlantdError) as refused:
        client.step(id, [[0.0]])
    assert refused.value.reason == "RUNNING"
    stands_at = client.pause(id).step
    client.run(id, steps=1, wait=True)
    assert client.get_plant(id).state.step == stands_at + 1


def test_an_input_now_and_then_acts_under_a_lease(client):
    with client.plant("cart-pole") as plant:
        with plant.hold() as lease:
            # In lockstep an input is a step.
            with pytest.raises(plantd.PlantdError) as refused:
                lease.set_input([1.0])
            assert (refused.value.code, refused.value.reason) == ("FAILED_PRECONDITION", "LOCKSTEP")
        plant.run("paced", speed=10)
        with plant.hold() as lease:
            assert lease.plant.id == plant.id and plant.info.driver == "drive"
            lease.set_input([2.5])
            lease.set_input([1.5])
            seen = next(s for s in plant.watch(["input", "timing"]) if s.timing.input_sequence == 2)
            assert seen.u == [1.5]
            with pytest.raises(plantd.PlantdError) as refused:
                lease.set_input([1.0, 2.0])
            assert refused.value.code == "INVALID_ARGUMENT"
            with pytest.raises(plantd.PlantdError) as refused:
                client.set_input(plant.id, "0", [1.0])
            assert refused.value.reason == "LEASE_LOST"
        for event in plant.watch_events(since=0):
            if event.kind == "driver_left":
                break
        with pytest.raises(plantd.PlantdError) as refused:
            client.set_input(plant.id, lease.lease_token, [1.0])
        assert refused.value.reason == "LEASE_LOST"


def test_watchdogs_hold_a_plant_and_say_why(client):
    id = client.create_plant("cart-pole").id
    assert client.get_plant(id).safety is None
    client.set_safety(id, [dict(quantity="x", max=0.2)])
    with client.drive(id) as driver, pytest.raises(plantd.PlantdError) as stopped:
        while True:
            driver.step([20.0])
    assert stopped.value.reason == "WATCHDOG"
    assert "x is 0.2" in stopped.value.message and "bound 0.2" in stopped.value.message
    frozen = client.get_plant(id).safety.frozen
    assert frozen.value > 0.2 and frozen.step == client.get_plant(id).state.step
    for event in client.watch_events(id, since=0):
        if event.kind == "watchdog":
            break
    assert (event.subject, event.value) == ("x", frozen.value)
