"""Trajectory optimisation, and references from outside."""

from __future__ import annotations

import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from google.protobuf import json_format

from plantd.v1 import control_service_pb2 as pb

from ._errors import PlantdError, translated
from ._feedback import GainSchedule
from ._types import Array, Gain, Trajectory, failure_text, matrix

Method = Literal["steepest", "quasi-newton", "newton"]


def method_number(name: str | None) -> Any:
    """The number of a method."""
    if name is None:
        return pb.DESCENT_METHOD_UNSPECIFIED
    return pb.DescentMethod.Value(f"DESCENT_METHOD_{name.upper().replace('-', '_')}")


def _method_name(number: Any) -> str:
    name: str = pb.DescentMethod.Name(number)
    return name.removeprefix("DESCENT_METHOD_").lower().replace("_", "-")


@dataclass(frozen=True)
class Checkpoint:
    """Where a search stands: `Client.optimize_trajectory` goes on from it, bit for bit."""

    message: pb.OptimizationCheckpoint = field(repr=False)

    @property
    def trajectory(self) -> Trajectory:
        """The trajectory so far."""
        return Trajectory._from(self.message.trajectory)

    @property
    def iterations(self) -> int:
        """Iterations so far."""
        return self.message.iterations

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes it to a JSON file, in the field names of the contract."""
        _save(self.message, path)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Checkpoint:
        """Reads the file of a checkpoint, or of a result, which holds one."""
        return cls(_load(path).checkpoint)


@dataclass(frozen=True)
class Progress:
    """One iteration of a search."""

    #: Number of the iteration, from 0.
    iteration: int
    #: Cost before and after it, with the penalties of bounds.
    cost_before: float
    cost: float
    #: Directional derivative of the cost along the step; negative.
    directional_derivative: float
    #: Method that gave the direction, and why it was not the one asked for; empty if it was.
    method: str
    fallback: str
    #: Length of the step; 0 when none was taken. Shortenings before it was accepted.
    step_length: float
    backtracks: int
    #: Largest violation of a bound.
    bound_violation: float
    #: Where the search could go on from; at the iterations asked for.
    checkpoint: Checkpoint | None = field(repr=False)

    @classmethod
    def _from(cls, m: pb.OptimizationProgress) -> Progress:
        return cls(
            m.iteration,
            m.cost_before,
            m.cost,
            m.directional_derivative,
            _method_name(m.method),
            m.fallback,
            m.step_length,
            m.backtracks,
            m.bound_violation,
            Checkpoint(m.checkpoint) if m.HasField("checkpoint") else None,
        )


@dataclass(frozen=True, eq=False)
class Optimum:
    """The end of a search: the best trajectory that was found."""

    #: The directional derivative and the bounds are within their tolerances.
    converged: bool
    #: Why not, in a sentence that says what to change; empty if it converged.
    failure: str
    #: Cost, without penalties.
    cost: float
    #: Largest violation of a bound.
    bound_violation: float
    #: Row k is x[k]; n + 1 rows.
    x: Array
    #: Initial state and inputs, fit for regulators, feedbacks and warm starts.
    trajectory: Trajectory
    #: Where the search could go on from.
    checkpoint: Checkpoint
    message: pb.OptimizationResult = field(repr=False)

    @property
    def u(self) -> Array:
        """Row k is u[k]; n rows."""
        return self.trajectory.u

    def save(self, path: str | os.PathLike[str]) -> None:
        """Writes it to a JSON file, in the field names of the contract, as ``plantctl`` does."""
        _save(self.message, path)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Optimum:
        """Reads such a file."""
        return cls._from(_load(path))

    @classmethod
    def _from(cls, m: pb.OptimizationResult) -> Optimum:
        checkpoint = Checkpoint(m.checkpoint)
        return cls(
            m.converged,
            failure_text(m),
            m.cost,
            m.bound_violation,
            matrix(m.x),
            checkpoint.trajectory,
            checkpoint,
            m,
        )


def _save(message: Any, path: str | os.PathLike[str]) -> None:
    text = json_format.MessageToJson(message, preserving_proto_field_name=True, indent=None)
    Path(path).write_text(text + "\n")


def _load(path: str | os.PathLike[str]) -> pb.OptimizationResult:
    text = Path(path).read_text()
    try:
        try:
            return json_format.Parse(text, pb.OptimizationResult())
        except json_format.ParseError:
            checkpoint = json_format.Parse(text, pb.OptimizationCheckpoint())
            return pb.OptimizationResult(checkpoint=checkpoint)
    except json_format.ParseError as error:
        raise ValueError(f"{path} holds no result of a search: {error}") from None


class Search:
    """A search under way: an iterator over its progress, then ``result``.

        search = client.optimize_trajectory(...)
        for step in search:
            print(step.iteration, step.cost)
        best = search.result

    ``result`` runs what is left of the iterations. ``cancel``, or leaving a ``with`` statement, ends
    the search on the server.
    """

    def __init__(self, call: Any):
        self._call = call
        self._result: Optimum | None = None

    def __iter__(self) -> Iterator[Progress]:
        return self

    def __next__(self) -> Progress:
        if self._result is not None:
            raise StopIteration
        with translated():
            message = next(self._call)
        if message.HasField("progress"):
            return Progress._from(message.progress)
        self._result = Optimum._from(message.result)
        raise StopIteration

    @property
    def result(self) -> Optimum:
        """The end of the search."""
        for _ in self:
            pass
        if self._result is None:
            raise PlantdError("CANCELLED", "the search has ended without a result")
        return self._result

    def cancel(self) -> None:
        """Ends the search."""
        self._call.cancel()

    def __enter__(self) -> Search:
        return self

    def __exit__(self, *exception: object) -> None:
        self.cancel()


@dataclass(frozen=True, eq=False)
class ProjectedReference:
    """How a configuration trajectory compares with the motions of a plant, and one that follows it."""

    #: It is one of them, within the tolerance.
    feasible: bool
    #: Largest violation of a constraint by the reference; its step and the constraint's name.
    constraint_violation: float
    constraint_violation_step: int
    constraint: str
    #: Largest force that neither inputs nor constraints can exert; its step and its coordinate.
    unexplained_force: float
    unexplained_force_step: int
    unexplained_force_coordinate: str
    #: Largest acceleration that such forces make; its step and its coordinate.
    unexplained_acceleration: float
    unexplained_step: int
    unexplained_coordinate: str
    #: Inputs of the reference: those given, or those that fit best.
    u: Array
    #: Largest difference in a coordinate between the motion found and the reference; where.
    deviation: float
    deviation_step: int
    deviation_coordinate: str
    #: The motion found.
    trajectory: Trajectory
    #: Its states with their gains; without rows in ``k`` where no weights were given, and in the last
    #: one, which holds the final state.
    steps: list[Gain]

    @property
    def law(self) -> GainSchedule:
        """The regulator of the motion, if weights were given."""
        return GainSchedule(self.steps)

    @classmethod
    def _from(cls, messages: Iterator[pb.ProjectReferenceResponse]) -> ProjectedReference:
        report, steps = None, []
        for message in messages:
            if message.HasField("report"):
                report = message.report
            else:
                steps.append(Gain._from(message.step))
        if report is None:
            raise PlantdError("UNAVAILABLE", "the server closed the stream")
        return cls(
            report.feasible,
            report.constraint_violation,
            report.constraint_violation_step,
            report.constraint,
            report.unexplained_force,
            report.unexplained_force_step,
            report.unexplained_force_coordinate,
            report.unexplained_acceleration,
            report.unexplained_step,
            report.unexplained_coordinate,
            matrix(report.u),
            report.deviation,
            report.deviation_step,
            report.deviation_coordinate,
            Trajectory._from(report.trajectory),
            steps,
        )
