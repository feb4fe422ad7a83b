"""The client against a real server."""

import dataclasses
import math
import threading

import numpy as np
import pytest

import plantd
from plantd.v1 import common_pb2, control_service_pb2, plant_service_pb2

SCENE = """
format = 1
gravity = [0.0, 0.0, 0.0]
name = "py-slider"

[[frames]]
name = "block"
joint = { type = "prismatic", axis = [1.0, 0.0, 0.0] }
body = { mass = 2.0 }

[[inputs]]
name = "push"
coordinate = "block"
"""


ROBOT = """<robot name="py-rod"><link name="base"/>
<joint name="hinge" type="revolute"><parent link="base"/><child link="rod"/><axis xyz="0 1 0"/>
<limit lower="-1" upper="1" velocity="1" effort="0"/></joint>
<link name="rod"><inertial><origin xyz="0 0 -0.5"/><mass value="2"/>
<inertia ixx="0.1" iyy="0.1" izz="0.01"/></inertial></link></robot>"""


def test_a_robot_is_a_file_or_a_text(client, tmp_path):
    file = tmp_path / "rod.urdf"
    file.write_text(ROBOT)
    for robot in [file, str(file), ROBOT]:
        with pytest.warns(UserWarning, match="2:1: joint `hinge` moves past its limits"):
            model = client.create_model(robot, name="py-rod-1")
        gain = client.solve_lqr(model.name, q=[100, 1], r=[1])
        assert gain.spectral_radius < 1
        client.delete_model(model.name)
    scene = tmp_path / "slider.toml"
    scene.write_text(SCENE)
    assert client.validate_scene(scene) == []
    with pytest.raises(FileNotFoundError):
        client.create_model("no-such-file.urdf")


def test_a_model_in_mjcf_comes_with_what_it_includes(client, tmp_path):
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "rod.xml").write_text(
        """<?xml version="1.0"?><!-- <mujoco/> --><mujocoinclude>
        <inertial pos="0 0 -0.5" mass="2" diaginertia="0.1 0.1 0.01"/></mujocoinclude>"""
    )
    text = """<mujoco model="py-mjcf"><!-- <include file="none.xml"/> --><worldbody>
      <body name="rod"><joint name="hinge" axis="0 1 0"/><include file="parts/rod.xml"/></body>
    </worldbody><actuator><motor name="drive" joint="hinge"/></actuator></mujoco>"""
    file = tmp_path / "rod.xml"
    file.write_text(text)
    model = client.create_model(file)
    force = client.dynamics(model=model.name, q=[0.3], v=[0.0]).gravity
    np.testing.assert_allclose(force, [2 * 9.81 * 0.5 * np.sin(0.3)], rtol=1e-12)
    client.delete_model(model.name)
    file.write_text(text.replace("parts/rod.xml", "rod.xml"))
    with pytest.raises(ValueError, match="included twice"):
        client.create_model(file)
    with pytest.raises(plantd.PlantdError, match="plantctl import"):
        client.create_model(text)


def test_lqr_balances_the_pendulum(client):
    gain = client.solve_lqr("pendulum", at="upright", q=[100, 1], r=[1])
    assert gain.spectral_radius < 1
    plant = client.create_plant("pendulum", q=math.pi - 0.2)
    state = plant.state
    with client.drive(plant.id) as driver:
        for k in range(100):
            state = driver.step(gain(state))
            assert state.step == k + 1
        assert driver.report.iterations > 0
    assert abs(state.q[0] - math.pi) < 1e-9


def test_states_have_the_velocity_of_their_momentum(client):
    plant = client.create_plant("cart-pole", q=[0.1, 0.7], velocity=[0.3, -2.0])
    np.testing.assert_allclose(plant.state.velocity, [0.3, -2.0], atol=1e-14)
    assert plant.state.v.size == 0
    states = client.step(plant.id, np.zeros((20, 1)))
    for state in states:
        mass = [[11.0, math.cos(state.q[1])], [math.cos(state.q[1]), 1.0]]
        np.testing.assert_allclose(state.velocity, np.linalg.solve(mass, state.p), atol=1e-13)
    last = states[-1]
    assert last.velocity.dtype == np.float64 and "velocity=array([" in repr(last)
    # What came out goes in again, under either name.
    for given in [{"velocity": last.velocity}, {"v": last.velocity}]:
        again = client.reset(plant.id, q=last.q, **given)
        np.testing.assert_allclose(again.p, last.p, atol=1e-13)
        np.testing.assert_allclose(again.velocity, last.velocity, atol=1e-13)
    for given in [{"v": [0, 0]}, {"p": [0, 0]}]:
        with pytest.raises(ValueError, match="give one of `velocity`, `v` and `p`"):
            client.reset(plant.id, q=last.q, velocity=last.velocity, **given)

    # Those of prescribed coordinates come last.
    state = client.step(client.create_plant("marionette").id, hold=5)[-1]
    assert state.velocity.shape == state.q.shape
    assert state.velocity[len(state.p) :].tolist() == state.v.tolist()


