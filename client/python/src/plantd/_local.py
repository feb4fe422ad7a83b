"""A server inside this process: the same client, and nothing in between."""

from __future__ import annotations

import threading
import weakref
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from os import PathLike, fspath
from typing import TYPE_CHECKING, Any

import numpy as np

from ._arrays import Vector, vector
from ._channels import Outputs
from ._check import mapping
from ._client import Client
from ._drive import Driver
from ._errors import PlantdError, StepError, error_of
from ._states import State, StepReport

if TYPE_CHECKING:
    from plantd.v1 import plant_service_pb2 as pb

    from . import _native


def local(
    *,
    limits: Mapping[str, int] | None = None,
    recordings: str | PathLike[str] | None = None,
    timeout: float = 60.0,
) -> Client:
    """A client of a server inside this process, without a socket: all calls, and the same bits.

        with plantd.local() as client, client.plant("pendulum", q=[3.0]) as plant:
            ...

    What steps and computes runs in threads of this process, without Python's lock. `Driver.step` takes and
    gives arrays and needs microseconds. ``limits`` of the server by name, such as ``{"plants": 10}``;
    ``recordings`` is the folder of recordings; ``timeout`` in seconds limits each call that is not a stream.
    The server and its plants end with the client. A process that is forked off this one makes its own.
    """
    try:
        from . import _native
    except ImportError:
        raise ImportError(
            "this installation of plantd is the client alone: `plantd.local` needs a wheel with the server "
            "in it, which `python3 client/python/wheel.py` builds; `plantd.launch()` starts a server beside "
            "this process"
        ) from None
    values = mapping("limits", limits, "{'plants': 10}")
    for name, value in values.items():
        if not isinstance(value, int) or value < 0:
            raise ValueError(f"`limits` has {name} = {value!r}; a whole number is needed, not below 0")
    folder = None if recordings is None else fspath(recordings)
    with _translated():
        server = _native.Server(dict(values), folder)
    return LocalClient(server, timeout=timeout)


@contextmanager
def _translated() -> Iterator[None]:
    from . import _native

    try:
        yield
    except _native.Refused as refused:
        code, message, details, goes_on = refused.args
        raise error_of(code, message, bytes(details), StepError if goes_on else PlantdError) from None


class LocalChannel:
    """What the generated stubs need of a channel."""

    def __init__(self, server: _native.Server):
        self.server = server
        #: Ends the server; also at exit.
        self.close = weakref.finalize(self, server.stop)

    def unary_unary(
        self,
        path: str,
        request_serializer: Callable[[Any], bytes],
        response_deserializer: Callable[[bytes], Any],
        **_: Any,
    ) -> Callable[..., Any]:
        """A call of one message each way."""
        server = self.server

        def call(request: Any, timeout: float | None = None) -> Any:
            with _translated():
                return response_deserializer(server.unary(path, request_serializer(request), timeout))

        return call

    def unary_stream(
        self,
        path: str,
        request_serializer: Callable[[Any], bytes],
        response_deserializer: Callable[[bytes], Any],
        **_: Any,
    ) -> Callable[..., Any]:
        """A call with a stream of answers."""

        def call(request: Any) -> Answers:
            with _translated():
                return Answers(self.server.stream(path, request_serializer(request)), response_deserializer)

        return call

    def stream_stream(
        self,
        path: str,
        request_serializer: Callable[[Any], bytes],
        response_deserializer: Callable[[bytes], Any],
        **_: Any,
    ) -> Callable[..., Any]:
        """A call with a stream each way."""

        def call(requests: Iterator[Any]) -> Answers:
            with _translated():
                call = self.server.stream(path)

            def send() -> None:
                for request in requests:
                    call.send(request_serializer(request))
                call.finish()

            threading.Thread(target=send, daemon=True).start()
            return Answers(call, response_deserializer)

        return call


class Answers:
    """The answers of a call, as gRPC gives them."""

    def __init__(self, call: _native.Call, deserialize: Callable[[bytes], Any]):
        self._call = call
        self._deserialize = deserialize

    def __iter__(self) -> Answers:
        return self

    def __next__(self) -> Any:
        with _translated():
            answer = self._call.next()
        if answer is None:
            raise StopIteration
        return self._deserialize(answer)

    def cancel(self) -> None:
        """Ends the call."""
        self._call.cancel()


class LocalClient(Client):
    """A client of a server in this process."""

    def __init__(self, server: _native.Server, *, timeout: float):
        self._server = server
        super().__init__("", timeout=timeout)

    def _open(self, address: str) -> LocalChannel:
        return LocalChannel(self._server)

    def _driver(self, open: pb.DriveOpen) -> Driver:
        if open.linearization or open.grace_s or open.resume:
            return Driver(self.plants, open)
        return LocalDriver(self, self._server, open)


class LocalDriver(Driver):
    """Steps a plant in lockstep without a message; goes over to the stream where there is something to wait for."""

    def __init__(self, client: LocalClient, server: _native.Server, open: pb.DriveOpen):
        self._client, self._open = client, open
        with _translated():
            self._lease: _native.Lease | None = server.lease(open.id)
        self.timing = None
        self.dropped = 0
        self.linearization = None
        self.u = None
        self.outputs = None
        self.lease_token = ""
        self._numbers: tuple[Any, ...] | None = None
        self.plant = client.get_plant(open.id)

    @property
    def report(self) -> StepReport | None:
        """What the solver did in the last step."""
        return None if self._numbers is None else StepReport(*self._numbers)

    @report.setter
    def report(self, report: StepReport | None) -> None:
        self._numbers = None if report is None else tuple(vars(report).values())

    def step(self, u: Vector = ()) -> State:
        if self._lease is None:
            return super().step(u)
        u = np.ascontiguousarray(vector(u, "u"))
        try:
            step = self._lease.step(u)
        except Exception:
            # What a loop does not pay for where nothing is wrong.
            with _translated():
                raise
        if step is None:
            self._go_over()
            return super().step(u)
        (index, time, parts), self._numbers, self.u, outputs = step
        self.outputs = None
        if outputs is not None:
            y, lost = outputs
            self.outputs = Outputs(y, tuple(int(i) for i in lost.nonzero()[0]))
        q, p, v, multipliers, velocity = parts
        time_step = self._time_step(index, time)
        return State(index, time, q, p, v, multipliers, self.plant.model, time_step, velocity)

    def offer(self, u: Vector) -> None:
        self._go_over()
        super().offer(u)

    def next(self) -> State:
        self._go_over()
        return super().next()

    def close(self) -> None:
        if self._lease is not None:
            self._lease.close()
        else:
            super().close()

    def _go_over(self) -> None:
        """From now on the stream drives the plant."""
        if self._lease is not None:
            self._lease.close()
            self._lease = None
            super().__init__(self._client.plants, self._open)
