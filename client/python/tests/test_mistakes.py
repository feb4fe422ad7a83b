"""Mistakes that people make: each is answered with the name of the culprit and what is allowed or near, and never
with words of the libraries underneath."""

import os
import re
import subprocess
from pathlib import Path

import numpy as np
import plantd
import pytest

#: Words of libraries underneath, which mean nothing to the caller.
STRANGE = [
    "protobuf", "Protocol message", "bad argument type", "has no attribute", "numpy", "inhomogeneous",
    "could not convert", "setting an array element", "serde", "KeyError", "expected one of", "NoneType",
    "unknown variant", "unknown field", "missing field", "invalid type", "descriptor", "_pb2", "Deserialize",
    "Value out of range", "enum", "iterable", "subscriptable", "matmul", "broadcast", "IndexError", "gRPC call",
    "f64", "u32", "u64",
]

SCENE = """
format = 1
name = "slider"
gravity = [0.0, 0.0, 0.0]

[[frames]]
name = "block"
joint = { type = "prismatic", axis = [1.0, 0.0, 0.0] }
body = { mass = 2.0 }

[[inputs]]
name = "push"
coordinate = "block"
"""

PLANT, X, U = "culprit", np.zeros(4), np.zeros((5, 1))


def cost(rows):
    return dict(x=np.zeros((rows + 1, 4)), q=[1, 1, 1, 1], r=[1])


def still(client):
    return plantd.Trajectory(client.get_plant(PLANT).state, U)


