"""FMUs that ``plantctl fmu`` makes, as FMPy sees them, beside the plants of a server."""

import os
import subprocess
import sys
from pathlib import Path

import fmpy
import numpy as np
import pytest
from fmpy.fmi1 import FMICallException
from fmpy.validation import validate_fmu

SCENES = ["pendulum", "cart-pole", "four-bar", "spherical-pendulum", "chain-4", "scissor-4", "marionette"]


@pytest.fixture(scope="module")
def make(tmp_path_factory):
    """Makes an FMU of a built-in model; its path."""
    folder = tmp_path_factory.mktemp("fmu")
    plantctl = Path(os.environ["PLANTD_SERVER"]).with_name("plantctl")

    def make(scene, *arguments):
        path = folder / f"{scene}{len(arguments)}.fmu"
        if not path.exists():
            command = [plantctl, "fmu", scene, "-o", path, *arguments]
            subprocess.run(command, check=True)
        return str(path)

    return make


def references(description):
    return {v.name: v.valueReference for v in description.modelVariables}


@pytest.fixture
def instantiate(make):
    """Instantiates an FMU; instances are freed at the end."""
    instances = []

    def instantiate(scene):
        path = make(scene)
        description = fmpy.read_model_description(path)
        folder = fmpy.extract(path)
        fmu = fmpy.instantiate_fmu(folder, description, "CoSimulation")
        instances.append(fmu)
        return fmu, references(description)

    yield instantiate
    for fmu in instances:
        fmu.freeInstance()


@pytest.mark.parametrize("scene", SCENES)
def test_validation_finds_no_problem(make, scene):
    assert validate_fmu(make(scene)) == []
    command = [sys.executable, "-m", "fmpy", "validate", make(scene)]
    assert "No problems found" in subprocess.run(command, capture_output=True, text=True).stdout


@pytest.mark.parametrize("scene", SCENES)
def test_simulation_has_the_bits_of_a_plant(client, make, scene):
    model = client.get_model(scene)
    names = [c.name for c in model.coordinates]
    outputs = [f"q({name})" for name in names] + [f"velocity({name})" for name in names]
    h = model.time_step_s
    found = fmpy.simulate_fmu(make(scene), output=outputs, stop_time=20 * h, validate=True)
    assert len(found) == 21
    plant = client.create_plant(scene)
    states = [plant.state, *client.step(plant.id, hold=20)]
    expected = np.array([[*state.q, *state.velocity] for state in states])
    values = np.array([[row[name] for name in outputs] for row in found])
    assert (values.view(np.uint64) == expected.view(np.uint64)).all()


def test_inputs_and_parameters_act(client, make):
    u = np.sin(np.arange(30.0))
    times = np.arange(31) * 0.01
    signal = np.array(list(zip(times, [*u, u[-1]])), dtype=[("time", float), ("u(force)", float)])
    found = fmpy.simulate_fmu(
        make("cart-pole"),
        input=signal,
        output=["q(x)", "q(theta)"],
        stop_time=0.3,
        start_values={"gravity[1]": -1.6, "frames[pole].body.mass": 2.0, "q(theta)": 0.25},
    )
    plant = client.create_plant("cart-pole", q=[0.0, 0.25])
    client.set_parameters(plant.id, {"gravity[1]": -1.6, "frames[pole].body.mass": 2.0})
    states = [plant.state.q, *(state.q for state in client.step(plant.id, u[:, None]))]
    # FMPy interpolates inputs at the points of its own grid, which rounding moves.
    assert np.abs(np.array([list(row)[1:] for row in found]) - states).max() < 1e-12


def test_states_can_be_taken_back_and_carried_over(instantiate):
    fmu, of = instantiate("cart-pole")
    fmu.enterInitializationMode()
    fmu.exitInitializationMode()
    fmu.setFloat64([of["u(force)"]], [3.0])
    fmu.doStep(0.0, 0.1)
    state = fmu.getFMUState()
    serialized = fmu.serializeFMUState(state)
    which = [of["q(x)"], of["q(theta)"], of["p(x)"], of["p(theta)"], of["energy"], of["time"]]

    def run(fmu):
        fmu.doStep(0.1, 0.1)
        return fmu.getFloat64(which)

    first = run(fmu)
    fmu.setFMUState(state)
    assert run(fmu) == first
    other, _ = instantiate("cart-pole")
    other.setFMUState(other.deserializeFMUState(serialized))
    assert run(other) == first
    fmu.freeFMUState(state)
    with pytest.raises(FMICallException):
        fmu.deserializeFMUState(serialized[:-1])


def test_directional_derivatives_are_a_and_b(client, instantiate):
    fmu, of = instantiate("cart-pole")
    fmu.enterInitializationMode()
    fmu.exitInitializationMode()
    x = ["q(x)", "q(theta)", "p(x)", "p(theta)"]
    unknowns = [of[f"next({name})"] for name in x]
    plant = client.create_plant("cart-pole")
    linear, seed = client.linearize(plant=plant.id), [0.0, 0.0, 0.0, 1.0]
    for matrix, knowns in [(linear.a, x), (linear.b, ["u(force)"])]:
        for column, known in zip(matrix.T, knowns):
            assert fmu.getDirectionalDerivative(unknowns, [of[known]], [1.0]) == list(column)
            assert fmu.getAdjointDerivative(unknowns, [of[known]], seed, 1) == [column[-1]]


def test_bad_calls_raise(instantiate):
    fmu, of = instantiate("pendulum")
    with pytest.raises(FMICallException):
        fmu.doStep(0.0, 0.1)
    fmu.enterInitializationMode(stopTime=1.0)
    fmu.exitInitializationMode()
    for call in [
        lambda: fmu.doStep(0.0, 0.0005),
        lambda: fmu.doStep(0.0, 2.0),
        lambda: fmu.getInt32([0]),
        lambda: fmu.setFloat64([of["q(theta)"]], [1.0]),
        lambda: fmu.setFloat64([of["u(tau)"]], [float("nan")]),
        lambda: fmu.enterEventMode(),
        lambda: fmu.getFloat64([9999]),
    ]:
        with pytest.raises(FMICallException):
            call()
    assert fmu.getInt32([]) == []
    fmu.terminate()


def test_model_exchange_is_not_offered(make):
    description = fmpy.read_model_description(make("pendulum"))
    assert description.modelExchange is None and description.scheduledExecution is None
    with pytest.raises(Exception, match="ModelExchange|model exchange|not supported"):
        fmpy.simulate_fmu(make("pendulum"), fmi_type="ModelExchange")
