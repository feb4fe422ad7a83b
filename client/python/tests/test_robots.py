"""Robots of eight kinds, from URDF and MJCF, in closed loops and without any drive."""

import pathlib
import re
import warnings

import numpy as np
import pytest

import plantd

ROBOTS = pathlib.Path(__file__).resolve().parents[3] / "tests" / "robots"


@pytest.fixture
def robot(client):
    """Uploads a robot, as it is or with its text changed; they are gone after the test."""
    names = []

    def upload(file, change=lambda text: text):
        with warnings.catch_warnings():
            # Contacts, limits and equalities, which are softer in MuJoCo.
            warnings.simplefilter("ignore", UserWarning)
            model = client.create_model(change((ROBOTS / file).read_text()))
        names.append(model.name)
        return model

    yield upload
    for plant in client.list_plants():
        client.delete_plant(plant.id)
    for name in names:
        client.delete_model(name)


def run(client, plant, steps):
    """The state after so many steps, which the plant takes by itself."""
    begin = client.get_plant(plant.id).state.step
    client.run(plant.id, "free", steps=steps, wait=True)
    state = client.get_plant(plant.id).state
    assert state.step == begin + steps, "a step has failed"
    return state


def hold(client, plant, u, steps):
    """The state after so many steps under one input."""
    return client.step(plant.id, np.tile(u, (steps, 1)))[-1]


def regulate(client, plant, q, r, **reference):
    """Closes the loop over an LQR in the plant itself."""
    nx = len(plant.state.x)
    weights = np.full(nx, 1e-6)
    weights[: len(plant.state.q)] = q
    client.set_feedback(plant.id, q=weights, r=r, mode="replace", **reference)


def holding(client, model, q):
    """The inputs that hold a configuration, least squares over its freedoms."""
    at = client.dynamics(model.name, q=q)
    n, columns = len(model.coordinates), []
    for i in range(len(model.inputs)):
        columns.append(client.dynamics(model.name, q=q, inputs=np.eye(len(model.inputs))[i]).input)
    reach = np.array(columns).T
    free = np.eye(n)
    if at.constraint_jacobian.size:
        _, sizes, rows = np.linalg.svd(at.constraint_jacobian)
        free = rows[np.count_nonzero(sizes > 1e-9 * sizes[0]) :].T
    u, *_ = np.linalg.lstsq(free.T @ reach, free.T @ (at.bias - at.passive), rcond=None)
    assert free.T @ (reach @ u + at.passive - at.bias) == pytest.approx(0, abs=1e-9)
    return u


def test_a_cart_balances_its_pole(client, robot):
    model = robot("cart_pole.xml")
    plant = client.create_plant(model.name, q=[0.4, 0.3])
    regulate(client, plant, [10, 10], [1], at="upright")
    assert run(client, plant, 2000).q == pytest.approx(0, abs=1e-6)


def test_a_quadrotor_flies_back_to_where_it_hovers(client, robot):
    model = robot("quadrotor.xml")
    plant = client.create_plant(model.name, q=[0.5, -0.4, 0.7, 0.2, -0.1, 0.3])
    regulate(client, plant, [10, 10, 10, 1, 1, 1], np.ones(4), at="hover")
    state = run(client, plant, 4000)
    assert state.q == pytest.approx([0, 0, 1, 0, 0, 0], abs=1e-4)


def test_an_arm_holds_a_posture_against_gravity(client, robot):
    model = robot("arm.urdf")
    posture = np.array([0.3, 0.7, -1.1, 0.4, 0.8, -0.2])
    u = holding(client, model, posture)
    rest = client.create_plant(model.name, q=posture)
    plant = client.create_plant(model.name, q=posture + [0.2, -0.1, 0.1, 0.2, -0.2, 0.1])
    regulate(client, plant, np.full(6, 100), np.full(6, 1e-3), state=rest.state, u=u)
    assert run(client, plant, 5000).q == pytest.approx(posture, abs=1e-6)


