"""Many plants at once: one step of each in one call, and many simulations as arrays."""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Union, cast

import numpy as np
import numpy.typing as npt

from plantd.v1 import control_service_pb2, plant_service_pb2

from ._arrays import Array, Vector, matrix_message, numbers
from ._calls import Calls
from ._channels import Outputs
from ._check import build, shown
from ._errors import PlantdError, StepError, from_failure
from ._plants import Plant
from ._progress import progress_bar
from ._requests import Stepping, initial_state, settings
from ._states import State

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from ._handle import PlantHandle

#: A plant by its id, its description or its handle.
PlantLike = Union[str, Plant, "PlantHandle"]


#: Limits of a server that a call with fewer cases keeps.
_LIMITS_OF_A_CALL = ("rollout_cases", "message_bytes", "message_parts")


def plant_id(plant: Any, argument: str) -> str:
    """The id of a plant."""
    id = plant if isinstance(plant, str) else getattr(plant, "id", None)
    if not isinstance(id, str):
        raise TypeError(f"`{argument}` is {shown(plant)}; a plant or its id is needed")
    return id


@dataclass(frozen=True, eq=False)
class Stepped:
    """What became of many plants that were to be stepped, in their order.

    ``x``, ``q``, ``p``, ``velocity`` have a row for each plant; they need plants of one size.
    """

    #: States: after the step, or where a step failed, as before.
    states: list[State]
    #: Errors by the index of the plant.
    errors: dict[int, PlantdError]
    #: What output channels deliver; None for a plant without any.
    outputs: list[Outputs | None]

    @property
    def x(self) -> Array:
        """States x = (q, p, v)."""
        return np.array([state.x for state in self.states])

    @property
    def q(self) -> Array:
        """Configurations."""
        return np.array([state.q for state in self.states])

    @property
    def p(self) -> Array:
        """Momenta."""
        return np.array([state.p for state in self.states])

    @property
    def velocity(self) -> Array:
        """Velocities of all coordinates."""
        return np.array([state.velocity for state in self.states])

    @property
    def time(self) -> Array:
        """Plant times, s."""
        return np.array([state.time for state in self.states])

    def raise_errors(self) -> None:
        """Raises the error of the first plant that was not stepped, if there is one."""
        for index in sorted(self.errors):
            raise self.errors[index]


@dataclass(frozen=True, eq=False)
class Rollout:
    """The end of one simulation of a batch."""

    #: Index of the case.
    case: int
    #: Why it ended early, or was not begun; ``None`` if it came to its end.
    error: PlantdError | None
    _states: list[State]

    @property
    def states(self) -> list[State]:
        """The states that were asked for, up to the last good one. Raises ``error`` where it left none: the
        case's initial state was refused, or no step of it succeeded."""
        if self.error and not self._states:
            raise self.error
        return self._states

    @property
    def failure(self) -> str:
        """Why it ended early; empty if it did not."""
        return f"{self.error.reason}: {self.error.message}" if self.error else ""

    @classmethod
    def _from(cls, m: control_service_pb2.RolloutResponse) -> Rollout:
        error = from_failure(m.failure, PlantdError) if m.HasField("failure") else None
        return cls(m.case_index, error, [State._from(state) for state in m.states])


@dataclass(frozen=True, eq=False)
class Rollouts:
    """Many simulations as arrays: case by case, and in each the sampled steps.

    Rows of a case that ended early are NaN from there on, and its error is in ``errors``.
    """

    #: Plant time of each sample, s.
    time: Array
    #: Step of each sample.
    steps: npt.NDArray[np.int64]
    #: [case][sample][coordinate]; dynamic ones first.
    q: Array
    #: [case][sample][dynamic coordinate].
    p: Array
    #: [case][sample][prescribed coordinate].
    v: Array
    #: [case][sample][coordinate].
    velocity: Array
    #: Errors by the index of the case.
    errors: dict[int, PlantdError]

    @property
    def x(self) -> Array:
        """States x = (q, p, v): [case][sample][entry]."""
        return np.concatenate((self.q, self.p, self.v), axis=2)

    def __len__(self) -> int:
        return int(self.q.shape[0])

    def raise_errors(self) -> None:
        """Raises the error of the first case that did not come to its end, if there is one."""
        for index in sorted(self.errors):
            raise self.errors[index]


