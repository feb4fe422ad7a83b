"""Feedback laws that come as gains: streamed by the server, or collected beforehand."""

from __future__ import annotations

import threading
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import replace
from typing import Any

import grpc

from plantd.v1 import plant_service_pb2

from ._errors import PlantdError, from_rpc_error
from ._types import Array, Gain, State, WatchedGain

#: Gains of a trajectory that are kept ahead of the step asked for.
_WINDOW = 1024


class GainSchedule:
    """Time-varying gains as a feedback law: ``u = schedule(state)``.

    Takes the gains of `Client.solve_trajectory_lqr` or `Client.project_reference`, or gains of one's
    own, in the order of their steps. The last may hold only the final reference state. Before the
    first gain's step that gain holds; after the last one the last gain holds, about the final state.
    ``first_step`` is the step of the plant at which the first gain holds, if it is another one than
    the gain's own.
    """

    def __init__(self, gains: Iterable[Gain], *, first_step: int | None = None):
        self.gains = list(gains)
        self._final: Array | None = None
        if self.gains and not self.gains[-1].k.size:
            self._final = self.gains.pop().x_reference
        if not self.gains:
            raise ValueError("there is no gain with `k`")
        shapes = {(g.k.shape, g.x_reference.shape, g.u_reference.shape) for g in self.gains}
        k, x, u = self.gains[0].k.shape, self.gains[0].x_reference, self.gains[0].u_reference
        if len(shapes) > 1 or k != u.shape + x.shape:
            raise ValueError("the gains' sizes do not fit each other and their references")
        if self._final is not None and self._final.shape != x.shape:
            raise ValueError("the final state differs in length from the references")
        shift = 0 if first_step is None else first_step - self.gains[0].step
        self._steps = [gain.step + shift for gain in self.gains]
        if any(a >= b for a, b in zip(self._steps, self._steps[1:])):
            raise ValueError("the gains' steps do not increase")

    def __call__(self, state: State) -> Array:
        """The input ``u_reference + feedforward - k (x - x_reference)`` at a state."""
        gain = self.gains[max(bisect_right(self._steps, state.step) - 1, 0)]
        if self._final is not None and state.step > self._steps[-1]:
            gain = replace(gain, x_reference=self._final)
        return gain(state)


class Follower:
    """The feedback law of a plant, applied here with the gains that the server streams.

        with client.follow_gains(plant.id) as law:
            u = law(state)

    A thread reads the stream. Along a trajectory it keeps the gains of the coming steps, 1024 of them
    at most, and a call waits where the gain of its step is not there yet; about an operating point it
    keeps the latest. When the server computes the gains anew, those from before are forgotten.
    """

    def __init__(self, watch: Callable[[], Any], timeout: float):
        self._watch, self._timeout = watch, timeout
        self._changed = threading.Condition()
        self._gains: deque[Gain] = deque()
        self._final: Array | None = None
        self._step = 0
        self._reopened_for: int | None = None
        self._end: PlantdError | None = None
        self._closed = False
        self._latest: WatchedGain | None = None
        self._stream: Any = None
        self._open()
        with self._changed:
            opened = self._changed.wait_for(lambda: self._latest or self._end, timeout)
        if not opened or self._latest is None:
            self.close()
            raise self._end or PlantdError("DEADLINE_EXCEEDED", f"no gain within {timeout} s")

    def _open(self) -> None:
        self._stream = self._watch()
        threading.Thread(target=self._read, args=(self._stream,), daemon=True).start()

    def _read(self, call: Any) -> None:
        try:
            for message in call:
                with self._changed:
                    if call is not self._stream:
                        return
                    self._note(message)
                    self._changed.notify_all()
                    self._changed.wait_for(
                        lambda: self._closed or call is not self._stream or self._has_room()
                    )
            end = PlantdError("UNAVAILABLE", "the server closed the stream")
        except grpc.RpcError as error:
            end = from_rpc_error(error)
        with self._changed:
            if call is self._stream:
                self._end = end
                self._changed.notify_all()

    def _has_room(self) -> bool:
        return not self.horizon or len(self._gains) < _WINDOW

    def _note(self, message: plant_service_pb2.WatchGainsResponse) -> None:
        """Takes in what the server sent."""
        news = WatchedGain._from(message)
        if self._latest is None or news.revision != self._latest.revision:
            self._gains.clear()
            self._final = None
        self._latest = news
        if news.gain is None:
            return
        if not news.gain.k.size:
            self._final = news.gain.x_reference
            return
        if not news.horizon or (self._gains and self._gains[-1].step >= news.gain.step):
            self._gains.clear()
        self._gains.append(news.gain)
        self._forget()

    def _forget(self) -> None:
        """Drops the gains of steps that have gone by."""
        while len(self._gains) > 1 and self._gains[1].step <= self._step:
            self._gains.popleft()

    def _find(self, state: State) -> Gain | None:
        """The gain of a state, if it is there."""
        had_room, self._step = self._has_room(), state.step
        self._forget()
        if not had_room and self._has_room():
            self._changed.notify_all()
        if not self._gains or self._latest is None:
            return None
        gain, first, horizon = self._gains[0], self._latest.first_step, self._latest.horizon
        step = max(state.step, first)
        if not horizon or gain.step == step:
            self._reopened_for = None
            return gain
        if gain.step > step:
            # The plant has gone back: the gains from there on are to be had from a new stream.
            if self._reopened_for == step:
                raise PlantdError(
                    "OUT_OF_RANGE",
                    f"the plant has left step {step} behind: its gains begin at step {gain.step}",
                )
            self._reopened_for = step
            self._gains.clear()
            self._final = None
            self._stream.cancel()
            self._end = None
            self._open()
            return None
        if self._final is not None and step >= first + horizon == gain.step + 1:
            return replace(gain, x_reference=self._final)
        return None

    def __call__(self, state: State) -> Array:
        """The input ``u_reference + feedforward - k (x - x_reference)`` at a state of the plant.

        Raises the `PlantdError` with which the stream ended; along a trajectory only where the gains
        that came before do not cover the step.
        """
        found: list[Gain] = []

        def look() -> bool:
            gain = self._find(state)
            if gain is not None:
                found.append(gain)
            return bool(found) or self._end is not None or self._closed

        with self._changed:
            arrived = self._changed.wait_for(look, self._timeout)
            ended = self._end is not None or self._closed
            if ended and (not found or not self.horizon):
                raise self._end or PlantdError("CANCELLED", "the follower is closed")
        if not arrived:
            raise PlantdError("DEADLINE_EXCEEDED", f"no gain for step {state.step}")
        return found[0](state)

    @property
    def revision(self) -> int:
        """Of which computation the gains are; a new number means that they were computed anew."""
        return self._latest.revision if self._latest else 0

    @property
    def dropped(self) -> int:
        """Revisions that were replaced before this follower saw them."""
        return self._latest.dropped if self._latest else 0

    @property
    def failure(self) -> str:
        """Why the gains in force are still those of the parameters before; empty if they are not."""
        return self._latest.failure if self._latest else ""

    @property
    def horizon(self) -> int:
        """Steps of the trajectory; 0 about an operating point."""
        return self._latest.horizon if self._latest else 0

    @property
    def end(self) -> PlantdError | None:
        """The error with which the stream has ended; None while it goes on."""
        return self._end

    def close(self) -> None:
        """Ends the stream."""
        with self._changed:
            self._closed = True
            self._changed.notify_all()
        self._stream.cancel()

    def __enter__(self) -> Follower:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()
