"""Orientations of ball joints: three entries of q that are a rotation vector."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt

from plantd.v1 import model_service_pb2

Array = npt.NDArray[np.float64]


def rotations(model: model_service_pb2.Model) -> list[int]:
    """Indices at which the rotation vectors of a model's ball joints begin in q."""
    groups = [coordinate.rotation_group for coordinate in model.coordinates]
    return [i for i, group in enumerate(groups) if group and (i == 0 or groups[i - 1] != group)]


def difference(
    x_reference: npt.ArrayLike, x: npt.ArrayLike, rotations: Sequence[int] = ()
) -> Array:
    """``x - x_reference``, for states and for configurations alike.

    The three entries from each index of ``rotations`` on are orientations, whose difference is the
    rotation vector ``log(R_reference' R)``, of a length up to pi: the difference in which
    linearizations and gains are expressed.
    """
    reference = np.atleast_1d(np.asarray(x_reference, dtype=np.float64))
    values = np.atleast_1d(np.asarray(x, dtype=np.float64))
    out: Array = values - reference
    for start in rotations:
        entries = slice(start, start + 3)
        out[entries] = _between(reference[entries], values[entries])
    return out


def compose(x_reference: npt.ArrayLike, dx: npt.ArrayLike, rotations: Sequence[int] = ()) -> Array:
    """The x whose `difference` from ``x_reference`` is ``dx``."""
    reference = np.atleast_1d(np.asarray(x_reference, dtype=np.float64))
    error = np.atleast_1d(np.asarray(dx, dtype=np.float64))
    out: Array = reference + error
    for start in rotations:
        entries = slice(start, start + 3)
        (w0, a), (w1, b) = _quaternion(reference[entries]), _quaternion(error[entries])
        out[entries] = _vector(float(w0 * w1 - a @ b), w0 * b + w1 * a + np.cross(a, b))
    return out


def _between(start: Array, end: Array) -> Array:
    (w0, a), (w1, b) = _quaternion(start), _quaternion(end)
    w = float(w0 * w1 + a @ b)
    return _vector(w, w0 * b - w1 * a - np.cross(a, b))


def _vector(w: float, v: Array) -> Array:
    """Rotation vector, of a length up to pi, of a unit quaternion."""
    if w < 0:
        w, v = -w, -v
    sine = float(np.linalg.norm(v))
    return v * (2.0 if sine == 0.0 else 2.0 * np.arctan2(sine, w) / sine)


def _quaternion(rotation: Array) -> tuple[float, Array]:
    """Scalar and vector part of the unit quaternion of a rotation vector."""
    angle = float(np.linalg.norm(rotation))
    scale = 0.5 if angle == 0.0 else np.sin(0.5 * angle) / angle
    return float(np.cos(0.5 * angle)), scale * rotation
