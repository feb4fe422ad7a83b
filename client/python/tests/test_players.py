"""What players of recordings find in them, by the readers of the format and the schemas that Foxglove publishes."""

import math

import pytest
from foxglove_schemas_protobuf import FrameTransforms_pb2, SceneUpdate_pb2
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory


def record(client, tmp_path, plant, act):
    recording = client.start_recording(plant.id)
    act()
    client.stop_recording(recording.name)
    file = tmp_path / "players.mcap"
    client.get_recording(recording.name, file)
    return file


def test_poses_and_signals_are_those_of_the_pendulum(client, tmp_path):
    plant = client.create_plant("pendulum", q=[0.3], dt=0.01)
    file = record(client, tmp_path, plant, lambda: client.step(plant.id, [[0.5]] * 40))
    with file.open("rb") as source:
        reader = make_reader(source, decoder_factories=[DecoderFactory()])
        topics = {}
        for schema, channel, message, decoded in reader.iter_decoded_messages():
            topics.setdefault(channel.topic, []).append((schema, message, decoded))
    assert set(topics) >= {"/plant", "/step", "/tf", "/scene", "/lines", "/signals"}
    for (_, message, step), (_, pose, frames), (_, _, signals) in zip(
        topics["/step"], topics["/tf"][1:], topics["/signals"][1:], strict=True
    ):
        # One clock for all: the plant's.
        assert message.log_time == pose.log_time == round(1e9 * step.state.time_s)
        (frame,) = frames.transforms
        assert (frame.parent_frame_id, frame.child_frame_id) == ("world", "rod")
        angle = 2 * math.atan2(frame.rotation.z, frame.rotation.w)
        assert math.remainder(angle - step.state.q[0], 2 * math.pi) == pytest.approx(0, abs=1e-12)
        assert signals.q.theta == step.state.q[0]
        assert signals.p.theta == step.state.p[0]
        assert signals.velocity.theta == step.state.velocity[0]
        assert signals.u.tau == 0.5
        # A point mass of 1 kg on 1 m, its potential zero at the pivot.
        kinetic = 0.5 * step.state.velocity[0] ** 2
        potential = -9.8 * math.cos(step.state.q[0])
        assert signals.energy.kinetic == pytest.approx(kinetic, abs=1e-12)
        assert signals.energy.potential == pytest.approx(potential, abs=1e-12)
        assert signals.energy.total == pytest.approx(kinetic + potential, abs=1e-12)


def test_messages_are_those_that_are_published(client, tmp_path):
    plant = client.create_plant("marionette")
    file = record(client, tmp_path, plant, lambda: client.step(plant.id, hold=3))
    published = {
        "/tf": FrameTransforms_pb2.FrameTransforms,
        "/scene": SceneUpdate_pb2.SceneUpdate,
        "/lines": SceneUpdate_pb2.SceneUpdate,
    }
    with file.open("rb") as source:
        reader = make_reader(source, decoder_factories=[DecoderFactory()])
        seen, shown, frames = set(), set(), {"world"}
        for schema, channel, message, decoded in reader.iter_decoded_messages():
            kind = published.get(channel.topic)
            if kind is None:
                continue
            seen.add(channel.topic)
            shown |= {entity.frame_id for entity in getattr(decoded, "entities", ())}
            for transform in getattr(decoded, "transforms", ()):
                # A frame hangs on one that a player knows.
                assert transform.parent_frame_id in frames, transform.child_frame_id
                frames.add(transform.child_frame_id)
            assert schema.name == kind.DESCRIPTOR.full_name
            same_fields(decoded.DESCRIPTOR, kind.DESCRIPTOR)
            # Nothing is left over when the published schema reads it.
            theirs = kind.FromString(message.data)
            assert theirs.SerializeToString(deterministic=True) == decoded.SerializeToString(
                deterministic=True
            )
    assert seen == set(published)
    assert shown and shown <= frames


def same_fields(ours, theirs, checked=None):
    """Our descriptor has the published fields, each with its number and type."""
    checked = set() if checked is None else checked
    if ours.full_name in checked:
        return
    checked.add(ours.full_name)
    facts = [
        {f.name: (f.number, f.type, f.is_repeated if hasattr(f, "is_repeated") else f.label) for f in d.fields}
        for d in (ours, theirs)
    ]
    assert facts[0] == facts[1], ours.full_name
    for field in ours.fields:
        if field.message_type is not None:
            same_fields(field.message_type, theirs.fields_by_name[field.name].message_type, checked)
