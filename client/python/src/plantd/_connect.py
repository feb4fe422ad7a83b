"""Connections: addresses, and what is wrong where no server answers."""

from __future__ import annotations

import os
import socket
import ssl
from collections import namedtuple
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import grpc

from ._check import shown
from ._errors import PlantdError

#: Answers hold no more than a request asked for; this only stops a runaway peer.
_MAX_RECEIVE_BYTES = 256 << 20

#: Longest wait for a connection.
_CONNECT_SECONDS = 5.0

#: First and longest pause between two attempts to connect, ms: a server that comes back is found at once.
_RECONNECT_MS = (100, 500)

_UNIX = "unix:"

_HOW_TO_START = (
    "`plantd serve` in a terminal starts a server at http://127.0.0.1:50051; `plantd.launch()` starts one "
    "for this program alone"
)


@dataclass(frozen=True)
class Credentials:
    """How a client shows who it is, and how it knows the server; files are in PEM."""

    token: str | None = field(default=None, repr=False)
    ca: str | None = None
    cert: str | None = None
    key: str | None = None

    @classmethod
    def of(
        cls,
        token: str | None,
        ca: str | PathLike[str] | None,
        cert: str | PathLike[str] | None,
        key: str | PathLike[str] | None,
    ) -> Credentials:
        """What is given; for what is not, the variables ``PLANTD_TOKEN``, ``PLANTD_CA`` and so on."""

        def chosen(given: str | PathLike[str] | None, name: str) -> str | None:
            return os.fspath(given) if given is not None else os.environ.get(name) or None

        return cls(
            chosen(token, "PLANTD_TOKEN"),
            chosen(ca, "PLANTD_CA"),
            chosen(cert, "PLANTD_CERT"),
            chosen(key, "PLANTD_KEY"),
        )

    def of_tls(self) -> grpc.ChannelCredentials:
        """What gRPC makes a connection with."""
        if (self.cert is None) != (self.key is None):
            raise PlantdError("INVALID_ARGUMENT", "`cert` and `key` belong together: one of them is missing")
        ca, key, cert = (_read(name, getattr(self, name)) for name in ("ca", "key", "cert"))
        return grpc.ssl_channel_credentials(ca, key, cert)


def _read(name: str, path: str | None) -> bytes | None:
    if path is None:
        return None
    try:
        return Path(path).read_bytes()
    except OSError as error:
        raise PlantdError("INVALID_ARGUMENT", f"`{name}`: {error}") from None


class _Details(
    namedtuple("_Details", ("method", "timeout", "metadata", "credentials", "wait_for_ready", "compression")),
    grpc.ClientCallDetails,
):
    """What a call is made with."""


class _WithToken(
    grpc.UnaryUnaryClientInterceptor,
    grpc.UnaryStreamClientInterceptor,
    grpc.StreamUnaryClientInterceptor,
    grpc.StreamStreamClientInterceptor,
):
    """Sends a token with every call; gRPC itself would not without TLS, over a unix-domain socket either."""

    def __init__(self, token: str):
        self._header = ("authorization", f"Bearer {token.strip()}")

    def _call(self, go_on: Any, details: Any, request: Any) -> Any:
        metadata = [*(details.metadata or ()), self._header]
        return go_on(
            _Details(
                details.method,
                details.timeout,
                metadata,
                details.credentials,
                details.wait_for_ready,
                details.compression,
            ),
            request,
        )

    def intercept_unary_unary(self, continuation: Any, client_call_details: Any, request: Any) -> Any:
        return self._call(continuation, client_call_details, request)

    def intercept_unary_stream(self, continuation: Any, client_call_details: Any, request: Any) -> Any:
        return self._call(continuation, client_call_details, request)

    def intercept_stream_unary(self, continuation: Any, client_call_details: Any, request_iterator: Any) -> Any:
        return self._call(continuation, client_call_details, request_iterator)

    def intercept_stream_stream(self, continuation: Any, client_call_details: Any, request_iterator: Any) -> Any:
        return self._call(continuation, client_call_details, request_iterator)


