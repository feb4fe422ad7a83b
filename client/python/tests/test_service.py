"""Control as a service, against a real server."""

import math
import threading

import numpy as np
import pytest

import plantd

PAPER = {"dt": 0.1, "paper": True}
STEPS = 100


def swing_up(client, guess=True, **options):
    """The swing-up of the paper's pendulum."""
    desired = np.zeros((STEPS + 1, 2))
    desired[50:, 0] = math.pi
    if guess is True:
        plant = client.create_plant("pendulum", q=[0.0], **PAPER)
        guess = plantd.Trajectory(plant.state, np.zeros((STEPS, 1)))
    defaults = {"first_method": "quasi-newton", "first_iterations": 4, "tolerance": 1e-6}
    return client.optimize_trajectory(
        "pendulum", guess, x=desired, q=[1000, 1], r=[50], **PAPER, **{**defaults, **options}
    )


def test_a_search_tells_of_its_iterations_and_ends(client):
    # The paper's projection.
    search = swing_up(client, projection=([1.0, 1.0], [1.0]))
    steps = list(search)
    assert [step.iteration for step in steps] == list(range(len(steps)))
    assert steps[0].cost_before == pytest.approx(251674.91222777878, rel=1e-12)
    assert steps[3].cost == pytest.approx(107176.097, abs=1e-3)
    assert [step.method for step in steps[:5]] == ["quasi-newton"] * 4 + ["newton"]
    best = search.result
    assert best.converged and best.failure == ""
    assert best.cost == pytest.approx(13297.378894617856, rel=1e-9)
    assert best.x.shape == (STEPS + 1, 2) and best.u.shape == (STEPS, 1)
    # What came out is a motion of the plant.
    plant = client.create_plant("pendulum", q=[0.0], **PAPER)
    assert client.step(plant.id, best.u)[-1].x == pytest.approx(best.x[-1], abs=1e-9)


def test_a_search_goes_on_bit_for_bit_from_a_file(client, tmp_path):
    whole = swing_up(client).result
    part = swing_up(client, max_iterations=6).result
    assert not part.converged and part.failure.startswith("MAX_ITERATIONS")
    part.save(tmp_path / "part.json")
    checkpoint = plantd.Checkpoint.load(tmp_path / "part.json")
    assert checkpoint.iterations == 6
    rest = swing_up(client, guess=None, resume=checkpoint).result
    assert rest.x.tobytes() == whole.x.tobytes() and rest.cost == whole.cost
    whole.save(tmp_path / "whole.json")
    loaded = plantd.Optimum.load(tmp_path / "whole.json")
    assert loaded.x.tobytes() == whole.x.tobytes() and loaded.converged
    again = list(swing_up(client, guess=loaded, first_iterations=0))
    assert len(again) <= 2
    checkpoint.save(tmp_path / "checkpoint.json")
    assert plantd.Checkpoint.load(tmp_path / "checkpoint.json").iterations == 6
    with pytest.raises(ValueError, match="no result"):
        (tmp_path / "nothing.json").write_text('{"a": 1}')
        plantd.Optimum.load(tmp_path / "nothing.json")


def test_bounds_and_a_free_initial_state(client):
    bounds = {"input_bounds": {"tau": (-5, 5)}, "bound_tolerance": 1e-3, "tolerance": 0.0}
    bounded = swing_up(client, **bounds).result
    assert bounded.converged, bounded.failure
    assert 4.9 < np.abs(bounded.u).max() < 5.001 and bounded.bound_violation < 1e-3
    assert bounded.cost > 13297.378894617856
    free = swing_up(client, free_initial=["theta"]).result
    assert free.converged and free.cost < 13297.378894617856
    assert free.x[0, 0] != 0 and free.x[0, 1] == 0
    with pytest.raises(plantd.PlantdError) as caught:
        list(swing_up(client, final_state={"phi": 1.0}))
    assert caught.value.code == "INVALID_ARGUMENT"


def test_a_search_can_be_left(client):
    with swing_up(client, method="steepest", first_iterations=0) as search:
        next(search)
    with pytest.raises(plantd.PlantdError) as caught:
        list(search)
    assert caught.value.code == "CANCELLED"


def test_arguments_of_a_search(client):
    with pytest.raises(ValueError, match="guess"):
        swing_up(client, guess=None)
    with pytest.raises(ValueError, match="step 0"):
        swing_up(client, stages=[{"q": [1, 1]}])


