"""States, linearizations and gains as numpy arrays, and the messages that they come in."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Union

import numpy as np
import numpy.typing as npt

from plantd.v1 import (
    channel_service_pb2,
    common_pb2,
    control_service_pb2,
    drawing_pb2,
    model_service_pb2,
    plant_service_pb2,
    realtime_pb2,
    recording_service_pb2,
)

from ._errors import PlantdError, from_failure
from ._rotation import difference

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
        arrays = map(array, (m.q, m.p, m.v, m.multipliers))
        velocity = array(m.velocity)
        return cls(m.step, m.time_s, *arrays, model=model, time_step=time_step, velocity=velocity)

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
        return common_pb2.Trajectory(initial=initial, u=matrix_message(self.u))


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
        return cls(*map(tensor, blocks), _linearized(m))


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


@dataclass(frozen=True, eq=False)
class Dynamics:
    """Accelerations and constraint forces of continuous time.

    Parameters of the derivatives are (q, v, inputs, prescribed_acceleration), outputs are
    (acceleration, multipliers).
    """

    acceleration: Array
    multipliers: Array
    #: [output][parameter]; None if it was not asked for.
    jacobian: Array | None
    #: [output][first parameter][second parameter]; None if it was not asked for.
    hessian: Array | None

    @classmethod
    def _from(cls, m: control_service_pb2.EvaluateDynamicsResponse) -> Dynamics:
        return cls(
            array(m.acceleration),
            array(m.multipliers),
            optional_matrix(m, "jacobian"),
            tensor(m.hessian) if m.HasField("hessian") else None,
        )


@dataclass(frozen=True, eq=False)
class FrameMotion:
    """Where a frame is and how it moves, in world axes."""

    #: Position of its origin, 3, m.
    position: Array
    #: Unit quaternion (w, x, y, z), its largest component positive.
    orientation: Array
    #: Velocity of its origin, 3, m/s.
    linear_velocity: Array
    #: Angular velocity, 3, rad/s.
    angular_velocity: Array
    #: 6 by nd + nk: linear, then angular velocity is ``jacobian @ v``; None if it was not asked for.
    jacobian: Array | None

    @classmethod
    def _from(cls, m: control_service_pb2.FrameMotion) -> FrameMotion:
        return cls(
            array(m.position),
            array(m.orientation),
            array(m.linear_velocity),
            array(m.angular_velocity),
            optional_matrix(m, "jacobian"),
        )


@dataclass(frozen=True, eq=False)
class PointMotion:
    """Where a point is and how it moves, in world axes."""

    #: 3, m.
    position: Array
    #: 3, m/s.
    velocity: Array
    #: 3 by nd + nk: the velocity is ``jacobian @ v``; None if it was not asked for.
    jacobian: Array | None

    @classmethod
    def _from(cls, m: control_service_pb2.PointMotion) -> PointMotion:
        return cls(array(m.position), array(m.velocity), optional_matrix(m, "jacobian"))


@dataclass(frozen=True, eq=False)
class CenterOfMass:
    """The centre of mass of all bodies that joints carry, in world axes."""

    #: 3, m.
    position: Array
    #: 3, m/s.
    velocity: Array
    #: Mass that moves, kg.
    mass: float
    #: 3 by nd + nk: the velocity is ``jacobian @ v``; None if it was not asked for.
    jacobian: Array | None

    @classmethod
    def _from(cls, m: control_service_pb2.CenterOfMass) -> CenterOfMass:
        jacobian = optional_matrix(m, "jacobian")
        return cls(array(m.position), array(m.velocity), m.mass_kg, jacobian)


@dataclass(frozen=True, eq=False)
class Kinematics:
    """Frames and points of a mechanism at a configuration and a velocity."""

    #: Names of the coordinates, dynamic ones first: the columns of Jacobians.
    coordinates: list[str]
    q: Array
    v: Array
    #: By name, in the order in which they were asked for, or of the scene.
    frames: dict[str, FrameMotion]
    #: In the order in which they were asked for.
    points: list[PointMotion]
    center_of_mass: CenterOfMass

    @classmethod
    def _from(cls, m: control_service_pb2.KinematicsResponse) -> Kinematics:
        return cls(
            list(m.coordinates),
            array(m.q),
            array(m.v),
            {frame.frame: FrameMotion._from(frame) for frame in m.frames},
            [PointMotion._from(point) for point in m.points],
            CenterOfMass._from(m.center_of_mass),
        )


@dataclass(frozen=True, eq=False)
class ForwardDynamics:
    """The accelerations that follow from the inputs."""

    #: Of all coordinates; those of prescribed ones are the given ones.
    acceleration: Array
    #: Constraint forces.
    multipliers: Array

    @classmethod
    def _from(cls, m: control_service_pb2.ForwardDynamics) -> ForwardDynamics:
        return cls(array(m.acceleration), array(m.multipliers))


@dataclass(frozen=True, eq=False)
class InverseDynamics:
    """The forces that an acceleration takes; they do not push against constraints."""

    #: tau, of all coordinates.
    force: Array
    #: Constraint forces.
    multipliers: Array
    #: Second time derivative of the constraints: zero where they allow the acceleration.
    constraint_acceleration: Array

    @classmethod
    def _from(cls, m: control_service_pb2.InverseDynamics) -> InverseDynamics:
        return cls(array(m.force), array(m.multipliers), array(m.constraint_acceleration))


@dataclass(frozen=True, eq=False)
class EquationOfMotion:
    """The terms of ``mass_matrix @ a + bias = passive + input + tau - constraint_jacobian.T @ lambda``.

    A row for each coordinate, dynamic ones first. tau is what nothing in the scene exerts: the forces
    of drives on prescribed coordinates, and on dynamic ones zero unless other accelerations are asked for.
    """

    #: Names of the coordinates.
    coordinates: list[str]
    #: Names of the constraint equations.
    constraints: list[str]
    q: Array
    v: Array
    inputs: Array
    #: Of bodies and armature.
    mass_matrix: Array
    #: Coriolis, centrifugal and gyroscopic forces and gravity; no springs, no dampers.
    bias: Array
    #: The part of ``bias`` that is there at rest.
    gravity: Array
    #: Forces of all elements that follow no input: springs, stops, damping, drag, friction, ...
    passive: Array
    #: Forces of the inputs.
    input: Array
    constraint_jacobian: Array
    energy: Energy
    #: None if it was not asked for.
    forward: ForwardDynamics | None
    #: None if no acceleration was given.
    inverse: InverseDynamics | None

    @classmethod
    def _from(cls, m: control_service_pb2.DynamicsResponse) -> EquationOfMotion:
        return cls(
            list(m.coordinates),
            list(m.constraints),
            array(m.q),
            array(m.v),
            array(m.inputs),
            matrix(m.mass_matrix),
            array(m.bias),
            array(m.gravity),
            array(m.passive),
            array(m.input),
            matrix(m.constraint_jacobian),
            Energy._from(m.energy),
            ForwardDynamics._from(m.forward) if m.HasField("forward") else None,
            InverseDynamics._from(m.inverse) if m.HasField("inverse") else None,
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


@dataclass(frozen=True)
class Recording:
    """A recording of a plant. What is not known of files of an earlier server is empty."""

    name: str
    plant: str
    #: ``active``, ``done`` or ``failed``.
    status: str
    #: Why it has failed.
    failure: str
    #: Steps written.
    steps: int
    #: Steps lost, because the disk did not follow.
    lost: int
    #: Bytes written.
    bytes: int

    @classmethod
    def _from(cls, m: recording_service_pb2.Recording) -> Recording:
        status = recording_service_pb2.RecordingStatus.Name(m.status)
        status = status.removeprefix("RECORDING_STATUS_").lower()
        return cls(m.name, m.plant, status, m.failure, m.steps, m.lost, m.bytes)


@dataclass(frozen=True, eq=False)
class Settled:
    """A configuration on the constraints; of an equilibrium also what holds it."""

    q: Array
    #: Input: forces, then the prescribed positions of ``q``.
    u: Array
    #: Potential energy, J; None if only the constraints were asked for, as all that follows.
    potential: float | None = None
    #: Largest force that remains on a coordinate, N or N m.
    residual: float | None = None
    #: Constraint forces that hold it.
    constraint_forces: Array | None = None
    #: A minimum of the potential energy, held coordinates apart.
    stable: bool | None = None
    #: Smallest eigenvalue of the stiffness on the constraints, N/m or N m/rad.
    smallest_stiffness: float | None = None

    @classmethod
    def _from(cls, m: model_service_pb2.SettleResponse) -> Settled:
        q, u = array(m.q), array(m.u)
        if not m.HasField("equilibrium"):
            return cls(q, u)
        e = m.equilibrium
        forces = array(e.constraint_forces)
        return cls(q, u, e.potential_j, e.residual, forces, e.stable, e.smallest_stiffness)


@dataclass(frozen=True, eq=False)
class Diagnostics:
    """What can be said of a state; vectors in world axes."""

    step: int
    degrees_of_freedom: int
    #: Independent constraint equations.
    constraint_rank: int
    #: Names of constraint equations that follow from the others.
    redundant_constraints: list[str]
    energy: Energy
    #: kg m/s.
    linear_momentum: Array
    #: About the world's origin, kg m²/s.
    angular_momentum: Array
    #: m.
    center_of_mass: Array
    #: kg.
    mass: float
    #: Multipliers of the last step by the time step.
    constraint_forces: Array
    mass_matrix_reciprocal_condition: float
    constraint_reciprocal_condition: float

    @classmethod
    def _from(cls, m: plant_service_pb2.DiagnoseResponse) -> Diagnostics:
        return cls(
            m.step,
            m.degrees_of_freedom,
            m.constraint_rank,
            list(m.redundant_constraints),
            Energy._from(m.energy),
            array(m.linear_momentum),
            array(m.angular_momentum),
            array(m.center_of_mass),
            m.mass_kg,
            array(m.constraint_forces),
            m.mass_matrix_reciprocal_condition,
            m.constraint_reciprocal_condition,
        )


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

    def __call__(self, state: State | npt.ArrayLike) -> Array:
        x = state_vector(state)
        if x.shape != self.x_reference.shape:
            raise ValueError(f"a state has {self.x_reference.size} entries here, not {x.size}")
        if isinstance(state, State):
            self._check_origin(state)
        error = difference(self.x_reference, x, self.rotations)
        return self.u_reference + self.feedforward - self.k @ error

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


@dataclass(frozen=True)
class Feedback:
    """A feedback of a plant."""

    #: What it does in the plant's loop: ``watch``, ``replace``, ``add`` or ``guard``.
    mode: str
    #: Counts the computations of its gains, from 1.
    revision: int
    #: Step of the plant at which a trajectory begins.
    first_step: int
    #: Steps of the trajectory; 0 about an operating point.
    horizon: int
    #: Step at which the watchdog took over, and the entry of x that made it do so.
    tripped_at_step: int | None
    tripped_by: str
    #: Why the gains in force are still those of the parameters before; empty if they are not.
    failure: str

    @classmethod
    def _from(cls, m: plant_service_pb2.FeedbackInfo) -> Feedback:
        modes = {number: name for name, number in FEEDBACK_MODES.items()}
        return cls(
            modes.get(m.mode, "watch"),
            m.revision,
            m.first_step,
            m.horizon,
            m.tripped_at_step if m.HasField("tripped_at_step") else None,
            m.tripped_by,
            failure_text(m),
        )


#: What a feedback does in the plant's own loop, see `Client.set_feedback`.
FEEDBACK_MODES = {
    "watch": plant_service_pb2.FEEDBACK_MODE_WATCH_ONLY,
    "replace": plant_service_pb2.FEEDBACK_MODE_REPLACE,
    "add": plant_service_pb2.FEEDBACK_MODE_ADD,
    "guard": plant_service_pb2.FEEDBACK_MODE_GUARD,
}


@dataclass(frozen=True)
class Accuracy:
    """What was promised when order and substeps were chosen."""

    #: The tolerance asked for, rad or m.
    tolerance: float
    #: Largest error of a coordinate that was found, rad or m.
    error: float
    #: Time steps over which it was found.
    periods: int

    @classmethod
    def _from(cls, m: plant_service_pb2.Accuracy) -> Accuracy:
        return cls(m.tolerance, m.error, m.periods)


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
    #: Feedback of the plant, if it has one.
    feedback: Feedback | None = None
    #: Numbers of the scene that were changed for this plant, by path.
    parameters: Mapping[str, float] = field(default_factory=dict)
    #: Order of accuracy.
    order: int = 2
    #: Steps of the method in a time step.
    substeps: int = 1
    #: How often a time step that cannot be solved is halved.
    halvings: int = 8
    #: Where the solver stops: ``exact`` or ``fast``.
    precision: str = "exact"
    #: What was promised, if order and substeps were chosen by a tolerance.
    accuracy: Accuracy | None = None
    #: The bounds that protect it and which of them holds it, if there are any.
    safety: realtime_pb2.SafetyInfo | None = None
    #: Reciprocal condition below which a step is refused as singular.
    singular_below: float = 1e-14
    #: Newton iterations before a step is given up.
    newton_iterations: int = 40
    #: All forces are put at the start of a step, as the paper does.
    paper: bool = False

    @classmethod
    def _from(cls, m: plant_service_pb2.PlantInfo, energy: Energy | None = None) -> Plant:
        return cls(
            m.id,
            m.model,
            m.settings.time_step_s,
            State._from(m.state, m.model, m.settings.time_step_s),
            m.driver,
            m.link_open,
            energy,
            Feedback._from(m.feedback) if m.HasField("feedback") else None,
            {parameter.path: parameter.value for parameter in m.parameters},
            m.settings.order,
            m.settings.substeps,
            m.settings.halvings,
            plant_service_pb2.Precision.Name(m.settings.precision)[10:].lower(),
            Accuracy._from(m.accuracy) if m.HasField("accuracy") else None,
            m.safety if m.HasField("safety") else None,
            m.settings.singular_below,
            m.settings.max_iterations,
            m.settings.force_split == plant_service_pb2.FORCE_SPLIT_PAPER,
        )


@dataclass(frozen=True, eq=False)
class Outputs:
    """What the output channels of a plant deliver."""

    #: Their numbers, in the order of ``Channels.names``.
    y: Array
    #: Indices of the channels whose numbers stand for lost ones.
    lost: tuple[int, ...] = ()

    @classmethod
    def _from(cls, m: common_pb2.Outputs) -> Outputs:
        return cls(array(m.y), tuple(m.lost))


@dataclass(frozen=True)
class StepTiming:
    """Times of one step of a plant that runs by itself, on the server's monotonic clock."""

    #: When it was due, ns; 0 when nothing was.
    due_ns: int
    #: When it began, ns.
    began_ns: int
    #: When it was over, ns.
    ended_ns: int
    #: Number of the driver's input in force; 0 for none.
    input_sequence: int
    #: Age of that input when the step began, ns.
    input_age_ns: int
    #: No new input had come since the step before.
    input_late: bool
    #: There was no valid input: what the policy says was in force.
    input_safe: bool

    @classmethod
    def _from(cls, m: realtime_pb2.StepTiming) -> StepTiming:
        return cls(
            m.due_ns,
            m.began_ns,
            m.ended_ns,
            m.input_sequence,
            m.input_age_ns,
            m.input_late,
            m.input_safe,
        )


