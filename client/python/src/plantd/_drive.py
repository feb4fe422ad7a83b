"""Driving a plant: one message per step each way."""

from __future__ import annotations

import math
import queue
import threading
import time
import weakref
from typing import Any, cast

from plantd.v1 import plant_service_pb2, realtime_pb2
from plantd.v1 import plant_service_pb2 as pb
from plantd.v1.plant_service_pb2_grpc import PlantServiceStub

from ._arrays import Array, Vector, array, vector
from ._calls import Calls
from ._channels import Outputs
from ._check import build, shown
from ._errors import (
    PlantdError,
    RolledBack,
    SteppedByOthers,
    from_failure,
    is_lost,
    translate,
    translated,
)
from ._linearize import Linearization
from ._plants import Plant
from ._realtime import StepTiming
from ._states import State, StepReport

#: How long a lost plant is looked for, s, unless it is said otherwise.
_PATIENCE_SECONDS = 30.0

#: The first pause between two attempts, and the longest one, s; each is twice the last.
_PAUSE_SECONDS = (0.01, 0.5)


class Driver:
    """Holds the lease of a plant: steps it in lockstep, or gives inputs to one that runs by itself.

    Use it in a ``with`` statement.
    """

    def __init__(self, stub: PlantServiceStub, open: pb.DriveOpen):
        self._sequence = 0
        #: Number of the last input that was answered.
        self._answered = 0
        self._answers_ns = 0
        #: Times of the last step, if the plant runs by itself.
        self.timing: StepTiming | None = None
        #: States of such a plant that were passed over, because newer ones were there.
        self.dropped = 0
        #: What the solver did in the last step.
        self.report: StepReport | None = None
        #: Linearization of the last step, if the driver was opened with it.
        self.linearization: Linearization | None = None
        #: Input of the last step, if a feedback, a channel or a fault had a say in it.
        self.u: Array | None = None
        #: What the output channels delivered after the last step, if there are any.
        self.outputs: Outputs | None = None
        self._begin(stub, open)

    def _begin(self, stub: PlantServiceStub, open: pb.DriveOpen) -> None:
        """Opens the stream."""
        self._requests: queue.SimpleQueue[pb.DriveRequest | None] = queue.SimpleQueue()
        self._requests.put(pb.DriveRequest(open=open))
        try:
            with translated():
                self._answers: Any = stub.Drive(iter(self._requests.get, None))
            self._opened: pb.DriveOpened = self._next().opened
        except BaseException:
            # Whoever reads the requests shall end.
            self._requests.put(None)
            raise
        #: The plant as it was when the driver opened it.
        self.plant = Plant._from(self._opened.plant)
        #: Names the lease, for ``resume`` after the connection broke; empty without ``grace``.
        self.lease_token: str = self._opened.lease_token

    @translate
    def _next(self) -> pb.DriveResponse:
        try:
            answer: pb.DriveResponse = next(self._answers)
            return answer
        except StopIteration:
            raise PlantdError("UNAVAILABLE", "the server closed the stream") from None

    def step(self, u: Vector = ()) -> State:
        """Takes one step with the input ``u`` (input forces, then next prescribed positions).

        Of a plant that runs by itself it waits for the first step on which the input acted, so that
        the same loop drives both.

        Raises `StepError` if the step failed: the plant is where it was and the driver goes on.
        """
        self.offer(u)
        # An earlier answer belongs to a step that was interrupted, for example by Ctrl-C.
        answer = self._next()
        while getattr(answer, answer.WhichOneof("response")).sequence < self._sequence:
            answer = self._next()
        return self._note(answer)

    def offer(self, u: Vector) -> None:
        """Gives a plant that runs by itself an input, which acts from its next step on."""
        self._sequence += 1
        input = pb.DriveInput(sequence=self._sequence, u=vector(u, "u"), answers_ns=self._answers_ns)
        self._requests.put(pb.DriveRequest(input=input))

    def next(self) -> State:
        """Waits for the next state of a plant that runs by itself: the latest, whatever input acted.

        `timing` says what became of the inputs. Raises `StepError` if an input was refused.
        """
        return self._note(self._next())

    def _note(self, answer: pb.DriveResponse) -> State:
        self._answered = getattr(answer, answer.WhichOneof("response")).sequence
        if answer.HasField("failure"):
            raise from_failure(answer.failure.failure)
        return self._note_step(answer.step)

    def _note_step(self, step: pb.DriveStep) -> State:
        self._answers_ns = step.clocks.monotonic_ns
        self.timing = StepTiming._from(step.timing) if step.timing.ended_ns else None
        self.dropped = step.dropped
        self.report = StepReport._from(step.report)
        self.u = array(step.u) if step.u else None
        self.outputs = Outputs._from(step.outputs) if step.HasField("outputs") else None
        if step.HasField("linearization"):
            self.linearization = Linearization._from(step.linearization)
        state = step.state
        return State._from(state, self.plant.model, self._time_step(state.step, state.time_s))

    def _time_step(self, step: int, time: float) -> float:
        """The plant's time step when it was opened, or 0 if another one is seen to be in force."""
        start, time_step = self.plant.state, self.plant.time_step
        steps = (time - start.time) / time_step
        return time_step if abs(steps - (step - start.step)) < 0.5 else 0.0

    def close(self) -> None:
        """Gives the lease back and waits until the server has done so."""
        self._requests.put(None)
        try:
            for _ in self._remaining():
                pass
        except PlantdError:
            # The stream has ended in another way, and with it the lease.
            pass

    @translate
    def _remaining(self) -> list[pb.DriveResponse]:
        return list(self._answers)

    def __enter__(self) -> Driver:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