#: A wrong call of a client at which the cart-pole `culprit` is, and what is said.
CALLS = [
    # Models and plants that there are not.
    (lambda c: c.create_plant("pendulm"), "there is no model `pendulm`; did you mean `pendulum`?"),
    (lambda c: c.create_plant("Pendulum"), "there is no model `Pendulum`; did you mean `pendulum`?"),
    (lambda c: c.create_plant("cart_pole"), "did you mean `cart-pole`?"),
    (lambda c: c.create_plant(""), "there is no model ``"),
    (lambda c: c.create_plant("chain-0"), "there is no model `chain-0`"),
    (lambda c: c.get_model("fourbar"), "did you mean `four-bar`?"),
    (lambda c: c.delete_model("pendulum"), "model `pendulum` came with the server"),
    (lambda c: c.delete_model("pendulms"), "did you mean `pendulum`?"),
    (lambda c: c.get_plant("culprt"), "there is no plant `culprt`; did you mean `culprit`?"),
    (lambda c: c.delete_plant("nobody"), "there is no plant `nobody`"),
    (lambda c: c.step("nobody", hold=1), "there is no plant `nobody`"),
    (lambda c: c.linearize(plant="culprits"), "did you mean `culprit`?"),
    (lambda c: c.linearize("cartpole"), "did you mean `cart-pole`?"),
    (lambda c: c.solve_lqr("pendulun", q=[1, 1], r=[1]), "did you mean `pendulum`?"),
    # Ids and names.
    (lambda c: c.create_plant("pendulum", id="My Plant"), r"id: .*lower-case"),
    (lambda c: c.create_plant("pendulum", id=PLANT), "there already is a plant `culprit`"),
    (lambda c: c.create_plant("pendulum", id=7), "`id` is 7; a text is needed"),
    (lambda c: c.create_plant(None, id=3), "`id` is 3; a text is needed"),
    (lambda c: c.create_plant(5), "`model` is 5; a text is needed"),
    (lambda c: c.get_plant(3), "`id` is 3; a text is needed"),
    (lambda c: c.get_model(["pendulum"]), r"`name` is \['pendulum'\]; a text is needed"),
    (lambda c: c.create_plant("pendulum", open_link="yes"), "`open_link` is 'yes'; True or False"),
    # Keywords.
    (lambda c: c.create_plant("pendulum", dtt=0.1), "there is no argument `dtt`; did you mean `dt`?"),
    (lambda c: c.create_plant("pendulum", time_step=0.1), "there is no argument `time_step`"),
    (lambda c: c.create_plant("pendulum", prescision="fast"), "did you mean `precision`?"),
    (lambda c: c.create_plant("pendulum", velocty=[1]), "did you mean `velocity`?"),
    (lambda c: c.linearize("pendulum", stat=None), "there is no argument `stat`; did you mean `state`?"),
    (lambda c: c.solve_lqr("pendulum", q=[1, 1], r=[1], orders=4), "did you mean `order`?"),
    # Operating points, coordinates, frames, entries.
    (lambda c: c.create_plant("cart-pole", at="uprigth"), "there is no operating point `uprigth`; did you mean `upright`?"),
    (lambda c: c.linearize("cart-pole", at="top"), "there is no operating point `top`; there are"),
    (lambda c: c.reset(PLANT, at="hangin"), "did you mean `hanging`?"),
    (lambda c: c.linearize("cart-pole", at=3), "`operating_point` is 3; a text is needed"),
    (lambda c: c.kinematics("cart-pole", frames=["pol"]), "there is no frame `pol`; did you mean `pole`?"),
    (lambda c: c.kinematics("cart-pole", points=[("cat", [0, 0, 0])]), "there is no frame `cat`; did you mean `cart`?"),
    (lambda c: c.kinematics("cart-pole", points=["cart"]), r"`points\[0\]` is 'cart'; a pair"),
    (lambda c: c.kinematics("cart-pole", points=[("cart", [0, 0])]), r"points\[0\].at"),
    (lambda c: c.kinematics("cart-pole", frames="pole"), "`frames` is 'pole'; a list is needed"),
    (lambda c: c.analyze("cart-pole", outputs=["thta"]), "there is no state entry `thta`; did you mean `theta`?"),
    (lambda c: c.analyze("cart-pole", outputs="theta"), "`outputs` is 'theta'; a list"),
    (lambda c: c.analyze("cart-pole", outputs=np.ones((2, 3))), "output_x"),
    (lambda c: c.analyze("cart-pole", frequencies=["1 Hz"]), "`frequencies` is .*numbers are needed"),
    (lambda c: list(c.watch(PLANT, coordinates=["y"])), "there is no coordinate `y`; there are `x`, `theta`"),
    (lambda c: list(c.watch(PLANT, ["stat"])), "`fields` is 'stat'; did you mean `state`?"),
    (lambda c: list(c.watch(PLANT, "state")), r"`fields` is 'state'; a list is needed"),
    (lambda c: list(c.watch(PLANT, [])), "fields"),
    (lambda c: list(c.watch(PLANT, every=-1)), "`every` is -1; a whole number from 0"),
    (lambda c: list(c.watch(PLANT, every=1.5)), "`every` is 1.5; a whole number"),
    # Initial states.
    (lambda c: c.create_plant("cart-pole", q=[0.0]), "q has 1 entries; 2 are needed"),
    (lambda c: c.create_plant("cart-pole", q=[[0.0, 1.0]]), r"`q` has the shape \(1, 2\); a vector is needed"),
    (lambda c: c.create_plant("cart-pole", q="0 1"), "`q` is '0 1'; numbers are needed"),
    (lambda c: c.create_plant("cart-pole", q=["x", 1]), r"`q` is \['x', 1\]; numbers are needed"),
    (lambda c: c.create_plant("cart-pole", q={"x": 1}), r"`q` is \{'x': 1\}; numbers are needed"),
    (lambda c: c.create_plant("cart-pole", q=[[0], [1, 2]]), "`q` is .*numbers are needed"),
    (lambda c: c.create_plant("cart-pole", q=[0, np.nan]), r"q\[1\] is NaN"),
    (lambda c: c.create_plant("cart-pole", q=[0, 1], velocity=[1]), "v has 1 entries; 2 are needed"),
    (lambda c: c.create_plant("cart-pole", velocity=[1, 1]), "`velocity`, `v` and `p` need `q`"),
    (lambda c: c.create_plant("cart-pole", q=[0, 1], at="upright"), "give one of `at`, `q` and `initial`"),
    (lambda c: c.create_plant("cart-pole", q=[0, 1], v=[0, 0], p=[0, 0]), "give one of `velocity`, `v` and `p`"),
    (lambda c: c.create_plant("four-bar", q=[1.0, 1.0, 1.0]), "constraint `.*` is violated by"),
    # How it is stepped.
    (lambda c: c.create_plant("pendulum", dt=-0.1), "time_step_s: must be finite and greater than zero"),
    (lambda c: c.create_plant("pendulum", dt="0.1"), "`dt` is '0.1'; a number is needed"),
    (lambda c: c.create_plant("pendulum", order=3), "order"),
    (lambda c: c.create_plant("pendulum", order=2.5), "`order` is 2.5; a whole number"),
    (lambda c: c.create_plant("four-bar", order=10), "order"),
    (lambda c: c.create_plant("pendulum", substeps=257), "substeps"),
    (lambda c: c.create_plant("pendulum", substeps=-1), "`substeps` is -1; a whole number from 0"),
    (lambda c: c.create_plant("pendulum", halvings=9), "halvings"),
    (lambda c: c.create_plant("pendulum", precision="quick"), "`precision` is 'quick'; allowed are `exact`, `fast`, `coarse`"),
    (lambda c: c.create_plant("pendulum", singular_below=2.0), "singular_below"),
    (lambda c: c.create_plant("pendulum", tolerance=1e-6, order=4), "order: is chosen by `tolerance`"),
    (lambda c: c.create_plant("pendulum", tolerance="small"), "`tolerance` is 'small'; a number"),
    (lambda c: c.create_plant("pendulum", expires=0.1), "expires_s: is 0.1; it must be 0 or lie between 1 and"),
    (lambda c: c.create_plant("pendulum", expires="1 h"), "`expires` is '1 h'; a number"),
    # Steps and inputs.
    (lambda c: c.step(PLANT, count=0), "`count` is 0; a whole number from 1"),
    (lambda c: c.step(PLANT, [[1.0], [2.0]], count=1), "`count` is 1; `u` has 2 rows"),
    (lambda c: c.step(PLANT, count=2, hold=1), "give one of `count` and `hold`"),
    (lambda c: c.step(PLANT, [[1.0, 2.0]]), "has 2 columns; 1 are needed"),
    (lambda c: c.step(PLANT, [1.0]), r"`u` has the shape \(1,\); a matrix is needed, with one row per step"),
    (lambda c: c.step(PLANT, [["a"]]), r"`u` is \[\['a'\]\]; numbers are needed"),
    (lambda c: c.step(PLANT, [[np.inf]]), r"u.data\[0\]|input 0"),
    (lambda c: c.step(PLANT, hold=-1), "`hold` is -1; a whole number from 0"),
    (lambda c: c.step(PLANT, hold=10**9), "limit `steps_per_call`"),
    (lambda c: drive(c, [1.0, 2.0]), "2 entries; 1"),
    (lambda c: drive(c, "left"), "`u` is 'left'; numbers are needed"),
    (lambda c: drive(c, [[1.0]]), r"`u` has the shape \(1, 1\); a vector is needed"),
    (lambda c: drive(c, None), "`u` is None; numbers are needed"),
    (lambda c: drive(c, [1.0], graze=2), "graze"),
    (lambda c: drive(c, [1.0], grace="long"), "`grace` is 'long'; a number"),
    (lambda c: drive(c, [1.0], resume="none"), "lease"),
    (lambda c: c.step_many([]), "`plants` is empty"),
    (lambda c: c.step_many(PLANT), "`plants` is 'culprit'; a list of plants is needed"),
    (lambda c: c.step_many([PLANT, PLANT]), r"ids\[1\]: is `culprit`, as ids\[0\] is"),
    (lambda c: c.step_many([PLANT, 5]), r"`plants\[1\]` is 5; a plant or its id is needed"),
    (lambda c: c.step_many([PLANT], np.ones((2, 1))), "`u` has 2 rows; there are 1 plants"),
    (lambda c: c.step_many([PLANT], [[1.0, 2.0]]), "u: has 2 entries; the 1 plants take 1 together"),
    (lambda c: c.step_many([PLANT], steps=-1), "`steps` is -1"),
    (lambda c: c.step_many([PLANT], np.ones((1, 1, 1))), "one row for each plant"),
    # Running.
    (lambda c: c.run(PLANT, "pacd"), "`pace` is 'pacd'; did you mean `paced`?"),
    (lambda c: c.run(PLANT, "fast"), "`pace` is 'fast'; allowed are `lockstep`, `paced`, `free`"),
    (lambda c: c.run(PLANT, "paced", action="halt"), "`action` is 'halt'; allowed are `hold`, `safe`, `ramp`, `stop`"),
    (lambda c: c.run(PLANT, "paced", speed=-1), "speed: is -1"),
    (lambda c: c.run(PLANT, "free", speed=2), "speed: is for plants that follow a clock"),
    (lambda c: c.run(PLANT, "paced", steps=-3), "`steps` is -3"),
    (lambda c: c.run(PLANT, "paced", timeout=-1), "timeout_s: is -1"),
    (lambda c: c.run(PLANT, "paced", timeout=1, action="safe", safe=[1, 2]), "safe"),
    (lambda c: c.set_safety(PLANT, [dict(quantity="y", max=1.0)]), "`y` is no coordinate"),
    (lambda c: c.set_safety(PLANT, [dict(quantity="x")]), "min: and `max` are both missing"),
    (lambda c: c.set_safety(PLANT, [dict(quantity="x", maximum=1)]), "there is no `maximum`; did you mean `max`?"),
    (lambda c: c.set_safety(PLANT, [dict(quantity="x", max="1")]), "`max` is '1'; a number"),
    (lambda c: c.set_safety(PLANT, [dict(quantity="x", max=1, action="rest")]), r"action.* is 'rest'; did you mean `reset`?"),
    (lambda c: c.set_safety(PLANT, ["x<1"]), r"`watchdogs\[0\]` is 'x<1'; a dict is needed"),
    (lambda c: c.set_safety(PLANT, on_step_failure="ignore"), "`on_step_failure` is 'ignore'; allowed are"),
    # Channels and faults.
    (lambda c: c.set_channels(PLANT, [dict(name="a", coordinate="tetha")]), "there is no coordinate `tetha`; did you mean `theta`?"),
    (lambda c: c.set_channels(PLANT, [dict(name="a", coordinte="theta")]), r"there is no `coordinte` of `outputs\[0\]`; did you mean `coordinate`?"),
    (lambda c: c.set_channels(PLANT, [dict(name="a", coordinate="theta", noise="big")]), r"`outputs\[0\].noise` is 'big'; a number"),
    (lambda c: c.set_channels(PLANT, [dict(name="a", coordinate="theta", noise=-1)]), "noise"),
    (lambda c: c.set_channels(PLANT, [dict(name="a")]), "outputs\\[0\\]"),
    (lambda c: c.set_channels(PLANT, ["theta"]), r"`outputs\[0\]` is 'theta'; a dict is needed"),
    (lambda c: c.set_channels(PLANT, inputs=[dict(input="forse", delay_s=0.1)]), "there is no input or prescribed coordinate `forse`; did you mean `force`?"),
    (lambda c: c.set_channels(PLANT, seed=-1), "`seed` is -1"),
    (lambda c: c.inject_fault(PLANT, input="forc", stuck=True), "did you mean `force`?"),
    (lambda c: c.inject_fault(PLANT, inputt="force"), "there is no `inputt`; did you mean `input`?"),
    (lambda c: c.inject_fault(PLANT, output="angle", stuck=True), "there is no output channel `angle`; there is none"),
    (lambda c: c.inject_fault(PLANT, input="force", stuck=True, duration_s="2"), "`duration_s` is '2'; a number"),
    (lambda c: c.inject_fault(PLANT, push=dict(point=dict(frame="poles"), force=[1, 0, 0])), "did you mean `pole`?"),
    (lambda c: c.inject_fault(PLANT, push=dict(pont=dict(frame="pole"))), "there is no `pont` of `push`; did you mean `point`?"),
    (lambda c: c.clear_fault(PLANT, 77), "there is no fault `77`"),
    # Parameters.
    (lambda c: c.set_parameters(PLANT, {"frames[pole].body.mas": 2.0}), "mas"),
    (lambda c: c.set_parameters(PLANT, {"frames[poll].body.mass": 2.0}), "did you mean `pole`?"),
    (lambda c: c.set_parameters(PLANT, {"frame[pole].body.mass": 2.0}), "did you mean `frames`?"),
    (lambda c: c.set_parameters(PLANT, {"frames[9].body.mass": 2.0}), "it has 2 entries, from 0 on"),
    (lambda c: c.set_parameters(PLANT, {"frames[pole].body.mass": -2.0}), "mass"),
    (lambda c: c.set_parameters(PLANT, {"frames[pole].body.mass": "2"}), "`value` is '2'; a number"),
    (lambda c: c.set_parameters(PLANT, {"name": 2.0}), "`name` is not a number"),
    (lambda c: c.set_parameters(PLANT, ["gravity[1]"]), r"`parameters` is \['gravity\[1\]'\]; a dict is needed"),
    # Regulators and feedback.
    (lambda c: c.solve_lqr("cart-pole", at="upright", q=[1, 1], r=[1]), "weights.q"),
    (lambda c: c.solve_lqr("cart-pole", at="upright", q=[1, 1, 1, 1], r=[0]), "weights.r"),
    (lambda c: c.solve_lqr("cart-pole", at="upright", q=[1, 1, 1, -1], r=[1]), "weights"),
    (lambda c: c.solve_lqr("cart-pole", at="upright", q="1 1 1 1", r=[1]), "`q` is '1 1 1 1'; numbers"),
    (lambda c: c.solve_lqr("cart-pole", at="upright", q=np.ones((4, 4, 1)), r=[1]), "`q` has the shape"),
    (lambda c: c.solve_lqr("cart-pole", q=[1, 1, 1, 1], r=[1]), "moves|equilibrium"),
    (lambda c: c.solve_lqr("cart-pole", state=[0, 0, 0, 0], q=[1] * 4, r=[1]), r"`state` is \[0, 0, 0, 0\]; a `plantd.State` is needed"),
    (lambda c: c.solve_lqr("cart-pole", at="upright", u=[1], q=[1] * 4, r=[1]), "`u` needs `state`"),
    (lambda c: c.set_feedback(PLANT, at="upright", q=[1] * 4, r=[1], mode="replce"), "`mode` is 'replce'; did you mean `replace`?"),
    (lambda c: c.set_feedback(PLANT), "give one of `at`, `state`, `plant`, `trajectory` and `gain`"),
    (lambda c: c.set_feedback(PLANT, at="upright"), "weights"),
    (lambda c: c.set_feedback(PLANT, gain=[[1, 1, 1, 1]]), r"`gain` is .*a `plantd.Gain` is needed"),
    (lambda c: c.set_feedback(PLANT, trajectory=U), "`trajectory` is .*a `plantd.Trajectory` is needed"),
    (lambda c: c.set_feedback(PLANT, at="upright", q=[1] * 4, r=[1], mode="guard", guard={"thet": 1}), "there is no entry `thet`; did you mean `theta`?"),
    (lambda c: c.set_feedback(PLANT, at="upright", q=[1] * 4, r=[1], guard=[1, 2]), r"bounds are \[1, 2\]; a dict is needed"),
    (lambda c: next(c.watch_gains(PLANT)), "plant `culprit` has no feedback"),
    (lambda c: c.solve_lqr("cart-pole", at="upright", q=[1] * 4, r=[1])([0, 0, 0]), "a state has 4 entries here, not 3"),
    (lambda c: c.solve_lqr("cart-pole", at="upright", q=[1] * 4, r=[1])("x"), "`state` is 'x'; numbers"),
    (lambda c: c.solve_kalman("cart-pole", at="upright", outputs=["tetha"], measurement_noise=[1]), "did you mean `theta`?"),
    (lambda c: c.solve_kalman("cart-pole", at="upright", outputs=["theta"], measurement_noise=[1, 2]), "measurement"),
    # Trajectories.
    (lambda c: list(c.linearize_trajectory("cart-pole", still(c), U)), "a trajectory already has inputs"),
    (lambda c: list(c.linearize_trajectory("cart-pole", c.get_plant(PLANT).state)), "`u`, the inputs of the trajectory, is needed"),
    (lambda c: list(c.linearize_trajectory("cart-pole", X, U)), "the initial state is .*a `plantd.State`"),
    (lambda c: c.optimize_trajectory("cart-pole", **cost(5)), "give one of `guess` and `resume`"),
    (lambda c: c.optimize_trajectory("cart-pole", U, **cost(5)), "`guess` is .*a `plantd.Trajectory`"),
    (lambda c: c.optimize_trajectory("cart-pole", still(c), **cost(4)).result, "cost.x"),
    (lambda c: c.optimize_trajectory("cart-pole", still(c), method="newtn", **cost(5)), "`method` is 'newtn'; did you mean `newton`?"),
    (lambda c: c.optimize_trajectory("cart-pole", still(c), input_bounds={"forc": (-1, 1)}, **cost(5)).result, "there is no entry `forc`; "),
    (lambda c: c.optimize_trajectory("cart-pole", still(c), input_bounds={"force": (1, -1)}, **cost(5)).result, "min 1 above max -1"),
    (lambda c: c.optimize_trajectory("cart-pole", still(c), input_bounds={"force": (1, 2, 3)}, **cost(5)), "the bounds of `force` are"),
    (lambda c: c.optimize_trajectory("cart-pole", still(c), max_iterations=-1, **cost(5)), "`max_iterations` is -1"),
    (lambda c: c.optimize_trajectory("cart-pole", still(c), free_initial=["thet"], **cost(5)).result, "did you mean `theta`?"),
    (lambda c: c.optimize_trajectory("cart-pole", still(c), stages=[dict(q=[1])], **cost(5)), "weights of step 0"),
    (lambda c: c.rollout("cart-pole", [1.0]), r"`u` has the shape \(1,\); \[case\]\[step\]\[entry\]"),
    (lambda c: c.rollout("cart-pole"), "0 steps are asked for"),
    (lambda c: c.rollout("cart-pole", U, every=0), "`every` is 0; at least 1"),
    (lambda c: c.rollout("cart-pole", U, q=np.zeros((2, 3))), "q has 3 entries; 2 are needed"),
    (lambda c: c.settle("four-bar", hold=["crnk"]), "there is no coordinate `crnk`; did you mean `crank`?"),
    (lambda c: c.settle("four-bar", guess={"crnk": 1.0}), "crnk"),
    (lambda c: c.settle("four-bar", guess=[1.0]), r"`guess` is \[1.0\]; a dict is needed"),
    (lambda c: c.settle("four-bar", targets={"crnk": [0, 0, 0]}), "crnk"),
    # Scenes and files.
    (lambda c: c.create_model("no-such-file.toml"), "no-such-file.toml"),
    (lambda c: c.create_model(42), "`scene` is 42; a text or a path is needed"),
    (lambda c: c.create_model(SCENE, name="A B"), "name"),
    (lambda c: c.restore(PLANT, b"nonsense"), "snapshot"),
    (lambda c: c.restore(PLANT, "text"), "snapshot"),
    (lambda c: c.start_recording(PLANT, "a/b"), "name"),
    (lambda c: c.stop_recording("nothing"), "there is no recording `nothing`"),
]