@dataclass(frozen=True)
class Event:
    """Something that happened to a plant besides its steps."""

    #: Number, from 0 for the plant.
    number: int
    #: What: ``started``, ``input_lost``, ``watchdog``, ... as in the contract's ``EventKind``.
    kind: str
    #: Step of the plant.
    step: int
    #: To whom or what.
    subject: str
    #: A quantity, see the contract.
    value: float
    #: When, ns on the server's monotonic clock.
    monotonic_ns: int
    #: When, UTC, ns since 1970.
    utc_ns: int

    @classmethod
    def _from(cls, m: realtime_pb2.WatchEventsResponse) -> Event:
        e = m.event
        kind = realtime_pb2.EventKind.Name(e.kind)[11:].lower()
        return cls(e.number, kind, e.step, e.subject, e.value, e.monotonic_ns, e.utc_ns)


@dataclass(frozen=True, eq=False)
class Channels:
    """The sensors and actuators of a plant."""

    #: Names of the numbers of the outputs.
    names: tuple[str, ...]
    #: What they deliver.
    outputs: Outputs
    #: As declared, with times in whole steps.
    declared: channel_service_pb2.Channels

    @classmethod
    def _from(cls, m: channel_service_pb2.ChannelsInfo, outputs: common_pb2.Outputs) -> Channels:
        return cls(tuple(m.names), Outputs._from(outputs), m.channels)


