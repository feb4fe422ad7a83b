"""Where a map comes from: names, time step and mechanics, asked for when somebody wants them."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any

import numpy as np

from ._arrays import Array

if TYPE_CHECKING:
    from plantd.v1 import model_service_pb2

    from ._client import Client
    from ._mechanics import EquationOfMotion
    from ._states import State


def state_names(model: model_service_pb2.Model) -> list[str]:
    """Names of the entries of x: ``theta``, ``p(theta)``, ``v(lift)``."""
    names = [coordinate.name for coordinate in model.coordinates]
    dynamic = [c.name for c in model.coordinates if not c.prescribed]
    return (
        names
        + [f"p({name})" for name in dynamic]
        + [f"v({name})" for name in names[len(dynamic) :]]
    )


def input_names(model: model_service_pb2.Model) -> list[str]:
    """Names of the entries of u: inputs, then prescribed coordinates."""
    return [*model.inputs, *(c.name for c in model.coordinates if c.prescribed)]


@dataclass(frozen=True, eq=False)
class Origin:
    """The model or plant whose map was looked at."""

    client: Client
    model_name: str
    plant: str
    #: Time step that was asked for; 0 for the model's.
    dt: float

    @cached_property
    def _plant(self) -> Any:
        return self.client.get_plant(self.plant)

    @cached_property
    def model(self) -> model_service_pb2.Model:
        """The model."""
        return self.client.get_model(self._plant.model if self.plant else self.model_name)

    @cached_property
    def time_step(self) -> float:
        """Time step of the map, s."""
        if self.plant:
            return float(self._plant.time_step)
        return self.dt or self.model.time_step_s

    @property
    def state_names(self) -> list[str]:
        """Names of the entries of x."""
        return state_names(self.model)

    @property
    def input_names(self) -> list[str]:
        """Names of the entries of u."""
        return input_names(self.model)

    @property
    def dynamic(self) -> int:
        """Number of dynamic coordinates."""
        return sum(not coordinate.prescribed for coordinate in self.model.coordinates)

    def equation(self, state: State) -> EquationOfMotion:
        """The terms of the equation of motion at the configuration of a state, at rest."""
        return self.client.dynamics(
            "" if self.plant else self.model_name, q=state.q, v=np.zeros_like(state.q), plant=self.plant
        )


def null_space(a: Array) -> Array:
    """Orthonormal columns that a matrix takes to zero."""
    if not a.shape[0]:
        return np.eye(a.shape[1])
    _, values, rows = np.linalg.svd(a)
    rank = int(np.sum(values > values[0] * max(a.shape) * np.finfo(float).eps)) if values.size else 0
    return np.asarray(rows[rank:].T)