def test_every_way_to_step_gives_the_same_bits(client):
    inputs = np.sin(0.1 * np.arange(50)).reshape(-1, 1)
    driven = client.create_plant("cart-pole").id
    with client.drive(driven, linearization=True) as driver:
        states = [driver.step(u) for u in inputs]
        last = driver.linearization
    stepped = client.step(client.create_plant("cart-pole").id, inputs)
    assert [s.x.tobytes() for s in states] == [s.x.tobytes() for s in stepped]
    initial = client.create_plant("cart-pole").state
    along = list(client.linearize_trajectory("cart-pole", initial, inputs))
    assert len(along) == 50
    assert along[-1].a.tobytes() == last.a.tobytes()


def test_methods(client):
    method = {"order": 6, "substeps": 2, "halvings": 1, "precision": "fast"}
    method |= {"singular_below": 1e-12, "newton_iterations": 30}
    plant = client.create_plant("cart-pole", **method)
    assert {name: getattr(plant, name) for name in method} == method
    assert not plant.paper
    assert client.create_plant("cart-pole", paper=True).paper
    with client.drive(plant.id) as driver:
        state = driver.step(0.5)
    assert (driver.report.steps, driver.report.halvings) == (2, 0)
    here = client.linearize("cart-pole", state=plant.state, u=[0.5], **method)
    assert here.next.x.tobytes() == state.x.tobytes()
    assert client.create_plant("cart-pole", precision="coarse").precision == "coarse"
    chosen = client.create_plant("cart-pole", tolerance=1e-6)
    assert chosen.accuracy.error <= chosen.accuracy.tolerance == 1e-6
    assert (chosen.order, chosen.substeps) != (2, 1)
    assert plant.accuracy is None
    with pytest.raises(plantd.PlantdError) as refused:
        client.create_plant("four-bar", order=10)
    assert refused.value.violations[0].field == "settings.order"
    with pytest.raises(TypeError, match="odrer"):
        client.create_plant("four-bar", odrer=4)


def test_every_setting_and_every_field_of_a_report_has_a_name_here():
    settings = plant_service_pb2.PlantSettings.DESCRIPTOR.fields_by_name.keys()
    ours = {"dt": "time_step_s", "paper": "force_split", "newton_iterations": "max_iterations"}
    keywords = {ours.get(name, name) for name in plantd.Stepping.__annotations__}
    # `create_plant` takes a tolerance in place of order and substeps.
    assert keywords | {"tolerance"} == set(settings)
    report = common_pb2.StepReport.DESCRIPTOR.fields_by_name.keys()
    assert set(plantd.StepReport.__dataclass_fields__) == set(report)


def test_linearization_at_a_point(client):
    here = client.linearize("cart-pole", at="upright")
    assert here.a.shape == (4, 4) and here.b.shape == (4, 1) and here.c.shape == (0, 4)
    assert here.controllability_rank == 4
    assert 0 < here.report.reciprocal_condition <= 1
    again = client.linearize("cart-pole", state=here.state, u=here.u)
    assert again.a.tobytes() == here.a.tobytes()


def test_gains_along_a_trajectory(client):
    initial = client.create_plant("cart-pole").state
    u = np.zeros((20, 1))
    gains = list(client.solve_trajectory_lqr("cart-pole", initial, u, q=np.eye(4), r=np.eye(1)))
    assert len(gains) == 21 and gains[0].k.shape == (1, 4)
    assert np.array_equal(gains[0](initial), [0.0])


