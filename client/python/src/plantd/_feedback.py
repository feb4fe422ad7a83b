"""Feedback laws that come as gains: streamed by the server, or collected beforehand."""

from __future__ import annotations

import threading
from bisect import bisect_right
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import numpy as np
import numpy.typing as npt

from plantd.v1 import plant_service_pb2

from ._arrays import Array, Vector, failure_text
from ._calls import Calls
from ._check import build, one_of, shown
from ._errors import PlantdError, translated
from ._gains import Gain
from ._plots import plot_entries
from ._requests import (
    Bounds,
    bounds,
    constraints,
    point,
    stage_weights,
    trajectory_weights,
)
from ._states import State, Trajectory

#: Gains of a trajectory that are kept ahead of the step asked for.
_WINDOW = 1024


#: What a feedback does in the plant's own loop, see `Client.set_feedback`.
FEEDBACK_MODES = {
    "watch": plant_service_pb2.FEEDBACK_MODE_WATCH_ONLY,
    "replace": plant_service_pb2.FEEDBACK_MODE_REPLACE,
    "add": plant_service_pb2.FEEDBACK_MODE_ADD,
    "guard": plant_service_pb2.FEEDBACK_MODE_GUARD,
}


@dataclass(frozen=True)
class Feedback:
    """A feedback of a plant."""

    #: What it does in the plant's loop: ``watch``, ``replace``, ``add`` or ``guard``.
    mode: str
    #: Counts the computations of its gains, from 1.
    revision: int
    #: Step of the plant at which a trajectory begins.
    first_step: int
    #: Steps of the trajectory; 0 about an operating point.
    horizon: int
    #: Step at which the watchdog took over, and the entry of x that made it do so.
    tripped_at_step: int | None
    tripped_by: str
    #: Why the gains in force are still those of the parameters before; empty if they are not.
    failure: str

    @classmethod
    def _from(cls, m: plant_service_pb2.FeedbackInfo) -> Feedback:
        modes = {number: name for name, number in FEEDBACK_MODES.items()}
        return cls(
            modes.get(m.mode, "watch"),
            m.revision,
            m.first_step,
            m.horizon,
            m.tripped_at_step if m.HasField("tripped_at_step") else None,
            m.tripped_by,
            failure_text(m),
        )


@dataclass(frozen=True, eq=False)
class WatchedGain:
    """One message of a watch of gains."""

    #: The gain; without rows in ``k`` in the message with the final state of a trajectory. None in
    #: a message that only reports a failure.
    gain: Gain | None
    #: Of which computation it is.
    revision: int
    #: Revisions that this watcher never saw.
    dropped: int
    #: Why the gains in force are still those of the parameters before; empty if they are not.
    failure: str
    #: Step of the plant at which the gain's trajectory begins, and its steps; 0 steps about an
    #: operating point.
    first_step: int
    horizon: int

    @classmethod
    def _from(cls, m: plant_service_pb2.WatchGainsResponse) -> WatchedGain:
        return cls(
            Gain._from(m.gain) if m.HasField("gain") else None,
            m.revision,
            m.dropped,
            failure_text(m),
            m.first_step,
            m.horizon,
        )


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

    def plot(self, states: Sequence[str] = (), inputs: Sequence[str] = ()) -> Any:
        """A figure of the entries of ``k`` over the steps. Needs ``matplotlib``."""
        return plot_entries(self._steps, np.array([gain.k for gain in self.gains]), inputs, states)


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
            with translated():
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
        except PlantdError as error:
            end = error
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


