"""What all calls of a client have in common."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, TypeVar

from plantd.v1.channel_service_pb2_grpc import ChannelServiceStub
from plantd.v1.control_service_pb2_grpc import ControlServiceStub
from plantd.v1.model_service_pb2_grpc import ModelServiceStub
from plantd.v1.plant_service_pb2 import CreatePlantRequest
from plantd.v1.plant_service_pb2_grpc import PlantServiceStub
from plantd.v1.recording_service_pb2_grpc import RecordingServiceStub
from plantd.v1.server_service_pb2_grpc import ServerServiceStub

from ._connect import Credentials, check_token_stays_hidden, open_channel
from ._errors import PlantdError, translate, translated

if TYPE_CHECKING:
    from ._client import Client

_R = TypeVar("_R")

#: So many servers, each of which knows the next, are asked for a plant.
_HOPS = 8


class Calls:
    """A connection with its stubs, and how a call is made over it."""

    def __init__(self, address: str, *, timeout: float = 60.0, credentials: Credentials | None = None, authority: str | None = None):
        #: Where it is connected to; empty for a server in this process.
        self.address = address
        self._credentials = credentials
        self._authority = authority
        self._channel = self._open(address)
        self._timeout = timeout
        self._is_closed = False
        #: Connections to servers to which plants have gone, by address.
        self._others: dict[str, Client] = {}
        self._connecting = threading.Lock()
        #: Addresses to which plants of this server have gone, by id.
        self._moved: dict[str, str] = {}
        self.models = ModelServiceStub(self._channel)
        self.plants = PlantServiceStub(self._channel)
        self.control = ControlServiceStub(self._channel)
        self.channels = ChannelServiceStub(self._channel)
        self.recordings = RecordingServiceStub(self._channel)
        self.servers = ServerServiceStub(self._channel)

    def _open(self, address: str) -> Any:
        return open_channel(address, self._credentials, self._authority)

    def close(self) -> None:
        """Closes the connection; streams end."""
        self._is_closed = True
        for other in self._others.values():
            other.close()
        self._channel.close()

    def at(self, address: str) -> Client:
        """A client of another server, with the same credentials and timeout, which is closed by whoever asks for it.

        Refused where the token would go to a server without TLS although it has been hidden so far.
        """
        from ._client import Client

        check_token_stays_hidden(self.address, address, self._credentials)
        return Client(address, timeout=self._timeout, credentials=self._credentials)

    def _at(self, address: str) -> Calls:
        """The same, kept and closed with this client; itself at its own address."""
        if address == self.address:
            return self
        with self._connecting:
            if address not in self._others:
                self._others[address] = self.at(address)
            return self._others[address]

    def _following(self, id: str, call: Callable[[Calls], _R]) -> _R:
        """Makes a call where the plant is: one that is refused with its address has done nothing."""
        here: Calls = self
        for _ in range(_HOPS):
            try:
                return call(here)
            except PlantdError as error:
                address = error.elsewhere
                if not address and error.code == "UNAVAILABLE":
                    # The server has ended; where the plant went it has said before.
                    address = here._moved.get(id, "")
                if not address:
                    raise
            here._moved[id] = address
            here = self._at(address)
        return call(here)

    def _call(self, method: Any, request: Any, limited: bool = True) -> Any:
        if len(getattr(request, "ids", ())) > 1 or isinstance(request, CreatePlantRequest):
            # Its plants may be on several servers; one that is made is nowhere yet.
            return self._ask(method, request, limited)

        def call(calls: Calls) -> Any:
            return calls._ask(calls._same(self, method), request, limited)

        return self._following(getattr(request, "id", ""), call)

    @translate
    def _ask(self, method: Any, request: Any, limited: bool) -> Any:
        return method(request, timeout=self._timeout if limited else None)

    def _same(self, other: Calls, method: Any) -> Any:
        """The call of this client's stubs that ``method`` is of the other's."""
        if other is self:
            return method
        for service in ("models", "plants", "control", "channels", "recordings", "servers"):
            for name, known in vars(getattr(other, service)).items():
                if known is method:
                    return getattr(getattr(self, service), name)
        raise AssertionError(method)

    def _messages(self, method: Any, request: Any, convert: Callable[[Any], _R]) -> Iterator[_R]:
        """Answers of a stream, which is asked for now, and where its plant is if that has gone."""
        stream = self._begin(method, request)
        is_asked = True

        def messages() -> Iterator[_R]:
            nonlocal stream
            try:
                first = self._following(getattr(request, "id", ""), begin)
                while first is not None:
                    yield convert(first)
                    first = _next(stream)
            finally:
                stream.cancel()

        def begin(calls: Calls) -> Any:
            nonlocal stream, is_asked
            if not is_asked:
                stream = calls._begin(calls._same(self, method), request)
            is_asked = False
            return _next(stream)

        return messages()

    @translate
    def _begin(self, method: Any, request: Any) -> Any:
        return method(request)


def _next(stream: Any) -> Any:
    """The next message of a stream; None at its end."""
    with translated():
        return next(stream, None)
