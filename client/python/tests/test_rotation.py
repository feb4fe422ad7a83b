"""Differences of orientations, against rotation matrices."""

import numpy as np
import pytest

import plantd
from plantd.v1 import model_service_pb2


def matrix(r):
    """exp of the cross-product matrix, summed."""
    w = np.array([[0, -r[2], r[1]], [r[2], 0, -r[0]], [-r[1], r[0], 0]])
    out, term = np.eye(3), np.eye(3)
    for k in range(1, 60):
        term = term @ w / k
        out = out + term
    return out


def test_the_difference_is_the_rotation_from_the_reference():
    rng = np.random.default_rng(7)
    for _ in range(200):
        a, b = rng.uniform(-1.8, 1.8, (2, 3))
        d = plantd.difference(a, b, [0])
        assert np.linalg.norm(d) <= np.pi + 1e-12
        assert np.allclose(matrix(d), matrix(a).T @ matrix(b), atol=1e-12)


def test_small_differences_keep_their_digits():
    d = plantd.difference([0.3, 0.0, 0.0], [0.3 + 1e-9, 0.0, 0.0], [0])
    assert d == pytest.approx([1e-9, 0, 0], rel=1e-6)
    assert not plantd.difference(np.ones(3), np.ones(3), [0]).any()


def test_other_entries_are_subtracted():
    x, reference = np.arange(7.0), np.full(7, 0.5)
    assert plantd.difference(reference, x).tolist() == (x - reference).tolist()
    d = plantd.difference(reference, x, [2])
    assert d[[0, 1, 5, 6]].tolist() == [-0.5, 0.5, 4.5, 5.5]


def test_rotations_of_a_model():
    coordinates = [model_service_pb2.Coordinate(rotation_group=g) for g in "a a a b b b".split()]
    model = model_service_pb2.Model(coordinates=[model_service_pb2.Coordinate(), *coordinates])
    assert plantd.rotations(model) == [1, 4]
