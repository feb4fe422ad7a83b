"""Feedback laws made of gains, without a server: what a stream may bring, and in which order."""

import queue
import threading

import numpy as np
import pytest

import plantd
from plantd._feedback import Follower
from plantd.v1 import common_pb2, plant_service_pb2


def gain_message(step, k, reference=0.0, feedforward=()):
    return common_pb2.Gain(
        step=step,
        k=common_pb2.Matrix(rows=1, cols=2, data=[k, 0.0]),
        x_reference=[reference, 0.0],
        u_reference=[0.0],
        feedforward=feedforward,
    )


def final(step, reference):
    return common_pb2.Gain(step=step, x_reference=[reference, 0.0])


def gains(*messages):
    return [plantd.Gain._from(message) for message in messages]


def state(step, q):
    nothing = np.empty(0)
    return plantd.State(step, 0.0, np.array([q]), np.array([0.0]), nothing, nothing)


class Stream:
    """Stands for a call of WatchGains."""

    def __init__(self):
        self.messages = queue.Queue()
        self.is_cancelled = False

    def send(self, gain, revision=1, first_step=0, horizon=0):
        message = plant_service_pb2.WatchGainsResponse(
            gain=gain, revision=revision, first_step=first_step, horizon=horizon
        )
        self.messages.put(message)

    def end(self):
        self.messages.put(None)

    def __iter__(self):
        return iter(self.messages.get, None)

    def cancel(self):
        self.is_cancelled = True
        self.end()


@pytest.fixture
def stream():
    stream = Stream()
    yield stream
    stream.end()


def follow(*streams, timeout=30.0):
    return Follower(iter(streams).__next__, timeout)


def test_a_gain_adds_its_feedforward():
    law = plantd.Gain._from(gain_message(0, 2.0, 1.0, feedforward=[0.25]))
    assert law(state(0, 2.0)).tolist() == [0.25 - 2.0]
    assert law([2.0, 0.0]).tolist() == [0.25 - 2.0]


def test_a_schedule_holds_its_ends():
    law = plantd.GainSchedule(
        gains(gain_message(0, 1.0), gain_message(1, 2.0, 1.0), final(2, 5.0)), first_step=7
    )
    steps = [(0, 1.0, -1.0), (7, 1.0, -1.0), (8, 2.0, -2.0), (9, 6.0, -2.0), (1000, 5.0, 0.0)]
    for step, q, u in steps:
        assert law(state(step, q)).tolist() == [u]


@pytest.mark.parametrize(
    ("messages", "part"),
    [
        ([], "no gain"),
        ([gain_message(1, 1.0), gain_message(1, 1.0)], "increase"),
        ([gain_message(0, 1.0), final(1, 0.0), gain_message(2, 1.0)], "sizes"),
        ([gain_message(0, 1.0), common_pb2.Gain(step=1, x_reference=[0.0])], "final state"),
    ],
)
def test_a_schedule_says_what_is_wrong(messages, part):
    with pytest.raises(ValueError, match=part):
        plantd.GainSchedule(gains(*messages))


def test_along_a_trajectory_a_step_waits_for_its_gain(stream):
    stream.send(gain_message(10, 10.0), first_step=10, horizon=2)
    with follow(stream) as law:
        assert (law.revision, law.horizon) == (1, 2)
        assert law(state(3, 1.0)).tolist() == [-10.0]
        asked = []
        thread = threading.Thread(target=lambda: asked.append(law(state(11, 1.0))))
        thread.start()
        thread.join(0.05)
        assert not asked
        stream.send(gain_message(11, 11.0), first_step=10, horizon=2)
        thread.join(30)
        assert asked[0].tolist() == [-11.0]
        stream.send(final(12, 1.0), first_step=10, horizon=2)
        assert law(state(20, 1.5)).tolist() == [-5.5]
        # All is known: the end of the stream changes nothing.
        stream.end()
        assert law(state(21, 1.0)).tolist() == [0.0]
    assert stream.is_cancelled


def test_a_plant_that_went_back_gets_its_gains_again(stream):
    again = Stream()
    stream.send(gain_message(5, 5.0), horizon=9)
    with follow(stream, again) as law:
        assert law(state(5, 1.0)).tolist() == [-5.0]
        again.send(gain_message(0, 1.0), horizon=9)
        assert law(state(0, 1.0)).tolist() == [-1.0]
        assert stream.is_cancelled


def test_gains_that_are_not_sent_again_are_refused(stream):
    late = Stream()
    stream.send(gain_message(5, 5.0), horizon=9)
    late.send(gain_message(4, 4.0), horizon=9)
    with follow(stream, late) as law, pytest.raises(plantd.PlantdError, match="step 4"):
        law(state(2, 1.0))


def test_a_new_revision_replaces_what_came_before(stream):
    stream.send(gain_message(0, 1.0), horizon=3)
    stream.send(gain_message(1, 1.0), horizon=3)
    with follow(stream) as law:
        assert law(state(1, 1.0)).tolist() == [-1.0]
        stream.send(gain_message(2, 2.0), revision=2, horizon=3)
        assert law(state(2, 1.0)).tolist() == [-2.0]
        assert law.revision == 2


def test_about_a_point_the_latest_gain_holds_until_the_stream_ends(stream):
    stream.send(gain_message(30, 1.0))
    with follow(stream) as law:
        assert law(state(0, 1.0)).tolist() == [-1.0]
        failed = plant_service_pb2.WatchGainsResponse(
            revision=1, failure=common_pb2.Failure(reason="NOT_STABILISABLE")
        )
        stream.messages.put(failed)
        stream.send(gain_message(31, 3.0), revision=2)
        while law.revision < 2:
            assert law(state(31, 1.0)).tolist() in ([-1.0], [-3.0])
        assert law(state(31, 1.0)).tolist() == [-3.0]
        stream.end()
        with pytest.raises(plantd.PlantdError):
            while True:
                law(state(32, 1.0))
        assert law.end is not None


def test_gains_ahead_of_their_step_do_not_pile_up(stream):
    for k in range(3000):
        stream.send(gain_message(k, float(k)), horizon=3000)
    with follow(stream) as law:
        for k in range(3000):
            assert law(state(k, 1.0)).tolist() == [-float(k)]
            assert len(law._gains) <= 1024


def test_no_gain_in_time(stream):
    with pytest.raises(plantd.PlantdError) as caught:
        follow(stream, timeout=0.01)
    assert caught.value.code == "DEADLINE_EXCEEDED"
