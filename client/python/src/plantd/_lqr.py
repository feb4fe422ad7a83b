"""Regulators: LQR about an equilibrium and along a trajectory."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import TYPE_CHECKING

import numpy.typing as npt

from plantd.v1 import control_service_pb2

from ._arrays import Vector
from ._calls import Calls
from ._check import build
from ._gains import Regulator, TrajectoryGain
from ._requests import (
    Stepping,
    constraints,
    point,
    settings,
    stage_weights,
    trajectory,
    trajectory_weights,
    weights,
)
from ._states import State, Trajectory

if TYPE_CHECKING:
    from typing_extensions import Unpack


class LqrCalls(Calls):
    """Calls that solve for regulators."""

    def solve_lqr(
        self,
        model: str,
        *,
        q: npt.ArrayLike,
        r: npt.ArrayLike,
        s: npt.ArrayLike | None = None,
        projected_momentum: bool = False,
        at: str | None = None,
        state: State | None = None,
        u: Vector = (),
        full: bool = False,
        **stepping: Unpack[Stepping],
    ) -> Regulator:
        """Infinite-horizon LQR about an equilibrium. Weights are diagonals or matrices, ``s`` is that
        of the cross term x' s u. With ``projected_momentum`` they are on (q, projected p, v): on a
        momentum that does not depend on the time step, where constraints would make it.

        ``full`` solves on the full state of a constrained model instead of on its manifold.
        """
        request = build(
            control_service_pb2.SolveLqrRequest,
            model=model,
            settings=settings(**stepping),
            point=point(at, state, u),
            weights=weights(q, r, s=s, projected_momentum=projected_momentum),
            constraints=constraints(full),
        )
        return Regulator._from_answer(self._call(self.control.SolveLqr, request))

    def solve_trajectory_lqr(
        self,
        model: str,
        initial: State | Trajectory,
        u: npt.ArrayLike | None = None,
        *,
        q: npt.ArrayLike | None = None,
        r: npt.ArrayLike | None = None,
        q_final: npt.ArrayLike | None = None,
        s: npt.ArrayLike | None = None,
        projected_momentum: bool = False,
        stages: Iterable[Mapping[str, npt.ArrayLike]] = (),
        values: bool = False,
        full: bool = False,
        **stepping: Unpack[Stepping],
    ) -> Iterator[TrajectoryGain]:
        """Time-varying LQR along a trajectory: one gain per step, then one with only the final
        reference state. `GainSchedule` makes a law of them.

        ``stages`` are weights of each step in place of ``q``, ``r`` and ``s``: mappings of these names
        and of ``x_linear`` and ``u_linear``. ``projected_momentum`` is as in `solve_lqr`. ``values``
        also returns the cost to go.
        """
        request = build(
            control_service_pb2.SolveTrajectoryLqrRequest,
            model=model,
            settings=settings(**stepping),
            trajectory=trajectory(initial, u),
            weights=trajectory_weights(q, r, q_final, s, projected_momentum),
            stages=stage_weights(stages),
            values=values,
            constraints=constraints(full),
        )
        return self._messages(self.control.SolveTrajectoryLqr, request, TrajectoryGain._from_answer)