class ReconnectingDriver(Driver):
    """A driver that opens its plant again when it has lost it, wherever that has gone, and sorts out what became of
    the step that was under way: see `Client.drive`.
    """

    def __init__(self, calls: Calls, open: pb.DriveOpen, patience: float):
        self._calls, self._open, self._patience = calls, open, patience
        #: Has the connections to all servers at which the plant has been.
        self._root = calls
        #: How often the plant was opened again.
        self.reconnections = 0
        super().__init__(calls.plants, open)
        #: The step at which the plant was seen last.
        self._known = self.plant.state.step
        #: The last input that was offered to a plant that runs by itself.
        self._offered: Vector | None = None
        self._watch = _Watch(self, calls._timeout)

    @property
    def address(self) -> str:
        """Where the server is reached that has the plant; empty for a server in this process."""
        return self._calls.address

    def step(self, u: Vector = ()) -> State:
        """Takes one step with the input ``u``, as `Driver.step`; after a loss it goes on where the plant is.

        Raises `RolledBack` or `SteppedByOthers` where that is at an unexpected step: the input was not taken, and
        the driver goes on from there. Raises the error of the last attempt when the plant was not found in time.
        """
        while True:
            try:
                with self._watch:
                    return self._seen(super().step(u))
            except PlantdError as error:
                lost = error
            if not is_lost(lost):
                raise lost
            # Inputs that may have been taken: this one, and those of steps that were interrupted.
            under_way = self._sequence - self._answered
            try:
                self._reopen(lost)
            except PlantdError:
                # Who tries again tries this step.
                self._sequence -= 1
                raise
            taken = self._compare()
            if not self._is_in_lockstep or taken < under_way:
                continue
            if taken > under_way or not self._opened.HasField("last"):
                raise SteppedByOthers(self._known - taken, self._known)
            return self._note_step(self._opened.last)

    def offer(self, u: Vector) -> None:
        self._offered = u
        super().offer(u)

    def next(self) -> State:
        """Waits for the next state of a plant that runs by itself, as `Driver.next`; after a loss it offers the last
        input again. Raises `RolledBack` where the plant is at an earlier step than before."""
        while True:
            try:
                with self._watch:
                    return self._seen(super().next())
            except PlantdError as error:
                lost = error
            if not is_lost(lost):
                raise lost
            self._reopen(lost)
            if self._offered is not None and not self._is_in_lockstep:
                super().offer(self._offered)
            self._compare()

    def close(self) -> None:
        self._watch.end()
        super().close()

    def _seen(self, state: State) -> State:
        self._known = state.step
        return state

    @property
    def _is_in_lockstep(self) -> bool:
        run = self._opened.plant.run
        return not run.HasField("settings") or run.settings.pace == realtime_pb2.PACE_LOCKSTEP

    def _compare(self) -> int:
        """Steps that were taken since the last that was seen; negative numbers are an error."""
        before, self._known = self._known, self.plant.state.step
        if self._known < before:
            raise RolledBack(before, self._known)
        return self._known - before

    def _reopen(self, lost: PlantdError) -> None:
        """Opens the plant again, where it is."""
        self._requests.put(None)
        deadline = time.monotonic() + self._patience
        address, token = self._calls.address, self.lease_token
        pause, longest = _PAUSE_SECONDS
        while True:
            if lost.elsewhere:
                # Its lease has stayed behind.
                address, token = lost.elsewhere, ""
            open = pb.DriveOpen()
            open.CopyFrom(self._open)
            open.resume = token
            try:
                there = self._root._at(address)
                with self._watch:
                    self._begin(there.plants, open)
            except PlantdError as error:
                lost = error
            else:
                break
            if self._root._is_closed:
                raise lost
            if lost.reason == "LEASE_LOST" and token:
                token = ""
                continue
            if not (is_lost(lost) or lost.reason == "LEASE_HELD") or time.monotonic() >= deadline:
                raise lost
            time.sleep(pause)
            pause = min(2 * pause, longest)
        if there is not self._calls:
            # For calls after the end of the servers at which it has been.
            self._root._moved[open.id] = address
            there._moved.pop(open.id, None)
            self._calls = there
        self._answered = self._sequence
        self.reconnections += 1


