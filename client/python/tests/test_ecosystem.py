"""What other packages make of plants: control, scipy, gymnasium, pandas, matplotlib."""

import dataclasses

import numpy as np
import plantd
import pytest
from plantd.v1 import common_pb2

control = pytest.importorskip("control")


@pytest.fixture(scope="module")
def own(addresses):
    with plantd.connect(addresses["unix"]) as client:
        yield client
        for plant in client.list_plants():
            client.delete_plant(plant.id)


def test_a_linearization_is_a_state_space_with_names_and_time_step(own):
    lin = own.linearize("cart-pole", at="upright", dt=0.02)
    system = lin.ss()
    assert system.dt == 0.02
    assert system.state_labels == ["x", "theta", "p(x)", "p(theta)"] == system.output_labels
    assert system.input_labels == ["force"]
    one = lin.ss(["theta"])
    assert one.output_labels == ["theta"] and np.array_equal(one.A, lin.a)
    gain, _, _ = control.dlqr(system, np.diag([1, 100, 1, 1]), [[0.1]])
    ours = own.solve_lqr("cart-pole", at="upright", q=[1, 100, 1, 1], r=[0.1], dt=0.02)
    assert np.allclose(gain, ours.k, rtol=1e-8)
    sampled = lin.to_scipy()
    assert sampled.dt == 0.02 and np.array_equal(sampled.A, lin.a)
    with pytest.raises(ValueError, match="no state entry `thta`; did you mean `theta`"):
        lin.ss(["thta"])


def test_states_are_velocities_where_wanted(own):
    lin = own.linearize("cart-pole", at="upright")
    system = lin.ss(velocity=True)
    assert system.state_labels == ["x", "theta", "v(x)", "v(theta)"]
    # The plant itself, a little beside its equilibrium, says so too.
    q, v = lin.state.q + [1e-5, 2e-5], np.array([3e-5, -1e-5])
    plant = own.create_plant("cart-pole", q=q, velocity=v)
    state = own.step(plant.id, [[1e-4]])[-1]
    z = system.A @ np.concatenate((q - lin.state.q, v)) + system.B @ [1e-4]
    assert np.allclose(z, np.concatenate((state.q - lin.state.q, state.velocity)), atol=1e-12)
    assert np.allclose(np.sort_complex(np.linalg.eigvals(system.A)), np.sort_complex(np.linalg.eigvals(lin.a)))
    moving = own.create_plant("cart-pole", q=[0, 0], velocity=[1, 0])
    with pytest.raises(ValueError, match="this one moves"):
        own.linearize(plant=moving.id).ss(velocity=True)


@pytest.mark.parametrize("model", ["four-bar", "marionette"])
def test_a_model_with_constraints_is_reduced_to_the_directions_in_which_it_can_move(own, model):
    rest = common_pb2.InitialState(equilibrium=common_pb2.InitialState.Equilibrium())
    plant = own.create_plant(model, initial=rest)
    lin = own.linearize(plant=plant.id)
    system = lin.ss(reduced=True)
    assert system.nstates < lin.a.shape[0] and system.dt == plant.time_step
    # The server's own analysis reduces in its own way.
    modes = np.array([mode.eigenvalue for mode in own.analyze(plant=plant.id).modes])
    poles = np.linalg.eigvals(system.A)
    for mode in modes:
        assert np.min(np.abs(poles - mode)) < 1e-5, mode
    with pytest.raises(ValueError, match="for models without constraints"):
        lin.ss(velocity=True)
    # Two steps of the reduced map are those of the full one, seen from outside.
    a, b, e, _ = lin.matrices(reduced=True)
    z = np.random.default_rng(3).normal(size=a.shape[0])
    full = (lin.a @ lin.a @ e @ z)[: lin.state.q.size]
    assert np.allclose((e @ a @ a @ z)[: lin.state.q.size], full, atol=1e-8 * np.linalg.norm(full))


def test_a_gain_of_ones_own_is_a_law_and_a_feedback(own):
    lin = own.linearize("cart-pole", at="upright")
    k, _, _ = control.dlqr(lin.ss(), np.diag([100, 100, 1, 1]), [[0.01]])
    law = plantd.Gain.from_matrix(k, lin.state, lin.u, model="cart-pole", time_step=0.01)
    with own.plant("cart-pole", q=lin.state.q + [0, 0.1]) as plant:
        plant.set_feedback(gain=law, mode="replace")
        plant.step(hold=4000)
        assert np.linalg.norm(plant.state.x - lin.state.x) < 1e-3
    with pytest.raises(ValueError, match=r"\(1, 4\) fits"):
        plantd.Gain.from_matrix([[1, 2]], lin.state, [0])


def test_motions_are_tables_with_names(own, tmp_path):
    pandas = pytest.importorskip("pandas")
    with own.plant("cart-pole", q=[0, 0.3]) as plant:
        recording = plant.start_recording()
        with plant.drive() as driver:
            states = [driver.step([0.5]) for _ in range(20)]
        own.stop_recording(recording.name)
    table = own.table(states)
    assert list(table.columns) == ["x", "theta", "p(x)", "p(theta)", "v(x)", "v(theta)"]
    assert isinstance(table, pandas.DataFrame) and table.index[-1] == pytest.approx(0.2)
    assert np.array_equal(table["theta"], [state.q[1] for state in states])
    own.get_recording(recording.name, tmp_path / "motion.mcap")
    recorded = plantd.read_recording(tmp_path / "motion.mcap")
    assert np.array_equal(recorded["theta"], table["theta"]) and set(recorded["u(force)"]) == {0.5}
    ends = own.rollout("cart-pole", np.ones((2, 5, 1)))
    assert list(own.table(ends, "cart-pole", case=1)["x"]) == list(ends.q[1, :, 0])
    data = own.dataset(ends, "cart-pole")
    assert data["x"].dims == ("case", "time") and np.array_equal(data["x"], ends.q[..., 0])
    assert np.array_equal(data.time, ends.time)
    assert np.array_equal(own.dataset(states)["theta"], table["theta"])
    with pytest.raises(ValueError, match="`model` is needed"):
        own.table(ends)
    with pytest.raises(TypeError, match="`motion` is 3"):
        own.table(3)


