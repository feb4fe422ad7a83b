"""A plant in one's hands: what can be done with it, without naming it each time."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterable, Sequence
from typing import TYPE_CHECKING, Any, TypeVar, cast

import numpy.typing as npt

from ._arrays import Vector
from ._channels import ChannelCalls
from ._drive import DriveCalls
from ._errors import PlantdError
from ._feedback import FeedbackCalls
from ._gains import Regulator
from ._linearize import Analysis, Contraction, Linearization, SecondOrder
from ._mechanics import EquationOfMotion, Kinematics
from ._plants import Diagnostics, Plant, PlantCalls
from ._realtime import RealtimeCalls
from ._recordings import RecordingCalls
from ._requests import Stepping
from ._states import Energy, State

if TYPE_CHECKING:
    from typing_extensions import Concatenate, ParamSpec, Unpack

    from plantd.v1 import channel_service_pb2, common_pb2, model_service_pb2

    from ._client import Client

    _P = ParamSpec("_P")

_R = TypeVar("_R")

#: How long a plant is kept that nobody uses and nobody has deleted.
_EXPIRES_SECONDS = 3600.0


def _by_id(
    call: Callable[Concatenate[Any, str, _P], _R],
) -> Callable[Concatenate[PlantHandle, _P], _R]:
    """A call of the client that begins with the id of a plant, as a method of the plant."""

    @functools.wraps(call)
    def method(self: PlantHandle, *args: _P.args, **kwargs: _P.kwargs) -> _R:
        return call(self.client, self.id, *args, **kwargs)

    return cast("Callable[Concatenate[PlantHandle, _P], _R]", method)


class PlantHandle:
    """A plant that belongs to a script: in a ``with`` statement it is deleted at the end of the block.

        with client.plant("cart-pole", q=[0, 3]) as plant:
            law = plant.lqr(at="upright", q=[1, 100, 1, 1], r=[0.01])
            with plant.drive() as driver:
                state = driver.step(law(driver.plant.state))

    `keep` lets it live on. Methods are those of the client that begin with the id of a plant.
    """

    def __init__(self, client: Client, plant: Plant, *, keep: bool = False):
        #: The client of the server to which it was moved last, at first the one that made it.
        self.client = client
        self._root = client
        #: Its id.
        self.id = plant.id
        #: Model it was made from.
        self.model_name = plant.model
        self._created = plant
        self._kept = keep

    # What belongs to its life.

    def __enter__(self) -> PlantHandle:
        return self

    def __exit__(self, kind: type[BaseException] | None, *rest: object) -> None:
        if self._kept:
            return
        try:
            self.delete()
        except PlantdError as error:
            # It is gone already, or what went wrong in the block says more.
            if kind is None and error.code != "NOT_FOUND":
                raise

    def keep(self) -> None:
        """Lets it live on after the block, for as long as somebody uses it: ``expires`` goes on to hold."""
        self._kept = True

    delete = _by_id(PlantCalls.delete_plant)

    def __repr__(self) -> str:
        return f"<plant {self.id} of {self.model_name}>"

    # What it is, and where.

    @property
    def info(self) -> Plant:
        """Its description, as it is now."""
        return self.client.get_plant(self.id)

    @property
    def model(self) -> model_service_pb2.Model:
        """Its model: coordinates, inputs, constraints, operating points."""
        return self.client.get_model(self.model_name)

    @property
    def state(self) -> State:
        """Its state, as it is now."""
        return self.info.state

    @property
    def energy(self) -> Energy:
        """Its energy, as it is now."""
        energy = self.info.energy
        assert energy is not None
        return energy

    @property
    def time_step(self) -> float:
        """Its time step, s."""
        return self.info.time_step

    @property
    def server(self) -> str:
        """Name of the server that has it now."""
        return self.info.server

    @property
    def address(self) -> str:
        """Where that server is reached; empty for a server in this process."""
        return self.info.address

    def move(self, to: Client | str, *, any_build: bool = False) -> Plant:
        """Moves it to another server, as `Client.move`; its calls go there from then on."""
        # A connection to an address is kept and closed by the client that made the plant.
        there = cast("Client", self._root._at(to)) if isinstance(to, str) else to
        moved = self.client.move(self.id, there, any_build=any_build)
        self.client = there
        return moved

    def diagnose(self) -> Diagnostics:
        """What can be said of its present state."""
        return self.client.diagnose(self.id)

    # Motion.

    step = _by_id(PlantCalls.step)
    reset = _by_id(PlantCalls.reset)
    snapshot = _by_id(PlantCalls.snapshot)
    restore = _by_id(PlantCalls.restore)
    watch = _by_id(PlantCalls.watch)
    set_parameters = _by_id(PlantCalls.set_parameters)
    open_link = _by_id(PlantCalls.open_link)
    drive = _by_id(DriveCalls.drive)
    hold = _by_id(DriveCalls.hold)
    run = _by_id(RealtimeCalls.run)
    pause = _by_id(RealtimeCalls.pause)
    set_safety = _by_id(RealtimeCalls.set_safety)
    timing = _by_id(RealtimeCalls.timing)
    watch_events = _by_id(RealtimeCalls.watch_events)
    start_recording = _by_id(RecordingCalls.start_recording)

    # Feedback, sensors, actuators and faults.

    set_feedback = _by_id(FeedbackCalls.set_feedback)
    clear_feedback = _by_id(FeedbackCalls.clear_feedback)
    watch_gains = _by_id(FeedbackCalls.watch_gains)
    follow_gains = _by_id(FeedbackCalls.follow_gains)
    set_channels = _by_id(ChannelCalls.set_channels)
    get_channels = _by_id(ChannelCalls.get_channels)
    clear_fault = _by_id(ChannelCalls.clear_fault)
    list_faults = _by_id(ChannelCalls.list_faults)

    def inject_fault(self, **fault: Any) -> channel_service_pb2.FaultInfo:
        """Lets something go wrong, as `Client.inject_fault`."""
        return self.client.inject_fault(self.id, **fault)

    # The map and the mechanism, where the plant is, with the parameters that it has.

    def linearize(self) -> Linearization:
        """Linearizes its map at its present state, with the input last applied."""
        return self.client.linearize(plant=self.id)

    def linearize_second_order(self) -> SecondOrder:
        """All second derivatives of its map there."""
        return self.client.linearize_second_order(plant=self.id)

    def contract_second_order(
        self, weights: Vector = (), *, multiplier_weights: Vector = ()
    ) -> Contraction:
        """The Hessian of a weighted sum of the outputs of its map there."""
        return self.client.contract_second_order(
            weights=weights, multiplier_weights=multiplier_weights, plant=self.id
        )

    def analyze(
        self,
        *,
        outputs: Sequence[str] | npt.ArrayLike = (),
        frequencies: Vector = (),
        full: bool = False,
    ) -> Analysis:
        """Controllability, observability, modes and frequency response of its map there."""
        return self.client.analyze(
            outputs=outputs, frequencies=frequencies, full=full, plant=self.id
        )

    def kinematics(
        self,
        *,
        q: Vector = (),
        v: Vector = (),
        frames: Sequence[str] = (),
        points: Iterable[tuple[str, Vector]] = (),
        jacobians: bool = False,
    ) -> Kinematics:
        """Poses, velocities and Jacobians at its present state, or at ``q`` with ``v``."""
        return self.client.kinematics(
            q=q, v=v, frames=frames, points=points, jacobians=jacobians, plant=self.id
        )

    def dynamics(
        self,
        *,
        q: Vector = (),
        v: Vector = (),
        inputs: Vector = (),
        acceleration: Vector = (),
        prescribed_acceleration: Vector = (),
        forward: bool = False,
    ) -> EquationOfMotion:
        """Mass matrix, bias, forces and energy at its present state, or at ``q`` with ``v``."""
        return self.client.dynamics(
            q=q,
            v=v,
            inputs=inputs,
            acceleration=acceleration,
            prescribed_acceleration=prescribed_acceleration,
            forward=forward,
            plant=self.id,
        )

    def lqr(
        self,
        *,
        q: npt.ArrayLike,
        r: npt.ArrayLike,
        s: npt.ArrayLike | None = None,
        projected_momentum: bool = False,
        at: str | None = None,
        state: State | None = None,
        u: Vector = (),
        full: bool = False,
    ) -> Regulator:
        """A regulator of its model, with its settings, about an equilibrium: the operating point ``at``, or
        ``state`` with ``u``. Changed parameters do not count here; `set_feedback` takes them."""
        return self.client.solve_lqr(
            self.model_name,
            q=q,
            r=r,
            s=s,
            projected_momentum=projected_momentum,
            at=at,
            state=state,
            u=u,
            full=full,
            **self._stepping(),
        )

    def _stepping(self) -> Stepping:
        """How it is stepped, as keywords of calls that look at its model."""
        plant = self.info
        return {
            "dt": plant.time_step,
            "paper": plant.paper,
            "order": plant.order,
            "substeps": plant.substeps,
            "halvings": plant.halvings,
            "precision": plant.precision,
            "singular_below": plant.singular_below,
            "newton_iterations": plant.newton_iterations,
        }


class HandleCalls(PlantCalls):
    """The call that makes a plant for a script."""

    def plant(
        self,
        model: str,
        *,
        id: str = "",
        at: str | None = None,
        q: Vector | None = None,
        velocity: Vector | None = None,
        v: Vector | None = None,
        p: Vector | None = None,
        initial: common_pb2.InitialState | None = None,
        open_link: bool = False,
        tolerance: float = 0.0,
        expires: float | None = None,
        keep: bool = False,
        **stepping: Unpack[Stepping],
    ) -> PlantHandle:
        """Creates a plant for a ``with`` statement, which deletes it at the end of the block.

        Arguments are those of `create_plant`. Where the script is killed before the end, the server
        deletes the plant when nobody has used it for ``expires`` seconds, by default an hour. ``keep`` lets
        it live on, by default without such a bound.
        """
        if expires is None:
            expires = 0.0 if keep else _EXPIRES_SECONDS
        plant = self.create_plant(
            model,
            id=id,
            at=at,
            q=q,
            velocity=velocity,
            v=v,
            p=p,
            initial=initial,
            open_link=open_link,
            tolerance=tolerance,
            expires=expires,
            **stepping,
        )
        return PlantHandle(self, plant, keep=keep)  # type: ignore[arg-type]