class _Watch:
    """Cancels the stream of a driver that has waited for an answer for too long, from a thread of its own."""

    def __init__(self, driver: ReconnectingDriver, timeout: float):
        self._driver = weakref.ref(driver)
        self._timeout = timeout
        self._is_over = threading.Event()
        #: When the wait has begun; None while there is none.
        self._since: float | None = None
        threading.Thread(target=self._look, daemon=True).start()

    def __enter__(self) -> None:
        self._since = time.monotonic()

    def __exit__(self, *exception: object) -> None:
        self._since = None

    def end(self) -> None:
        self._is_over.set()

    def _look(self) -> None:
        while not self._is_over.wait(min(self._timeout / 4, 1.0)):
            since, driver = self._since, self._driver()
            if driver is None:
                return
            if since is not None and time.monotonic() - since > self._timeout:
                driver._answers.cancel()


class Hold:
    """Holds the lease of a plant that runs by itself; inputs are calls of their own.

    Use it in a ``with`` statement. `Driver` streams its inputs and sees what becomes of each; this is
    for those who give one now and then.
    """

    def __init__(self, calls: DriveCalls, id: str):
        self._calls = calls
        self._id = id
        self._stream: Any = calls.plants.Hold(build(pb.HoldRequest, id=id))
        self._sequence = 0
        with translated():
            opened = next(self._stream)
        #: The plant as it was when the lease was taken.
        self.plant = Plant._from(opened.plant)
        #: Names the lease, for `Client.set_input`.
        self.lease_token: str = opened.lease_token

    def set_input(self, u: Vector) -> None:
        """Gives the plant an input, which acts from its next step on until there is another one."""
        self._sequence += 1
        self._calls.set_input(self._id, self.lease_token, u, sequence=self._sequence)

    def close(self) -> None:
        """Gives the lease back."""
        self._stream.cancel()

    def __enter__(self) -> Hold:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()


class DriveCalls(Calls):
    """The calls that take the lease of a plant."""

    def _driver(self, open: pb.DriveOpen) -> Driver:
        return Driver(self.plants, open)

    def drive(
        self,
        id: str,
        *,
        linearization: bool = False,
        grace: float = 0.0,
        resume: str = "",
        reconnect: bool | float = False,
    ) -> Driver:
        """Takes the lease of a plant, to step it or to give it inputs.

        The lease is kept for ``grace`` seconds when the connection breaks; ``resume`` goes on with
        it (`Driver.lease_token`).

        With ``reconnect``, true or a number of seconds (30), a driver that loses its plant looks for it that long:
        when the connection breaks or is reset, its server ends and comes back, the client's ``timeout`` is over, its
        lease is lost, or the plant goes to another server. Then `Driver.step` compares the plant's step with the
        last that it saw. Where they are equal, the input had not arrived and is sent again; where the plant is one
        step further, the answer was lost and is read. Fewer steps, because the server came back with an earlier
        state, raise `RolledBack`, and more raise `SteppedByOthers`; then the input was not taken, and the next call
        goes on from there. Without ``grace`` somebody else may drive in between: one step of theirs is taken for
        this driver's own. A plant that runs by itself has gone on meanwhile, which is no error.
        """
        open = build(
            plant_service_pb2.DriveOpen,
            id=id, linearization=linearization, grace_s=grace, resume=resume
        )
        patience = _patience(reconnect)
        if patience is None:
            return self._following(id, lambda calls: cast(DriveCalls, calls)._driver(open))
        return self._following(id, lambda calls: ReconnectingDriver(calls, open, patience))

    def hold(self, id: str) -> Hold:
        """Takes the lease of a plant that runs by itself, to give it an input now and then."""
        return self._following(id, lambda calls: Hold(cast(DriveCalls, calls), id))

    def set_input(self, id: str, lease_token: str, u: Vector, *, sequence: int = 0) -> None:
        """Gives a plant an input under the lease that ``lease_token`` names (`Hold.lease_token`).

        Refused with the reason ``LOCKSTEP`` where the plant does not run by itself, and ``LEASE_LOST``
        where the lease has ended. ``sequence`` is the number by which `StepTiming` tells the input.
        """
        request = build(
            pb.SetInputRequest, id=id, lease_token=lease_token, u=vector(u, "u"), sequence=sequence
        )
        self._call(self.plants.SetInput, request)


def _patience(reconnect: bool | float) -> float | None:
    """How long a lost plant is looked for, s; None for not at all."""
    if isinstance(reconnect, bool):
        return _PATIENCE_SECONDS if reconnect else None
    if not isinstance(reconnect, (int, float)) or not math.isfinite(reconnect) or reconnect < 0:
        raise TypeError(f"`reconnect` is {shown(reconnect)}; True, False or a number of seconds is needed")
    return float(reconnect) or None