def test_weights_are_on_either_momentum(client):
    # The linkage has one freedom: so many are the independent projected momenta.
    weights = {"q": np.ones(6), "r": [1.0], "full": True}
    u = np.zeros((5, 1))

    def rank(value):
        return np.linalg.matrix_rank(value[3:, 3:] / np.abs(value).max(), tol=1e-8)

    for projected, expected in [(False, 3), (True, 1)]:
        regulator = client.solve_lqr("four-bar", at="rest", projected_momentum=projected, **weights)
        assert rank(regulator.value) == expected
        initial = client.create_plant("four-bar").state
        along = client.solve_trajectory_lqr(
            "four-bar", initial, u, projected_momentum=projected, values=True, **weights
        )
        assert [rank(gain.value) for gain in along] == [expected] * 6


def test_snapshot_restore_and_reset(client):
    plant = client.create_plant("double-pendulum", q=[0.5, -0.5])
    client.step(plant.id, hold=10)
    snapshot = client.snapshot(plant.id)
    ahead = client.step(plant.id, hold=10)[-1]
    assert client.restore(plant.id, snapshot).step == 10
    assert client.step(plant.id, hold=10)[-1].x.tobytes() == ahead.x.tobytes()
    assert client.reset(plant.id).x.tobytes() == plant.state.x.tobytes()
    assert client.reset(plant.id, q=[0.1, 0.2], v=[0, 0]).q.tolist() == [0.1, 0.2]


def test_watch(client):
    plant = client.create_plant("pendulum").id
    stop = threading.Event()

    def drive():
        with client.drive(plant) as driver:
            while not stop.is_set():
                driver.step(0.1)

    driving = threading.Thread(target=drive)
    driving.start()
    try:
        steps = []
        for message in client.watch(plant, ["state", "energy"], every=2):
            assert message.report is None and message.energy.total < 0
            assert message.state.step == message.step
            steps.append(message.step)
            if len(steps) == 5:
                break
    finally:
        stop.set()
        driving.join(30)
    assert all(step % 2 == 0 for step in steps) and sorted(set(steps)) == steps


def test_a_watch_at_a_pace_shows_where_things_are_and_the_poles(client):
    plant = client.create_plant("cart-pole", at="upright").id
    drawing = client.get_drawing(plant).drawing
    assert [frame.name for frame in drawing.frames] == ["cart", "pole"]
    fields = ["state", "poses", "poles"]
    with client.drive(plant) as driver:
        watch = client.watch(plant, fields, at_most_hz=1000)
        next(watch)
        driver.step(3.0)
        message = next(watch)
    assert message.step == 1 and message.generation == 0 and message.dropped == 0
    assert message.poses.frames.shape == (2, 7) and message.poses.points.shape == (2, 3)
    np.testing.assert_allclose(message.poses.frames[0, 0], message.state.q[0], rtol=1e-12)
    np.testing.assert_allclose(message.poses.arrows[0, 3:], [3, 0, 0])
    assert abs(message.poles.open_loop).max() > 1 and message.poles.closed_loop.size == 0
    assert client.get_drawing(model="cart-pole").drawing == drawing


def test_meshes_come_with_their_model(client, tmp_path):
    robot = tmp_path / "rod_description" / "robots" / "rod.urdf"
    meshes = tmp_path / "rod_description" / "meshes"
    for folder in (robot.parent, meshes):
        folder.mkdir(parents=True)
    visuals = "".join(
        f'<visual><geometry><mesh filename="package://{file}"/></geometry></visual>'
        for file in ("rod_description/meshes/rod.obj", "hand/hand.stl", "none/none.stl")
    )
    robot.write_text(ROBOT.replace("</link></robot>", f"{visuals}</link></robot>"))
    (meshes / "rod.obj").write_text("mtllib rod.mtl\nv 0 0 0\n")
    (meshes / "rod.mtl").write_text("newmtl m\nmap_Kd ../rod.png\n")
    (meshes.parent / "rod.png").write_bytes(b"picture")
    (tmp_path / "hand.stl").write_bytes(b"mesh")
    with pytest.warns(UserWarning) as told:
        model = client.create_model(robot, name="py-shown", packages={"hand": tmp_path})
    missing = [str(w.message) for w in told if "was not" in str(w.message)]
    assert missing == ["py-shown:\nmesh `package://none/none.stl` was not found"]
    drawing = client.get_drawing(model=model.name).drawing
    urls = {s.mesh.file: s.mesh.url for f in drawing.frames for s in f.shapes}
    assert urls["package://hand/hand.stl"].startswith("/models/py-shown/files/hand/hand.stl?v=")
    assert urls["package://rod_description/meshes/rod.obj"] and not urls["package://none/none.stl"]
    client.delete_model(model.name)