def open_channel(
    address: str, credentials: Credentials | None = None, authority: str | None = None
) -> grpc.Channel:
    """A connection to ``http://host:port``, ``https://host:port``, ``host:port`` or ``unix:/path`` on which a
    server answers, that of the name ``authority`` if it is given."""
    if not isinstance(address, str):
        raise TypeError(f"`address` is {shown(address)}; a text such as http://127.0.0.1:50051 is needed")
    target = _target(address)
    options: list[tuple[str, Any]] = [
        ("grpc.max_receive_message_length", _MAX_RECEIVE_BYTES),
        ("grpc.initial_reconnect_backoff_ms", _RECONNECT_MS[0]),
        ("grpc.max_reconnect_backoff_ms", _RECONNECT_MS[1]),
    ]
    if authority is None and target.startswith(_UNIX):
        # Without it gRPC sends the path as the authority, which HTTP/2 servers refuse.
        authority = "localhost"
    if authority is not None:
        options.append(("grpc.default_authority", authority))
    credentials = credentials or Credentials()
    is_secured = address.startswith("https://")
    if is_secured:
        channel = grpc.secure_channel(target, credentials.of_tls(), options)
    else:
        channel = grpc.insecure_channel(target, options)
    try:
        grpc.channel_ready_future(channel).result(timeout=_CONNECT_SECONDS)
    except grpc.FutureTimeoutError:
        channel.close()
        message = f"cannot connect to {address}: {_problem(target, credentials if is_secured else None)}. {_HOW_TO_START}"
        raise PlantdError("UNAVAILABLE", message) from None
    if credentials.token is not None:
        return grpc.intercept_channel(channel, _WithToken(credentials.token))
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
    if scheme not in ("http", "https"):
        raise _refused(address, "the scheme is unknown")
    if not place:
        raise _refused(address, "it names no host")
    try:
        has_port = urlsplit(f"//{place}").port is not None
    except ValueError:
        raise _refused(address, "it cannot be read") from None
    return place if has_port else f"{place}:{443 if scheme == 'https' else 80}"


def check_token_stays_hidden(here: str, there: str, credentials: Credentials | None) -> None:
    """That a token which nobody on the way could read is not sent to a server without TLS."""
    hidden = ("https://", _UNIX)
    if credentials is None or credentials.token is None or here == there:
        return
    if here.startswith(hidden) and not there.startswith(hidden):
        message = f"the token is not sent to {there}: it is without TLS, and everybody on the way could read it"
        raise PlantdError("INVALID_ARGUMENT", message)


def _refused(address: str, problem: str) -> PlantdError:
    message = f"`{address}` is not an address: {problem}; write http://host:port, https://host:port or unix:/path"
    return PlantdError("INVALID_ARGUMENT", message)


def _problem(target: str, secured: Credentials | None = None) -> str:
    """Why gRPC got no answer; it does not tell, so that the connection is made once more by hand."""
    is_unix = target.startswith(_UNIX)
    try:
        if is_unix:
            with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as by_hand:
                by_hand.settimeout(_CONNECT_SECONDS)
                by_hand.connect(target.removeprefix(_UNIX))
        else:
            place = urlsplit(f"//{target}")
            with socket.create_connection((place.hostname, place.port), _CONNECT_SECONDS) as by_hand:
                if secured is not None:
                    return _tls_problem(by_hand, place.hostname or "", secured)
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
        "the port of plantd's gRPC, and not that of its metrics or of another server? One with TLS is at https://"
    )


def _tls_problem(connection: socket.socket, host: str, credentials: Credentials) -> str:
    """Which side refuses TLS, and why; gRPC does not tell."""
    try:
        context = ssl.create_default_context(cafile=credentials.ca)
        if credentials.cert is not None:
            context.load_cert_chain(credentials.cert, credentials.key)
        context.set_alpn_protocols(["h2"])
        with context.wrap_socket(connection, server_hostname=host) as secured:
            # With TLS 1.3 a server looks at the client's certificate after the client has done.
            secured.sendall(b"PRI * HTTP/2.0\r\n\r\nSM\r\n\r\n\x00\x00\x00\x04\x00\x00\x00\x00\x00")
            secured.recv(1)
    except ssl.SSLCertVerificationError as error:
        return f"this client refuses the server's certificate: {error.verify_message}; is `ca` the server's CA?"
    except ssl.SSLError as error:
        reason = (error.reason or str(error)).replace("_", " ").lower()
        if "certificate required" in reason:
            return "the server refuses this client: it lets in only those with a certificate; give `cert` and `key`"
        if "wrong version number" in reason or "record layer" in reason:
            return "what answers there does not speak TLS: write http:// in place of https://"
        return f"TLS was refused: {reason}; did a CA issue the client's certificate that the server trusts?"
    except OSError as error:
        return str(error)
    return "it speaks TLS, but does not answer as gRPC; is this the port of plantd's gRPC?"