def drive(client, u, **how):
    with client.drive(PLANT, **how) as driver:
        return driver.step(u)


#: What is changed in the scene, and what is said of it.
SCENES = [
    ("mass = 2.0", "mas = 2.0", "there is no key `mas`; did you mean `mass`?"),
    ("mass = 2.0", 'mass = "2"', 'string "2" is given; a number is needed'),
    ("mass = 2.0", "mass = -2.0", "mass"),
    ("format = 1\n", "", "`format` is missing"),
    ("format = 1", "format = 9", "format"),
    ("gravity = [0.0, 0.0, 0.0]\n", "", "gravity"),
    ("gravity = [0.0, 0.0, 0.0]", "gravity = [0.0, 0.0]", "a list of 3 is needed"),
    ('type = "prismatic"', 'type = "prismatik"', "did you mean `prismatic`?"),
    ('type = "prismatic", ', "", "`type` is missing"),
    ("[[frames]]", "[[frame]]", "there is no key `frame`; did you mean `frames`?"),
    ('coordinate = "block"', 'coordinate = "blok"', "there is no coordinate `blok`; did you mean `block`?"),
    ('name = "block"', 'name = "block"\nparent = "wrld"', "there is no frame `wrld`"),
    ('name = "slider"', 'name = "My Slider"', "lower-case"),
    ('name = "slider"', 'name = slider', "line 3"),
    ("axis = [1.0, 0.0, 0.0]", "axis = [0.0, 0.0, 0.0]", "axis"),
]


