"""States, linearizations and gains as numpy arrays, and the messages that they come in."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Union

import numpy as np
import numpy.typing as npt

from plantd.v1 import common_pb2, control_service_pb2, plant_service_pb2

Array = npt.NDArray[np.float64]
Vector = Union[Sequence[float], npt.NDArray[Any], float]


@dataclass(frozen=True, eq=False)
class State:
    """A state of a plant; nd dynamic and nk prescribed coordinates, dynamic ones first."""

    #: Steps since the plant was created or reset.
    step: int
    #: Plant time, s.
    time: float
    #: Configuration, nd + nk, m or rad.
    q: Array
    #: Discrete momentum of the dynamic coordinates, nd.
    p: Array
    #: Velocity of the prescribed coordinates over the last step, nk.
    v: Array
    #: Constraint impulses of the last step; divide by the time step for forces.
    multipliers: Array

    @cached_property
    def x(self) -> Array:
        """The state vector (q, p, v) of linearizations and gains."""
        return np.concatenate((self.q, self.p, self.v))

    @classmethod
    def _from(cls, m: common_pb2.State) -> State:
        return cls(m.step, m.time_s, *map(array, (m.q, m.p, m.v, m.multipliers)))

    def _message(self) -> common_pb2.State:
        return common_pb2.State(q=self.q, p=self.p, v=self.v)


@dataclass(frozen=True)
class Energy:
    """Energy of a state, J."""

    kinetic: float
    potential: float

    @property
    def total(self) -> float:
        """Kinetic and potential energy."""
        return self.kinetic + self.potential

    @classmethod
    def _from(cls, m: common_pb2.Energy) -> Energy:
        return cls(m.kinetic_j, m.potential_j)


@dataclass(frozen=True)
class StepReport:
    """What the solver did in one step."""

    #: Residual evaluations, each followed by one correction.
    iterations: int
    #: Factorizations of the Newton matrix.
    factorizations: int
    #: Final residual in units of its own round-off.
    residual: float
    #: Largest constraint violation in units of its own round-off.
    constraint_residual: float
    #: Smallest pivot of the Newton matrix relative to its largest entry.
    reciprocal_condition: float

    @classmethod
    def _from(cls, m: common_pb2.StepReport) -> StepReport:
        return cls(
            m.iterations, m.factorizations, m.residual, m.constraint_residual, m.reciprocal_condition
        )


@dataclass(frozen=True, eq=False)
class Linearization:
    """dx[k+1] = a dx[k] + b du[k], dlambda = c dx[k] + d du[k]."""

    #: Step index of x[k].
    step: int
    a: Array
    b: Array
    #: Derivatives of the constraint multipliers; without rows where there are no constraints.
    c: Array
    d: Array
    #: State and input at which the map was linearized, where the call says so.
    state: State | None = None
    u: Array | None = None
    #: f(x, u) and the rank of (b, a b, a² b, ...), where the call says so.
    next: State | None = None
    controllability_rank: int | None = None

    @classmethod
    def _from(cls, m: common_pb2.Linearization, **extra: Any) -> Linearization:
        c, d = matrix(m.multipliers_x), matrix(m.multipliers_u)
        return cls(m.step, matrix(m.a), matrix(m.b), c, d, **extra)


@dataclass(frozen=True, eq=False)
class Gain:
    """The feedback law u = u_reference - k (x - x_reference); call it with a state."""

    #: Step index from which it holds.
    step: int
    k: Array
    x_reference: Array
    u_reference: Array

    def __call__(self, state: State) -> Array:
        return self.u_reference - self.k @ (state.x - self.x_reference)

    @classmethod
    def _from(cls, m: common_pb2.Gain) -> Gain:
        return cls(m.step, matrix(m.k), array(m.x_reference), array(m.u_reference))


@dataclass(frozen=True, eq=False)
class Regulator(Gain):
    """The gain of an infinite-horizon regulator, with its certificate."""

    #: Cost to go: 1/2 dx' value dx.
    value: Array
    #: Largest modulus of the closed loop's eigenvalues.
    spectral_radius: float
    #: Relative residual of the Riccati equation.
    residual: float

    @classmethod
    def _from_answer(cls, m: control_service_pb2.SolveLqrResponse) -> Regulator:
        gain = Gain._from(m.gain)
        return cls(
            gain.step,
            gain.k,
            gain.x_reference,
            gain.u_reference,
            matrix(m.value),
            m.spectral_radius,
            m.residual,
        )


@dataclass(frozen=True, eq=False)
class Plant:
    """A plant as the server described it."""

    id: str
    #: Model it was made from.
    model: str
    #: Time step, s.
    time_step: float
    state: State
    #: Who holds the lease: empty, ``step``, ``drive`` or ``link``.
    driver: str
    #: The shared-memory link is open.
    link_open: bool
    #: Energy of the state, where the call says so.
    energy: Energy | None = None

    @classmethod
    def _from(cls, m: plant_service_pb2.PlantInfo, energy: Energy | None = None) -> Plant:
        state = State._from(m.state)
        return cls(m.id, m.model, m.settings.time_step_s, state, m.driver, m.link_open, energy)


@dataclass(frozen=True, eq=False)
class Watched:
    """One message of a watch; what was not asked for is None."""

    step: int
    state: State | None
    report: StepReport | None
    energy: Energy | None
    linearization: Linearization | None
    gain: Gain | None
    #: Why there is no linearization or gain although it was asked for; empty if there is.
    failure: str
    #: Messages that this watcher has lost so far.
    dropped: int

    @classmethod
    def _from(cls, m: plant_service_pb2.WatchResponse) -> Watched:
        def part(name: str, kind: Any) -> Any:
            return kind._from(getattr(m, name)) if m.HasField(name) else None

        return cls(
            m.step,
            part("state", State),
            part("report", StepReport),
            part("energy", Energy),
            part("linearization", Linearization),
            part("gain", Gain),
            f"{m.failure.reason}: {m.failure.message}" if m.HasField("failure") else "",
            m.dropped,
        )


@dataclass(frozen=True, eq=False)
class Rollout:
    """The end of one simulation of a batch."""

    #: Index of the case.
    case: int
    states: list[State]
    #: Why it ended early; empty if it did not.
    failure: str

    @classmethod
    def _from(cls, m: control_service_pb2.RolloutResponse) -> Rollout:
        failure = f"{m.failure.reason}: {m.failure.message}" if m.HasField("failure") else ""
        return cls(m.case_index, [State._from(state) for state in m.states], failure)


def array(values: Iterable[float]) -> Array:
    """A repeated field as an array."""
    return np.array(values, dtype=np.float64)


def vector(values: Vector) -> Array:
    """What a caller gave as a vector; a number stands for a vector of one."""
    out = np.atleast_1d(np.asarray(values, dtype=np.float64))
    if out.ndim != 1:
        raise ValueError(f"a vector is needed, not an array of shape {out.shape}")
    return out


def matrix(m: common_pb2.Matrix) -> Array:
    """A matrix message as an array."""
    return array(m.data).reshape(m.rows, m.cols)


def matrix_message(values: npt.ArrayLike) -> common_pb2.Matrix:
    """An array as a matrix message; one row per step where it is a sequence of inputs."""
    a = np.asarray(values, dtype=np.float64)
    if a.ndim != 2:
        raise ValueError(f"a matrix is needed, not an array of shape {a.shape}")
    return common_pb2.Matrix(rows=a.shape[0], cols=a.shape[1], data=a.ravel())


def weight(values: npt.ArrayLike) -> common_pb2.Weight:
    """A weight: a vector is a diagonal, a matrix is itself."""
    a = np.asarray(values, dtype=np.float64)
    if a.ndim == 2:
        return common_pb2.Weight(full=matrix_message(a))
    return common_pb2.Weight(diagonal=common_pb2.Diagonal(values=vector(a)))