def test_a_reference_from_outside(client):
    plant = client.create_plant("cart-pole", at="hanging")
    states = [plant.state, *client.step(plant.id, np.full((20, 1), 2.0))]
    q = np.array([state.q for state in states])
    found = client.project_reference("cart-pole", q, q=[1] * 4, r=[1], strict=True)
    assert found.feasible and found.unexplained_acceleration < 1e-6
    assert found.u == pytest.approx(np.full((20, 1), 2.0), abs=1e-3)
    assert len(found.steps) == 21 and found.deviation < 1e-7
    assert found.law(states[3]) == pytest.approx([2.0], abs=1e-2)
    q[7:, 1] += 0.3
    jump = client.project_reference("cart-pole", q)
    assert not jump.feasible and jump.unexplained_acceleration > 1
    assert jump.unexplained_coordinate in ("x", "theta") and 5 <= jump.unexplained_step <= 8
    with pytest.raises(plantd.PlantdError) as caught:
        client.project_reference("cart-pole", q, strict=True)
    assert caught.value.reason == "INFEASIBLE_REFERENCE"


NOISE = {"measurement_noise": [1e-4, 1e-4], "process_noise": [1e-6] * 4}


def test_a_steady_filter_agrees_with_its_riccati_equation(client):
    kalman = client.solve_kalman("cart-pole", at="upright", outputs=["x", "theta"], **NOISE)
    a, c = kalman.linearization.a, kalman.output_x
    p, w, r = kalman.predicted_covariance, 1e-6 * np.eye(4), 1e-4 * np.eye(2)
    assert c.tolist() == np.eye(4)[:2].tolist() and kalman.outputs == ["x", "theta"]
    gain = p @ c.T @ np.linalg.inv(c @ p @ c.T + r)
    assert kalman.gain == pytest.approx(gain, rel=1e-9)
    filtered = (np.eye(4) - gain @ c) @ p
    assert kalman.filtered_covariance == pytest.approx(filtered, rel=1e-7, abs=1e-15)
    assert a @ filtered @ a.T + w == pytest.approx(p, rel=1e-7, abs=1e-15)
    modes = np.abs(np.linalg.eigvals(a @ (np.eye(4) - gain @ c)))
    assert np.sort(np.abs(kalman.error_modes)) == pytest.approx(np.sort(modes), rel=1e-7)
    with pytest.raises(plantd.PlantdError) as caught:
        client.solve_kalman("cart-pole", at="upright", outputs=["p(x)"], **{
            **NOISE, "measurement_noise": [1e-4]
        })
    assert caught.value.reason == "NOT_DETECTABLE"


def test_a_filter_along_a_trajectory_finds_the_state(client):
    plant = client.create_plant("cart-pole", at="hanging")
    u = 20 * np.sin(0.1 * np.arange(60)).reshape(-1, 1)
    filter = client.solve_trajectory_kalman(
        "cart-pole",
        plant.state,
        u,
        outputs=["x", "theta"],
        measurement_noise=[1e-8, 1e-8],
        process_noise=[1e-12] * 4,
        initial_covariance=[1e-2] * 4,
        covariances=True,
    )
    assert len(filter.steps) == 61 and filter.steps[60].linearization is None
    assert filter.steps[0].predicted_covariance == pytest.approx(1e-2 * np.eye(4))
    state = client.reset(plant.id, q=[0.01, -0.02], p=[0.03, 0.01])
    with client.drive(plant.id) as driver:
        for row in u:
            filter.correct(state.q)
            filter.predict(row)
            state = driver.step(row)
    assert filter.correct(state.q) == pytest.approx(state.x, abs=1e-3)


