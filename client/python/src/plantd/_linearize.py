"""Linearizations of the map, and what follows from them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from plantd.v1 import common_pb2, control_service_pb2

from ._arrays import Array, Vector, array, matrix, tensor, vector
from ._calls import Calls
from ._check import build
from ._requests import Stepping, constraints, point, settings, split_outputs, trajectory
from ._states import State, StepReport, Trajectory

if TYPE_CHECKING:
    from typing_extensions import Unpack


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
    #: What the solver did, and how well conditioned the equations are, where the call says so.
    report: StepReport | None = None

    @classmethod
    def _from(cls, m: common_pb2.Linearization, **extra: Any) -> Linearization:
        c, d = matrix(m.multipliers_x), matrix(m.multipliers_u)
        return cls(m.step, matrix(m.a), matrix(m.b), c, d, **extra)


@dataclass(frozen=True, eq=False)
class SecondOrder:
    """Second derivatives of the map at a point, as arrays [output][first][second].

    Outputs are the entries of x[k+1], or the constraint multipliers.
    """

    xx: Array
    xu: Array
    uu: Array
    multipliers_xx: Array
    multipliers_xu: Array
    multipliers_uu: Array
    #: First derivatives.
    linearization: Linearization

    @classmethod
    def _from(cls, m: control_service_pb2.LinearizeSecondOrderResponse) -> SecondOrder:
        t = m.tensors
        blocks = (t.xx, t.xu, t.uu, t.multipliers_xx, t.multipliers_xu, t.multipliers_uu)
        xx, xu, uu, multipliers_xx, multipliers_xu, multipliers_uu = map(tensor, blocks)
        return cls(
            xx, xu, uu, multipliers_xx, multipliers_xu, multipliers_uu, _linearized(m)
        )


@dataclass(frozen=True, eq=False)
class Contraction:
    """The Hessian of a weighted sum of the map's outputs."""

    xx: Array
    xu: Array
    uu: Array
    #: First derivatives.
    linearization: Linearization

    @classmethod
    def _from(cls, m: control_service_pb2.LinearizeSecondOrderResponse) -> Contraction:
        c = m.contraction
        return cls(matrix(c.xx), matrix(c.xu), matrix(c.uu), _linearized(m))


def _linearized(m: control_service_pb2.LinearizeSecondOrderResponse) -> Linearization:
    return Linearization._from(
        m.linearization,
        state=State._from(m.state),
        u=array(m.u),
        next=State._from(m.next),
        report=StepReport._from(m.report),
    )


@dataclass(frozen=True)
class Mode:
    """An eigenvalue of the map, read as a mode of continuous time."""

    eigenvalue: complex
    modulus: float
    #: Natural frequency, Hz; infinite for the eigenvalue 0.
    frequency: float
    #: 1 decays without oscillation, 0 oscillates without decay, negative grows.
    damping_ratio: float
    #: Time to decay to 1/e, s; negative when it grows, infinite when it does neither.
    time_constant: float

    @classmethod
    def _from(cls, m: control_service_pb2.Mode) -> Mode:
        return cls(
            complex(m.real, m.imaginary),
            m.modulus,
            m.natural_frequency_hz,
            m.damping_ratio,
            m.time_constant_s,
        )


@dataclass(frozen=True, eq=False)
class Analysis:
    """What can be said of the linearized map."""

    #: Independent directions of the state.
    order: int
    controllability_rank: int
    observability_rank: int
    #: Largest modulus of the modes.
    spectral_radius: float
    #: Modes, the slowest to decay first.
    modes: list[Mode]
    #: Names of the outputs.
    outputs: list[str]
    #: Frequencies of the response, Hz.
    frequencies: Array
    #: Complex response, [frequency][output][input].
    response: npt.NDArray[np.complex128]
    #: State and input at which the map was linearized.
    state: State
    u: Array

    @classmethod
    def _from(cls, m: control_service_pb2.AnalyzeResponse) -> Analysis:
        responses = [
            matrix(r.magnitude) * np.exp(1j * matrix(r.phase_rad)) for r in m.responses
        ]
        return cls(
            m.order,
            m.controllability_rank,
            m.observability_rank,
            m.spectral_radius,
            [Mode._from(mode) for mode in m.modes],
            list(m.outputs),
            array(r.frequency_hz for r in m.responses),
            np.array(responses, dtype=np.complex128),
            State._from(m.state),
            array(m.u),
        )