def test_a_hand_closes_as_far_as_its_tendons_pull(client, robot):
    model = robot("hand.xml")
    assert list(model.inputs)[:2] == ["thumb_lean", "thumb_bend"]
    plant = client.create_plant(model.name)
    state = hold(client, plant, [0.2, 1.0] * 3, 2500)
    assert abs(state.velocity).max() < 1e-6
    near, knuckle, tip = state.q.reshape(3, 3).T
    # The tendon is held at its length but for what springs and weight stretch the servo.
    assert knuckle + 0.7 * tip == pytest.approx(1, abs=0.1)
    assert near == pytest.approx(0.2, abs=0.05)
    # It pulls the tip with 0.7 of the torque at the knuckle, and both have the same springs.
    assert tip / knuckle == pytest.approx(0.7, abs=0.1)


def test_a_quadruped_stands_and_bows(client, robot):
    model = robot("quadruped.xml")
    plant = client.create_plant(model.name)
    tall = hold(client, plant, np.zeros(12), 1500)
    assert abs(tall.velocity).max() < 1e-9
    # Thighs forward, knees back by twice as much, for legs of two equal parts: straight down.
    bend = 0.2
    low = hold(client, plant, np.tile([0, bend, -2 * bend], 4), 1500)
    assert abs(low.velocity).max() < 1e-6
    names = [coordinate.name for coordinate in model.coordinates]
    sunk = tall.q[names.index("float_z")] - low.q[names.index("float_z")]
    assert sunk == pytest.approx(0.4 * (np.cos(0.6) - np.cos(0.6 + bend)), abs=0.005)
    feet = client.kinematics(plant=plant.id, points=[("fl_shank", (0, 0, -0.2))]).points
    assert feet[0].position == pytest.approx([0.2, 0.16, 0], abs=1e-9)


def test_a_humanoid_balances_on_its_feet(client, robot):
    model = robot("humanoid.xml")
    plant = client.create_plant(model.name)
    rest = plant.state
    push = np.zeros(len(model.inputs))
    push[list(model.inputs).index("waist_pitch")] = 0.3
    client.step(plant.id, np.tile(push, (50, 1)))
    assert abs(client.get_plant(plant.id).state.q - rest.q).max() > 0.01
    regulate(client, plant, np.full(26, 100), np.ones(20), state=rest, u=np.zeros(20))
    assert run(client, plant, 4000).q == pytest.approx(rest.q, abs=1e-5)


def test_a_parallel_robot_holds_its_platform(client, robot):
    model = robot("delta.xml")
    plant = client.create_plant(model.name)
    rest, u = plant.state, holding(client, model, plant.state.q)
    assert u == pytest.approx(np.full(3, u[0]), abs=1e-9)
    client.step(plant.id, np.tile(u + [0.3, -0.2, 0.1], (50, 1)))
    assert abs(client.get_plant(plant.id).state.q - rest.q).max() > 0.01
    regulate(client, plant, np.full(21, 100), np.ones(3), state=rest, u=u)
    assert run(client, plant, 4000).q == pytest.approx(rest.q, abs=1e-5)


def test_a_biped_with_loops_bends_its_knees(client, robot):
    model = robot("biped.xml")
    plant = client.create_plant(model.name)
    tall = hold(client, plant, np.zeros(8), 1500)
    bend = 0.1
    # Roll, pitch, knee and crank of each leg; what turns the crank turns the foot through the loop.
    low = hold(client, plant, np.tile([0, -bend, 2 * bend, -bend], 2), 2500)
    assert abs(low.velocity).max() < 1e-3
    names = [coordinate.name for coordinate in model.coordinates]
    sunk = tall.q[names.index("float_z")] - low.q[names.index("float_z")]
    assert sunk == pytest.approx(0.7 * (np.cos(0.4) - np.cos(0.4 + bend)), abs=0.005)
    heel = re.search(r'name="left_heel" pos="([^"]*)"', (ROBOTS / "biped.xml").read_text())
    heel = [float(number) for number in heel[1].split()]
    for side in ("left", "right"):
        crank, ankle = (low.q[names.index(f"{side}_{what}")] for what in ("crank", "ankle"))
        assert crank < -0.05 and ankle < -0.05
        ends = [(f"{side}_rod", (0, 0, -0.3)), (f"{side}_foot", heel)]
        rod, foot = client.kinematics(plant=plant.id, points=ends).points
        assert rod.position == pytest.approx(foot.position, abs=1e-9)