def test_rollout(client):
    cases = [
        control_service_pb2.RolloutCase(
            initial=common_pb2.InitialState(
                velocity=common_pb2.InitialState.Velocity(q=[0.1 * k], v=[0.0])
            ),
            hold=10,
        )
        for k in range(4)
    ]
    ends = sorted(client.rollout_cases("pendulum", cases), key=lambda end: end.case)
    assert [end.case for end in ends] == [0, 1, 2, 3]
    assert all(not end.failure and end.states[-1].step == 10 for end in ends)


def test_a_case_of_a_rollout_that_is_refused_says_so(client):
    def case(*q):
        velocity = common_pb2.InitialState.Velocity(q=q, v=[0.0])
        return control_service_pb2.RolloutCase(
            initial=common_pb2.InitialState(velocity=velocity), hold=10
        )

    good, refused = sorted(
        client.rollout_cases("pendulum", [case(0.1), case(0.1, 0.2)]), key=lambda end: end.case
    )
    assert good.error is None and good.states[-1].step == 10
    assert refused.error.code == "INVALID_ARGUMENT" and "cases[1].initial" in refused.failure
    with pytest.raises(plantd.PlantdError, match=r"cases\[1\]\.initial"):
        refused.states[-1]


def test_models(client):
    assert "marionette" in [model.name for model in client.list_models()]
    assert client.validate_scene(SCENE) == []
    client.create_model(SCENE)
    try:
        assert client.get_model("py-slider").inputs == ["push"]
    finally:
        client.delete_model("py-slider")


def test_a_bad_scene_names_all_its_errors(client):
    bad = SCENE.replace("2.0", "-2.0").replace('coordinate = "block"', 'coordinate = "brick"')
    with pytest.raises(plantd.PlantdError) as caught:
        client.create_model(bad)
    assert (caught.value.code, caught.value.reason) == ("INVALID_ARGUMENT", "INVALID_SCENE")
    fields = {violation.field for violation in caught.value.violations}
    assert fields >= {"frames[0].body.mass", "inputs[0].coordinate"}
    assert {problem.path for problem in client.validate_scene(bad)} == fields


def test_a_bad_input_leaves_the_driver_going(client):
    plant = client.create_plant("pendulum")
    with client.drive(plant.id) as driver:
        for u, reason in [([], "INPUT_DIMENSION"), ([math.nan], "INPUT_NOT_FINITE")]:
            with pytest.raises(plantd.StepError) as caught:
                driver.step(u)
            assert caught.value.reason == reason
        assert driver.step(0.0).step == 1


def test_a_second_driver_and_a_deleted_plant(client):
    plant = client.create_plant("pendulum").id
    with client.drive(plant) as driver:
        with pytest.raises(plantd.PlantdError) as caught:
            client.drive(plant)
        assert caught.value.reason == "LEASE_HELD"
        client.delete_plant(plant)
        with pytest.raises(plantd.PlantdError) as caught:
            driver.step(0.0)
        assert caught.value.reason == "PLANT_DELETED"
    with pytest.raises(plantd.PlantdError) as caught:
        client.get_plant(plant)
    assert (caught.value.code, caught.value.reason) == ("NOT_FOUND", "PLANT_NOT_FOUND")


def test_the_lease_is_free_after_the_with_statement(client):
    plant = client.create_plant("pendulum").id
    for k in range(20):
        with client.drive(plant) as driver:
            assert driver.step(0.0).step == k + 1


def test_arguments_that_contradict_each_other(client):
    with pytest.raises(ValueError):
        client.create_plant("pendulum", at="upright", q=[0.0])
    with pytest.raises(ValueError):
        client.create_plant("pendulum", v=[0.0])
    with pytest.raises(ValueError):
        client.solve_lqr("pendulum", q=np.zeros((2, 2, 2)), r=[1])
    state = client.create_plant("pendulum").state
    with pytest.raises(ValueError, match="`at`"):
        client.linearize("pendulum", at="upright", state=state, u=[0.0])
    with pytest.raises(ValueError, match="`plant`"):
        client.linearize(plant="somebody", at="upright")
    with pytest.raises(ValueError, match="`u`"):
        client.linearize("pendulum", at="upright", u=[0.0])