class BatchCalls(Calls):
    """Calls for many plants and many simulations."""

    def step_many(
        self,
        plants: Sequence[PlantLike],
        u: npt.ArrayLike | Sequence[Vector] | None = None,
        *,
        steps: int = 1,
    ) -> Stepped:
        """Steps many plants in one call, in parallel on the server.

        ``u`` has a row for each plant, or is one input for all of them; without it there are no input
        forces, and prescribed coordinates stay where they are. Plants of several models take a list
        of vectors. A plant that cannot be stepped does not disturb the others: see ``errors``. Unknown
        plants and inputs that do not fit are refused before any plant is stepped.
        """
        if isinstance(plants, str) or not isinstance(plants, Iterable):
            raise TypeError(f"`plants` is {shown(plants)}; a list of plants is needed")
        ids = [plant_id(plant, f"plants[{i}]") for i, plant in enumerate(plants)]
        if not ids:
            raise ValueError("`plants` is empty; at least one plant is needed")
        request = build(
            plant_service_pb2.StepManyRequest, ids=ids, u=_inputs(u, len(ids)), steps=steps
        )
        answer = self._call(self.plants.StepMany, request)
        errors = {
            i: from_failure(plant.failure, StepError)
            for i, plant in enumerate(answer.plants)
            if plant.HasField("failure")
        }
        return Stepped(
            [State._from(plant.state) for plant in answer.plants],
            errors,
            [
                Outputs._from(plant.outputs) if plant.HasField("outputs") else None
                for plant in answer.plants
            ],
        )

    def rollout(
        self,
        model: str,
        u: npt.ArrayLike | None = None,
        *,
        steps: int = 0,
        at: str | None = None,
        q: npt.ArrayLike | None = None,
        velocity: npt.ArrayLike | None = None,
        p: npt.ArrayLike | None = None,
        every: int = 1,
        progress: bool | None = None,
        **stepping: Unpack[Stepping],
    ) -> Rollouts:
        """Simulates a model many times in parallel, and gives the states as arrays.

        ``u`` is [case][step][entry], or [step][entry] for all cases; its last row holds for ``steps``
        more. Cases begin at ``q``, [case][coordinate] or one for all, with ``velocity`` or momentum
        ``p`` of that shape, at the operating point ``at``, or where the scene says. A state is kept
        after each ``every``-th step. ``progress`` shows a bar; by default on a terminal.
        """
        inputs = None if u is None else numbers(u, "u")
        if inputs is not None and inputs.ndim not in (2, 3):
            raise ValueError(
                f"`u` has the shape {inputs.shape}; [case][step][entry] or [step][entry] is needed"
            )
        if every < 1:
            raise ValueError(f"`every` is {every}; at least 1 is needed")
        starts = {
            name: None if given is None else numbers(given, name)
            for name, given in [("q", q), ("velocity", velocity), ("p", p)]
        }
        count = _count(inputs, starts)
        cases = []
        for k in range(count):
            here = {
                name: None if rows is None else (rows[k] if rows.ndim > 1 else rows)
                for name, rows in starts.items()
            }
            rows = None if inputs is None else (inputs[k] if inputs.ndim == 3 else inputs)
            cases.append(
                build(
                    control_service_pb2.RolloutCase,
                    initial=initial_state(at, here["q"], here["velocity"], None, here["p"], None),
                    u=None if rows is None else matrix_message(rows, "u"),
                    hold=steps,
                )
            )
        length = (0 if inputs is None else inputs.shape[-2]) + steps
        if length < every:
            raise ValueError(f"{length} steps are asked for, and a state after each {every}-th")
        return _gathered(
            self.rollout_cases(model, cases, every=every, **stepping), count, length // every, every, progress
        )

    def rollout_cases(
        self,
        model: str,
        cases: Iterable[control_service_pb2.RolloutCase],
        *,
        every: int = 0,
        **stepping: Unpack[Stepping],
    ) -> Iterator[Rollout]:
        """Simulations of several lengths and kinds of start; answers come in the order in which they end.

        A case that cannot be started or stepped does not disturb the others: its ``error`` says why.
        ``every`` of 0 keeps only the last state.
        """
        request = build(
            control_service_pb2.RolloutRequest,
            model=model,
            settings=settings(**stepping),
            cases=list(cases),
            every=every,
        )
        return map(Rollout._from, self._rollout(request))

    def _rollout(
        self, request: control_service_pb2.RolloutRequest
    ) -> Iterator[control_service_pb2.RolloutResponse]:
        """Answers to a request, which is asked for now; in parts, one after the other, where the server has limits
        that it exceeds."""

        def itself(m: control_service_pb2.RolloutResponse) -> control_service_pb2.RolloutResponse:
            return m

        answers = self._messages(self.control.Rollout, request, itself)

        def whole_or_halves() -> Iterator[control_service_pb2.RolloutResponse]:
            try:
                first = next(answers, None)
            except PlantdError as error:
                count = len(request.cases)
                if count < 2 or error.metadata.get("limit") not in _LIMITS_OF_A_CALL:
                    raise
            else:
                if first is not None:
                    yield first
                    yield from answers
                return
            for start, end in [(0, count // 2), (count // 2, count)]:
                half = control_service_pb2.RolloutRequest()
                half.CopyFrom(request)
                del half.cases[end:]
                del half.cases[:start]
                for answer in self._rollout(half):
                    shift_cases(answer, start)
                    yield answer

        return whole_or_halves()


def shift_cases(answer: control_service_pb2.RolloutResponse, by: int) -> None:
    """Counts the cases of an answer from another one on."""

    def shift(failure: Any) -> None:
        failure.message = re.sub(r"\bcases\[(\d+)\]", lambda m: f"cases[{int(m[1]) + by}]", failure.message)

    if not answer.HasField("table"):
        answer.case_index += by
        if answer.HasField("failure"):
            shift(answer.failure)
        return
    answer.table.case_indices[:] = [case + by for case in answer.table.case_indices]
    for failed in answer.table.failures:
        failed.case_index += by
        shift(failed.failure)


def _inputs(u: npt.ArrayLike | Sequence[Vector] | None, count: int) -> Array:
    """Inputs of all plants, one after the other."""
    if u is None:
        return np.zeros(0)
    try:
        rows = numbers(cast(npt.ArrayLike, u), "u")
    except TypeError:
        # Plants of several models have inputs of several lengths.
        if not isinstance(u, Sequence) or isinstance(u, str):
            raise
        parts = [np.atleast_1d(numbers(part, f"u[{i}]")) for i, part in enumerate(u)]
        if len(parts) != count:
            raise ValueError(f"`u` has {len(parts)} inputs; there are {count} plants") from None
        return np.concatenate(parts)
    if rows.ndim > 2:
        raise ValueError(f"`u` has the shape {rows.shape}; one row for each plant is needed")
    if rows.ndim < 2:
        return np.tile(np.atleast_1d(rows), count)
    if rows.shape[0] != count:
        raise ValueError(f"`u` has {rows.shape[0]} rows; there are {count} plants")
    return rows.ravel()


def _count(inputs: Array | None, starts: dict[str, Array | None]) -> int:
    """Number of the cases; all that has a row for each must have as many."""
    counts = {} if inputs is None or inputs.ndim < 3 else {"u": inputs.shape[0]}
    for name, rows in starts.items():
        if rows is not None and rows.ndim > 2:
            raise ValueError(f"`{name}` has the shape {rows.shape}; one row for each case is needed")
        if rows is not None and rows.ndim == 2:
            counts[name] = rows.shape[0]
    if len(set(counts.values())) > 1:
        said = ", ".join(f"`{name}` {count}" for name, count in counts.items())
        raise ValueError(f"the numbers of cases differ: {said}")
    return next(iter(counts.values()), 1)


def _gathered(
    ends: Iterator[Rollout], count: int, samples: int, every: int, progress: bool | None
) -> Rollouts:
    found: dict[int, Rollout] = {}
    with progress_bar("rollout", count, progress) as bar:
        for end in ends:
            found[end.case] = end
            bar.update(1)
    errors = {case: end.error for case, end in sorted(found.items()) if end.error is not None}
    example = next((end._states[0] for end in found.values() if end._states), None)
    if example is None:
        raise errors[min(errors)]
    arrays: dict[str, Array] = {
        name: np.full((count, samples, getattr(example, name).size), np.nan)
        for name in ("q", "p", "v", "velocity")
    }
    time = np.full(samples, np.nan)
    for case, end in found.items():
        for row, state in enumerate(end._states):
            time[row] = state.time
            for name, rows in arrays.items():
                rows[case, row] = getattr(state, name)
    steps = every * np.arange(1, samples + 1)
    return Rollouts(time, steps, errors=errors, **arrays)
