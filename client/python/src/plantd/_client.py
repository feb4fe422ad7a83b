"""The client: one method per thing that a controller's author wants."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Literal

import grpc
import numpy as np
import numpy.typing as npt

from plantd.v1 import common_pb2, control_service_pb2, model_service_pb2, plant_service_pb2
from plantd.v1.control_service_pb2_grpc import ControlServiceStub
from plantd.v1.model_service_pb2_grpc import ModelServiceStub
from plantd.v1.plant_service_pb2_grpc import PlantServiceStub

from ._drive import Driver
from ._errors import PlantdError, translate, translated
from ._types import (
    Analysis,
    Array,
    Contraction,
    Diagnostics,
    Dynamics,
    Energy,
    Gain,
    Linearization,
    Plant,
    Regulator,
    Rollout,
    SecondOrder,
    Settled,
    State,
    StepReport,
    Vector,
    Watched,
    matrix_message,
    vector,
    weight,
)

#: Where a server listens unless it is told otherwise.
DEFAULT_ADDRESS = "http://127.0.0.1:50051"

Field = Literal["state", "report", "energy", "linearization", "gain"]

#: Answers hold no more than a request asked for; this only stops a runaway peer.
_MAX_RECEIVE_BYTES = 256 << 20

#: Longest wait for a connection.
_CONNECT_SECONDS = 5.0


def connect(address: str = DEFAULT_ADDRESS, *, timeout: float = 60.0) -> Client:
    """Connects to ``http://host:port``, ``host:port`` or ``unix:/path``.

    A server that is just starting is waited for, 5 seconds at most. ``timeout`` in seconds limits
    each call that is not a stream.
    """
    return Client(address, timeout=timeout)


class Client:
    """A connection to a server. Use it in a ``with`` statement, or call ``close``.

    ``models``, ``plants`` and ``control`` are the generated stubs, for what is not wrapped.
    """

    def __init__(self, address: str, *, timeout: float = 60.0):
        options: list[tuple[str, Any]] = [("grpc.max_receive_message_length", _MAX_RECEIVE_BYTES)]
        if address.startswith("unix:"):
            # Without it gRPC sends the path as the authority, which HTTP/2 servers refuse.
            options.append(("grpc.default_authority", "localhost"))
        self._channel = grpc.insecure_channel(address.removeprefix("http://"), options)
        try:
            grpc.channel_ready_future(self._channel).result(timeout=_CONNECT_SECONDS)
        except grpc.FutureTimeoutError:
            self._channel.close()
            raise PlantdError("UNAVAILABLE", f"no server at {address}") from None
        self._timeout = timeout
        self.models = ModelServiceStub(self._channel)
        self.plants = PlantServiceStub(self._channel)
        self.control = ControlServiceStub(self._channel)

    def close(self) -> None:
        """Closes the connection; streams end."""
        self._channel.close()

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    @translate
    def _call(self, method: Any, request: Any) -> Any:
        return method(request, timeout=self._timeout)

    # ---- models ----

    def list_models(self) -> list[model_service_pb2.Model]:
        """All models, built-in ones first."""
        models, token = [], ""
        while True:
            request = model_service_pb2.ListModelsRequest(page_token=token)
            page = self._call(self.models.ListModels, request)
            models.extend(page.models)
            token = page.next_page_token
            if not token:
                return models

    def get_model(self, name: str) -> model_service_pb2.Model:
        """A model: coordinates, inputs, constraints, operating points, scene and plan."""
        request = model_service_pb2.GetModelRequest(name=name)
        return self._call(self.models.GetModel, request).model

    def create_model(self, scene: str, *, name: str = "") -> model_service_pb2.Model:
        """Uploads a scene (TOML or JSON); all its errors are in the error's ``violations``."""
        request = model_service_pb2.CreateModelRequest(scene=scene, name=name)
        return self._call(self.models.CreateModel, request).model

    def validate_scene(self, scene: str) -> list[model_service_pb2.SceneProblem]:
        """All errors of a scene; empty when it is good."""
        request = model_service_pb2.ValidateSceneRequest(scene=scene)
        return list(self._call(self.models.ValidateScene, request).problems)

    def settle(
        self,
        model: str,
        *,
        q: Vector = (),
        guess: Mapping[str, float] | None = None,
        hold: Sequence[str] = (),
        inputs: Mapping[str, float] | None = None,
        constraints_only: bool = False,
    ) -> Settled:
        """Finds a configuration in which the model rests, from a guess.

        The guess is ``q``, or the scene's initial configuration, with the values of ``guess`` put in;
        coordinates in ``hold`` keep their value of it. ``inputs`` are the forces that act.
        ``constraints_only`` finds a configuration close to the guess that satisfies the constraints.
        """
        goal = "SETTLE_GOAL_CONSTRAINTS" if constraints_only else "SETTLE_GOAL_EQUILIBRIUM"
        request = model_service_pb2.SettleRequest(
            model=model,
            q=vector(q),
            guess=dict(guess or {}),
            hold=hold,
            inputs=dict(inputs or {}),
            goal=model_service_pb2.SettleGoal.Value(goal),
        )
        return Settled._from(self._call(self.models.Settle, request))

    def delete_model(self, name: str) -> None:
        """Forgets an uploaded model; its plants live on."""
        self._call(self.models.DeleteModel, model_service_pb2.DeleteModelRequest(name=name))

    # ---- plants ----

    def create_plant(
        self,
        model: str,
        *,
        id: str = "",
        dt: float = 0.0,
        paper: bool = False,
        at: str | None = None,
        q: Vector | None = None,
        v: Vector | None = None,
        p: Vector | None = None,
        initial: common_pb2.InitialState | None = None,
        open_link: bool = False,
    ) -> Plant:
        """Creates a plant: at an operating point (``at``), at a configuration ``q`` with velocity
        ``v`` or momentum ``p``, in any other ``initial`` state, or where the scene says.

        ``dt`` is the time step in seconds, 0 the scene's; ``paper`` puts all forces at the start of
        a step.
        """
        request = plant_service_pb2.CreatePlantRequest(
            id=id,
            model=model,
            settings=_settings(dt, paper),
            initial=_initial(at, q, v, p, initial),
            open_link=open_link,
        )
        return Plant._from(self._call(self.plants.CreatePlant, request).plant)

    def get_plant(self, id: str) -> Plant:
        """A plant, its state and its energy."""
        answer = self._call(self.plants.GetPlant, plant_service_pb2.GetPlantRequest(id=id))
        return Plant._from(answer.plant, Energy._from(answer.energy))

    def diagnose(
        self,
        id: str = "",
        *,
        model: str = "",
        initial: common_pb2.InitialState | None = None,
    ) -> Diagnostics:
        """What can be said of a plant's present state, or of a state of a model."""
        request = plant_service_pb2.DiagnoseRequest(id=id, model=model, initial=initial)
        return Diagnostics._from(self._call(self.plants.Diagnose, request))

    def list_plants(self) -> list[Plant]:
        """All plants, by id."""
        plants: list[Plant] = []
        token = ""
        while True:
            request = plant_service_pb2.ListPlantsRequest(page_token=token)
            page = self._call(self.plants.ListPlants, request)
            plants.extend(map(Plant._from, page.plants))
            token = page.next_page_token
            if not token:
                return plants

    def delete_plant(self, id: str) -> None:
        """Ends a plant; whoever drives or watches it gets ``NOT_FOUND``."""
        self._call(self.plants.DeletePlant, plant_service_pb2.DeletePlantRequest(id=id))

    def step(self, id: str, u: npt.ArrayLike = (), *, hold: int = 0) -> list[State]:
        """Takes one step per row of ``u`` and ``hold`` more with the last row; all their states.

        Without rows there are no input forces and prescribed coordinates stay where they are.
        To close a loop use `drive`: it is faster and keeps others from stepping in between.
        """
        rows = np.asarray(u, dtype=np.float64)
        request = plant_service_pb2.StepRequest(
            id=id,
            u=matrix_message(rows) if rows.size else None,
            hold=hold,
            all_states=True,
        )
        return [State._from(state) for state in self._call(self.plants.Step, request).states]

    def drive(self, id: str, *, linearization: bool = False) -> Driver:
        """Takes the lease of a plant, to step it in lockstep."""
        return Driver(self.plants, id, linearization)

    def watch(
        self,
        id: str,
        fields: Iterable[Field] = ("state",),
        *,
        every: int = 1,
        coordinates: Sequence[str] = (),
        q: npt.ArrayLike | None = None,
        r: npt.ArrayLike | None = None,
    ) -> Iterator[Watched]:
        """What a plant does while somebody drives it. Latest wins: a slow reader loses messages.

        ``q`` and ``r`` are the weights for the field ``gain``. Leaving the loop ends the watch.
        """
        request = plant_service_pb2.WatchRequest(
            id=id,
            fields=[
                plant_service_pb2.WatchField.Value(f"WATCH_FIELD_{field.upper()}")
                for field in fields
            ],
            every=every,
            coordinates=coordinates,
            weights=None if q is None or r is None else _weights(q, r),
        )
        # Asked for now rather than at the first message, so that nothing in between is missed.
        return self._messages(self.plants.Watch(request), Watched._from)

    def reset(
        self,
        id: str,
        *,
        at: str | None = None,
        q: Vector | None = None,
        v: Vector | None = None,
        p: Vector | None = None,
        initial: common_pb2.InitialState | None = None,
    ) -> State:
        """Puts a plant back to step 0, where it was created or where the arguments say."""
        state = _initial(at, q, v, p, initial)
        request = plant_service_pb2.ResetRequest(id=id, initial=state)
        return State._from(self._call(self.plants.Reset, request).state)

    def snapshot(self, id: str) -> bytes:
        """A snapshot: a plant restored from it continues bit for bit."""
        return self._call(self.plants.Snapshot, plant_service_pb2.SnapshotRequest(id=id)).snapshot

    def restore(self, id: str, snapshot: bytes) -> State:
        """Restores a snapshot of a plant of the same model and settings, step count included."""
        request = plant_service_pb2.RestoreRequest(id=id, snapshot=snapshot)
        return State._from(self._call(self.plants.Restore, request).state)

    def open_link(self, id: str) -> plant_service_pb2.OpenLinkResponse:
        """Opens the shared-memory link of a plant and says how to reach it."""
        return self._call(self.plants.OpenLink, plant_service_pb2.OpenLinkRequest(id=id))

    # ---- linearizations, analysis, regulators and rollouts ----

    def linearize(
        self,
        model: str = "",
        *,
        at: str = "initial",
        state: State | None = None,
        u: Vector = (),
        plant: str = "",
        dt: float = 0.0,
        paper: bool = False,
    ) -> Linearization:
        """Linearizes the map of a model at an operating point, or at ``state`` with input ``u``; or
        that of a ``plant``, where it is."""
        request = control_service_pb2.LinearizeRequest(
            model=model, settings=_settings(dt, paper), point=_point(at, state, u, plant)
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

    def linearize_second_order(
        self,
        model: str = "",
        *,
        at: str = "initial",
        state: State | None = None,
        u: Vector = (),
        plant: str = "",
        dt: float = 0.0,
        paper: bool = False,
    ) -> SecondOrder:
        """All second derivatives of the map at a point given as in `linearize`."""
        request = control_service_pb2.LinearizeSecondOrderRequest(
            model=model, settings=_settings(dt, paper), point=_point(at, state, u, plant)
        )
        return SecondOrder._from(self._call(self.control.LinearizeSecondOrder, request))

    def contract_second_order(
        self,
        model: str = "",
        weights: Vector = (),
        *,
        multiplier_weights: Vector = (),
        at: str = "initial",
        state: State | None = None,
        u: Vector = (),
        plant: str = "",
        dt: float = 0.0,
        paper: bool = False,
    ) -> Contraction:
        """The Hessian of ``weights @ x[k+1] + multiplier_weights @ multipliers`` at such a point.

        The tensors are not formed: it works where they would be too large.
        """
        request = control_service_pb2.LinearizeSecondOrderRequest(
            model=model,
            settings=_settings(dt, paper),
            point=_point(at, state, u, plant),
            weights=common_pb2.ContractionWeights(
                x=vector(weights), multipliers=vector(multiplier_weights)
            ),
        )
        return Contraction._from(self._call(self.control.LinearizeSecondOrder, request))

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
        request = control_service_pb2.EvaluateDynamicsRequest(
            model=model,
            operating_point=at,
            q=vector(q),
            v=vector(v),
            inputs=vector(inputs),
            prescribed_acceleration=vector(prescribed_acceleration),
            order=order,
        )
        return Dynamics._from(self._call(self.control.EvaluateDynamics, request))

    def analyze(
        self,
        model: str = "",
        *,
        outputs: Sequence[str] | npt.ArrayLike = (),
        frequencies: Vector = (),
        at: str = "initial",
        state: State | None = None,
        u: Vector = (),
        plant: str = "",
        dt: float = 0.0,
        paper: bool = False,
        full: bool = False,
    ) -> Analysis:
        """Controllability, observability, modes and frequency response at such a point.

        ``outputs`` are names of entries of x such as ``theta`` or ``p(theta)``, or a matrix; all of x
        if not given. ``frequencies`` in Hz. ``full`` looks at the full state of a constrained model
        instead of at its manifold.
        """
        request = control_service_pb2.AnalyzeRequest(
            model=model,
            settings=_settings(dt, paper),
            point=_point(at, state, u, plant),
            constraints=_constraints(full),
            frequencies_hz=vector(frequencies),
        )
        if isinstance(outputs, np.ndarray) or (len(outputs) and not isinstance(outputs[0], str)):
            request.output_x.CopyFrom(matrix_message(outputs))
        else:
            request.outputs.extend(outputs)
        return Analysis._from(self._call(self.control.Analyze, request))

    def solve_lqr(
        self,
        model: str,
        *,
        q: npt.ArrayLike,
        r: npt.ArrayLike,
        at: str = "initial",
        state: State | None = None,
        u: Vector = (),
        dt: float = 0.0,
        paper: bool = False,
        full: bool = False,
    ) -> Regulator:
        """Infinite-horizon LQR about an equilibrium. Weights are diagonals or matrices.

        ``full`` solves on the full state of a constrained model instead of on its manifold.
        """
        request = control_service_pb2.SolveLqrRequest(
            model=model,
            settings=_settings(dt, paper),
            point=_point(at, state, u),
            weights=_weights(q, r),
            constraints=_constraints(full),
        )
        return Regulator._from_answer(self._call(self.control.SolveLqr, request))

    def linearize_trajectory(
        self, model: str, initial: State, u: npt.ArrayLike, *, dt: float = 0.0, paper: bool = False
    ) -> Iterator[Linearization]:
        """Linearizes the map at every step of the trajectory that ``u`` drives from ``initial``."""
        request = control_service_pb2.LinearizeTrajectoryRequest(
            model=model, settings=_settings(dt, paper), trajectory=_trajectory(initial, u)
        )
        return self._messages(
            self.control.LinearizeTrajectory(request),
            lambda m: Linearization._from(
                m.linearization, state=State._from(m.state), report=StepReport._from(m.report)
            ),
        )

    def solve_trajectory_lqr(
        self,
        model: str,
        initial: State,
        u: npt.ArrayLike,
        *,
        q: npt.ArrayLike,
        r: npt.ArrayLike,
        q_final: npt.ArrayLike | None = None,
        dt: float = 0.0,
        paper: bool = False,
        full: bool = False,
    ) -> Iterator[Gain]:
        """Time-varying LQR along a trajectory: one gain per step, then one with only the final
        reference state."""
        request = control_service_pb2.SolveTrajectoryLqrRequest(
            model=model,
            settings=_settings(dt, paper),
            trajectory=_trajectory(initial, u),
            weights=_weights(q, r, q_final),
            constraints=_constraints(full),
        )
        return self._messages(
            self.control.SolveTrajectoryLqr(request), lambda m: Gain._from(m.gain)
        )

    def rollout(
        self,
        model: str,
        cases: Iterable[control_service_pb2.RolloutCase],
        *,
        every: int = 0,
        dt: float = 0.0,
        paper: bool = False,
    ) -> Iterator[Rollout]:
        """Runs many simulations at once; answers come in the order in which they end."""
        request = control_service_pb2.RolloutRequest(
            model=model, settings=_settings(dt, paper), cases=cases, every=every
        )
        return self._messages(self.control.Rollout(request), Rollout._from)

    @staticmethod
    def _messages(call: Any, convert: Any) -> Iterator[Any]:
        def messages() -> Iterator[Any]:
            try:
                with translated():
                    for message in call:
                        yield convert(message)
            finally:
                call.cancel()

        return messages()


def _settings(dt: float, paper: bool) -> plant_service_pb2.PlantSettings:
    split = plant_service_pb2.FORCE_SPLIT_PAPER if paper else plant_service_pb2.FORCE_SPLIT_SYMMETRIC
    return plant_service_pb2.PlantSettings(time_step_s=dt, force_split=split)


def _initial(
    at: str | None,
    q: Vector | None,
    v: Vector | None,
    p: Vector | None,
    initial: common_pb2.InitialState | None,
) -> common_pb2.InitialState | None:
    if sum(given is not None for given in (at, q, initial)) > 1:
        raise ValueError("give one of `at`, `q` and `initial`")
    if q is None and (v is not None or p is not None):
        raise ValueError("`v` and `p` need `q`")
    if v is not None and p is not None:
        raise ValueError("give `v` or `p`")
    if at is not None:
        return common_pb2.InitialState(operating_point=at)
    if q is None:
        return initial
    configuration = vector(q)
    if p is not None:
        momentum = common_pb2.InitialState.Momentum(q=configuration, p=vector(p))
        return common_pb2.InitialState(momentum=momentum)
    rate: Array = np.zeros_like(configuration) if v is None else vector(v)
    velocity = common_pb2.InitialState.Velocity(q=configuration, v=rate)
    return common_pb2.InitialState(velocity=velocity)


def _point(at: str, state: State | None, u: Vector, plant: str = "") -> common_pb2.Point:
    if plant:
        return common_pb2.Point(plant=plant)
    if state is None:
        return common_pb2.Point(operating_point=at)
    here = common_pb2.StateAndInput(state=state._message(), u=vector(u))
    return common_pb2.Point(state_and_input=here)


def _trajectory(initial: State, u: npt.ArrayLike) -> common_pb2.Trajectory:
    return common_pb2.Trajectory(initial=initial._message(), u=matrix_message(u))


def _weights(
    q: npt.ArrayLike, r: npt.ArrayLike, q_final: npt.ArrayLike | None = None
) -> plant_service_pb2.LqrWeights:
    final = None if q_final is None else weight(q_final)
    return plant_service_pb2.LqrWeights(q=weight(q), r=weight(r), q_final=final)


def _constraints(full: bool) -> Any:
    if full:
        return control_service_pb2.CONSTRAINT_HANDLING_FULL
    return control_service_pb2.CONSTRAINT_HANDLING_MANIFOLD