@dataclass(frozen=True, eq=False)
class Poses:
    """Where everything in a plant's drawing is, in world axes."""

    #: A row for each frame: position of its origin, m; unit quaternion w, x, y, z.
    frames: Array
    #: A row for each point of each line, m.
    points: Array
    #: A row for each arrow: where it acts, m; force or torque, N or N m.
    arrows: Array

    @classmethod
    def _from(cls, m: drawing_pb2.Poses) -> Poses:
        rows = (array(m.frames), 7), (array(m.points), 3), (array(m.arrows), 6)
        return cls(*(numbers.reshape(-1, width) for numbers, width in rows))


@dataclass(frozen=True, eq=False)
class Poles:
    """Poles of the map at a state: motions decay whose pole lies inside the unit circle."""

    #: Of A, on the constraints.
    open_loop: npt.NDArray[np.complex128]
    #: Of A - B K, with the gain of the plant's feedback; empty without one.
    closed_loop: npt.NDArray[np.complex128]

    @classmethod
    def _from(cls, m: plant_service_pb2.Poles) -> Poles:
        both = m.open_loop, m.closed_loop
        return cls(*(np.array([complex(z.real, z.imaginary) for z in of], complex) for of in both))


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
    #: Input last applied.
    u: Array | None = None
    #: What the output channels deliver.
    outputs: Outputs | None = None
    #: Times of the step, of a plant that runs by itself.
    timing: StepTiming | None = None
    #: Where everything in the plant's drawing is.
    poses: Poses | None = None
    #: Poles of the map at the state.
    poles: Poles | None = None
    #: Counts the changes of the plant's parameters: with a new number its drawing may be another.
    generation: int = 0

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
            failure_text(m),
            m.dropped,
            array(m.u) if m.u else None,
            part("outputs", Outputs),
            part("timing", StepTiming),
            part("poses", Poses),
            part("poles", Poles),
            m.generation,
        )


