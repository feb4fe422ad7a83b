"""Arrays, and the messages that they come in."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any, Union

import numpy as np
import numpy.typing as npt

from plantd.v1 import common_pb2, control_service_pb2

Array = npt.NDArray[np.float64]
Vector = Union[Sequence[float], npt.NDArray[Any], float]


def array(values: Iterable[float]) -> Array:
    """A repeated field as an array."""
    return np.array(values if hasattr(values, "__len__") else list(values), dtype=np.float64)


def vector(values: Vector) -> Array:
    """What a caller gave as a vector; a number stands for a vector of one."""
    out = np.atleast_1d(np.asarray(values, dtype=np.float64))
    if out.ndim != 1:
        raise ValueError(f"a vector is needed, not an array of shape {out.shape}")
    return out


def matrix(m: common_pb2.Matrix) -> Array:
    """A matrix message as an array."""
    return array(m.data).reshape(m.rows, m.cols)


def optional_matrix(m: Any, field: str) -> Array | None:
    """A field as an array; None where it is not set."""
    return matrix(getattr(m, field)) if m.HasField(field) else None


def tensor(m: common_pb2.Tensor) -> Array:
    """A tensor message as an array [output][first][second]."""
    return array(m.data).reshape(m.outputs, m.first, m.second)


def complexes(values: Iterable[control_service_pb2.Complex]) -> npt.NDArray[np.complex128]:
    """Complex numbers as an array."""
    return np.array([complex(z.real, z.imaginary) for z in values], dtype=np.complex128)


def matrix_message(values: npt.ArrayLike) -> common_pb2.Matrix:
    """An array as a matrix message; one row per step where it is a sequence of inputs."""
    a = np.asarray(values, dtype=np.float64)
    if a.ndim != 2:
        raise ValueError(f"a matrix is needed, not an array of shape {a.shape}")
    return common_pb2.Matrix(rows=a.shape[0], cols=a.shape[1], data=a.ravel())


def weight(values: npt.ArrayLike) -> common_pb2.Weight:
    """A weight: a vector is a diagonal, a matrix is itself."""
    a = np.asarray(values, dtype=np.float64)
    if a.ndim == 2:
        return common_pb2.Weight(full=matrix_message(a))
    return common_pb2.Weight(diagonal=common_pb2.Diagonal(values=vector(a)))


def failure_text(m: Any) -> str:
    """The failure that a message carries; empty if there is none."""
    return f"{m.failure.reason}: {m.failure.message}" if m.HasField("failure") else ""
