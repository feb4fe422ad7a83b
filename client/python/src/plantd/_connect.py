"""Connections: addresses, and what is wrong where no server answers."""

from __future__ import annotations

import socket
from typing import Any
from urllib.parse import urlsplit

import grpc

from ._check import shown
from ._errors import PlantdError

#: Answers hold no more than a request asked for; this only stops a runaway peer.
_MAX_RECEIVE_BYTES = 256 << 20

#: Longest wait for a connection.
_CONNECT_SECONDS = 5.0

_UNIX = "unix:"

_HOW_TO_START = (
    "`plantd serve` in a terminal starts a server at http://127.0.0.1:50051; `plantd.launch()` starts one "
    "for this program alone"
)


def open_channel(address: str) -> grpc.Channel:
    """A connection to ``http://host:port``, ``host:port`` or ``unix:/path`` on which a server answers."""
    if not isinstance(address, str):
        raise TypeError(f"`address` is {shown(address)}; a text such as http://127.0.0.1:50051 is needed")
    target = _target(address)
    options: list[tuple[str, Any]] = [("grpc.max_receive_message_length", _MAX_RECEIVE_BYTES)]
    if target.startswith(_UNIX):
        # Without it gRPC sends the path as the authority, which HTTP/2 servers refuse.
        options.append(("grpc.default_authority", "localhost"))
    channel = grpc.insecure_channel(target, options)
    try:
        grpc.channel_ready_future(channel).result(timeout=_CONNECT_SECONDS)
    except grpc.FutureTimeoutError:
        channel.close()
        message = f"cannot connect to {address}: {_problem(target)}. {_HOW_TO_START}"
        raise PlantdError("UNAVAILABLE", message) from None
    return channel


def _target(address: str) -> str:
    """What gRPC calls an address."""
    if address.startswith(_UNIX):
        path = address.removeprefix(_UNIX).removeprefix("//")
        if path.startswith("/"):
            return _UNIX + path
        raise _refused(address, "the path of a socket begins with `/`")
    scheme, separator, place = address.partition("://")
    if not separator:
        scheme, place = "http", address
    place = place.rstrip("/")
    if scheme == "https":
        raise _refused(address, "plantd does not speak TLS")
    if scheme != "http":
        raise _refused(address, "the scheme is unknown")
    if not place:
        raise _refused(address, "it names no host")
    try:
        has_port = urlsplit(f"//{place}").port is not None
    except ValueError:
        raise _refused(address, "it cannot be read") from None
    return place if has_port else f"{place}:80"


def _refused(address: str, problem: str) -> PlantdError:
    message = f"`{address}` is not an address: {problem}; write http://host:port or unix:/path"
    return PlantdError("INVALID_ARGUMENT", message)


def _problem(target: str) -> str:
    """Why gRPC got no answer; it does not tell, so that the connection is made once more by hand."""
    is_unix = target.startswith(_UNIX)
    try:
        if is_unix:
            with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as by_hand:
                by_hand.settimeout(_CONNECT_SECONDS)
                by_hand.connect(target.removeprefix(_UNIX))
        else:
            place = urlsplit(f"//{target}")
            socket.create_connection((place.hostname, place.port), _CONNECT_SECONDS).close()
    except socket.gaierror:
        return "there is no host of that name; is it spelt right? A number such as 127.0.0.1 will do too"
    except FileNotFoundError:
        return "there is no such socket; plantd makes it when it starts, with `--unix` and this path"
    except PermissionError:
        return (
            "permission denied: to write to the socket you have to be its owner or in its group, unless "
            "the server's `unix_mode` says otherwise"
        )
    except ConnectionRefusedError:
        if is_unix:
            return "connection refused: the server of this socket has ended, or it is no socket; start it again"
        return "connection refused: no server listens there; is plantd running, and is this its port?"
    except TimeoutError:
        return (
            f"no answer within {_CONNECT_SECONDS:g} s; is the host right and running, and does a firewall "
            "keep the port closed?"
        )
    except OSError as error:
        return str(error)
    return (
        "what answers there does not speak gRPC without TLS, or has no room for more connections; is this "
        "the port of plantd's gRPC, and not that of its metrics or of another server?"
    )
