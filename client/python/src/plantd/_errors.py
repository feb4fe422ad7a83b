"""Errors, with the details that the server sends."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, TypeVar

import grpc
from google.rpc import error_details_pb2, status_pb2  # type: ignore[import-untyped]

from plantd.v1 import common_pb2

#: What is said where a call did not reach the server, or its answer not the client.
_TRANSPORT = {
    "UNAVAILABLE": "the server does not answer any more: it has ended, or the connection broke",
    "DEADLINE_EXCEEDED": "no answer within the client's `timeout`; `plantd.connect` takes a longer one",
    "UNIMPLEMENTED": "the server does not know this call: it is another version than this package",
    "CANCELLED": "the call was cancelled here",
}

_DETAILS_KEY = "grpc-status-details-bin"
_Function = TypeVar("_Function", bound=Callable[..., Any])


@dataclass(frozen=True)
class Violation:
    """One fault of a request."""

    #: Path of the field, for example ``frames[3].body.mass`` in a scene.
    field: str
    #: What is wrong with it.
    description: str


class PlantdError(Exception):
    """A call was refused or failed, or a stream ended with an error."""

    def __init__(
        self,
        code: str,
        message: str,
        reason: str = "",
        violations: tuple[Violation, ...] = (),
        metadata: Mapping[str, str] | None = None,
    ):
        lines = [f"{code} ({reason}): {message}" if reason else f"{code}: {message}"]
        lines += [
            f"  {violation.field}: {violation.description}"
            for violation in violations
            if violation.description not in message
        ]
        super().__init__("\n".join(lines))
        #: gRPC code, for example ``NOT_FOUND``.
        self.code = code
        #: A sentence that names the culprit.
        self.message = message
        #: Upper-case reason, for example ``LEASE_HELD``; empty if there is none.
        self.reason = reason
        #: The faults of the request.
        self.violations = violations
        #: What belongs to the reason, for example ``address`` of ``PLANT_ELSEWHERE``.
        self.metadata: dict[str, str] = dict(metadata or {})

    @property
    def elsewhere(self) -> str:
        """Address of the server to which the plant has gone; empty for all other errors."""
        return self.metadata.get("address", "") if self.reason == "PLANT_ELSEWHERE" else ""

    def __reduce__(self) -> tuple[Any, ...]:
        # Processes hand errors to one another.
        return type(self), (self.code, self.message, self.reason, self.violations, self.metadata)


class StepError(PlantdError):
    """A step was refused or failed; the plant is where it was and the driver goes on."""


class _AtAnotherStep(PlantdError):
    """A plant is at another step than its driver has left it at. The input was not taken; the driver goes on there."""

    _code: str
    _reason: str
    _said: str

    def __init__(self, from_step: int, to_step: int):
        super().__init__(self._code, self._said.format(from_step, to_step), self._reason)
        #: The last step that was seen.
        self.from_step = from_step
        #: The step at which the plant is.
        self.to_step = to_step

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.from_step, self.to_step)


class RolledBack(_AtAnotherStep):
    """The server came back with an earlier state than a driver had seen: the steps in between are lost.

    The input was not taken; the driver goes on from there.
    """

    _code, _reason = "DATA_LOSS", "ROLLED_BACK"
    _said = "step {} had been reached, the server is at step {}"


class SteppedByOthers(_AtAnotherStep):
    """Somebody else has stepped a plant while its driver was away.

    The input was not taken; the driver goes on from there.
    """

    _code, _reason = "ABORTED", "STEPPED_BY_OTHERS"
    _said = "the plant was at step {} when its driver lost it, and is at step {}"


def is_lost(error: PlantdError) -> bool:
    """Whether an error is of the connection, or of a server that ends, and not of the plant or the request."""
    if isinstance(error, StepError):
        return False
    if error.code in ("UNAVAILABLE", "DEADLINE_EXCEEDED") or error.reason == "LEASE_LOST" or error.elsewhere:
        return True
    return error.code in ("INTERNAL", "UNKNOWN", "CANCELLED") and not error.reason


def from_failure(failure: common_pb2.Failure, kind: type[PlantdError] = StepError) -> PlantdError:
    """The error of a step, or of something else, that failed in band."""
    return kind(_code_name(failure.code), failure.message, failure.reason)


def from_rpc_error(error: grpc.RpcError) -> PlantdError:
    """The error of a call."""
    if not isinstance(error, grpc.Call):
        return PlantdError("UNKNOWN", str(error))
    metadata = dict(error.trailing_metadata() or ())
    reason, violations, said = _details(metadata.get(_DETAILS_KEY, b""))
    code, message = error.code().name, error.details() or ""
    if code == "CANCELLED" and message == "Timeout expired":
        # The server keeps the client's time as well, and was the first to see that it is over.
        code = "DEADLINE_EXCEEDED"
    if not reason:
        # It did not come from the server.
        message = _TRANSPORT.get(code, message)
    return PlantdError(code, message, reason, violations, said)


def error_of(number: int, message: str, details: bytes, kind: type[PlantdError] = PlantdError) -> PlantdError:
    """The error of a call in this process: number of the code, message, and details as the server sends them."""
    return kind(_code_name(number), message, *_details(details))


def _details(value: bytes) -> tuple[str, tuple[Violation, ...], dict[str, str]]:
    """Reason, faults of the request, and what belongs to the reason."""
    reason, violations, metadata = "", [], {}
    for detail in status_pb2.Status.FromString(value).details:
        info, request = error_details_pb2.ErrorInfo(), error_details_pb2.BadRequest()
        if detail.Unpack(info):
            reason, metadata = info.reason, dict(info.metadata)
        elif detail.Unpack(request):
            violations += [Violation(v.field, v.description) for v in request.field_violations]
    return reason, tuple(violations), metadata


def _code_name(number: int) -> str:
    for code in grpc.StatusCode:
        if code.value[0] == number:
            return code.name
    return "UNKNOWN"


@contextmanager
def translated() -> Iterator[None]:
    """Raises gRPC's errors as this package's."""
    try:
        yield
    except grpc.RpcError as error:
        raise from_rpc_error(error) from None
    except ValueError as error:
        if "closed channel" not in str(error) and "Channel closed" not in str(error):
            raise
        raise PlantdError("CANCELLED", "the client is closed") from None


def translate(function: _Function) -> _Function:
    """The same for a whole function."""

    @functools.wraps(function)
    def wrapper(*args: Any, **kwargs: Any) -> Any:
        with translated():
            return function(*args, **kwargs)

    return wrapper  # type: ignore[return-value]
