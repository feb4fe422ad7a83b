"""Gains: feedback laws about a point or at a step of a trajectory."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import numpy.typing as npt

from plantd.v1 import common_pb2, control_service_pb2

from ._arrays import Array, Vector, array, complexes, matrix, matrix_message, numbers, vector
from ._plots import plot_matrix
from ._rotation import difference
from ._states import State, state_vector


@dataclass(frozen=True, eq=False)
class Gain:
    """The feedback law u = u_reference + feedforward - k (x - x_reference); call it with a state.

    Differences of orientations of ball joints are those of `plantd.difference`. A state of another
    length is refused with `ValueError`, and so is the `State` of a plant of another model or time step
    than those that the gain was computed for; its vector ``state.x`` is taken all the same.
    """

    #: Step index from which it holds.
    step: int
    #: Without rows in the message that ends a trajectory, which holds only the final state.
    k: Array
    x_reference: Array
    u_reference: Array
    #: Indices in x at which rotation vectors of ball joints begin.
    rotations: tuple[int, ...]
    #: Added to the reference's input.
    feedforward: Array
    #: Model that it was computed for; empty where that is not said.
    model: str = field(default="", kw_only=True)
    #: Time step that it was computed for, s; 0 where that is not said.
    time_step: float = field(default=0.0, kw_only=True)

    @classmethod
    def from_matrix(
        cls,
        k: npt.ArrayLike,
        x_reference: State | npt.ArrayLike,
        u_reference: Vector,
        *,
        rotations: Sequence[int] = (),
        model: str = "",
        time_step: float = 0.0,
    ) -> Gain:
        """A law of one's own, ``u = u_reference - k (x - x_reference)``, for `Client.set_feedback` as well."""
        matrix, x = numbers(k, "k"), state_vector(x_reference)
        u = vector(u_reference, "u_reference")
        if matrix.shape != (u.size, x.size):
            raise ValueError(
                f"`k` has the shape {matrix.shape}; {(u.size, x.size)} fits `u_reference` and `x_reference`"
            )
        feedforward = np.zeros_like(u)
        return cls(0, matrix, x, u, tuple(rotations), feedforward, model=model, time_step=time_step)

    def __call__(self, state: State | npt.ArrayLike) -> Array:
        x = state_vector(state)
        if x.shape != self.x_reference.shape:
            raise ValueError(f"a state has {self.x_reference.size} entries here, not {x.size}")
        if isinstance(state, State):
            self._check_origin(state)
        error = difference(self.x_reference, x, self.rotations)
        return self.u_reference + self.feedforward - self.k @ error

    def plot(self, states: Sequence[str] = (), inputs: Sequence[str] = ()) -> Any:
        """A figure of ``k``, a colour for each entry, with the names of the states and inputs where they are given.
        Needs ``matplotlib``."""
        return plot_matrix(self.k, inputs, states, "gain")

    def _check_origin(self, state: State) -> None:
        """Refuses the state of a plant that the gain was not computed for."""
        hint = "give `state.x` to apply it all the same"
        if self.model and state.model and self.model != state.model:
            raise ValueError(
                f"the gain is for model `{self.model}`, the state of a plant of `{state.model}`; {hint}"
            )
        if self.time_step and state.time_step and self.time_step != state.time_step:
            raise ValueError(
                f"the gain is for time step {self.time_step} s, the state of a plant whose time step "
                f"is {state.time_step} s; {hint}"
            )

    @classmethod
    def _from(cls, m: common_pb2.Gain) -> Gain:
        return cls(**cls._fields(m))

    @staticmethod
    def _fields(m: common_pb2.Gain) -> dict[str, Any]:
        reference = array(m.u_reference)
        return {
            "step": m.step,
            "k": matrix(m.k),
            "x_reference": array(m.x_reference),
            "u_reference": reference,
            "rotations": tuple(m.rotations),
            "feedforward": array(m.feedforward) if m.feedforward else np.zeros_like(reference),
            "model": m.model,
            "time_step": m.time_step_s,
        }

    def _message(self) -> common_pb2.Gain:
        return common_pb2.Gain(
            step=self.step,
            k=matrix_message(self.k),
            x_reference=self.x_reference,
            u_reference=self.u_reference,
            rotations=self.rotations,
            feedforward=self.feedforward,
            model=self.model,
            time_step_s=self.time_step,
        )


@dataclass(frozen=True, eq=False)
class TrajectoryGain(Gain):
    """The gain of one step of a trajectory."""

    #: Cost to go, 1/2 dx' value dx + value_linear' dx; None if it was not asked for.
    value: Array | None
    #: None where ``value`` is; empty when it is zero.
    value_linear: Array | None
    #: Reciprocal condition of r + b' value[k+1] b; 0 in the last message.
    reciprocal_condition: float

    @classmethod
    def _from_answer(cls, m: control_service_pb2.SolveTrajectoryLqrResponse) -> TrajectoryGain:
        has_value = m.HasField("value")
        return cls(
            **Gain._fields(m.gain),
            value=matrix(m.value) if has_value else None,
            value_linear=array(m.value_linear) if has_value else None,
            reciprocal_condition=m.reciprocal_condition,
        )


@dataclass(frozen=True, eq=False)
class Regulator(Gain):
    """The gain of an infinite-horizon regulator, with its certificate."""

    #: Cost to go: 1/2 dx' value dx.
    value: Array
    #: Largest modulus of the closed loop's eigenvalues.
    spectral_radius: float
    #: Relative residual of the Riccati equation.
    residual: float
    #: Eigenvalues of the closed loop, the largest first.
    closed_loop: npt.NDArray[np.complex128]
    #: Reciprocal condition of r + b' value b, whose inverse makes the gain.
    reciprocal_condition: float

    @classmethod
    def _from_answer(cls, m: control_service_pb2.SolveLqrResponse) -> Regulator:
        return cls(
            **Gain._fields(m.gain),
            value=matrix(m.value),
            spectral_radius=m.spectral_radius,
            residual=m.residual,
            closed_loop=complexes(m.closed_loop),
            reciprocal_condition=m.reciprocal_condition,
        )
