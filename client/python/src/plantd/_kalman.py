"""Kalman filters: the server computes their gains, the filters run here."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from plantd.v1 import control_service_pb2

from ._arrays import Array, Vector, array, complexes, matrix, vector, weight
from ._calls import Calls
from ._check import build
from ._errors import PlantdError, translated
from ._linearize import Linearization
from ._requests import Stepping, constraints, measurement, noise, point, settings, trajectory
from ._rotation import compose, difference
from ._states import State, Trajectory, state_vector

if TYPE_CHECKING:
    from typing_extensions import Unpack


class _Filter:
    """What both filters share: an estimate, as a difference from the reference."""

    #: Estimate of x - x_reference.
    dx: Array

    def _start(self, state: State | npt.ArrayLike | None, reference: Array, rotations: Any) -> None:
        if state is None:
            self.dx = np.zeros_like(reference)
        else:
            self.dx = difference(reference, state_vector(state), rotations)


@dataclass(eq=False)
class Kalman(_Filter):
    """A steady-state Kalman filter about an equilibrium.

    It starts at the equilibrium; ``reset`` starts it elsewhere. Each step, ``correct(y)`` takes a
    measurement in and ``predict(u)`` goes one step on; ``x`` is the estimate in between.
    """

    #: Filter gain, states by outputs.
    gain: Array
    #: Covariances of the error before and after the correction.
    predicted_covariance: Array
    filtered_covariance: Array
    #: Eigenvalues of the error's map, the largest first.
    error_modes: npt.NDArray[np.complex128]
    #: Relative residual of the Riccati equation.
    residual: float
    #: Reciprocal condition of the innovation's covariance.
    reciprocal_condition: float
    #: The linear map of the filter.
    linearization: Linearization
    #: dy = output_x dx + output_u du.
    output_x: Array
    output_u: Array
    #: Where it holds.
    x_reference: Array
    u_reference: Array
    y_reference: Array
    #: Names of the outputs.
    outputs: list[str]
    #: Indices in x at which rotation vectors of ball joints begin.
    rotations: tuple[int, ...]

    def __post_init__(self) -> None:
        self.reset()

    def reset(self, state: State | npt.ArrayLike | None = None) -> None:
        """Starts anew from an estimate of the state; from the equilibrium if none is given."""
        self._start(state, self.x_reference, self.rotations)

    @property
    def x(self) -> Array:
        """The estimate of x = (q, p, v); gains take it in place of a state."""
        return compose(self.x_reference, self.dx, self.rotations)

    def correct(self, y: Vector, u: Vector | None = None) -> Array:
        """Takes in the measurement of the present state; returns the estimate.

        ``u`` is the input in it, of use only where the outputs depend on it.
        """
        innovation = vector(y, "y") - self.y_reference - self.output_x @ self.dx
        if u is not None:
            innovation = innovation - self.output_u @ (vector(u, "u") - self.u_reference)
        self.dx = self.dx + self.gain @ innovation
        return self.x

    def predict(self, u: Vector) -> Array:
        """Goes one step on with the input ``u``; returns the estimate."""
        du = vector(u, "u") - self.u_reference
        self.dx = self.linearization.a @ self.dx + self.linearization.b @ du
        return self.x

    @classmethod
    def _from(cls, m: control_service_pb2.SolveKalmanResponse) -> Kalman:
        return cls(
            matrix(m.gain),
            matrix(m.predicted_covariance),
            matrix(m.filtered_covariance),
            complexes(m.error_modes),
            m.residual,
            m.reciprocal_condition,
            Linearization._from(m.linearization),
            matrix(m.output_x),
            matrix(m.output_u),
            array(m.x_reference),
            array(m.u_reference),
            array(m.y_reference),
            list(m.outputs),
            tuple(m.rotations),
        )


@dataclass(frozen=True, eq=False)
class KalmanStep:
    """The filter at one state of a trajectory."""

    step: int
    gain: Array
    #: Map to the next state; None in the last one.
    linearization: Linearization | None
    x_reference: Array
    #: Empty in the last one.
    u_reference: Array
    y_reference: Array
    #: Covariances of the error before and after the correction; None if they were not asked for.
    predicted_covariance: Array | None
    filtered_covariance: Array | None
    #: Reciprocal condition of the innovation's covariance.
    reciprocal_condition: float
    rotations: tuple[int, ...]

    @classmethod
    def _from(cls, m: control_service_pb2.SolveTrajectoryKalmanResponse) -> KalmanStep:
        def part(name: str, convert: Any) -> Any:
            return convert(getattr(m, name)) if m.HasField(name) else None

        return cls(
            m.step,
            matrix(m.gain),
            part("linearization", Linearization._from),
            array(m.x_reference),
            array(m.u_reference),
            array(m.y_reference),
            part("predicted_covariance", matrix),
            part("filtered_covariance", matrix),
            m.reciprocal_condition,
            tuple(m.rotations),
        )


class TrajectoryKalman(_Filter):
    """A time-varying Kalman filter along a trajectory.

    It starts at the trajectory's first state; ``correct(y)`` takes a measurement of the present state
    in and ``predict(u)`` goes one step on.
    """

    def __init__(self, steps: Sequence[KalmanStep], output_x: Array, output_u: Array):
        #: The filter at each state.
        self.steps = list(steps)
        #: dy = output_x dx + output_u du.
        self.output_x, self.output_u = output_x, output_u
        self.reset()

    @classmethod
    def _from(
        cls, messages: Iterable[control_service_pb2.SolveTrajectoryKalmanResponse]
    ) -> TrajectoryKalman:
        all = list(messages)
        if not all:
            raise PlantdError("UNAVAILABLE", "the server closed the stream")
        outputs = matrix(all[0].output_x), matrix(all[0].output_u)
        return cls([KalmanStep._from(message) for message in all], *outputs)

    def reset(self, state: State | npt.ArrayLike | None = None) -> None:
        """Starts anew from an estimate of the first state."""
        #: Index of the present state in ``steps``.
        self.k = 0
        first = self.steps[0]
        self._start(state, first.x_reference, first.rotations)

    @property
    def x(self) -> Array:
        """The estimate of x = (q, p, v)."""
        here = self.steps[self.k]
        return compose(here.x_reference, self.dx, here.rotations)

    def correct(self, y: Vector, u: Vector | None = None) -> Array:
        """Takes in the measurement of the present state; returns the estimate."""
        here = self.steps[self.k]
        innovation = vector(y, "y") - here.y_reference - self.output_x @ self.dx
        if u is not None and here.u_reference.size:
            innovation = innovation - self.output_u @ (vector(u, "u") - here.u_reference)
        self.dx = self.dx + here.gain @ innovation
        return self.x

    def predict(self, u: Vector) -> Array:
        """Goes one step on with the input ``u``; raises `IndexError` at the end of the trajectory."""
        here = self.steps[self.k]
        if here.linearization is None:
            raise IndexError(f"the trajectory ends at step {here.step}")
        du = vector(u, "u") - here.u_reference
        self.dx = here.linearization.a @ self.dx + here.linearization.b @ du
        self.k += 1
        return self.x


class KalmanCalls(Calls):
    """Calls that solve for filters."""

    def solve_kalman(
        self,
        model: str = "",
        *,
        outputs: Sequence[str] | npt.ArrayLike = (),
        output_u: npt.ArrayLike | None = None,
        measurement_noise: npt.ArrayLike,
        process_noise: npt.ArrayLike | None = None,
        input_noise: npt.ArrayLike | None = None,
        at: str | None = None,
        state: State | None = None,
        u: Vector = (),
        plant: str = "",
        full: bool = False,
        **stepping: Unpack[Stepping],
    ) -> Kalman:
        """Steady-state Kalman filter about an equilibrium, ready to ``correct`` and ``predict``.

        ``outputs`` are what is measured: names of entries of x such as ``theta`` or ``p(theta)``,
        velocities such as ``v(theta)`` at a point at rest, or a matrix. Noises are covariances per step,
        diagonals or matrices: of the measurement, of the state and of the inputs.
        """
        request = build(
            control_service_pb2.SolveKalmanRequest,
            model=model,
            settings=settings(**stepping),
            point=point(at, state, u, plant),
            measurement=measurement(outputs, output_u),
            noise=noise(process_noise, input_noise, measurement_noise),
            constraints=constraints(full),
        )
        return Kalman._from(self._call(self.control.SolveKalman, request))

    def solve_trajectory_kalman(
        self,
        model: str,
        initial: State | Trajectory,
        u: npt.ArrayLike | None = None,
        *,
        outputs: Sequence[str] | npt.ArrayLike = (),
        output_u: npt.ArrayLike | None = None,
        measurement_noise: npt.ArrayLike,
        process_noise: npt.ArrayLike | None = None,
        input_noise: npt.ArrayLike | None = None,
        initial_covariance: npt.ArrayLike,
        covariances: bool = False,
        full: bool = False,
        **stepping: Unpack[Stepping],
    ) -> TrajectoryKalman:
        """Time-varying Kalman filter along a trajectory, as `solve_kalman`; ``initial_covariance`` is
        that of the error in the initial state. ``covariances`` also returns those of each step."""
        request = build(
            control_service_pb2.SolveTrajectoryKalmanRequest,
            model=model,
            settings=settings(**stepping),
            trajectory=trajectory(initial, u),
            measurement=measurement(outputs, output_u),
            noise=noise(process_noise, input_noise, measurement_noise),
            initial_covariance=weight(initial_covariance, "initial_covariance"),
            constraints=constraints(full),
            covariances=covariances,
        )
        with translated():
            return TrajectoryKalman._from(self.control.SolveTrajectoryKalman(request))