@dataclass(frozen=True, eq=False)
class WatchedGain:
    """One message of a watch of gains."""

    #: The gain; without rows in ``k`` in the message with the final state of a trajectory. None in
    #: a message that only reports a failure.
    gain: Gain | None
    #: Of which computation it is.
    revision: int
    #: Revisions that this watcher never saw.
    dropped: int
    #: Why the gains in force are still those of the parameters before; empty if they are not.
    failure: str
    #: Step of the plant at which the gain's trajectory begins, and its steps; 0 steps about an
    #: operating point.
    first_step: int
    horizon: int

    @classmethod
    def _from(cls, m: plant_service_pb2.WatchGainsResponse) -> WatchedGain:
        return cls(
            Gain._from(m.gain) if m.HasField("gain") else None,
            m.revision,
            m.dropped,
            failure_text(m),
            m.first_step,
            m.horizon,
        )


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


def failure_text(m: Any) -> str:
    """The failure that a message carries; empty if there is none."""
    return f"{m.failure.reason}: {m.failure.message}" if m.HasField("failure") else ""


def state_vector(state: State | npt.ArrayLike) -> Array:
    """x of a state, or a vector that is one."""
    return state.x if isinstance(state, State) else vector(np.asarray(state))


def complexes(values: Iterable[control_service_pb2.Complex]) -> npt.NDArray[np.complex128]:
    """Complex numbers as an array."""
    return np.array([complex(z.real, z.imaginary) for z in values], dtype=np.complex128)


def array(values: Iterable[float]) -> Array:
    """A repeated field as an array."""
    return np.array(values if hasattr(values, "__len__") else list(values), dtype=np.float64)


def vector(values: Vector) -> Array:
    """What a caller gave as a vector; a number stands for a vector of one."""
    out = np.atleast_1d(np.asarray(values, dtype=np.float64))
    if out.ndim != 1:
        raise ValueError(f"a vector is needed, not an array of shape {out.shape}")
    return out


def matrix(m: common_pb2.Matrix) -> Array:
    """A matrix message as an array."""
    return array(m.data).reshape(m.rows, m.cols)


def optional_matrix(m: Any, field: str) -> Array | None:
    """A field as an array; None where it is not set."""
    return matrix(getattr(m, field)) if m.HasField(field) else None


def tensor(m: common_pb2.Tensor) -> Array:
    """A tensor message as an array [output][first][second]."""
    return array(m.data).reshape(m.outputs, m.first, m.second)


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
