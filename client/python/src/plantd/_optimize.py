"""Trajectory optimisation, and references from outside."""

from __future__ import annotations

import os
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy.typing as npt
from google.protobuf import json_format

from plantd.v1 import control_service_pb2
from plantd.v1 import control_service_pb2 as pb

from ._arrays import Array, failure_text, matrix, matrix_message, weight
from ._calls import Calls
from ._check import build, one_of, shown, texts
from ._errors import PlantdError, translated
from ._feedback import GainSchedule
from ._gains import Gain
from ._progress import progress_bar
from ._requests import (
    Bounds,
    Stepping,
    bounds,
    constraints,
    settings,
    stage_weights,
    trajectory_weights,
    weights,
)
from ._states import Trajectory

if TYPE_CHECKING:
    from typing_extensions import Unpack

Method = Literal["steepest", "quasi-newton", "newton"]


def method_number(name: str | None) -> Any:
    """The number of a method."""
    if name is None:
        return pb.DESCENT_METHOD_UNSPECIFIED
    one_of("method", name, get_args(Method))
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

    def __init__(self, call: Any, progress: bool | None = None):
        self._call = call
        self._progress = progress
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
        with progress_bar("search", None, self._progress) as bar:
            for step in self:
                bar.set_postfix_str(f"cost {step.cost:.6g}")
                bar.update(1)
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


class OptimizeCalls(Calls):
    """Calls that search for trajectories."""

    def optimize_trajectory(
        self,
        model: str,
        guess: Trajectory | Optimum | None = None,
        *,
        x: npt.ArrayLike,
        u: npt.ArrayLike | None = None,
        q: npt.ArrayLike | None = None,
        r: npt.ArrayLike | None = None,
        q_final: npt.ArrayLike | None = None,
        s: npt.ArrayLike | None = None,
        projected_momentum: bool = False,
        stages: Iterable[Mapping[str, npt.ArrayLike]] = (),
        resume: Checkpoint | None = None,
        state_bounds: Bounds | None = None,
        input_bounds: Bounds | None = None,
        final_state: Bounds | None = None,
        model_limits: bool = False,
        free_initial: bool | Sequence[str] = False,
        initial_weight: npt.ArrayLike | None = None,
        method: Method = "newton",
        first_method: Method | None = None,
        first_iterations: int = 0,
        max_iterations: int = 0,
        tolerance: float = 0.0,
        alpha: float = 0.0,
        beta: float = 0.0,
        max_backtracks: int = 0,
        near_last_step: bool = False,
        projection: tuple[npt.ArrayLike, npt.ArrayLike] | None = None,
        bound_tolerance: float = 0.0,
        checkpoint_every: int = 0,
        progress: bool | None = None,
        **stepping: Unpack[Stepping],
    ) -> Search:
        """Finds a trajectory that costs least: an iterator over the iterations, with ``result``.

        The cost is that of the distance from the desired states ``x`` (n + 1 rows, which need not be a
        motion) and inputs ``u`` (n rows; zero if not given), with weights as in
        `solve_trajectory_lqr`. ``guess`` is where the search begins: a trajectory, or a former result;
        or ``resume`` is where it left off. Bounds are by the name of an entry, ``{"force": (-5, 5)}``;
        ``final_state={"theta": math.pi}`` fixes an entry of the last state; ``model_limits`` adds the limits
        that the model has of coordinates and inputs. ``free_initial`` frees all
        entries of the initial state, or those that are named; ``initial_weight`` weighs their
        distance from the guess. ``projection`` is the pair of weights (q, r) of a regulator that
        projects onto motions of the plant, in place of the law of the descent. The other options are
        those of `OptimizationOptions` in the contract; 0 means its default. ``progress`` shows a bar while
        ``result`` is waited for; by default on a terminal.
        """
        if (guess is None) == (resume is None):
            raise ValueError("give one of `guess` and `resume`")
        start = guess.trajectory if isinstance(guess, Optimum) else guess
        if start is not None and not isinstance(start, Trajectory):
            raise TypeError(
                f"`guess` is {shown(guess)}; a `plantd.Trajectory` or `plantd.Optimum` is needed"
            )
        free = None
        if free_initial is not False:
            free = build(
                control_service_pb2.FreeInitialState,
                entries=() if free_initial is True else texts("free_initial", free_initial),
                weight=None if initial_weight is None else weight(initial_weight, "initial_weight"),
            )
        request = build(
            control_service_pb2.OptimizeTrajectoryRequest,
            model=model,
            settings=settings(**stepping),
            cost=build(
                control_service_pb2.TrajectoryCost,
                x=matrix_message(x, "x"),
                u=None if u is None else matrix_message(u, "u"),
                weights=trajectory_weights(q, r, q_final, s, projected_momentum),
                stages=stage_weights(stages),
            ),
            guess=None if start is None else start._message(),
            resume=None if resume is None else resume.message,
            bounds=build(
                control_service_pb2.TrajectoryBounds,
                state=bounds(state_bounds),
                input=bounds(input_bounds),
                final_state=bounds(final_state),
                model_limits=model_limits,
            ),
            free_initial=free,
            options=build(
                control_service_pb2.OptimizationOptions,
                method=method_number(method),
                first_method=method_number(first_method),
                first_iterations=first_iterations,
                max_iterations=max_iterations,
                tolerance=tolerance,
                alpha=alpha,
                beta=beta,
                max_backtracks=max_backtracks,
                near_last_step=near_last_step,
                projection=None if projection is None else weights(*projection),
                bound_tolerance=bound_tolerance,
                checkpoint_every=checkpoint_every,
            ),
        )
        return Search(self.control.OptimizeTrajectory(request), progress)

    def project_reference(
        self,
        model: str,
        reference: npt.ArrayLike,
        u: npt.ArrayLike | None = None,
        *,
        q: npt.ArrayLike | None = None,
        r: npt.ArrayLike | None = None,
        q_final: npt.ArrayLike | None = None,
        s: npt.ArrayLike | None = None,
        projected_momentum: bool = False,
        projection: tuple[npt.ArrayLike, npt.ArrayLike] | None = None,
        tolerance: float = 0.0,
        strict: bool = False,
        full: bool = False,
        **stepping: Unpack[Stepping],
    ) -> ProjectedReference:
        """Compares configurations from any planner with the motions of the plant, and finds a motion
        that follows them, with its regulator if the weights ``q`` and ``r`` are given.

        Row k of ``reference`` is the configuration at step k. ``u`` are the planned inputs; forces
        that fit best if not given. ``strict`` refuses a reference that is no motion, within
        ``tolerance``, with reason ``INFEASIBLE_REFERENCE``.
        """
        has_weights = q is not None and r is not None
        request = build(
            control_service_pb2.ProjectReferenceRequest,
            model=model,
            settings=settings(**stepping),
            q=matrix_message(reference, "reference"),
            u=None if u is None else matrix_message(u, "u"),
            projection=None if projection is None else weights(*projection),
            weights=trajectory_weights(q, r, q_final, s, projected_momentum) if has_weights else None,
            constraints=constraints(full),
            tolerance=tolerance,
            strict=strict,
        )
        with translated():
            return ProjectedReference._from(self.control.ProjectReference(request))