def test_a_gain_knows_what_it_is_for(client):
    gain = client.solve_lqr("cart-pole", at="upright", q=np.ones(4), r=[1])
    assert (gain.model, gain.time_step) == ("cart-pole", 0.01)
    for wrong in ([0.1], np.zeros(3), np.zeros(5), np.zeros((4, 4))):
        with pytest.raises(ValueError):
            gain(wrong)
    own = client.create_plant("cart-pole").state
    assert gain(own).tobytes() == gain(own.x).tobytes()

    # Of the same size, and yet another plant; whoever means it says so.
    double = client.create_plant("double-pendulum", id="double").state
    slow = client.create_plant("cart-pole", id="slow", dt=0.02).state
    for state, part in [(double, "double-pendulum"), (slow, "0.02")]:
        with pytest.raises(ValueError, match=part):
            gain(state)
        assert gain(state.x).shape == (1,)
    with client.drive("slow") as driver, pytest.raises(ValueError, match="0.02"):
        gain(driver.step([0.0]))
    for id, field in [("double", "gain.model"), ("slow", "gain.time_step_s")]:
        with pytest.raises(plantd.PlantdError, match=field):
            client.set_feedback(id, gain=gain)
    anybody = dataclasses.replace(gain, model="", time_step=0.0)
    assert client.set_feedback("slow", gain=anybody).revision == 1


def test_a_changed_time_step_is_not_taken_for_another_plants(client):
    plant = client.create_plant("cart-pole", at="upright").id
    with client.drive(plant) as driver:
        client.set_parameters(plant, {}, dt=0.02)
        gain = client.solve_lqr("cart-pole", at="upright", q=np.ones(4), r=[1], dt=0.02)
        assert gain(driver.step([0.0])).shape == (1,)


def test_modes_and_responses(client):
    pendulum = client.analyze("pendulum", at="hanging", frequencies=[0.0, 0.2])
    assert (pendulum.order, pendulum.controllability_rank, pendulum.observability_rank) == (2, 2, 2)
    # The midpoint rule swings a little slower than sqrt(g / l).
    expected = 2 / 0.1 * math.atan(math.sqrt(9.8) * 0.1 / 2) / (2 * math.pi)
    assert [mode.frequency for mode in pendulum.modes] == pytest.approx([expected] * 2)
    a = client.linearize("pendulum", at="hanging")
    z = np.exp(2j * np.pi * 0.2 * 0.1)
    response = np.linalg.solve(z * np.eye(2) - a.a, a.b)
    assert pendulum.response.shape == (2, 2, 1) and pendulum.outputs == ["theta", "p(theta)"]
    assert np.allclose(pendulum.response[1], response, rtol=1e-12, atol=0)
    seen = client.analyze("pendulum", at="hanging", outputs=["p(theta)"], frequencies=0.2)
    assert np.allclose(seen.response[0], response[1:], rtol=1e-12, atol=0)
    weighted = client.analyze("pendulum", at="hanging", outputs=[[2.0, 1.0]], frequencies=0.2)
    assert np.allclose(weighted.response[0], [[2.0, 1.0]] @ response, rtol=1e-12, atol=0)
    with pytest.raises(plantd.PlantdError) as caught:
        client.analyze("pendulum", outputs=["phi"])
    assert caught.value.violations[0].field == "outputs[0]"


def test_a_plant_is_analysed_where_it_is(client):
    plant = client.create_plant("cart-pole").id
    state = client.step(plant, [[2.0]] * 5)[-1]
    assert client.analyze(plant=plant).state.x.tobytes() == state.x.tobytes()
    here = client.linearize(plant=plant)
    assert here.u.tolist() == [2.0] and here.step == 5