@pytest.fixture(scope="module")
def own(addresses):
    with plantd.connect(addresses["grpc"]) as client:
        client.create_plant("cart-pole", id=PLANT, q=[0.0, 0.5])
        yield client
        client.delete_plant(PLANT)


def check(call, said):
    with pytest.raises((plantd.PlantdError, ValueError, TypeError, OSError)) as caught:
        call()
    message = str(caught.value)
    assert [word for word in STRANGE if word in message] == [], message
    caught.match(said)


@pytest.mark.parametrize("index", range(len(CALLS)), ids=lambda index: f"{index}-{CALLS[index][1][:30]}")
def test_a_wrong_call_says_what_is_wrong(own, index):
    call, said = CALLS[index]
    before = own.get_plant(PLANT).state
    check(lambda: call(own), said)
    after = own.get_plant(PLANT).state
    assert (after.step, list(after.x)) == (before.step, list(before.x))


@pytest.mark.parametrize("good, wrong, said", SCENES)
def test_a_wrong_scene_says_what_is_wrong(own, good, wrong, said):
    assert good in SCENE
    check(lambda: own.create_model(SCENE.replace(good, wrong, 1)), said)


SCENARIO = """
duration_s = 1.0
[plant]
model = "pendulum"
time_step_s = 0.02
[[expect]]
settles = { signal = "theta", to = 0, within = 0.1, by_s = 0.5 }
"""

