"""Plants that belong to a script, and many of them at once."""

import math
import time

import numpy as np
import plantd
import pytest
from test_client import SCENE


def test_a_plant_goes_with_its_block(client):
    with client.plant("cart-pole", at="upright", dt=0.02) as plant:
        assert plant.time_step == 0.02 and plant.info.expires == 3600
        law = plant.lqr(at="upright", q=[1, 100, 1, 1], r=[0.01])
        assert law.time_step == 0.02
        plant.reset(q=[0, math.pi - 0.1])
        with plant.drive() as driver:
            state = driver.plant.state
            for _ in range(400):
                state = driver.step(law(state))
        assert abs(state.q[1] - math.pi) < 0.05
        assert plant.state.step == 400
        assert np.array_equal(plant.linearize().a, client.linearize(plant=plant.id).a)
        assert plant.kinematics(frames=["pole"]).frames["pole"].position.shape == (3,)
        assert plant.energy.kinetic >= 0 and plant.dynamics().mass_matrix.shape == (2, 2)
        assert plant.model.name == "cart-pole"
    with pytest.raises(plantd.PlantdError, match="PLANT_NOT_FOUND"):
        plant.state


def test_a_plant_that_is_kept_stays(client):
    with client.plant("pendulum") as plant:
        plant.keep()
    assert plant.state.step == 0
    with client.plant("pendulum", keep=True) as other:
        pass
    assert other.info.expires == 0
    assert {p.id for p in client.list_plants()} == {plant.id, other.id}
    plant.delete()


def test_an_error_in_the_block_is_the_one_that_is_raised(client):
    with pytest.raises(ZeroDivisionError):
        with client.plant("pendulum") as plant:
            plant.delete()
            1 / 0
    with client.plant("pendulum") as plant:
        plant.delete()


def test_a_plant_that_nobody_uses_expires(client):
    unused = client.create_plant("pendulum", expires=1)
    driven = client.create_plant("pendulum", expires=1)
    called = client.create_plant("pendulum", expires=1)
    watched = client.create_plant("pendulum", expires=1)
    events = client.watch_events(watched.id)
    with client.drive(driven.id):
        deadline = time.monotonic() + 60
        while any(plant.id == unused.id for plant in client.list_plants()):
            assert time.monotonic() < deadline
            client.step(called.id, hold=1)
            time.sleep(0.1)
        left = {plant.id for plant in client.list_plants()}
        assert left == {driven.id, called.id, watched.id}
    events.close()
    while client.list_plants():
        assert time.monotonic() < deadline
        time.sleep(0.1)
    with pytest.raises(plantd.PlantdError, match="expires_s: is 0.5"):
        client.create_plant("pendulum", expires=0.5)


def test_a_model_is_replaced_and_its_plants_live_on(client):
    client.create_model(SCENE, name="py-replaced")
    plant = client.create_plant("py-replaced")
    heavier = SCENE.replace("mass = 2.0", "mass = 4.0")
    with pytest.raises(plantd.PlantdError, match="MODEL_EXISTS"):
        client.create_model(heavier, name="py-replaced")
    client.create_model(heavier, name="py-replaced", replace=True)
    new = client.create_plant("py-replaced")
    masses = [client.dynamics(plant=p.id).mass_matrix[0, 0] for p in (plant, new)]
    assert masses == [2.0, 4.0]
    with pytest.raises(plantd.PlantdError, match="MODEL_EXISTS"):
        client.create_model(SCENE, name="pendulum", replace=True)
    client.delete_model("py-replaced")


def test_many_plants_step_as_each_alone(client):
    starts = np.linspace(-1, 1, 20)
    many = [client.create_plant("cart-pole", q=[0.0, q]) for q in starts]
    alone = [client.create_plant("cart-pole", q=[0.0, q]) for q in starts]
    forces = np.random.default_rng(1).normal(size=(3, 20, 1))
    for u in forces:
        stepped = client.step_many(many, u)
        assert not stepped.errors and stepped.x.shape == (20, 4)
        for plant, force, state in zip(alone, u, stepped.states):
            assert np.array_equal(client.step(plant.id, [force])[-1].x, state.x)
    assert stepped.time == pytest.approx(3 * many[0].time_step)
    # One input for all, several steps, and none at all.
    ends = client.step_many(many, [2.0], steps=4)
    for plant, state in zip(alone, ends.states):
        assert np.array_equal(client.step(plant.id, [[2.0]], hold=3)[-1].x, state.x)
    assert client.step_many([plant.id for plant in many]).states[0].step == 8


def test_plants_of_several_models_step_together(client):
    plants = [client.create_plant("pendulum"), client.create_plant("marionette")]
    entries = [client.linearize(plant=plant.id).b.shape[1] for plant in plants]
    inputs = [np.zeros(1), client.linearize(plant=plants[1].id).u]
    assert entries == [1, len(inputs[1])]
    stepped = client.step_many(plants, inputs)
    assert [state.step for state in stepped.states] == [1, 1] and not stepped.errors


def test_a_plant_that_cannot_be_stepped_does_not_disturb_the_others(client):
    plants = [client.create_plant("pendulum") for _ in range(3)]
    with client.drive(plants[1].id):
        stepped = client.step_many(plants, [[0.1], [0.2], [0.3]])
    assert [state.step for state in stepped.states] == [1, 0, 1]
    assert list(stepped.errors) == [1] and stepped.errors[1].reason == "LEASE_HELD"
    with pytest.raises(plantd.StepError, match="LEASE_HELD"):
        stepped.raise_errors()
    # What is wrong with the call itself steps nobody.
    for wrong in [[plants[0], "no-such-plant"], [plants[0], plants[0]]]:
        with pytest.raises(plantd.PlantdError):
            client.step_many(wrong)
    with pytest.raises(plantd.PlantdError, match="the 3 plants take 3 together"):
        client.step_many(plants, [[1.0, 2.0]] * 3)
    assert client.get_plant(plants[0].id).state.step == 1


def test_rollouts_are_arrays(client):
    forces = np.random.default_rng(2).normal(size=(5, 30, 1))
    ends = client.rollout("cart-pole", forces, q=[0.0, 0.3], every=10)
    assert ends.x.shape == (5, 3, 4) and list(ends.steps) == [10, 20, 30] and not ends.errors
    plant = client.create_plant("cart-pole", q=[0.0, 0.3])
    for case in range(5):
        client.reset(plant.id)
        states = client.step(plant.id, forces[case])
        assert np.array_equal(ends.x[case], [states[k].x for k in (9, 19, 29)])
    starts = np.column_stack((np.zeros(4), np.linspace(0, 1, 4)))
    free = client.rollout("cart-pole", q=starts, velocity=np.ones((4, 2)), steps=7)
    assert free.q.shape == (4, 7, 2) and free.velocity.shape == (4, 7, 2)
    with pytest.raises(ValueError, match="numbers of cases differ: `u` 5, `q` 4"):
        client.rollout("cart-pole", forces, q=starts)


def test_a_case_that_fails_is_named_and_the_others_are_there(client):
    # The second start violates the constraint of the loop.
    good = client.create_plant("four-bar").state.q
    ends = client.rollout("four-bar", q=[good, good + [0.3, 0, 0]], steps=2)
    assert list(ends.errors) == [1] and ends.errors[1].reason == "OFF_CONSTRAINT"
    assert np.all(np.isfinite(ends.q[0])) and np.all(np.isnan(ends.q[1]))
    with pytest.raises(plantd.PlantdError, match=r"cases\[1\]"):
        ends.raise_errors()