def test_second_derivatives(client):
    plant = client.create_plant("four-bar").id
    client.step(plant, [[0.4]] * 5)
    tensors = client.linearize_second_order(plant=plant)
    assert tensors.xx.shape == (6, 6, 6) and tensors.xu.shape == (6, 6, 1)
    assert tensors.uu.shape == (6, 1, 1) and tensors.multipliers_xx.shape == (2, 6, 6)
    assert tensors.linearization.a.tobytes() == client.linearize(plant=plant).a.tobytes()
    weights, impulses = np.arange(1.0, 7.0), np.array([0.5, -2.0])
    sum = client.contract_second_order(plant=plant, weights=weights, multiplier_weights=impulses)
    expected = np.tensordot(weights, tensors.xx, 1) + np.tensordot(impulses, tensors.multipliers_xx, 1)
    assert np.allclose(sum.xx, expected, rtol=0, atol=1e-10 * np.abs(expected).max())
    # The marionette's tensors are too large to send; their contraction is not.
    with pytest.raises(plantd.PlantdError) as caught:
        client.linearize_second_order("marionette")
    assert caught.value.reason == "LIMIT_EXCEEDED"
    assert client.contract_second_order("marionette", np.ones(80)).xu.shape == (80, 18)


def test_continuous_dynamics(client):
    motion = client.evaluate_dynamics("pendulum", 0.4, 3.0, 0.7, order=2)
    assert motion.acceleration == pytest.approx([0.7 - 9.8 * math.sin(0.4)], rel=1e-13)
    assert motion.jacobian == pytest.approx(np.array([[-9.8 * math.cos(0.4), 0, 1]]), abs=1e-12)
    assert motion.hessian[0, 0, 0] == pytest.approx(9.8 * math.sin(0.4), rel=1e-12)
    assert client.evaluate_dynamics("pendulum").jacobian is None


def test_kinematics(client):
    q, v = np.array([0.4, -1.1]), np.array([0.9, -1.7])
    point = ("forearm", [0.0, 0.0, -1.0])
    found = client.kinematics("double-pendulum", q=q, v=v, points=[point], jacobians=True)
    assert found.coordinates == ["shoulder", "elbow"] and found.frames == {}
    tip = found.points[0]
    angles = q.cumsum()
    assert tip.position == pytest.approx([-np.sin(angles).sum(), 0, -np.cos(angles).sum()])
    assert tip.jacobian.shape == (3, 2) and tip.jacobian @ v == pytest.approx(tip.velocity)
    for i, unit in enumerate(1e-5 * np.eye(2)):
        moved = [client.kinematics("double-pendulum", q=q + d, points=[point]) for d in (unit, -unit)]
        ahead, behind = (kinematics.points[0].position for kinematics in moved)
        assert (ahead - behind) / 2e-5 == pytest.approx(tip.jacobian[:, i], abs=1e-9)
    assert found.center_of_mass.mass == 2.0
    assert found.center_of_mass.jacobian @ v == pytest.approx(found.center_of_mass.velocity)

    plant = client.create_plant("double-pendulum", q=q, v=v).id
    state = client.step(plant, [[0.1, 0.2]] * 3)[-1]
    here = client.kinematics(plant=plant, jacobians=True)
    assert list(here.frames) == ["upper_arm", "forearm"] and here.q.tolist() == state.q.tolist()
    forearm = here.frames["forearm"]
    motion = np.concatenate((forearm.linear_velocity, forearm.angular_velocity))
    assert forearm.jacobian @ here.v == pytest.approx(motion)
    assert np.linalg.norm(forearm.orientation) == pytest.approx(1)
    assert client.get_plant(plant).state.step == state.step
    with pytest.raises(plantd.PlantdError) as caught:
        client.kinematics("double-pendulum", frames=["tail"])
    assert caught.value.violations[0].field == "frames[0]"


