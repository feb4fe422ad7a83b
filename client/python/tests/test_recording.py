"""Recordings, read by the readers of the format."""

import pytest
from mcap.reader import make_reader
from mcap_protobuf.decoder import DecoderFactory

import plantd


def test_a_recording_is_read_with_the_schemas_in_it(client, tmp_path):
    plant = client.create_plant("cart-pole", q=[0.1, -0.2])
    recording = client.start_recording(plant.id)
    assert (recording.plant, recording.status) == (plant.id, "active")
    with pytest.raises(plantd.PlantdError) as error:
        client.start_recording(plant.id)
    assert error.value.reason == "RECORDING_ACTIVE"
    u = [[0.1 * k] for k in range(50)]
    states = client.step(plant.id, u)
    recording = client.stop_recording(recording.name)
    assert (recording.status, recording.steps, recording.lost) == ("done", 50, 0)
    assert recording in client.list_recordings()

    file = tmp_path / "fetched.mcap"
    client.get_recording(recording.name, file)
    assert file.stat().st_size == recording.bytes
    with file.open("rb") as source:
        reader = make_reader(source, decoder_factories=[DecoderFactory()])
        summary = reader.get_summary()
        names = {schema.name for schema in summary.schemas.values()}
        kinds = ("PlantRecord", "StepRecord", "MarkRecord", "Event")
        ours = {f"plantd.v1.{kind}" for kind in kinds}
        assert names == ours | {"foxglove.FrameTransforms", "foxglove.SceneUpdate", "plantd.Signals"}
        assert summary.statistics.message_count >= 51
        messages = [
            (channel.topic, message.log_time, message.publish_time, decoded)
            for _, channel, message, decoded in reader.iter_decoded_messages()
        ]
        metadata = {record.name: record.metadata for record in reader.iter_metadata()}
    assert metadata["plantd"]["plant"] == plant.id
    assert metadata["plantd"]["coordinates"] == "x,theta"

    _, _, _, first = messages[0]
    assert (first.plant.id, first.plant.model) == (plant.id, "cart-pole")
    assert list(first.plant.state.q) == [0.1, -0.2]
    assert first.model.scene_toml.startswith("format = ")
    steps = [(published, step) for topic, _, published, step in messages if topic == "/step"]
    assert len(steps) == 50
    for (published, step), state, row in zip(steps, states, u):
        assert step.state.step == state.step
        # To the last bit.
        assert list(step.state.q) == state.q.tolist()
        assert list(step.state.p) == state.p.tolist()
        assert list(step.state.velocity) == state.velocity.tolist()
        assert list(step.u) == list(step.driver) == row
        assert step.report.iterations > 0
        assert published == pytest.approx(1e9 * step.state.time_s, abs=1)
    log_times = [time for _, time, _, _ in messages]
    assert log_times == sorted(log_times)

    client.delete_recording(recording.name)
    with pytest.raises(plantd.PlantdError) as error:
        client.get_recording(recording.name, file)
    assert error.value.reason == "RECORDING_NOT_FOUND"
