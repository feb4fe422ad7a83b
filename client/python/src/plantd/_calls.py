"""What all calls of a client have in common."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from plantd.v1.channel_service_pb2_grpc import ChannelServiceStub
from plantd.v1.control_service_pb2_grpc import ControlServiceStub
from plantd.v1.model_service_pb2_grpc import ModelServiceStub
from plantd.v1.plant_service_pb2_grpc import PlantServiceStub
from plantd.v1.recording_service_pb2_grpc import RecordingServiceStub

from ._connect import Credentials, open_channel
from ._errors import translate, translated


class Calls:
    """A connection with its stubs, and how a call is made over it."""

    def __init__(self, address: str, *, timeout: float = 60.0, credentials: Credentials | None = None):
        self._credentials = credentials
        self._channel = self._open(address)
        self._timeout = timeout
        self.models = ModelServiceStub(self._channel)
        self.plants = PlantServiceStub(self._channel)
        self.control = ControlServiceStub(self._channel)
        self.channels = ChannelServiceStub(self._channel)
        self.recordings = RecordingServiceStub(self._channel)

    def _open(self, address: str) -> Any:
        return open_channel(address, self._credentials)

    @translate
    def _call(self, method: Any, request: Any, limited: bool = True) -> Any:
        return method(request, timeout=self._timeout if limited else None)

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
