"""Filters without a server: their arithmetic, and orientations in the estimate."""

import numpy as np
import pytest

import plantd
from plantd.v1 import common_pb2, control_service_pb2


def matrix(a):
    a = np.atleast_2d(a)
    return common_pb2.Matrix(rows=a.shape[0], cols=a.shape[1], data=a.ravel())


A, B = np.array([[1.0, 0.1], [-0.2, 0.9]]), np.array([[0.0], [0.5]])
C, D, GAIN = np.array([[2.0, 0.0]]), np.array([[0.25]]), np.array([[0.3], [0.1]])


def answer(**more):
    return control_service_pb2.SolveKalmanResponse(
        gain=matrix(GAIN),
        linearization=common_pb2.Linearization(a=matrix(A), b=matrix(B)),
        output_x=matrix(C),
        output_u=matrix(D),
        x_reference=[1.0, 2.0],
        u_reference=[0.5],
        y_reference=[2.0],
        **more,
    )


def test_a_filter_corrects_and_predicts():
    kalman = plantd.Kalman._from(answer())
    assert kalman.x.tolist() == [1.0, 2.0]
    kalman.reset([1.1, 2.2])
    dx, du = np.array([0.1, 0.2]), np.array([0.7]) - 0.5
    expected = dx + GAIN @ (np.array([2.5]) - 2.0 - C @ dx - D @ du)
    assert kalman.correct(2.5, 0.7) == pytest.approx([1.0, 2.0] + expected, abs=1e-15)
    expected = A @ expected + B @ du
    assert kalman.predict(0.7) == pytest.approx([1.0, 2.0] + expected, abs=1e-15)


def test_a_filter_along_a_trajectory_changes_its_reference():
    steps = [
        control_service_pb2.SolveTrajectoryKalmanResponse(
            step=k,
            gain=matrix(GAIN * (k + 1)),
            x_reference=[1.0 + k, 2.0],
            u_reference=[] if k == 1 else [0.5],
            y_reference=[2.0 + 2 * k],
        )
        for k in range(2)
    ]
    steps[0].linearization.a.CopyFrom(matrix(A))
    steps[0].linearization.b.CopyFrom(matrix(B))
    steps[0].output_x.CopyFrom(matrix(C))
    steps[0].output_u.CopyFrom(matrix(D))
    kalman = plantd.TrajectoryKalman._from(steps)
    kalman.reset([1.1, 2.2])
    assert kalman.predict(0.5) == pytest.approx([2.0, 2.0] + A @ [0.1, 0.2], abs=1e-15)
    dx = A @ [0.1, 0.2]
    expected = dx + 2 * GAIN @ (np.array([4.5]) - 4.0 - C @ dx)
    assert kalman.correct(4.5) == pytest.approx([2.0, 2.0] + expected, abs=1e-15)
    with pytest.raises(IndexError, match="step 1"):
        kalman.predict(0.0)


def test_compose_undoes_difference():
    rng = np.random.default_rng(5)
    for _ in range(100):
        x, y = rng.uniform(-1.7, 1.7, (2, 8))
        dx = plantd.difference(x, y, [1, 4])
        assert plantd.compose(x, dx, [1, 4]) == pytest.approx(y, abs=1e-14)
