"""The mechanism in continuous time: kinematics and the equation of motion."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

from plantd.v1 import channel_service_pb2, control_service_pb2

from ._arrays import Array, Vector, array, matrix, optional_matrix, tensor, vector
from ._calls import Calls
from ._check import build, shown, texts
from ._states import Energy


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


def mechanical_state(
    model: str, plant: str, at: str, q: Vector, v: Vector
) -> control_service_pb2.MechanicalState:
    return build(
        control_service_pb2.MechanicalState,
        model=model, plant=plant, operating_point=at, q=vector(q, "q"), v=vector(v, "v")
    )


def _pairs(points: Iterable[tuple[str, Vector]]) -> Iterable[tuple[str, Vector]]:
    for i, point in enumerate(points):
        if isinstance(point, str) or not isinstance(point, Sequence) or len(point) != 2:
            raise TypeError(
                f"`points[{i}]` is {shown(point)}; a pair of a frame and a position is needed"
            )
        yield point[0], point[1]


class MechanicsCalls(Calls):
    """Calls that evaluate the mechanism at a state."""

    def evaluate_dynamics(
        self,
        model: str,
        q: Vector = (),
        v: Vector = (),
        inputs: Vector = (),
        prescribed_acceleration: Vector = (),
        *,
        at: str = "",
        order: int = 0,
    ) -> Dynamics:
        """Accelerations and constraint forces of continuous time, with derivatives up to ``order``.

        What is not given is that of the operating point ``at``, at rest.
        """
        request = build(
            control_service_pb2.EvaluateDynamicsRequest,
            model=model,
            operating_point=at,
            q=vector(q, "q"),
            v=vector(v, "v"),
            inputs=vector(inputs, "inputs"),
            prescribed_acceleration=vector(prescribed_acceleration, "prescribed_acceleration"),
            order=order,
        )
        return Dynamics._from(self._call(self.control.EvaluateDynamics, request))

    def kinematics(
        self,
        model: str = "",
        *,
        q: Vector = (),
        v: Vector = (),
        frames: Sequence[str] = (),
        points: Iterable[tuple[str, Vector]] = (),
        jacobians: bool = False,
        at: str = "",
        plant: str = "",
    ) -> Kinematics:
        """Poses, velocities and Jacobians of frames and points, and the centre of mass.

        At the configuration ``q`` with the velocity ``v``, by default zero, or at the operating point
        ``at`` of a model; of a ``plant`` where neither is given at its present state. It stays there.
        ``frames`` are names, all if neither frames nor points are given; ``points`` are pairs of a frame
        and a position in its axes, m.
        """
        request = build(
            control_service_pb2.KinematicsRequest,
            state=mechanical_state(model, plant, at, q, v),
            frames=texts("frames", frames),
            points=[
                build(channel_service_pb2.FramePoint, frame=frame, at=vector(position, "position"))
                for frame, position in _pairs(points)
            ],
            jacobians=jacobians,
        )
        return Kinematics._from(self._call(self.control.Kinematics, request))

    def dynamics(
        self,
        model: str = "",
        *,
        q: Vector = (),
        v: Vector = (),
        inputs: Vector = (),
        acceleration: Vector = (),
        prescribed_acceleration: Vector = (),
        forward: bool = False,
        at: str = "",
        plant: str = "",
    ) -> EquationOfMotion:
        """Mass matrix, bias, forces and energy at such a state.

        With ``acceleration`` of the dynamic coordinates the forces that it takes, with ``forward`` the
        accelerations that follow from ``inputs``: by default those of the operating point, or those last
        given to the plant. Prescribed coordinates have the acceleration zero if it is not given.
        """
        request = build(
            control_service_pb2.DynamicsRequest,
            state=mechanical_state(model, plant, at, q, v),
            inputs=vector(inputs, "inputs"),
            acceleration=vector(acceleration, "acceleration"),
            prescribed_acceleration=vector(prescribed_acceleration, "prescribed_acceleration"),
            forward=forward,
        )
        return EquationOfMotion._from(self._call(self.control.Dynamics, request))