#: What is changed in the scenario, and what is said of it.
SCENARIOS = [
    ("duration_s = 1.0", "duration = 1.0", "there is no key `duration`; did you mean `duration_s`?"),
    ("duration_s = 1.0", "", "`duration_s` is missing"),
    ("duration_s = 1.0", 'duration_s = "1"', 'duration_s: string "1" is given; a number is needed'),
    ("duration_s = 1.0", "duration_s = -1.0", "duration_s is -1; it must be greater than zero"),
    ("duration_s = 1.0", 'duration_s = 1.0\npace = "pacd"', "pace: there is no `pacd`; did you mean `paced`?"),
    ('model = "pendulum"', "", "plant: give either `model` or `scene`"),
    ('model = "pendulum"', 'modell = "pendulum"', "plant.modell: there is no key `modell`; did you mean `model`?"),
    ("[plant]", "[plnt]", "there is no key `plnt`; did you mean `plant`?"),
    ("settles", "setles", r"expect\[0\]: there is no `setles`; did you mean `settles`?"),
    ("by_s = 0.5", "by = 0.5", r"expect\[0\].settles.by: there is no key `by`; there are `signal`, `to`, `within`, `by_s`"),
    ("by_s = 0.5", "by_s = 2.0", r"expect\[0\].settles: by_s is 2"),
    ('signal = "theta"', 'signal = "speed(theta)"', "there is no function `speed` at character 1"),
    ('signal = "theta"', "signal = [1]", "a number or an expression is needed"),
    ("within = 0.1, ", "", "`within` is missing"),
    ("time_step_s = 0.02", "time_step_s = 0.02\ndt = 0.02", "time_step_s"),
    ("[[expect]]", "[controller.lqr]\nq = [1]\nr = [1]\n[[expect]]", "controller.lqr: a `reference` is needed"),
    ("[[expect]]", "[controller.pid]\nk = 1\n[[expect]]", "controller: there is no `pid`"),
]