def test_dynamics(client):
    plant = client.create_plant("four-bar").id
    client.step(plant, [[0.4]] * 8)
    found = client.dynamics(plant=plant, forward=True)
    forward, dh = found.forward, found.constraint_jacobian
    assert found.inputs.tolist() == [0.4] and dh.shape == (2, 3) and len(found.constraints) == 2
    left = found.mass_matrix @ forward.acceleration + found.bias
    right = found.passive + found.input - dh.T @ forward.multipliers
    assert left == pytest.approx(right, abs=1e-10)
    energy = client.get_plant(plant).energy
    assert found.energy.total == pytest.approx(energy.total)
    assert found.v @ found.mass_matrix @ found.v / 2 == pytest.approx(energy.kinetic)
    known = client.evaluate_dynamics("four-bar", found.q, found.v, found.inputs)
    assert forward.acceleration == pytest.approx(known.acceleration)
    assert forward.multipliers == pytest.approx(known.multipliers)

    # Along the constraints' null space: tau is M times the change, lambda stays.
    change = np.linalg.svd(dh)[2][-1]
    inverse = client.dynamics(plant=plant, acceleration=forward.acceleration + change).inverse
    assert inverse.force == pytest.approx(found.mass_matrix @ change)
    assert inverse.multipliers == pytest.approx(forward.multipliers)
    assert inverse.constraint_acceleration == pytest.approx(np.zeros(2), abs=1e-9)
    assert found.inverse is None
    with pytest.raises(plantd.PlantdError) as caught:
        client.dynamics("pendulum", q=[0.1, 0.2])
    assert caught.value.violations[0].field == "state.q"


def test_settle_and_diagnose(client):
    rest = client.settle("pendulum", guess={"theta": 0.9}, inputs={"tau": 4.9})
    assert rest.q == pytest.approx([math.pi / 6]) and rest.u.tolist() == [4.9] and rest.stable
    there = client.kinematics("double-pendulum", q=[0.5, 0.9]).frames["forearm"]
    found = client.settle(
        "double-pendulum", q=[0.4, 0.8], targets={"forearm": there.position}, constraints_only=True
    )
    again = client.kinematics("double-pendulum", q=found.q).frames["forearm"]
    np.testing.assert_allclose(again.position, there.position, atol=1e-9)
    on = client.settle("four-bar", guess={"crank": -0.8}, hold=["crank"], constraints_only=True)
    assert on.q[0] == -0.8 and on.stable is None
    plant = client.create_plant("four-bar", q=on.q).id
    diagnosed = client.diagnose(plant)
    assert (diagnosed.degrees_of_freedom, diagnosed.constraint_rank) == (1, 2)
    assert diagnosed.mass == pytest.approx(2.7) and diagnosed.redundant_constraints == []
    assert diagnosed.energy.total == pytest.approx(client.get_plant(plant).energy.total)
    initial = common_pb2.InitialState(operating_point="hanging")
    hanging = client.diagnose(model="pendulum", initial=initial)
    assert hanging.center_of_mass == pytest.approx([0, -1, 0], abs=1e-15)


STICK = """
format = 1
name = "py-stick"
gravity = [0.0, 0.0, -9.8]
time_step_s = 0.02

[[frames]]
name = "stick"
joint = { type = "ball" }
body = { mass = 1.0, center_of_mass = [0.0, 0.0, -0.5], inertia = [0.1, 0.1, 0.02] }

[[inputs]]
name = "x"
coordinate = "stick_rx"

[[inputs]]
name = "y"
coordinate = "stick_ry"

[[inputs]]
name = "z"
coordinate = "stick_rz"

[[signals]]
drives = "z"
type = "constant"
value = 0.0

[[operating_points]]
name = "turned"
coordinates = { stick_rz = 3.0 }
"""


def test_a_gain_turns_a_ball_joint_the_short_way(client):
    model = client.create_model(STICK)
    try:
        assert [c.rotation_group for c in model.coordinates] == ["stick"] * 3
        assert [(s.drives, s.u_index, s.kind, s.replaces) for s in model.signals] == [
            ("z", 2, "constant", False)
        ]
        gain = client.solve_lqr("py-stick", at="turned", q=[100] * 3 + [1] * 3, r=[1] * 3)
        plant = client.create_plant("py-stick", q=[0.0, 0.3, -3.0])
        reference, rotations = gain.x_reference[:3], plantd.rotations(model)
        state = plant.state
        # The vectors are six radians apart, the orientations less than half a radian.
        assert np.linalg.norm(state.q - reference) > 5.9
        with client.drive(plant.id) as driver:
            for _ in range(200):
                error = plantd.difference(reference, state.q, rotations)
                assert np.linalg.norm(error) < 0.7
                state = driver.step(gain(state))
        assert np.linalg.norm(plantd.difference(reference, state.q, rotations)) < 1e-4
    finally:
        client.delete_model("py-stick")
