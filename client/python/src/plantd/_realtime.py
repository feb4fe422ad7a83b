"""Plants that run by themselves: pace, safety, timing and events."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Literal, get_args

from plantd.v1 import realtime_pb2

from ._arrays import Vector, vector
from ._calls import Calls
from ._check import build, one_of, shown
from ._errors import from_failure
from ._states import State

#: How a plant is run: when its driver steps it, by the wall clock, or as fast as possible.
Pace = Literal["lockstep", "paced", "free"]
#: What a plant does that runs and has no valid input.
InputAction = Literal["hold", "safe", "ramp", "stop"]
#: What a bound of a plant does when it is left.
WatchdogAction = Literal["freeze", "reset", "disconnect"]


@dataclass(frozen=True)
class StepTiming:
    """Times of one step of a plant that runs by itself, on the server's monotonic clock."""

    #: When it was due, ns; 0 when nothing was.
    due_ns: int
    #: When it began, ns.
    began_ns: int
    #: When it was over, ns.
    ended_ns: int
    #: Number of the driver's input in force; 0 for none.
    input_sequence: int
    #: Age of that input when the step began, ns.
    input_age_ns: int
    #: No new input had come since the step before.
    input_late: bool
    #: There was no valid input: what the policy says was in force.
    input_safe: bool

    @classmethod
    def _from(cls, m: realtime_pb2.StepTiming) -> StepTiming:
        return cls(
            m.due_ns,
            m.began_ns,
            m.ended_ns,
            m.input_sequence,
            m.input_age_ns,
            m.input_late,
            m.input_safe,
        )


@dataclass(frozen=True)
class Event:
    """Something that happened to a plant besides its steps."""

    #: Number, from 0 for the plant.
    number: int
    #: What: ``started``, ``input_lost``, ``watchdog``, ... as in the contract's ``EventKind``.
    kind: str
    #: Step of the plant.
    step: int
    #: To whom or what.
    subject: str
    #: A quantity, see the contract.
    value: float
    #: When, ns on the server's monotonic clock.
    monotonic_ns: int
    #: When, UTC, ns since 1970.
    utc_ns: int

    @classmethod
    def _from(cls, m: realtime_pb2.WatchEventsResponse) -> Event:
        e = m.event
        kind = realtime_pb2.EventKind.Name(e.kind)[11:].lower()
        return cls(e.number, kind, e.step, e.subject, e.value, e.monotonic_ns, e.utc_ns)


class RealtimeCalls(Calls):
    """Calls that let a plant run by itself."""

    def run(
        self,
        id: str,
        pace: Pace | None = None,
        *,
        speed: float = 0.0,
        steps: int = 0,
        wait: bool = False,
        timeout: float = 0.0,
        action: InputAction = "hold",
        ramp: float = 0.0,
        safe: Vector = (),
        latch: bool = False,
    ) -> realtime_pb2.RunInfo:
        """Runs a plant: ``"paced"`` by the wall clock, ``"free"`` as fast as possible, or in
        ``"lockstep"``; without a pace as before. ``steps`` of 0 means until it is paused. With
        ``wait`` it returns when the plant stands still again, however long that takes, and raises the
        `StepError` that has stopped it before its steps were taken.

        A plant that runs by itself waits for nobody: its driver's latest input acts. ``timeout``
        (seconds on the plant's clock, 0 for never), ``action`` (``"hold"``, ``"safe"``, ``"ramp"``
        within ``ramp`` seconds, ``"stop"``), ``safe`` and ``latch`` say what happens without one.
        """
        settings = None
        one_of("action", action, get_args(InputAction))
        if pace is not None:
            one_of("pace", pace, get_args(Pace))
            policy = build(
                realtime_pb2.InputPolicy,
                timeout_s=timeout,
                action=realtime_pb2.InputAction.Value(f"INPUT_ACTION_{action.upper()}"),
                ramp_s=ramp,
                safe=vector(safe, "safe"),
                latch=latch,
            )
            settings = build(
                realtime_pb2.RunSettings,
                pace=realtime_pb2.Pace.Value(f"PACE_{pace.upper()}"),
                speed=speed,
                input=None if pace == "lockstep" else policy,
            )
        request = build(realtime_pb2.RunRequest, id=id, settings=settings, steps=steps, wait=wait)
        answer: realtime_pb2.RunResponse = self._call(self.plants.Run, request, limited=not wait)
        if wait and answer.run.HasField("stopped_by"):
            raise from_failure(answer.run.stopped_by)
        return answer.run

    def pause(self, id: str) -> State:
        """Pauses a plant between two steps, and returns the state in which it stands."""
        return State._from(self._call(self.plants.Pause, build(realtime_pb2.PauseRequest, id=id)).state)

    def set_safety(
        self,
        id: str,
        watchdogs: Iterable[Mapping[str, Any]] = (),
        *,
        on_step_failure: WatchdogAction | None = None,
    ) -> None:
        """Sets bounds that protect a plant, in place of those before.

        Each is a mapping: ``dict(quantity="x", max=2.0, action="reset")``. Quantities are
        coordinates, ``v(coordinate)``, ``force(constraint)`` and ``energy``; actions ``freeze``
        (the default), ``reset`` and ``disconnect``.
        """

        def act(argument: str, name: str) -> Any:
            one_of(argument, name, get_args(WatchdogAction))
            return realtime_pb2.WatchdogAction.Value(f"WATCHDOG_ACTION_{name.upper()}")

        dogs = []
        for i, dog in enumerate(watchdogs):
            if not isinstance(dog, Mapping):
                raise TypeError(f"`watchdogs[{i}]` is {shown(dog)}; a dict is needed")
            action = act(f"watchdogs[{i}]['action']", dog.get("action", "freeze"))
            dogs.append(build(realtime_pb2.Watchdog, **{**dog, "action": action}))
        failure = None if on_step_failure is None else act("on_step_failure", on_step_failure)
        request = build(
            realtime_pb2.SetSafetyRequest,
            id=id, watchdogs=dogs, on_step_failure=failure
        )
        self._call(self.plants.SetSafety, request)

    def timing(self, id: str, *, clear: bool = False) -> realtime_pb2.GetTimingResponse:
        """What the loop of a plant that runs by itself has counted; ``clear`` begins anew."""
        request = build(realtime_pb2.GetTimingRequest, id=id, clear=clear)
        answer: realtime_pb2.GetTimingResponse = self._call(self.plants.GetTiming, request)
        return answer

    def watch_events(self, id: str, since: int | None = None) -> Iterator[Event]:
        """What happens to a plant besides its steps, from event ``since`` on; a plant keeps 256.

        Without ``since``: from now on. Leaving the loop ends the watch.
        """
        request = build(realtime_pb2.WatchEventsRequest, id=id, since=since)
        return self._messages(self.plants.WatchEvents, request, Event._from)