def passive(text):
    """A robot without actuators, dampers and, where it flies, without weight.

    The biped, which would fall into configurations where its loops are singular, stands on springs.
    """
    text = re.sub(r"<actuator>.*</actuator>|<keyframe>.*</keyframe>", "", text, flags=re.S)
    text = re.sub(r' damping="[^"]*"', "", text)
    if "left_rod" in text:
        text = re.sub(r'(name="\w+_(?:roll|pitch|knee|crank)" axis)', r'stiffness="300" \1', text)
    return text.replace("<option ", '<option gravity="0 0 0" ') if "quadrotor" in text else text


#: Robot, time step, s, steps of the test, and the band of the energy's error; `tests/peers/passive.py` takes a million.
PASSIVE = [
    ("cart_pole.xml", 1e-3, 20_000, 1e-3),
    ("quadrotor.xml", 1e-3, 20_000, 1e-5),
    ("arm.urdf", 5e-4, 20_000, 1e-3),
    ("hand.xml", 1e-3, 5000, 1e-3),
    # Legs that swing through where they are straight.
    ("quadruped.xml", 5e-4, 2000, 1e-3),
    ("humanoid.xml", 5e-4, 2000, 1e-3),
    ("delta.xml", 5e-4, 4000, 1e-3),
    ("biped.xml", 5e-4, 2000, 1e-3),
]


@pytest.mark.parametrize(("file", "dt", "steps", "band"), PASSIVE)
def test_nothing_is_won_or_lost_without_drives(client, robot, file, dt, steps, band):
    """Energy stays within a band of what is exchanged between kinetic and potential energy."""
    model = robot(file, passive)
    q, v = moving(client, model)
    plant, energies = client.create_plant(model.name, q=q, velocity=v, dt=dt), []
    for part in range(11):
        if part:
            run(client, plant, steps // 10)
        energy = client.dynamics(plant=plant.id).energy
        energies.append((energy.kinetic, energy.potential))
    kinetic, potential = np.array(energies).T
    total = kinetic + potential
    assert abs(total - total[0]).max() < band * max(kinetic.max(), np.ptp(potential))


def moving(client, model):
    """The initial configuration and a velocity of all freedoms."""
    at = client.dynamics(model.name)
    names = [coordinate.name for coordinate in model.coordinates]
    v = np.random.default_rng(1).normal(size=len(names))
    held = at.constraint_jacobian
    if "left_rod" in names:
        # The biped stands where its feet leave the legs more velocities than motions: they move as mirror images.
        apart = ["float_y", "float_rx", "float_rz", "left_roll", "right_roll"]
        pairs = [(f"left_{what}", f"right_{what}") for what in ("pitch", "knee", "crank", "rod", "ankle")]
        unit = np.eye(len(names))
        mirror = [unit[names.index(name)] for name in apart]
        mirror += [unit[names.index(left)] - unit[names.index(right)] for left, right in pairs]
        held = np.vstack([held, mirror])
    if held.size:
        _, sizes, rows = np.linalg.svd(held)
        free = rows[np.count_nonzero(sizes > 1e-9 * sizes[0]) :]
        v = free.T @ (free @ v)
    return at.q, v


def test_meshes_are_read_where_the_robot_stands(client, tmp_path):
    """A file brings the meshes from which its inertia comes; a text does not, and is told which it misses."""
    (tmp_path / "parts").mkdir()
    tetrahedron = "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 3 2\nf 1 2 4\nf 1 4 3\nf 2 3 4\n"
    (tmp_path / "parts" / "tip.obj").write_text(tetrahedron)
    robot = tmp_path / "robot.xml"
    robot.write_text(
        """<mujoco model="tip"><compiler meshdir="parts"/><asset><mesh name="tip" file="tip.obj"/>
        <mesh name="unused" file="gone.stl"/></asset><worldbody><body name="tip"><joint type="slide" axis="1 0 0"/>
        <geom type="mesh" mesh="tip" contype="0" conaffinity="0"/></body></worldbody></mujoco>"""
    )
    assert client.validate_scene(robot) == []
    model = client.create_model(robot)
    assert client.dynamics(model.name).mass_matrix[0, 0] == pytest.approx(1000 / 6)
    client.delete_model(model.name)
    with pytest.raises(plantd.PlantdError, match="mesh file `parts/tip.obj`, which is not here"):
        client.create_model(robot.read_text())
    (tmp_path / "parts" / "tip.obj").unlink()
    assert "`parts/tip.obj`" in client.validate_scene(robot)[0].message
