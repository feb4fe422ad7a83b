"""Linearizations of the map, and what follows from them."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import numpy.typing as npt

from plantd.v1 import common_pb2, control_service_pb2

from ._arrays import Array, Vector, array, matrix, tensor, vector
from ._calls import Calls
from ._check import build, instead, texts
from ._extras import needed
from ._origin import Origin, null_space
from ._plots import plot_analysis
from ._requests import Stepping, constraints, point, settings, split_outputs, trajectory
from ._states import State, StepReport, Trajectory

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from ._client import Client


#: Velocity up to which a state is at rest, m/s or rad/s.
_REST = 1e-12


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
    #: Model or plant whose map it is, where `Client.linearize` made it.
    origin: Origin | None = field(default=None, repr=False)

    def matrices(
        self, *, velocity: bool = False, reduced: bool = False
    ) -> tuple[Array, Array, Array, list[str]]:
        """The map in other states: (a, b, e, names) with x = e z and z[k+1] = a z[k] + b u[k].

        With ``velocity`` the states are (q, q̇) instead of (q, p, v): p = M(q) q̇, for models without
        constraints, at rest. ``reduced`` keeps the directions in which a model with constraints can
        move, at an equilibrium: displacements that satisfy them, and momenta apart from what constraints
        take up; without constraints all of them.
        """
        origin = self._origin()
        names = origin.state_names
        nd, n = origin.dynamic, len(origin.model.coordinates)
        assert self.state is not None
        equation = origin.equation(self.state) if velocity or reduced else None
        e, left = np.eye(len(names)), np.eye(len(names))
        if equation is not None and equation.constraint_jacobian.shape[0]:
            if velocity:
                raise ValueError(
                    "`velocity` is for models without constraints: with them a velocity does not give the "
                    "momentum; leave it away"
                )
            if reduced:
                jacobian = equation.constraint_jacobian
                e_q, e_p = null_space(jacobian), null_space(jacobian[:, :nd])
                e = _blocks(e_q, e_p, np.eye(n - nd))
                left = e.T
                names = [f"z{i}" for i in range(e.shape[1])]
        elif velocity and equation is not None:
            if np.any(np.abs(self.state.velocity) > _REST):
                raise ValueError("`velocity` is for states at rest; this one moves")
            mass = equation.mass_matrix[:nd, :nd]
            e = _blocks(np.eye(n), mass, np.eye(n - nd))
            left = _blocks(np.eye(n), np.linalg.inv(mass), np.eye(n - nd))
            coordinates = names[:n]
            names = coordinates + [f"v({name})" for name in coordinates]
        return left @ self.a @ e, left @ self.b, e, names

    def ss(
        self,
        outputs: Sequence[str] | None = None,
        *,
        velocity: bool = False,
        reduced: bool = False,
    ) -> Any:
        """The map as ``control.StateSpace``, with names and time step, in differences from its point.

        ``outputs`` are names of entries of x; all of its states, or with ``reduced`` all of x, if not
        given. ``velocity`` and ``reduced`` are as in `matrices`. Needs the package ``control``.
        """
        control = needed("control", "control")
        a, b, c, d, states, names = self._system(outputs, velocity, reduced)
        origin = self._origin()
        return control.ss(
            a, b, c, d, origin.time_step, states=states, inputs=origin.input_names, outputs=names
        )

    def to_scipy(
        self,
        outputs: Sequence[str] | None = None,
        *,
        velocity: bool = False,
        reduced: bool = False,
    ) -> Any:
        """The map as ``scipy.signal.StateSpace`` in discrete time, as `ss`. Needs the package ``scipy``."""
        signal = needed("scipy.signal", "control")
        a, b, c, d, _, _ = self._system(outputs, velocity, reduced)
        return signal.StateSpace(a, b, c, d, dt=self._origin().time_step)

    def _system(
        self, outputs: Sequence[str] | None, velocity: bool, reduced: bool
    ) -> tuple[Array, Array, Array, Array, list[str], list[str]]:
        a, b, e, states = self.matrices(velocity=velocity, reduced=reduced)
        entries = self._origin().state_names
        if outputs is None and (velocity or states == entries):
            names, c = states, np.eye(len(states))
        else:
            names = entries if outputs is None else texts("outputs", outputs)
            c = np.zeros((len(names), len(states)))
            for row, name in enumerate(names):
                if name in entries:
                    c[row] = e[entries.index(name)]
                elif name in states:
                    c[row, states.index(name)] = 1.0
                else:
                    raise ValueError(f"there is no state entry `{name}`{instead(name, [*entries, *states])}")
        return a, b, c, np.zeros((len(names), b.shape[1])), states, names

    def _origin(self) -> Origin:
        if self.origin is None:
            raise ValueError(
                "this linearization does not say of which model it is; `client.linearize` makes one that does"
            )
        return self.origin

    @classmethod
    def _from(cls, m: common_pb2.Linearization, **extra: Any) -> Linearization:
        c, d = matrix(m.multipliers_x), matrix(m.multipliers_u)
        return cls(m.step, matrix(m.a), matrix(m.b), c, d, **extra)


def _blocks(*blocks: npt.NDArray[Any]) -> Array:
    """A block diagonal matrix."""
    out = np.zeros((sum(b.shape[0] for b in blocks), sum(b.shape[1] for b in blocks)))
    row = column = 0
    for block in blocks:
        rows, columns = block.shape
        out[row : row + rows, column : column + columns] = block
        row, column = row + rows, column + columns
    return out


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
    #: Model or plant whose map it is.
    origin: Origin | None = field(default=None, repr=False)

    def plot(self) -> Any:
        """A figure of the poles and, where frequencies were given, the frequency responses. Needs
        ``matplotlib``."""
        return plot_analysis(self)

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
            origin=Origin(cast("Client", self), model, plant, stepping.get("dt", 0.0)),
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
            self.control.LinearizeTrajectory,
            request,
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
        analysis = Analysis._from(self._call(self.control.Analyze, request))
        origin = Origin(cast("Client", self), model, plant, stepping.get("dt", 0.0))
        return replace(analysis, origin=origin)
