"""States and motions of plants."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property

import numpy as np
import numpy.typing as npt

from plantd.v1 import common_pb2

from ._arrays import Array, array, matrix, matrix_message, numbers, vector


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
    #: Velocity of the prescribed coordinates alone, over the last step, nk.
    v: Array
    #: Constraint impulses of the last step; divide by the time step for forces.
    multipliers: Array
    #: Model of the plant whose state it is; empty where that is not known.
    model: str = ""
    #: Time step of that plant, s; 0 where it is not known.
    time_step: float = 0.0
    #: Velocity of all coordinates, nd + nk, m/s or rad/s: of the momentum projected onto the constraints,
    #: and `v`. Empty where the state is not that of a plant.
    velocity: Array = field(default_factory=lambda: np.zeros(0))

    @cached_property
    def x(self) -> Array:
        """The state vector (q, p, v) of linearizations and gains."""
        return np.concatenate((self.q, self.p, self.v))

    @classmethod
    def _from(cls, m: common_pb2.State, model: str = "", time_step: float = 0.0) -> State:
        return cls(
            m.step,
            m.time_s,
            array(m.q),
            array(m.p),
            array(m.v),
            array(m.multipliers),
            model,
            time_step,
            array(m.velocity),
        )

    def _message(self) -> common_pb2.State:
        return common_pb2.State(q=self.q, p=self.p, v=self.v)


@dataclass(frozen=True, eq=False)
class Trajectory:
    """A motion, given by where it starts and what drives it."""

    #: Initial state; None means the scene's initial configuration, at rest.
    initial: State | None
    #: Row k is u[k]; n rows of ni + nk columns.
    u: Array

    @classmethod
    def _from(cls, m: common_pb2.Trajectory) -> Trajectory:
        return cls(State._from(m.initial) if m.HasField("initial") else None, matrix(m.u))

    def _message(self) -> common_pb2.Trajectory:
        initial = None if self.initial is None else self.initial._message()
        return common_pb2.Trajectory(initial=initial, u=matrix_message(self.u, "u"))


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
    #: Estimate of the reciprocal condition of the Newton matrix, at most 1.
    reciprocal_condition: float
    #: The same for the constraints, without redundant ones; 1 without constraints.
    constraint_reciprocal_condition: float = 1.0
    #: Constraint equations that follow from others.
    redundant_constraints: int = 0
    #: Steps of the method in the time step; the counts above are those of all of them.
    steps: int = 1
    #: How often the time step was halved: 0 unless it could not be solved in longer steps.
    halvings: int = 0

    @classmethod
    def _from(cls, m: common_pb2.StepReport) -> StepReport:
        return cls(
            m.iterations,
            m.factorizations,
            m.residual,
            m.constraint_residual,
            m.reciprocal_condition,
            m.constraint_reciprocal_condition,
            m.redundant_constraints,
            m.steps,
            m.halvings,
        )


def state_vector(state: State | npt.ArrayLike) -> Array:
    """x of a state, or a vector that is one."""
    return state.x if isinstance(state, State) else vector(numbers(state, "state"), "state")
