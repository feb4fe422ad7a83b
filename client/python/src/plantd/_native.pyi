"""The server inside this process; what `_local` is made of."""

from os import PathLike
from typing import final

import numpy as np
import numpy.typing as npt

_Array = npt.NDArray[np.float64]

class Refused(Exception):
    """Its arguments: number of the code, message, details, and whether the plant's driver goes on."""

    args: tuple[int, str, bytes, bool]

@final
class Server:
    def __new__(cls, limits: dict[str, int], recordings: str | PathLike[str] | None = None) -> Server: ...
    def unary(self, path: str, request: bytes, timeout_s: float | None = None) -> bytes: ...
    def stream(self, path: str, request: bytes | None = None) -> Call: ...
    def lease(self, id: str) -> Lease: ...
    def stop(self) -> None: ...

@final
class Call:
    def send(self, request: bytes) -> None: ...
    def finish(self) -> None: ...
    def next(self) -> bytes | None: ...
    def cancel(self) -> None: ...

@final
class Lease:
    def step(
        self, u: _Array
    ) -> (
        tuple[
            tuple[int, float, list[_Array]],
            tuple[int, int, float, float, float, float, int, int, int],
            _Array | None,
            list[_Array] | None,
        ]
        | None
    ): ...
    def close(self) -> None: ...