#: A configuration, and what is said of it.
CONFIGURATIONS = [
    ('gprc = "off"', "line 1: there is no key `gprc`; did you mean `grpc`?"),
    ('grpc = "nowhere"', "`nowhere` is neither `off` nor an address like"),
    ("threads = -1", "line 1: number `-1` is given; a whole number that is not negative is needed"),
    ('\nthreads = "many"', 'line 2: string "many" is given'),
    ("[log]\nformat = 'jsn'", "there is no `jsn`; did you mean `json`?"),
    ("[limits]\nplant = 3", "there is no key `plant`; did you mean `plants`?"),
    ("shutdown_grace_s = -1", "shutdown_grace_s is -1; it must lie between 0 and"),
    ("grpc = ", "line 1"),
]


def said_by(program, *arguments):
    """What a program says that refuses; not twice the same."""
    folder = Path(os.environ["PLANTD_SERVER"]).parent
    run = subprocess.run([folder / program, *arguments], capture_output=True, text=True, timeout=60)
    assert run.returncode != 0, run.stdout
    text = run.stdout + run.stderr
    assert [word for word in STRANGE if word in text] == [], text
    return text


def test_a_wrong_scenario_says_what_is_wrong(tmp_path):
    for number, (good, wrong, _) in enumerate(SCENARIOS):
        assert good in SCENARIO
        (tmp_path / f"{number:02}.toml").write_text(SCENARIO.replace(good, wrong, 1))
    lines = said_by("plantctl", "test", "--list", str(tmp_path)).splitlines()
    assert len(lines) == len(SCENARIOS)
    for number, (_, _, said) in enumerate(SCENARIOS):
        (line,) = [line for line in lines if f"{number:02}.toml" in line]
        assert re.search(said, line), f"{said}: {line}"


