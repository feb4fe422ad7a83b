"""Plants: making, stepping, watching and restoring them."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, cast, get_args

import numpy as np
import numpy.typing as npt

from plantd.v1 import common_pb2, drawing_pb2, plant_service_pb2, realtime_pb2

from ._arrays import Array, Vector, array, complexes, failure_text, matrix_message, numbers
from ._calls import Calls
from ._channels import Outputs
from ._check import build, mapping, one_of, shown, texts
from ._feedback import Feedback
from ._gains import Gain
from ._linearize import Linearization
from ._realtime import StepTiming
from ._requests import Precision, Stepping, initial_state, settings, trajectory_weights
from ._states import Energy, State, StepReport

if TYPE_CHECKING:
    from typing_extensions import Unpack

#: What can be watched of a plant.
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
    parameters: Mapping[str, float] = dataclasses.field(default_factory=dict)
    #: Order of accuracy.
    order: int = 2
    #: Steps of the method in a time step.
    substeps: int = 1
    #: How often a time step that cannot be solved is halved.
    halvings: int = 8
    #: Where the solver stops: ``exact``, ``fast`` or ``coarse``.
    precision: Precision = "exact"
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
    #: Seconds without use after which the server deletes it; 0 means never.
    expires: float = 0.0
    #: Name of the server that has it.
    server: str = ""
    #: Where that server is reached; empty for a server in this process.
    address: str = ""

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
            cast(Precision, plant_service_pb2.Precision.Name(m.settings.precision)[10:].lower()),
            Accuracy._from(m.accuracy) if m.HasField("accuracy") else None,
            m.safety if m.HasField("safety") else None,
            m.settings.singular_below,
            m.settings.max_iterations,
            m.settings.force_split == plant_service_pb2.FORCE_SPLIT_PAPER,
            m.expires_s,
            m.server,
            m.address,
        )


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
        return cls(complexes(m.open_loop), complexes(m.closed_loop))


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


class PlantCalls(Calls):
    """Calls of the service of plants."""

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
        expires: float = 0.0,
        **stepping: Unpack[Stepping],
    ) -> Plant:
        """Creates a plant: at an operating point (``at``), at a configuration ``q`` with ``velocity``,
        of all coordinates as in `State.velocity` (``v`` is short for it here), or momentum ``p``, in any other
        ``initial`` state, or where the scene says.

        The keywords of `Stepping` say how it is stepped. ``tolerance``, rad or m, chooses ``order`` and
        ``substeps`` in their place, so that no coordinate is off by more over the next 50 steps;
        ``accuracy`` of the plant tells by how much they are. The server deletes it when nobody has used it
        for ``expires`` seconds; 0 means never. `plant` is the same for a ``with`` statement.
        """
        request = build(
            plant_service_pb2.CreatePlantRequest,
            id=id,
            model=model,
            settings=settings(**stepping),
            initial=initial_state(at, q, velocity, v, p, initial),
            open_link=open_link,
            expires_s=expires,
        )
        request.settings.tolerance = build(plant_service_pb2.Accuracy, tolerance=tolerance).tolerance
        return Plant._from(self._call(self.plants.CreatePlant, request).plant)

    def get_plant(self, id: str) -> Plant:
        """A plant, its state and its energy."""
        answer = self._call(self.plants.GetPlant, build(plant_service_pb2.GetPlantRequest, id=id))
        return Plant._from(answer.plant, Energy._from(answer.energy))

    def diagnose(
        self,
        id: str = "",
        *,
        model: str = "",
        initial: common_pb2.InitialState | None = None,
    ) -> Diagnostics:
        """What can be said of a plant's present state, or of a state of a model."""
        request = build(plant_service_pb2.DiagnoseRequest, id=id, model=model, initial=initial)
        return Diagnostics._from(self._call(self.plants.Diagnose, request))

    def list_plants(self) -> list[Plant]:
        """All plants, by id."""
        plants: list[Plant] = []
        token = ""
        while True:
            request = build(plant_service_pb2.ListPlantsRequest, page_token=token)
            page = self._call(self.plants.ListPlants, request)
            plants.extend(map(Plant._from, page.plants))
            token = page.next_page_token
            if not token:
                return plants

    def delete_plant(self, id: str) -> None:
        """Ends a plant; whoever drives or watches it gets ``NOT_FOUND``."""
        self._call(self.plants.DeletePlant, build(plant_service_pb2.DeletePlantRequest, id=id))

    def step(
        self, id: str, u: npt.ArrayLike = (), *, count: int | None = None, hold: int = 0
    ) -> list[State]:
        """Takes one step per row of ``u``, ``count`` in all, as ``plantctl step`` does; all their states.

        Steps after the last row repeat it. Without rows there are no input forces, prescribed coordinates stay
        where they are, and one step is taken. ``hold``, steps after the last row, says the same as ``count``.
        To close a loop use `drive`: it is faster and keeps others from stepping in between.
        """
        rows = numbers(u, "u")
        given = len(rows) if rows.size else 0
        if count is not None:
            if hold:
                raise ValueError("give one of `count` and `hold`")
            if not isinstance(count, int) or count < 1:
                raise ValueError(f"`count` is {shown(count)}; a whole number from 1 on is needed")
            if count < given:
                raise ValueError(f"`count` is {count}; `u` has {given} rows")
            hold = count - given
        elif not given and hold == 0:
            hold = 1
        request = build(
            plant_service_pb2.StepRequest,
            id=id,
            u=matrix_message(rows, "u") if rows.size else None,
            hold=hold,
            all_states=True,
        )
        return [State._from(state) for state in self._call(self.plants.Step, request).states]

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
        wanted = []
        for field in texts("fields", fields):
            one_of("fields", field, get_args(Field))
            wanted.append(plant_service_pb2.WatchField.Value(f"WATCH_FIELD_{field.upper()}"))
        request = build(
            plant_service_pb2.WatchRequest,
            id=id,
            fields=wanted,
            every=every,
            coordinates=texts("coordinates", coordinates),
            weights=trajectory_weights(q, r, None, None, projected_momentum),
            queue=queue,
            at_most_hz=at_most_hz,
        )
        # Asked for now rather than at the first message, so that nothing in between is missed.
        return self._messages(self.plants.Watch, request, Watched._from)

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
        request = build(plant_service_pb2.ResetRequest, id=id, initial=state)
        return State._from(self._call(self.plants.Reset, request).state)

    def snapshot(self, id: str) -> bytes:
        """A snapshot: a plant restored from it continues bit for bit."""
        request = build(plant_service_pb2.SnapshotRequest, id=id)
        answer: plant_service_pb2.SnapshotResponse = self._call(self.plants.Snapshot, request)
        return answer.snapshot

    def restore(self, id: str, snapshot: bytes, *, state_alone: bool = False) -> State:
        """Restores a snapshot of a plant of the same model and settings, step count included.

        What was under way in channels and faults goes on; these must be the plant's. With ``state_alone``
        they may be others, and begin at the restored state.
        """
        request = build(
            plant_service_pb2.RestoreRequest, id=id, snapshot=snapshot, state_alone=state_alone
        )
        return State._from(self._call(self.plants.Restore, request).state)

    def set_parameters(
        self, id: str, parameters: Mapping[str, float] | None = None, *, dt: float = 0.0
    ) -> Plant:
        """Changes numbers of a plant's scene, or its time step, while it runs; its state x stays.

        ``parameters`` by where they stand, as in the errors of scenes: ``gravity[1]``,
        ``frames[pole].body.mass``. All of them take effect, or none.
        """
        request = build(
            plant_service_pb2.SetParametersRequest,
            id=id,
            parameters=[
                build(plant_service_pb2.Parameter, path=path, value=value)
                for path, value in mapping("parameters", parameters, "{'gravity[1]': -9.81}").items()
            ],
            time_step_s=dt,
        )
        return Plant._from(self._call(self.plants.SetParameters, request).plant)

    def open_link(self, id: str) -> plant_service_pb2.OpenLinkResponse:
        """Opens the shared-memory link of a plant and says how to reach it."""
        request = build(plant_service_pb2.OpenLinkRequest, id=id)
        answer: plant_service_pb2.OpenLinkResponse = self._call(self.plants.OpenLink, request)
        return answer
