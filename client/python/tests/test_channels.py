"""Sensors, actuators and faults, against a real server."""

import numpy as np
import pytest

import plantd


def drive(client, id, steps):
    with client.drive(id) as driver:
        return [(driver.step([0.5]), driver.outputs) for _ in range(steps)]


def test_sensors_and_actuators(client):
    plant = client.create_plant("pendulum")
    tip = dict(frame="rod", at=[0.0, -1.0, 0.0])
    channels = client.set_channels(
        plant.id,
        [
            dict(name="angle", coordinate="theta"),
            dict(name="late", coordinate="theta", latency_s=0.2, noise=0.1),
            dict(name="tip", position=tip),
        ],
        [dict(input="tau", delay_s=0.3)],
        seed=7,
    )
    assert channels.names == ("angle", "late", "tip.x", "tip.y", "tip.z")
    assert channels.declared.outputs[1].latency_s == pytest.approx(0.2)
    assert channels.outputs.y[0] == plant.state.q[0]
    plain = client.create_plant("pendulum")
    for k, (state, outputs) in enumerate(drive(client, plant.id, 10)):
        expected = client.step(plain.id, [[0.0 if k < 3 else 0.5]])[-1]
        assert state.x.tobytes() == expected.x.tobytes()
        angle = state.q[0]
        assert outputs.y[0] == angle
        assert outputs.y[2:] == pytest.approx([np.sin(angle), -np.cos(angle), 0.0], abs=1e-14)
        assert outputs.lost == ()
    assert client.get_channels(plant.id).outputs.y.tobytes() == outputs.y.tobytes()
    watched = next(client.watch(plant.id, ["outputs"]))
    assert watched.outputs.y.tobytes() == outputs.y.tobytes()
    with pytest.raises(plantd.PlantdError) as refused:
        client.set_channels(plant.id, [dict(name="a", coordinate="phi")])
    assert refused.value.violations[0].field == "channels.outputs[0].coordinate"


def test_faults(client):
    plant = client.create_plant("pendulum")
    client.set_channels(plant.id, [dict(name="torque", input="tau")])
    client.inject_fault(plant.id, input="tau", off=True, start_step=2, duration_s=0.3)
    push = dict(point=dict(frame="rod"), torque=[0.0, 0.0, 1.0])
    second = client.inject_fault(plant.id, push=push, start_s=100.0)
    torques = [outputs.y[0] for _, outputs in drive(client, plant.id, 7)]
    assert torques == [0.5, 0.5, 0.0, 0.0, 0.0, 0.5, 0.5]
    assert [fault.beginnings for fault in client.list_faults(plant.id)] == [1, 0]
    assert client.clear_fault(plant.id, second.id) == 1
    assert client.clear_fault(plant.id) == 1
    assert client.list_faults(plant.id) == []
