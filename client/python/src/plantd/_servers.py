"""Servers: which one it is, its end, and plants that go from one to another."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

from plantd.v1 import plant_service_pb2, realtime_pb2, server_service_pb2

from ._batch import PlantLike, plant_id
from ._calls import Calls
from ._check import build, shown
from ._errors import PlantdError
from ._plants import Plant

if TYPE_CHECKING:
    from ._client import Client


@dataclass(frozen=True)
class ServerInfo:
    """A server as it describes itself."""

    #: Its name among others.
    name: str
    #: Where clients reach it; empty for a server inside a process.
    address: str
    #: Version of plantd.
    version: str
    #: Of which build the bits of motions are: a plant goes on bit for bit on servers that have the same.
    build: str
    #: It is about to end, and takes nothing new.
    draining: bool
    #: Plants of the caller.
    plants: int

    @classmethod
    def _from(cls, m: server_service_pb2.GetServerResponse) -> ServerInfo:
        return cls(m.name, m.address, m.version, m.build, m.draining, m.plants)


@dataclass(frozen=True)
class Adopted:
    """Plants of another server that were taken over."""

    #: Ids of the plants that are on this server now.
    plants: tuple[str, ...]
    #: Plants that could not be taken, each with why; they stay as they are.
    lost: dict[str, str]


class ServerCalls(Calls):
    """Calls of the service of servers, and the move of a plant."""

    def get_server(self) -> ServerInfo:
        """Which server this is."""
        request = build(server_service_pb2.GetServerRequest)
        return ServerInfo._from(self._call(self.servers.GetServer, request))

    def drain(self, drain_s: float | None = None) -> int:
        """Lets the server end, as SIGTERM does; how many plants are driven.

        It takes nothing new, which is refused with the reason ``DRAINING``, and serves on while plants are driven,
        for ``drain_s`` seconds at most, its own time if that is None. Then it saves its plants, where it has a
        directory for them, and ends.
        """
        answer: server_service_pb2.DrainResponse
        answer = self._call(self.servers.Drain, build(server_service_pb2.DrainRequest, drain_s=drain_s))
        return answer.driven

    def adopt(self, server: str) -> Adopted:
        """Takes the plants over that another server of the same object store has, and does not come back for.

        ``server`` is its name. Plants of a server that ended in good order need no such call: they come to whoever is
        asked for them. Should it live after all, nothing of what it does is saved any more. ``NO_OBJECT_STORE`` when
        this server keeps its plants in no store that others share.
        """
        answer: server_service_pb2.AdoptPlantsResponse
        request = build(server_service_pb2.AdoptPlantsRequest, **{"from": server})
        answer = self._call(self.servers.AdoptPlants, request)
        return Adopted(tuple(answer.plants), {lost.id: lost.problem for lost in answer.lost})

    def move(self, plant: PlantLike, to: Client | str, *, any_build: bool = False) -> Plant:
        """Moves a plant to another server, where it goes on as it was, and describes it there.

        ``to`` is a client of that server or its address. The plant is paused here, made there with everything
        that belongs to it, and then deleted here; who asks for it here is told where it is. A driver in lockstep
        waits meanwhile, and loses no step if it reconnects (`drive`). Leases, watchers, events, counts of timing
        and recordings stay behind. A server of another build is refused with ``OTHER_BUILD`` unless ``any_build``
        is set: the motion goes on there with other round-off.

        When the other server refuses the plant, it stays here, run as it was. ``MOVED_ON`` when somebody has run it
        meanwhile: then the one that was made there is deleted again. After any other error of the last step both may
        be there, the one here paused.
        """
        id = plant_id(plant, "plant")
        if not isinstance(to, (str, Calls)):
            raise TypeError(f"`to` is {shown(to)}; a client or an address is needed")
        there = cast("Client", self._at(to) if isinstance(to, str) else to)
        pb = plant_service_pb2
        # Where it has been before must not be taken for where it is.
        self._moved.pop(id, None)
        exported = self._call(self.plants.ExportPlant, build(pb.ExportPlantRequest, id=id, pause=True))
        record = build(pb.CreatePlantRequest, record=exported.record, any_build=any_build)
        try:
            made = there._call(there.plants.CreatePlant, record).plant
        except PlantdError:
            self._go_on(id, exported.run)
            raise
        there._moved.pop(made.id, None)
        address = made.address or there.address
        request = build(pb.DeletePlantRequest, id=id, moved_to=address, step=exported.step)
        try:
            self._call(self.plants.DeletePlant, request)
        except PlantdError as error:
            if error.reason == "MOVED_ON":
                _try(there, there.plants.DeletePlant, build(pb.DeletePlantRequest, id=made.id))
            # Otherwise it may be deleted here all the same: better two of it than none.
            raise
        if address:
            self._moved[id] = address
        return Plant._from(made)

    def _go_on(self, id: str, run: Any) -> None:
        """Runs a plant as it was run before it was paused."""
        if run.running:
            settings = run.settings if run.HasField("settings") else None
            request = build(realtime_pb2.RunRequest, id=id, settings=settings, steps=run.steps_left)
            _try(self, self.plants.Run, request)


def _try(calls: Calls, method: Any, request: Any) -> None:
    """Makes a call whose own error is not the one to tell."""
    try:
        calls._call(method, request)
    except PlantdError:
        pass