@pytest.mark.parametrize("text, said", CONFIGURATIONS)
def test_a_wrong_configuration_says_once_what_is_wrong(tmp_path, text, said):
    file = tmp_path / "plantd.toml"
    file.write_text(text)
    told = said_by("plantd", "serve", "--config", str(file))
    assert len(told.strip().splitlines()) == 1 and re.search(said, told), told


def test_the_list_is_long():
    assert len(CALLS) + len(SCENES) + len(SCENARIOS) + len(CONFIGURATIONS) >= 140


@pytest.mark.parametrize("address, said", [
    (50051, "`address` is 50051; a text such as"),
    ("http://127.0.0.1:1", "no server listens there.*`plantd serve` in a terminal.*plantd.launch"),
    ("unix:/no/such.sock", "no such socket.*plantd.launch"),
    ("localhost:no", "is not an address"),
])
def test_an_address_without_a_server(monkeypatch, address, said):
    monkeypatch.setattr("plantd._connect._CONNECT_SECONDS", 0.5)
    check(lambda: plantd.connect(address), said)


def test_a_client_that_is_closed(addresses):
    client = plantd.connect(addresses["grpc"])
    client.close()
    check(client.list_plants, "the client is closed")


def test_a_call_that_takes_too_long(addresses):
    with plantd.connect(addresses["grpc"], timeout=1e-4) as client:
        check(lambda: client.get_model("scissor-32"), "no answer within the client's `timeout`")