def test_motions_and_analyses_are_drawn(own):
    pytest.importorskip("pandas")
    matplotlib = pytest.importorskip("matplotlib")
    matplotlib.use("Agg")
    plant = own.create_plant("cart-pole", q=[0, 0.3])
    figure = own.plot(own.step(plant.id, np.zeros((10, 1))), "cart-pole")
    assert [axis.get_ylabel().split(",")[0] for axis in figure.axes] == ["configuration", "velocity", "momentum"]
    assert len(figure.axes[0].lines) == 2
    analysis = own.analyze("cart-pole", at="upright", outputs=["theta"], frequencies=np.logspace(-1, 1, 30))
    figure = analysis.plot()
    poles, magnitude, _ = figure.axes
    assert sum(len(line.get_xdata()) for line in poles.lines[1:]) == len(analysis.modes)
    assert magnitude.lines[0].get_label() == "theta / force"
    assert len(own.analyze("cart-pole", at="upright").plot().axes) == 1
    law = own.solve_lqr("cart-pole", at="upright", q=[1, 1, 1, 1], r=[1])
    names = ["x", "theta", "p(x)", "p(theta)"]
    axis, _ = law.plot(names, ["force"]).axes
    assert [tick.get_text() for tick in axis.get_xticklabels()] == names and len(axis.texts) == 4
    with pytest.raises(ValueError, match="1 names are given; 4 are needed"):
        law.plot(["x"])
    later = plantd.Gain.from_matrix(2 * law.k, law.x_reference, law.u_reference)
    schedule = plantd.GainSchedule([law, dataclasses.replace(later, step=5)])
    (axis,) = schedule.plot().axes
    assert len(axis.lines) == 4 and list(axis.lines[1].get_ydata()) == [law.k[0, 1], 2 * law.k[0, 1]]


def test_progress_is_shown_where_somebody_asked_and_nowhere_else(own, capsys):
    pytest.importorskip("tqdm")
    own.rollout("pendulum", np.zeros((3, 2, 1)))
    assert capsys.readouterr().err == ""
    own.rollout("pendulum", np.zeros((3, 2, 1)), progress=True)
    assert "rollout" in capsys.readouterr().err


def balance():
    from plantd.gym import Task

    class Balance(Task):
        model = "cart-pole"
        horizon = 30
        action_limits = {"force": (-20, 20)}

        def start(self, rng):
            return {"q": [0, np.pi + rng.uniform(-0.2, 0.2)]}

        def reward(self, state, action):
            error = state.q[1] - np.pi
            return 1 - error**2, abs(error) > 0.5

    return Balance()


def test_a_plant_is_an_environment(own):
    gymnasium = pytest.importorskip("gymnasium")
    from gymnasium.utils.env_checker import check_env
    from plantd.gym import PlantEnv, Task

    env = PlantEnv(own, balance())
    check_env(env, skip_render_check=True)
    assert env.action_space == gymnasium.spaces.Box(-20.0, 20.0, (1,), np.float64)
    runs = []
    for _ in range(2):
        start, _ = env.reset(seed=7)
        rows = [env.step([np.sin(k)]) for k in range(40)]
        runs.append((start, [row[0] for row in rows], [row[1] for row in rows]))
    assert np.array_equal(runs[0][1], runs[1][1]) and runs[0][2] == runs[1][2]
    assert rows[29][3] and not rows[28][3]
    plant = env.plant.id
    env.close()
    assert plant not in {p.id for p in own.list_plants()}

    class NoLimits(Task):
        model = "cart-pole"

    with pytest.raises(ValueError, match="gives no limits of input `force`: `action_limits`"):
        PlantEnv(own, NoLimits())


def test_many_plants_are_a_vector_environment_that_agrees_with_single_ones(own):
    pytest.importorskip("gymnasium")
    from plantd.gym import PlantEnv, PlantVectorEnv

    many, one = PlantVectorEnv(own, balance(), 4), PlantEnv(own, balance())
    forces = np.random.default_rng(5).uniform(-20, 20, (40, 4, 1))
    seen, _ = many.reset(seed=3)
    rows = [many.step(u) for u in forces]
    for i in range(4):
        start, _ = one.reset(seed=3 + i)
        assert np.array_equal(start, seen[i])
        restart = False
        for u, (observed, rewards, terminated, truncated, _) in zip(forces, rows):
            if restart:
                observation, _ = one.reset()
                assert np.array_equal(observation, observed[i]) and rewards[i] == 0
                restart = False
                continue
            observation, reward, ends, is_cut, _ = one.step(u[i])
            assert np.array_equal(observation, observed[i])
            assert (reward, ends, is_cut) == (rewards[i], terminated[i], truncated[i])
            restart = ends or is_cut
    again, _ = many.reset(seed=3)
    assert np.array_equal(again, seen) and many.observation_space.shape == (4, 4)
    many.close()
    one.close()
    assert own.list_plants() == [] or all(p.id not in many.plants for p in own.list_plants())
