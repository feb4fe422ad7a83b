"""Arrays, and the messages that they come in."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, Union

import numpy as np
import numpy.typing as npt

from plantd.v1 import common_pb2

from ._check import shown

Array = npt.NDArray[np.float64]
Vector = Union[Sequence[float], npt.NDArray[Any], float]


def array(values: Iterable[float]) -> Array:
    """A repeated field as an array."""
    return np.array(values if hasattr(values, "__len__") else list(values), dtype=np.float64)


def numbers(values: npt.ArrayLike, name: str) -> Array:
    """What a caller gave as numbers."""
    if values is None or isinstance(values, (str, bytes, Mapping)):
        raise TypeError(f"`{name}` is {shown(values)}; numbers are needed")
    try:
        return np.asarray(values, dtype=np.float64)
    except (TypeError, ValueError):
        raise TypeError(f"`{name}` is {shown(values)}; numbers are needed, in rows of one length") from None


def vector(values: Vector, name: str = "vector") -> Array:
    """What a caller gave as a vector; a number stands for a vector of one."""
    out = np.atleast_1d(numbers(values, name))
    if out.ndim != 1:
        raise ValueError(f"`{name}` has the shape {out.shape}; a vector is needed")
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


def complexes(values: Iterable[common_pb2.Complex]) -> npt.NDArray[np.complex128]:
    """Complex numbers as an array."""
    return np.array([complex(z.real, z.imaginary) for z in values], dtype=np.complex128)


def matrix_message(values: npt.ArrayLike, name: str = "matrix") -> common_pb2.Matrix:
    """An array as a matrix message; one row per step where it is a sequence of inputs."""
    a = numbers(values, name)
    if a.ndim != 2:
        raise ValueError(f"`{name}` has the shape {a.shape}; a matrix is needed, with one row per step or output")
    return common_pb2.Matrix(rows=a.shape[0], cols=a.shape[1], data=a.ravel())


def weight(values: npt.ArrayLike, name: str = "weight") -> common_pb2.Weight:
    """A weight: a vector is a diagonal, a matrix is itself."""
    a = numbers(values, name)
    if a.ndim == 2:
        return common_pb2.Weight(full=matrix_message(a))
    if a.ndim > 2:
        raise ValueError(f"`{name}` has the shape {a.shape}; a diagonal or a matrix is needed")
    return common_pb2.Weight(diagonal=common_pb2.Diagonal(values=vector(a)))


def failure_text(m: Any) -> str:
    """The failure that a message carries; empty if there is none."""
    return f"{m.failure.reason}: {m.failure.message}" if m.HasField("failure") else ""