def test_gains_of_an_operating_point_are_followed(client):
    plant = client.create_plant("pendulum", q=[math.pi - 0.2])
    with pytest.raises(plantd.PlantdError) as caught:
        client.follow_gains(plant.id)
    assert caught.value.reason == "NO_FEEDBACK"
    feedback = client.set_feedback(plant.id, at="upright", q=[100, 1], r=[1])
    assert (feedback.mode, feedback.revision, feedback.horizon) == ("watch", 1, 0)
    expected = client.solve_lqr("pendulum", at="upright", q=[100, 1], r=[1])
    with client.drive(plant.id) as driver, client.follow_gains(plant.id) as law:
        state = driver.plant.state
        assert law(state) == pytest.approx(expected(state), rel=1e-12)
        for _ in range(100):
            state = driver.step(law(state))
        assert abs(state.q[0] - math.pi) < 1e-9
        # Gains for less gravity replace those in force, off the control path.
        changed = client.set_parameters(plant.id, {"gravity[1]": -1.6})
        assert changed.parameters == {"gravity[1]": -1.6}
        while law.revision == 1:
            state = driver.step(law(state))
        assert not np.allclose(law(plant.state), expected(plant.state), rtol=1e-3)
        client.clear_feedback(plant.id)
        with pytest.raises(plantd.PlantdError) as caught:
            while True:
                state = driver.step(law(state))
        assert caught.value.reason == "NO_FEEDBACK"


def test_gains_along_a_trajectory_are_followed(client):
    best = swing_up(client).result
    plant = client.create_plant("pendulum", q=[1.0], p=[1.0], **PAPER)
    client.set_feedback(plant.id, trajectory=best.trajectory, q=[1, 1], r=[1])
    gains = client.solve_trajectory_lqr("pendulum", best.trajectory, q=[1, 1], r=[1], **PAPER)
    schedule = plantd.GainSchedule(gains)
    for _ in range(2):
        # The second time over after a reset.
        state = client.reset(plant.id)
        with client.drive(plant.id) as driver, client.follow_gains(plant.id) as law:
            for _ in range(STEPS):
                assert law(state) == pytest.approx(schedule(state), rel=1e-12, abs=1e-12)
                state = driver.step(law(state))
            assert np.linalg.norm(state.x - best.x[-1]) < 1e-6
            assert law(state) == pytest.approx(schedule(state), rel=1e-12, abs=1e-12)
            assert law.horizon == STEPS


def test_a_follower_survives_a_reset(client):
    best = swing_up(client).result
    plant = client.create_plant("pendulum", q=[0.0], **PAPER)
    client.set_feedback(plant.id, trajectory=best.trajectory, q=[1, 1], r=[1])
    with client.follow_gains(plant.id) as law:
        for _ in range(2):
            state = client.reset(plant.id)
            with client.drive(plant.id) as driver:
                for _ in range(STEPS):
                    state = driver.step(law(state))
            assert state.x == pytest.approx(best.x[-1], abs=1e-8)


def test_a_feedback_in_the_plants_own_loop(client):
    plant = client.create_plant("pendulum", q=[math.pi - 0.2])
    client.set_feedback(plant.id, at="upright", q=[100, 1], r=[1], mode="replace")
    with client.drive(plant.id) as driver:
        for _ in range(100):
            state = driver.step()
        assert abs(state.q[0] - math.pi) < 1e-9 and driver.u is not None
    client.reset(plant.id, at="upright")
    guard = {"theta": (-0.1, 0.1)}
    client.set_feedback(plant.id, at="upright", q=[100, 1], r=[1], mode="guard", guard=guard)
    with client.drive(plant.id) as driver:
        for _ in range(300):
            state = driver.step(0.5)
    assert abs(state.q[0] - math.pi) < 1e-9
    feedback = client.get_plant(plant.id).feedback
    assert feedback.mode == "guard" and feedback.tripped_by == "theta"
    assert feedback.tripped_at_step > 0
    with pytest.raises(ValueError, match="one of"):
        client.set_feedback(plant.id, q=[1, 1], r=[1])


def test_gains_and_inputs_are_watched(client):
    plant = client.create_plant("pendulum", q=[1.0])
    client.set_feedback(plant.id, at="hanging", q=[1, 1], r=[1])
    watch = client.watch_gains(plant.id)
    message = next(watch)
    assert (message.revision, message.horizon, message.failure) == (1, 0, "")
    assert message.gain.x_reference.tolist() == [0.0, 0.0]
    watch.close()
    seen = []

    def look():
        for message in client.watch(plant.id, ["input"]):
            if message.u is not None and message.u.size and message.u[0] == 0.25:
                seen.append(message.step)
                return

    thread = threading.Thread(target=look)
    thread.start()
    with client.drive(plant.id) as driver:
        while thread.is_alive():
            driver.step(0.25)
    assert seen
