"""The client: one method per thing that a controller's author wants."""

from __future__ import annotations

from os import PathLike
from typing import TYPE_CHECKING

from ._batch import BatchCalls
from ._channels import ChannelCalls
from ._connect import Credentials
from ._drive import DriveCalls
from ._feedback import FeedbackCalls
from ._handle import HandleCalls
from ._kalman import KalmanCalls
from ._linearize import LinearizeCalls
from ._lqr import LqrCalls
from ._mechanics import MechanicsCalls
from ._optimize import OptimizeCalls
from ._realtime import RealtimeCalls
from ._recordings import RecordingCalls
from ._servers import ServerCalls
from ._tables import TableCalls

if TYPE_CHECKING:
    from ._launch import Server

#: Where a server listens unless it is told otherwise.
DEFAULT_ADDRESS = "http://127.0.0.1:50051"


def connect(
    address: str = DEFAULT_ADDRESS,
    *,
    timeout: float = 60.0,
    token: str | None = None,
    ca: str | PathLike[str] | None = None,
    cert: str | PathLike[str] | None = None,
    key: str | PathLike[str] | None = None,
    authority: str | None = None,
) -> Client:
    """Connects to ``http://host:port``, ``https://host:port``, ``host:port`` or ``unix:/path``.

    A server that is just starting is waited for, 5 seconds at most; after that the error says what
    there is in its place. ``timeout`` in seconds limits each call that is not a stream.

    Where the server asks who calls, ``token`` says it, or a certificate ``cert`` with its ``key``; ``ca`` has
    the certificates of the CA that issued the server's, without which those count that gRPC knows. These three
    are files in PEM. What is not given comes from the variables PLANTD_TOKEN, PLANTD_CA, PLANTD_CERT and
    PLANTD_KEY.

    ``authority`` is the name by which the server is called where its address says another one: that of a server
    behind a gateway.
    """
    credentials = Credentials.of(token, ca, cert, key)
    return Client(address, timeout=timeout, credentials=credentials, authority=authority)


class Client(
    TableCalls,
    HandleCalls,
    DriveCalls,
    RealtimeCalls,
    ChannelCalls,
    RecordingCalls,
    FeedbackCalls,
    LinearizeCalls,
    MechanicsCalls,
    LqrCalls,
    KalmanCalls,
    OptimizeCalls,
    BatchCalls,
    ServerCalls,
):
    """A connection to a server. Use it in a ``with`` statement, or call ``close``.

    ``models``, ``plants``, ``control``, ``channels``, ``recordings`` and ``servers`` are the generated stubs,
    for what is not wrapped.

    A plant that has gone to another server is asked for there: calls that are refused with its address are
    made once more at that address, with this client's credentials.
    """

    #: The server that `plantd.launch` has started for this client.
    server: Server | None = None

    def close(self) -> None:
        """Closes the connection; streams end, and so does the server of `plantd.launch`."""
        super().close()
        if self.server is not None:
            self.server.stop()

    def __enter__(self) -> Client:
        return self

    def __exit__(self, *exception: object) -> None:
        self.close()