class LinearizeCalls(Calls):
    """Calls that differentiate the map."""

    def linearize(
        self,
        model: str = "",
        *,
        at: str | None = None,
        state: State | None = None,
        u: Vector = (),
        plant: str = "",
        **stepping: Unpack[Stepping],
    ) -> Linearization:
        """Linearizes the map of a model at the operating point ``at``, by default ``initial``, or at
        ``state`` with input ``u``; or that of a ``plant``, where it is. Two of them raise `ValueError`.
        """
        request = build(
            control_service_pb2.LinearizeRequest,
            model=model, settings=settings(**stepping), point=point(at, state, u, plant)
        )
        answer = self._call(self.control.Linearize, request)
        return Linearization._from(
            answer.linearization,
            state=State._from(answer.state),
            u=np.array(answer.u),
            next=State._from(answer.next),
            controllability_rank=answer.controllability_rank,
            report=StepReport._from(answer.report),
        )

    def linearize_trajectory(
        self,
        model: str,
        initial: State | Trajectory,
        u: npt.ArrayLike | None = None,
        **stepping: Unpack[Stepping],
    ) -> Iterator[Linearization]:
        """Linearizes the map at every step of the trajectory that ``u`` drives from ``initial``."""
        request = build(
            control_service_pb2.LinearizeTrajectoryRequest,
            model=model, settings=settings(**stepping), trajectory=trajectory(initial, u)
        )
        return self._messages(
            self.control.LinearizeTrajectory(request),
            lambda m: Linearization._from(
                m.linearization, state=State._from(m.state), report=StepReport._from(m.report)
            ),
        )

    def linearize_second_order(
        self,
        model: str = "",
        *,
        at: str | None = None,
        state: State | None = None,
        u: Vector = (),
        plant: str = "",
        **stepping: Unpack[Stepping],
    ) -> SecondOrder:
        """All second derivatives of the map at a point given as in `linearize`."""
        request = build(
            control_service_pb2.LinearizeSecondOrderRequest,
            model=model, settings=settings(**stepping), point=point(at, state, u, plant)
        )
        return SecondOrder._from(self._call(self.control.LinearizeSecondOrder, request))

    def contract_second_order(
        self,
        model: str = "",
        weights: Vector = (),
        *,
        multiplier_weights: Vector = (),
        at: str | None = None,
        state: State | None = None,
        u: Vector = (),
        plant: str = "",
        **stepping: Unpack[Stepping],
    ) -> Contraction:
        """The Hessian of ``weights @ x[k+1] + multiplier_weights @ multipliers`` at such a point.

        The tensors are not formed: it works where they would be too large.
        """
        request = build(
            control_service_pb2.LinearizeSecondOrderRequest,
            model=model,
            settings=settings(**stepping),
            point=point(at, state, u, plant),
            weights=build(
                common_pb2.ContractionWeights,
                x=vector(weights, "weights"), multipliers=vector(multiplier_weights, "multiplier_weights")
            ),
        )
        return Contraction._from(self._call(self.control.LinearizeSecondOrder, request))

    def analyze(
        self,
        model: str = "",
        *,
        outputs: Sequence[str] | npt.ArrayLike = (),
        frequencies: Vector = (),
        at: str | None = None,
        state: State | None = None,
        u: Vector = (),
        plant: str = "",
        full: bool = False,
        **stepping: Unpack[Stepping],
    ) -> Analysis:
        """Controllability, observability, modes and frequency response at such a point.

        ``outputs`` are names of entries of x such as ``theta`` or ``p(theta)``, or a matrix; all of x
        if not given. ``frequencies`` in Hz. ``full`` looks at the full state of a constrained model
        instead of at its manifold.
        """
        request = build(
            control_service_pb2.AnalyzeRequest,
            model=model,
            settings=settings(**stepping),
            point=point(at, state, u, plant),
            constraints=constraints(full),
            frequencies_hz=vector(frequencies, "frequencies"),
        )
        names, rows = split_outputs(outputs)
        request.outputs.extend(names)
        if rows is not None:
            request.output_x.CopyFrom(rows)
        return Analysis._from(self._call(self.control.Analyze, request))