def feedback_request(
    id: str,
    *,
    at: str | None = None,
    state: State | None = None,
    u: Vector = (),
    plant: str = "",
    trajectory: Trajectory | None = None,
    gain: Gain | None = None,
    q: npt.ArrayLike | None = None,
    r: npt.ArrayLike | None = None,
    q_final: npt.ArrayLike | None = None,
    s: npt.ArrayLike | None = None,
    projected_momentum: bool = False,
    stages: Iterable[Mapping[str, npt.ArrayLike]] = (),
    full: bool = False,
    mode: Literal["watch", "replace", "add", "guard"] = "watch",
    first_step: int | None = None,
    guard: Bounds | None = None,
) -> plant_service_pb2.SetFeedbackRequest:
    """What `FeedbackCalls.set_feedback` asks for."""
    forms = [at is not None, state is not None, bool(plant), trajectory is not None]
    if sum([*forms, gain is not None]) != 1:
        raise ValueError("give one of `at`, `state`, `plant`, `trajectory` and `gain`")
    one_of("mode", mode, FEEDBACK_MODES)
    for argument, value, kind in [
        ("trajectory", trajectory, Trajectory),
        ("gain", gain, Gain),
    ]:
        if value is not None and not isinstance(value, kind):
            raise TypeError(f"`{argument}` is {shown(value)}; a `plantd.{kind.__name__}` is needed")
    request = build(
        plant_service_pb2.SetFeedbackRequest,
        id=id,
        stages=stage_weights(stages),
        constraints=constraints(full),
        mode=FEEDBACK_MODES[mode],
        first_step=first_step,
        guard=bounds(guard),
    )
    if gain is not None:
        request.gain.CopyFrom(gain._message())
    elif trajectory is not None:
        request.trajectory.CopyFrom(trajectory._message())
    else:
        request.point.CopyFrom(point(at, state, u, plant))
    given = trajectory_weights(q, r, q_final, s, projected_momentum)
    if given is not None:
        request.weights.CopyFrom(given)
    return request


class FeedbackCalls(Calls):
    """Calls that give a plant a regulator."""

    def set_feedback(
        self,
        id: str,
        *,
        at: str | None = None,
        state: State | None = None,
        u: Vector = (),
        plant: str = "",
        trajectory: Trajectory | None = None,
        gain: Gain | None = None,
        q: npt.ArrayLike | None = None,
        r: npt.ArrayLike | None = None,
        q_final: npt.ArrayLike | None = None,
        s: npt.ArrayLike | None = None,
        projected_momentum: bool = False,
        stages: Iterable[Mapping[str, npt.ArrayLike]] = (),
        full: bool = False,
        mode: Literal["watch", "replace", "add", "guard"] = "watch",
        first_step: int | None = None,
        guard: Bounds | None = None,
    ) -> Feedback:
        """Gives a plant a reference with its regulator, which the server computes, and computes anew
        when the plant's parameters change. `follow_gains` applies it here.

        The reference is one of: an equilibrium (``at``, or ``state`` with ``u``, or where ``plant``
        is), a ``trajectory``, which begins at the plant's step ``first_step`` or at the present one,
        or a ``gain`` as it stands, which must not say that it is for another model or time step. When
        parameters change, the reference of a trajectory is the motion of the changed plant from the
        same initial state under the same inputs.

        ``mode`` is what the feedback does in the plant's own loop, ``law`` standing for its input:
        ``watch`` nothing; ``replace`` u = law; ``add`` u = law + what the driver sends; ``guard``
        u = law from the first step on at which an entry of x - x_reference leaves its bounds in
        ``guard``.
        """
        request = feedback_request(
            id,
            at=at,
            state=state,
            u=u,
            plant=plant,
            trajectory=trajectory,
            gain=gain,
            q=q,
            r=r,
            q_final=q_final,
            s=s,
            projected_momentum=projected_momentum,
            stages=stages,
            full=full,
            mode=mode,
            first_step=first_step,
            guard=guard,
        )
        return Feedback._from(self._call(self.plants.SetFeedback, request).feedback)

    def clear_feedback(self, id: str) -> None:
        """Takes the reference away; the driver's input acts alone again."""
        self._call(self.plants.ClearFeedback, build(plant_service_pb2.ClearFeedbackRequest, id=id))

    def watch_gains(self, id: str) -> Iterator[WatchedGain]:
        """The gains of a plant's feedback: along a trajectory those of every step from the present one
        on, ahead of time; about an operating point the one in force and each that replaces it."""
        request = build(plant_service_pb2.WatchGainsRequest, id=id)
        return self._messages(self.plants.WatchGains, request, WatchedGain._from)

    def follow_gains(self, id: str) -> Follower:
        """Follows the gains of a plant's feedback, to apply them here: ``u = law(state)``."""
        request = build(plant_service_pb2.WatchGainsRequest, id=id)
        return self._following(
            id, lambda calls: Follower(lambda: calls.plants.WatchGains(request), self._timeout)
        )
