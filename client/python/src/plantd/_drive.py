"""Driving a plant: one message per step each way."""

from __future__ import annotations

import queue
from typing import Any

from plantd.v1 import plant_service_pb2
from plantd.v1 import plant_service_pb2 as pb
from plantd.v1.plant_service_pb2_grpc import PlantServiceStub

from ._arrays import Array, Vector, array, vector
from ._calls import Calls
from ._channels import Outputs
from ._check import build
from ._errors import PlantdError, from_failure, translate, translated
from ._linearize import Linearization
from ._plants import Plant
from ._realtime import StepTiming
from ._states import State, StepReport


class Driver:
    """Holds the lease of a plant: steps it in lockstep, or gives inputs to one that runs by itself.

    Use it in a ``with`` statement.
    """

    def __init__(self, stub: PlantServiceStub, open: pb.DriveOpen):
        self._requests: queue.SimpleQueue[pb.DriveRequest | None] = queue.SimpleQueue()
        self._requests.put(pb.DriveRequest(open=open))
        self._answers: Any = stub.Drive(iter(self._requests.get, None))
        self._sequence = 0
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
        opened = self._next().opened
        #: The plant as it was when the driver opened it.
        self.plant = Plant._from(opened.plant)
        #: Names the lease, for ``resume`` after the connection broke; empty without ``grace``.
        self.lease_token: str = opened.lease_token

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
        if answer.HasField("failure"):
            raise from_failure(answer.failure.failure)
        self._answers_ns = answer.step.clocks.monotonic_ns
        self.timing = StepTiming._from(answer.step.timing) if answer.step.timing.ended_ns else None
        self.dropped = answer.step.dropped
        self.report = StepReport._from(answer.step.report)
        self.u = array(answer.step.u) if answer.step.u else None
        has_outputs = answer.step.HasField("outputs")
        self.outputs = Outputs._from(answer.step.outputs) if has_outputs else None
        if answer.step.HasField("linearization"):
            self.linearization = Linearization._from(answer.step.linearization)
        state = answer.step.state
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
        self, id: str, *, linearization: bool = False, grace: float = 0.0, resume: str = ""
    ) -> Driver:
        """Takes the lease of a plant, to step it or to give it inputs.

        The lease is kept for ``grace`` seconds when the connection breaks; ``resume`` goes on with
        it (`Driver.lease_token`).
        """
        open = build(
            plant_service_pb2.DriveOpen,
            id=id, linearization=linearization, grace_s=grace, resume=resume
        )
        return self._driver(open)

    def hold(self, id: str) -> Hold:
        """Takes the lease of a plant that runs by itself, to give it an input now and then."""
        return Hold(self, id)

    def set_input(self, id: str, lease_token: str, u: Vector, *, sequence: int = 0) -> None:
        """Gives a plant an input under the lease that ``lease_token`` names (`Hold.lease_token`).

        Refused with the reason ``LOCKSTEP`` where the plant does not run by itself, and ``LEASE_LOST``
        where the lease has ended. ``sequence`` is the number by which `StepTiming` tells the input.
        """
        request = build(
            pb.SetInputRequest, id=id, lease_token=lease_token, u=vector(u, "u"), sequence=sequence
        )
        self._call(self.plants.SetInput, request)
