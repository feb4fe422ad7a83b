"""The client: one method per thing that a controller's author wants."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from os import PathLike
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import grpc
import numpy as np
import numpy.typing as npt

from plantd.v1 import (
    channel_service_pb2,
    common_pb2,
    control_service_pb2,
    model_service_pb2,
    plant_service_pb2,
    realtime_pb2,
    recording_service_pb2,
)
from plantd.v1.channel_service_pb2_grpc import ChannelServiceStub
from plantd.v1.control_service_pb2_grpc import ControlServiceStub
from plantd.v1.model_service_pb2_grpc import ModelServiceStub
from plantd.v1.plant_service_pb2_grpc import PlantServiceStub
from plantd.v1.recording_service_pb2_grpc import RecordingServiceStub

from . import _meshes
from ._connect import open_channel
from ._drive import Driver
from ._errors import PlantdError, translate, translated
from ._feedback import Follower
from ._kalman import Kalman, TrajectoryKalman
from ._optimize import Checkpoint, Method, Optimum, ProjectedReference, Search, method_number
from ._requests import (
    Bounds,
    Stepping,
    bounds,
    constraints,
    initial_state,
    is_file,
    measurement,
    mechanical_state,
    momentum,
    noise,
    point,
    scene_text,
    settings,
    split_outputs,
    stage_weights,
    trajectory,
    weights,
)
from ._types import (
    FEEDBACK_MODES,
    Analysis,
    Channels,
    Contraction,
    Diagnostics,
    Dynamics,
    Energy,
    EquationOfMotion,
    Event,
    Feedback,
    Gain,
    Kinematics,
    Linearization,
    Plant,
    Recording,
    Regulator,
    Rollout,
    SecondOrder,
    Settled,
    State,
    StepReport,
    Trajectory,
    TrajectoryGain,
    Vector,
    Watched,
    WatchedGain,
    matrix_message,
    vector,
    weight,
)

if TYPE_CHECKING:
    from typing_extensions import Unpack

#: Where a server listens unless it is told otherwise.
DEFAULT_ADDRESS = "http://127.0.0.1:50051"

Field = Literal[
    "state",
    "report",
    "energy",
    "linearization",
    "gain",
    "input",
    "outputs",
    "timing",
    "poses",
    "poles",
]


def connect(address: str = DEFAULT_ADDRESS, *, timeout: float = 60.0) -> Client:
    """Connects to ``http://host:port``, ``host:port`` or ``unix:/path``.

    A server that is just starting is waited for, 5 seconds at most; after that the error says what
    there is in its place. ``timeout`` in seconds limits each call that is not a stream.
    """
    return Client(address, timeout=timeout)


class Client:
    """A connection to a server. Use it in a ``with`` statement, or call ``close``.

    ``models``, ``plants``, ``control``, ``channels`` and ``recordings`` are the generated stubs, for
    what is not wrapped.
    """

    def __init__(self, address: str, *, timeout: float = 60.0):
        self._channel = open_channel(address)
        self._timeout = timeout
        self.models = ModelServiceStub(self._channel)
        self.plants = PlantServiceStub(self._channel)
        self.control = ControlServiceStub(self._channel)
        self.channels = ChannelServiceStub(self._channel)
        self.recordings = RecordingServiceStub(self._channel)

    def close(self) -> None:
        """Closes the connection; streams end."""
        self._channel.close()

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()

    @translate
    def _call(self, method: Any, request: Any, limited: bool = True) -> Any:
        return method(request, timeout=self._timeout if limited else None)

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

    def create_model(
        self,
        scene: str | PathLike[str],
        *,
        name: str = "",
        packages: Mapping[str, str | PathLike[str]] | None = None,
    ) -> model_service_pb2.Model:
        """Uploads a scene (TOML, JSON) or a robot (URDF, MJCF): a text of several lines, or a file.

        All errors are in the error's ``violations``. What a robot says and a scene cannot is a
        ``UserWarning`` with lines and columns; what has no effect on the motion is not mentioned.
        The meshes that show what is in a file are sent along where they are found: beside it, or in
        the folders of ``packages`` by name, or in folders of these names around it. One that is not
        found, or not taken, is a ``UserWarning``.
        """
        request = model_service_pb2.CreateModelRequest(scene=scene_text(scene), name=name)
        answer = self._call(self.models.CreateModel, request)
        told = [
            f"{note.line}:{note.column}: {note.message}"
            for note in answer.import_report.notes
            if note.kind != model_service_pb2.IMPORT_KIND_NO_EFFECT
        ]
        if told:
            warnings.warn("\n".join([f"{answer.model.name}:", *told]), stacklevel=2)
        if is_file(scene):
            missing = self._put_meshes(answer.model.name, Path(scene).parent, packages or {})
            if missing:
                warnings.warn("\n".join([f"{answer.model.name}:", *missing]), stacklevel=2)
        return answer.model

    def _put_meshes(
        self, model: str, folder: Path, packages: Mapping[str, str | PathLike[str]]
    ) -> list[str]:
        """Sends the meshes of a model that the server has not; says which could not be sent, and why."""
        shapes = [
            shape for frame in self.get_drawing(model=model).drawing.frames for shape in frame.shapes
        ]
        files = {s.mesh.file for s in shapes if s.HasField("mesh") and not s.mesh.url}
        missing = []
        for file, data in _meshes.find(files, folder, packages):
            if data is None:
                missing.append(f"mesh `{file}` was not found")
                continue
            try:
                self.put_model_file(model, file, data)
            except PlantdError as error:
                missing.append(f"mesh `{file}` was not taken: {error}")
        return missing

    def put_model_file(self, model: str, file: str, data: bytes) -> str:
        """Gives an uploaded model a file that its visuals name; where browsers find it, a path on the
        server's address."""
        request = model_service_pb2.PutModelFileRequest(model=model, file=file, data=data)
        return self._call(self.models.PutModelFile, request).url

    def get_drawing(
        self, plant: str | None = None, *, model: str | None = None
    ) -> model_service_pb2.GetDrawingResponse:
        """What a viewer draws of a plant, or of a model: frames with shapes, lines, arrows."""
        request = model_service_pb2.GetDrawingRequest(plant=plant, model=model)
        return self._call(self.models.GetDrawing, request)

    def validate_scene(
        self, scene: str | PathLike[str]
    ) -> list[model_service_pb2.SceneProblem]:
        """All errors of a scene or robot, a text of several lines or a file; none when it is good."""
        request = model_service_pb2.ValidateSceneRequest(scene=scene_text(scene))
        return list(self._call(self.models.ValidateScene, request).problems)

    def settle(
        self,
        model: str,
        *,
        q: Vector = (),
        guess: Mapping[str, float] | None = None,
        hold: Sequence[str] = (),
        inputs: Mapping[str, float] | None = None,
        targets: Mapping[str, Vector] | None = None,
        constraints_only: bool = False,
    ) -> Settled:
        """Finds a configuration in which the model rests, from a guess.

        The guess is ``q``, or the scene's initial configuration, with the values of ``guess`` put in;
        coordinates in ``hold`` keep their value of it. ``inputs`` are the forces that act.
        ``constraints_only`` finds a configuration close to the guess that satisfies the constraints.
        ``targets`` say where the origins of frames shall be in the world, three numbers each, or seven with
        the orientation as a unit quaternion w, x, y, z: inverse kinematics.
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
        for frame, target in (targets or {}).items():
            numbers = vector(target)
            request.targets.add(
                point={"frame": frame}, position=numbers[:3], orientation=numbers[3:]
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
        at: str | None = None,
        q: Vector | None = None,
        velocity: Vector | None = None,
        v: Vector | None = None,
        p: Vector | None = None,
        initial: common_pb2.InitialState | None = None,
        open_link: bool = False,
        tolerance: float = 0.0,
        **stepping: Unpack[Stepping],
    ) -> Plant:
        """Creates a plant: at an operating point (``at``), at a configuration ``q`` with ``velocity``,
        of all coordinates as in `State.velocity` (``v`` is short for it here), or momentum ``p``, in any other
        ``initial`` state, or where the scene says.

        The keywords of `Stepping` say how it is stepped. ``tolerance``, rad or m, chooses ``order`` and
        ``substeps`` in their place, so that no coordinate is off by more over the next 50 steps;
        ``accuracy`` of the plant tells by how much they are.
        """
        request = plant_service_pb2.CreatePlantRequest(
            id=id,
            model=model,
            settings=settings(**stepping),
            initial=initial_state(at, q, velocity, v, p, initial),
            open_link=open_link,
        )
        request.settings.tolerance = tolerance
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

    def drive(
        self, id: str, *, linearization: bool = False, grace: float = 0.0, resume: str = ""
    ) -> Driver:
        """Takes the lease of a plant, to step it or to give it inputs.

        The lease is kept for ``grace`` seconds when the connection breaks; ``resume`` goes on with
        it (`Driver.lease_token`).
        """
        open = plant_service_pb2.DriveOpen(
            id=id, linearization=linearization, grace_s=grace, resume=resume
        )
        return Driver(self.plants, open)

    def watch(
        self,
        id: str,
        fields: Iterable[Field] = ("state",),
        *,
        every: int = 1,
        coordinates: Sequence[str] = (),
        q: npt.ArrayLike | None = None,
        r: npt.ArrayLike | None = None,
        projected_momentum: bool = False,
        queue: int = 1,
        at_most_hz: float = 0.0,
    ) -> Iterator[Watched]:
        """What a plant does while somebody drives it. A slow reader loses messages: ``queue`` of them
        may wait, the latest ones. With ``at_most_hz`` no more than so many come a second; the latest
        state wins.

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
            weights=_trajectory_weights(q, r, None, None, projected_momentum),
            queue=queue,
            at_most_hz=at_most_hz,
        )
        # Asked for now rather than at the first message, so that nothing in between is missed.
        return self._messages(self.plants.Watch(request), Watched._from)

    def reset(
        self,
        id: str,
        *,
        at: str | None = None,
        q: Vector | None = None,
        velocity: Vector | None = None,
        v: Vector | None = None,
        p: Vector | None = None,
        initial: common_pb2.InitialState | None = None,
    ) -> State:
        """Puts a plant back to step 0, where it was created or where the arguments say."""
        state = initial_state(at, q, velocity, v, p, initial)
        request = plant_service_pb2.ResetRequest(id=id, initial=state)
        return State._from(self._call(self.plants.Reset, request).state)

    def snapshot(self, id: str) -> bytes:
        """A snapshot: a plant restored from it continues bit for bit."""
        return self._call(self.plants.Snapshot, plant_service_pb2.SnapshotRequest(id=id)).snapshot

    def restore(self, id: str, snapshot: bytes) -> State:
        """Restores a snapshot of a plant of the same model and settings, step count included."""
        request = plant_service_pb2.RestoreRequest(id=id, snapshot=snapshot)
        return State._from(self._call(self.plants.Restore, request).state)

    # ---- recordings ----

    def start_recording(
        self, id: str, name: str = "", *, checkpoint_interval: float = 0.0
    ) -> Recording:
        """Starts to record a plant into a file of the server, until `stop_recording`.

        A replay can begin every ``checkpoint_interval`` seconds; 0 means 5.
        """
        request = recording_service_pb2.StartRecordingRequest(
            id=id, name=name, checkpoint_interval_s=checkpoint_interval
        )
        return Recording._from(self._call(self.recordings.StartRecording, request).recording)

    def stop_recording(self, name: str) -> Recording:
        """Ends a recording; its file is complete then."""
        request = recording_service_pb2.StopRecordingRequest(name=name)
        return Recording._from(self._call(self.recordings.StopRecording, request).recording)

    def list_recordings(self) -> list[Recording]:
        """All recordings of the server, by name."""
        recordings: list[Recording] = []
        token = ""
        while True:
            request = recording_service_pb2.ListRecordingsRequest(page_token=token)
            page = self._call(self.recordings.ListRecordings, request)
            recordings.extend(map(Recording._from, page.recordings))
            token = page.next_page_token
            if not token:
                return recordings

    @translate
    def get_recording(self, name: str, path: str | PathLike[str]) -> None:
        """Fetches the file of a recording, which is MCAP."""
        request = recording_service_pb2.GetRecordingRequest(name=name)
        with open(path, "wb") as file:
            for piece in self.recordings.GetRecording(request):
                file.write(piece.data)

    def delete_recording(self, name: str) -> None:
        """Deletes a recording that has ended."""
        request = recording_service_pb2.DeleteRecordingRequest(name=name)
        self._call(self.recordings.DeleteRecording, request)

    # ---- parameters and feedback ----

    def set_parameters(
        self, id: str, parameters: Mapping[str, float] | None = None, *, dt: float = 0.0
    ) -> Plant:
        """Changes numbers of a plant's scene, or its time step, while it runs; its state x stays.

        ``parameters`` by where they stand, as in the errors of scenes: ``gravity[1]``,
        ``frames[pole].body.mass``. All of them take effect, or none.
        """
        request = plant_service_pb2.SetParametersRequest(
            id=id,
            parameters=[
                plant_service_pb2.Parameter(path=path, value=value)
                for path, value in (parameters or {}).items()
            ],
            time_step_s=dt,
        )
        return Plant._from(self._call(self.plants.SetParameters, request).plant)

    def set_feedback(
        self,
        id: str,
        *,
        at: str | None = None,
        state: State | None = None,
        u: Vector = (),
        plant: str = "",
        trajectory: Trajectory | None = None,
        gain: Gain | None = None,
        q: npt.ArrayLike | None = None,
        r: npt.ArrayLike | None = None,
        q_final: npt.ArrayLike | None = None,
        s: npt.ArrayLike | None = None,
        projected_momentum: bool = False,
        stages: Iterable[Mapping[str, npt.ArrayLike]] = (),
        full: bool = False,
        mode: Literal["watch", "replace", "add", "guard"] = "watch",
        first_step: int | None = None,
        guard: Bounds | None = None,
    ) -> Feedback:
        """Gives a plant a reference with its regulator, which the server computes, and computes anew
        when the plant's parameters change. `follow_gains` applies it here.

        The reference is one of: an equilibrium (``at``, or ``state`` with ``u``, or where ``plant``
        is), a ``trajectory``, which begins at the plant's step ``first_step`` or at the present one,
        or a ``gain`` as it stands, which must not say that it is for another model or time step. When
        parameters change, the reference of a trajectory is the motion of the changed plant from the
        same initial state under the same inputs.

        ``mode`` is what the feedback does in the plant's own loop, ``law`` standing for its input:
        ``watch`` nothing; ``replace`` u = law; ``add`` u = law + what the driver sends; ``guard``
        u = law from the first step on at which an entry of x - x_reference leaves its bounds in
        ``guard``.
        """
        forms = [at is not None, state is not None, bool(plant), trajectory is not None]
        if sum([*forms, gain is not None]) != 1:
            raise ValueError("give one of `at`, `state`, `plant`, `trajectory` and `gain`")
        request = plant_service_pb2.SetFeedbackRequest(
            id=id,
            stages=stage_weights(stages),
            constraints=constraints(full),
            mode=FEEDBACK_MODES[mode],
            first_step=first_step,
            guard=bounds(guard),
        )
        if gain is not None:
            request.gain.CopyFrom(gain._message())
        elif trajectory is not None:
            request.trajectory.CopyFrom(trajectory._message())
        else:
            request.point.CopyFrom(point(at, state, u, plant))
        given = _trajectory_weights(q, r, q_final, s, projected_momentum)
        if given is not None:
            request.weights.CopyFrom(given)
        return Feedback._from(self._call(self.plants.SetFeedback, request).feedback)

    def clear_feedback(self, id: str) -> None:
        """Takes the reference away; the driver's input acts alone again."""
        self._call(self.plants.ClearFeedback, plant_service_pb2.ClearFeedbackRequest(id=id))

    def run(
        self,
        id: str,
        pace: str = "",
        *,
        speed: float = 0.0,
        steps: int = 0,
        wait: bool = False,
        timeout: float = 0.0,
        action: str = "hold",
        ramp: float = 0.0,
        safe: Vector = (),
        latch: bool = False,
    ) -> realtime_pb2.RunInfo:
        """Runs a plant: ``"paced"`` by the wall clock, ``"free"`` as fast as possible, or in
        ``"lockstep"``; without a pace as before. ``steps`` of 0 means until it is paused. With
        ``wait`` it returns when the plant stands still again, however long that takes.

        A plant that runs by itself waits for nobody: its driver's latest input acts. ``timeout``
        (seconds on the plant's clock, 0 for never), ``action`` (``"hold"``, ``"safe"``, ``"ramp"``
        within ``ramp`` seconds, ``"stop"``), ``safe`` and ``latch`` say what happens without one.
        """
        settings = None
        if pace:
            policy = realtime_pb2.InputPolicy(
                timeout_s=timeout,
                action=realtime_pb2.InputAction.Value(f"INPUT_ACTION_{action.upper()}"),
                ramp_s=ramp,
                safe=vector(safe),
                latch=latch,
            )
            settings = realtime_pb2.RunSettings(
                pace=realtime_pb2.Pace.Value(f"PACE_{pace.upper()}"),
                speed=speed,
                input=None if pace == "lockstep" else policy,
            )
        request = realtime_pb2.RunRequest(id=id, settings=settings, steps=steps, wait=wait)
        return self._call(self.plants.Run, request, limited=not wait).run

    def pause(self, id: str) -> State:
        """Pauses a plant between two steps, and returns the state in which it stands."""
        return State._from(self._call(self.plants.Pause, realtime_pb2.PauseRequest(id=id)).state)

    def set_safety(
        self,
        id: str,
        watchdogs: Iterable[Mapping[str, Any]] = (),
        *,
        on_step_failure: str = "unspecified",
    ) -> None:
        """Sets bounds that protect a plant, in place of those before.

        Each is a mapping: ``dict(quantity="x", max=2.0, action="reset")``. Quantities are
        coordinates, ``v(coordinate)``, ``force(constraint)`` and ``energy``; actions ``freeze``
        (the default), ``reset`` and ``disconnect``.
        """

        def act(name: str) -> realtime_pb2.WatchdogAction:
            return realtime_pb2.WatchdogAction.Value(f"WATCHDOG_ACTION_{name.upper()}")

        dogs = [
            realtime_pb2.Watchdog(**{**dog, "action": act(dog.get("action", "freeze"))})
            for dog in watchdogs
        ]
        request = realtime_pb2.SetSafetyRequest(
            id=id, watchdogs=dogs, on_step_failure=act(on_step_failure)
        )
        self._call(self.plants.SetSafety, request)

    def timing(self, id: str, *, clear: bool = False) -> realtime_pb2.GetTimingResponse:
        """What the loop of a plant that runs by itself has counted; ``clear`` begins anew."""
        request = realtime_pb2.GetTimingRequest(id=id, clear=clear)
        return self._call(self.plants.GetTiming, request)

    def watch_events(self, id: str, since: int | None = None) -> Iterator[Event]:
        """What happens to a plant besides its steps, from event ``since`` on; a plant keeps 256.

        Without ``since``: from now on. Leaving the loop ends the watch.
        """
        request = realtime_pb2.WatchEventsRequest(id=id, since=since)
        return self._messages(self.plants.WatchEvents(request), Event._from)

    def set_channels(
        self,
        id: str,
        outputs: Iterable[Mapping[str, Any]] = (),
        inputs: Iterable[Mapping[str, Any]] = (),
        *,
        seed: int = 0,
    ) -> Channels:
        """Declares the sensors and actuators of a plant, in place of those before.

        Each is a mapping with the fields of ``OutputChannel`` or ``InputChannel`` of the contract:
        ``dict(name="encoder", coordinate="theta", noise=0.001, latency_s=0.02)``,
        ``dict(input="tau", delay_s=0.01, max=5.0)``. Times become whole steps.
        """
        channels = channel_service_pb2.Channels(
            outputs=[channel_service_pb2.OutputChannel(**output) for output in outputs],
            inputs=[channel_service_pb2.InputChannel(**input) for input in inputs],
            seed=seed,
        )
        request = channel_service_pb2.SetChannelsRequest(id=id, channels=channels)
        answer = self._call(self.channels.SetChannels, request)
        return Channels._from(answer.info, common_pb2.Outputs(y=answer.y))

    def get_channels(self, id: str) -> Channels:
        """The channels of a plant, with what they deliver now."""
        request = channel_service_pb2.GetChannelsRequest(id=id)
        answer = self._call(self.channels.GetChannels, request)
        return Channels._from(answer.info, common_pb2.Outputs(y=answer.y, lost=answer.lost))

    def inject_fault(self, id: str, **fault: Any) -> channel_service_pb2.FaultInfo:
        """Lets something go wrong: the fields of ``FaultSpec`` of the contract.

            client.inject_fault("p1", input="tau", stuck=True, start_s=2.0, duration_s=0.5)
            client.inject_fault("p1", push=dict(point=dict(frame="rod"), force=[5, 0, 0]), duration_s=0.1)
        """
        spec = channel_service_pb2.FaultSpec(**fault)
        request = channel_service_pb2.InjectFaultRequest(id=id, fault=spec)
        return self._call(self.channels.InjectFault, request).fault

    def clear_fault(self, id: str, fault_id: int = 0) -> int:
        """Ends a fault, or all; how many."""
        request = channel_service_pb2.ClearFaultRequest(id=id, fault_id=fault_id)
        return self._call(self.channels.ClearFault, request).cleared

    def list_faults(self, id: str) -> list[channel_service_pb2.FaultInfo]:
        """The faults of a plant, in the order in which they were injected."""
        request = channel_service_pb2.ListFaultsRequest(id=id)
        return list(self._call(self.channels.ListFaults, request).faults)

    def watch_gains(self, id: str) -> Iterator[WatchedGain]:
        """The gains of a plant's feedback: along a trajectory those of every step from the present one
        on, ahead of time; about an operating point the one in force and each that replaces it."""
        request = plant_service_pb2.WatchGainsRequest(id=id)
        return self._messages(self.plants.WatchGains(request), WatchedGain._from)

    def follow_gains(self, id: str) -> Follower:
        """Follows the gains of a plant's feedback, to apply them here: ``u = law(state)``."""
        request = plant_service_pb2.WatchGainsRequest(id=id)
        return Follower(lambda: self.plants.WatchGains(request), self._timeout)

    def open_link(self, id: str) -> plant_service_pb2.OpenLinkResponse:
        """Opens the shared-memory link of a plant and says how to reach it."""
        return self._call(self.plants.OpenLink, plant_service_pb2.OpenLinkRequest(id=id))

    # ---- linearizations, analysis, regulators and rollouts ----

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
        request = control_service_pb2.LinearizeRequest(
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
        request = control_service_pb2.LinearizeSecondOrderRequest(
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
        request = control_service_pb2.LinearizeSecondOrderRequest(
            model=model,
            settings=settings(**stepping),
            point=point(at, state, u, plant),
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
        request = control_service_pb2.KinematicsRequest(
            state=mechanical_state(model, plant, at, q, v),
            frames=frames,
            points=[
                channel_service_pb2.FramePoint(frame=frame, at=vector(position))
                for frame, position in points
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
        request = control_service_pb2.DynamicsRequest(
            state=mechanical_state(model, plant, at, q, v),
            inputs=vector(inputs),
            acceleration=vector(acceleration),
            prescribed_acceleration=vector(prescribed_acceleration),
            forward=forward,
        )
        return EquationOfMotion._from(self._call(self.control.Dynamics, request))

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
        request = control_service_pb2.AnalyzeRequest(
            model=model,
            settings=settings(**stepping),
            point=point(at, state, u, plant),
            constraints=constraints(full),
            frequencies_hz=vector(frequencies),
        )
        names, rows = split_outputs(outputs)
        request.outputs.extend(names)
        if rows is not None:
            request.output_x.CopyFrom(rows)
        return Analysis._from(self._call(self.control.Analyze, request))

    def solve_lqr(
        self,
        model: str,
        *,
        q: npt.ArrayLike,
        r: npt.ArrayLike,
        s: npt.ArrayLike | None = None,
        projected_momentum: bool = False,
        at: str | None = None,
        state: State | None = None,
        u: Vector = (),
        full: bool = False,
        **stepping: Unpack[Stepping],
    ) -> Regulator:
        """Infinite-horizon LQR about an equilibrium. Weights are diagonals or matrices, ``s`` is that
        of the cross term x' s u. With ``projected_momentum`` they are on (q, projected p, v): on a
        momentum that does not depend on the time step, where constraints would make it.

        ``full`` solves on the full state of a constrained model instead of on its manifold.
        """
        request = control_service_pb2.SolveLqrRequest(
            model=model,
            settings=settings(**stepping),
            point=point(at, state, u),
            weights=weights(q, r, s=s, projected_momentum=projected_momentum),
            constraints=constraints(full),
        )
        return Regulator._from_answer(self._call(self.control.SolveLqr, request))

    def linearize_trajectory(
        self,
        model: str,
        initial: State | Trajectory,
        u: npt.ArrayLike | None = None,
        **stepping: Unpack[Stepping],
    ) -> Iterator[Linearization]:
        """Linearizes the map at every step of the trajectory that ``u`` drives from ``initial``."""
        request = control_service_pb2.LinearizeTrajectoryRequest(
            model=model, settings=settings(**stepping), trajectory=trajectory(initial, u)
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
        initial: State | Trajectory,
        u: npt.ArrayLike | None = None,
        *,
        q: npt.ArrayLike | None = None,
        r: npt.ArrayLike | None = None,
        q_final: npt.ArrayLike | None = None,
        s: npt.ArrayLike | None = None,
        projected_momentum: bool = False,
        stages: Iterable[Mapping[str, npt.ArrayLike]] = (),
        values: bool = False,
        full: bool = False,
        **stepping: Unpack[Stepping],
    ) -> Iterator[TrajectoryGain]:
        """Time-varying LQR along a trajectory: one gain per step, then one with only the final
        reference state. `GainSchedule` makes a law of them.

        ``stages`` are weights of each step in place of ``q``, ``r`` and ``s``: mappings of these names
        and of ``x_linear`` and ``u_linear``. ``projected_momentum`` is as in `solve_lqr`. ``values``
        also returns the cost to go.
        """
        request = control_service_pb2.SolveTrajectoryLqrRequest(
            model=model,
            settings=settings(**stepping),
            trajectory=trajectory(initial, u),
            weights=_trajectory_weights(q, r, q_final, s, projected_momentum),
            stages=stage_weights(stages),
            values=values,
            constraints=constraints(full),
        )
        return self._messages(self.control.SolveTrajectoryLqr(request), TrajectoryGain._from_answer)

    def optimize_trajectory(
        self,
        model: str,
        guess: Trajectory | Optimum | None = None,
        *,
        x: npt.ArrayLike,
        u: npt.ArrayLike | None = None,
        q: npt.ArrayLike | None = None,
        r: npt.ArrayLike | None = None,
        q_final: npt.ArrayLike | None = None,
        s: npt.ArrayLike | None = None,
        projected_momentum: bool = False,
        stages: Iterable[Mapping[str, npt.ArrayLike]] = (),
        resume: Checkpoint | None = None,
        state_bounds: Bounds | None = None,
        input_bounds: Bounds | None = None,
        final_state: Bounds | None = None,
        model_limits: bool = False,
        free_initial: bool | Sequence[str] = False,
        initial_weight: npt.ArrayLike | None = None,
        method: Method = "newton",
        first_method: Method | None = None,
        first_iterations: int = 0,
        max_iterations: int = 0,
        tolerance: float = 0.0,
        alpha: float = 0.0,
        beta: float = 0.0,
        max_backtracks: int = 0,
        near_last_step: bool = False,
        projection: tuple[npt.ArrayLike, npt.ArrayLike] | None = None,
        bound_tolerance: float = 0.0,
        checkpoint_every: int = 0,
        **stepping: Unpack[Stepping],
    ) -> Search:
        """Finds a trajectory that costs least: an iterator over the iterations, with ``result``.

        The cost is that of the distance from the desired states ``x`` (n + 1 rows, which need not be a
        motion) and inputs ``u`` (n rows; zero if not given), with weights as in
        `solve_trajectory_lqr`. ``guess`` is where the search begins: a trajectory, or a former result;
        or ``resume`` is where it left off. Bounds are by the name of an entry, ``{"force": (-5, 5)}``;
        ``final_state={"theta": math.pi}`` fixes an entry of the last state; ``model_limits`` adds the limits
        that the model has of coordinates and inputs. ``free_initial`` frees all
        entries of the initial state, or those that are named; ``initial_weight`` weighs their
        distance from the guess. ``projection`` is the pair of weights (q, r) of a regulator that
        projects onto motions of the plant, in place of the law of the descent. The other options are
        those of `OptimizationOptions` in the contract; 0 means its default.
        """
        if (guess is None) == (resume is None):
            raise ValueError("give one of `guess` and `resume`")
        start = guess.trajectory if isinstance(guess, Optimum) else guess
        free = None
        if free_initial is not False:
            free = control_service_pb2.FreeInitialState(
                entries=() if free_initial is True else free_initial,
                weight=None if initial_weight is None else weight(initial_weight),
            )
        request = control_service_pb2.OptimizeTrajectoryRequest(
            model=model,
            settings=settings(**stepping),
            cost=control_service_pb2.TrajectoryCost(
                x=matrix_message(x),
                u=None if u is None else matrix_message(u),
                weights=_trajectory_weights(q, r, q_final, s, projected_momentum),
                stages=stage_weights(stages),
            ),
            guess=None if start is None else start._message(),
            resume=None if resume is None else resume.message,
            bounds=control_service_pb2.TrajectoryBounds(
                state=bounds(state_bounds),
                input=bounds(input_bounds),
                final_state=bounds(final_state),
                model_limits=model_limits,
            ),
            free_initial=free,
            options=control_service_pb2.OptimizationOptions(
                method=method_number(method),
                first_method=method_number(first_method),
                first_iterations=first_iterations,
                max_iterations=max_iterations,
                tolerance=tolerance,
                alpha=alpha,
                beta=beta,
                max_backtracks=max_backtracks,
                near_last_step=near_last_step,
                projection=None if projection is None else weights(*projection),
                bound_tolerance=bound_tolerance,
                checkpoint_every=checkpoint_every,
            ),
        )
        return Search(self.control.OptimizeTrajectory(request))

    def project_reference(
        self,
        model: str,
        reference: npt.ArrayLike,
        u: npt.ArrayLike | None = None,
        *,
        q: npt.ArrayLike | None = None,
        r: npt.ArrayLike | None = None,
        q_final: npt.ArrayLike | None = None,
        s: npt.ArrayLike | None = None,
        projected_momentum: bool = False,
        projection: tuple[npt.ArrayLike, npt.ArrayLike] | None = None,
        tolerance: float = 0.0,
        strict: bool = False,
        full: bool = False,
        **stepping: Unpack[Stepping],
    ) -> ProjectedReference:
        """Compares configurations from any planner with the motions of the plant, and finds a motion
        that follows them, with its regulator if the weights ``q`` and ``r`` are given.

        Row k of ``reference`` is the configuration at step k. ``u`` are the planned inputs; forces
        that fit best if not given. ``strict`` refuses a reference that is no motion, within
        ``tolerance``, with reason ``INFEASIBLE_REFERENCE``.
        """
        has_weights = q is not None and r is not None
        request = control_service_pb2.ProjectReferenceRequest(
            model=model,
            settings=settings(**stepping),
            q=matrix_message(reference),
            u=None if u is None else matrix_message(u),
            projection=None if projection is None else weights(*projection),
            weights=_trajectory_weights(q, r, q_final, s, projected_momentum) if has_weights else None,
            constraints=constraints(full),
            tolerance=tolerance,
            strict=strict,
        )
        with translated():
            return ProjectedReference._from(self.control.ProjectReference(request))

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

        ``outputs`` are what is measured: names of entries of x such as ``theta`` or ``p(theta)``, or a
        matrix. Noises are covariances per step, diagonals or matrices: of the measurement, of the
        state and of the inputs.
        """
        request = control_service_pb2.SolveKalmanRequest(
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
        request = control_service_pb2.SolveTrajectoryKalmanRequest(
            model=model,
            settings=settings(**stepping),
            trajectory=trajectory(initial, u),
            measurement=measurement(outputs, output_u),
            noise=noise(process_noise, input_noise, measurement_noise),
            initial_covariance=weight(initial_covariance),
            constraints=constraints(full),
            covariances=covariances,
        )
        with translated():
            return TrajectoryKalman._from(self.control.SolveTrajectoryKalman(request))

    def rollout(
        self,
        model: str,
        cases: Iterable[control_service_pb2.RolloutCase],
        *,
        every: int = 0,
        **stepping: Unpack[Stepping],
    ) -> Iterator[Rollout]:
        """Runs many simulations at once; answers come in the order in which they end.

        A case that cannot be started or stepped does not disturb the others: its ``error`` says why.
        """
        request = control_service_pb2.RolloutRequest(
            model=model, settings=settings(**stepping), cases=cases, every=every
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


def _trajectory_weights(
    q: npt.ArrayLike | None,
    r: npt.ArrayLike | None,
    q_final: npt.ArrayLike | None,
    s: npt.ArrayLike | None,
    projected_momentum: bool,
) -> plant_service_pb2.LqrWeights | None:
    """The weights that go beside those of each step, or stand for them."""
    if q is not None and r is not None:
        return weights(q, r, q_final, s, projected_momentum)
    if q_final is not None:
        return plant_service_pb2.LqrWeights(
            q_final=weight(q_final), momentum=momentum(projected_momentum)
        )
    return None
