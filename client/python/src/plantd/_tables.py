"""Motions as tables with names, with pandas."""

from __future__ import annotations

from collections.abc import Sequence
from os import PathLike
from typing import TYPE_CHECKING, Any, Union

import numpy as np

from ._arrays import Array, array
from ._batch import Rollouts
from ._check import shown
from ._extras import needed
from ._models import ModelCalls
from ._optimize import Optimum
from ._origin import input_names, state_names
from ._plots import plot_table
from ._states import State

if TYPE_CHECKING:
    pass

#: What can be shown as a table: states in their order, simulations, or the result of a search.
Motion = Union[Sequence[State], Rollouts, Optimum]


class TableCalls(ModelCalls):
    """Calls that show motions with the names of a model."""

    def table(self, motion: Motion, model: str = "", *, case: int = 0, dt: float = 0.0) -> Any:
        """A motion as a ``pandas.DataFrame``: one row a state, over its time in seconds.

        Columns are the entries of x, then of the velocity of dynamic coordinates, ``v(theta)``, and of
        the input of a search's result, ``u(force)``. ``model`` names the columns; states that a driver gave know theirs.
        ``case`` chooses among simulations; ``dt`` is the time step of a search that had another one than
        the model's. Needs the package ``pandas``.
        """
        pandas = needed("pandas", "table")
        columns, time = self._columns(motion, model, dt)
        if isinstance(motion, Rollouts):
            columns = {name: values[case] for name, values in columns.items()}
        return pandas.DataFrame(columns, index=pandas.Index(time, name="time"))

    def dataset(self, motion: Motion, model: str = "", *, dt: float = 0.0) -> Any:
        """A motion as an ``xarray.Dataset``: the columns of `table` as variables over ``time``, and of
        simulations over ``case`` and ``time``. Needs the package ``xarray``."""
        xarray = needed("xarray", "xarray")
        columns, time = self._columns(motion, model, dt)
        over = ("case", "time") if isinstance(motion, Rollouts) else ("time",)
        variables = {name: (over, values) for name, values in columns.items()}
        return xarray.Dataset(variables, coords={"time": ("time", time, {"units": "s"})})

    def _columns(self, motion: Motion, model: str, dt: float) -> tuple[dict[str, Array], Array]:
        """Numbers by name, and their times; those of simulations have a row for each case."""
        x: Array
        velocity: Array | None
        time: Array
        if isinstance(motion, Rollouts):
            x, velocity, time, u = motion.x, motion.velocity, motion.time, None
        elif isinstance(motion, Optimum):
            known = self.get_model(model)
            x, velocity, u = motion.x, None, motion.u
            time = array(np.arange(len(x)) * (dt or known.time_step_s))
        else:
            states = list(motion) if isinstance(motion, Sequence) and not isinstance(motion, str) else []
            if not states or not all(isinstance(state, State) for state in states):
                raise TypeError(f"`motion` is {shown(motion)}; states, `Rollouts` or an `Optimum` is needed")
            x = np.array([state.x for state in states])
            velocity = np.array([state.velocity for state in states])
            time, u = np.array([state.time for state in states]), None
            model = model or states[0].model
        if not model:
            raise ValueError("`model` is needed: this motion does not say of which model it is")
        known = self.get_model(model)
        names = state_names(known)
        if len(names) != x.shape[-1]:
            raise ValueError(f"the states have {x.shape[-1]} entries; those of `{model}` have {len(names)}")
        columns = {name: x[..., i] for i, name in enumerate(names)}
        for i, coordinate in enumerate(known.coordinates):
            if velocity is not None and velocity.shape[-1] and not coordinate.prescribed:
                columns[f"v({coordinate.name})"] = velocity[..., i]
        if u is not None:
            for name, row in zip(input_names(known), u.T):
                # The last state has no input.
                columns[f"u({name})"] = np.append(row, np.nan)
        return columns, time

    def plot(self, motion: Motion, model: str = "", *, case: int = 0, dt: float = 0.0) -> Any:
        """A figure of a motion over time; arguments are those of `table`. Needs ``matplotlib`` and ``pandas``."""
        return plot_table(self.table(motion, model, case=case, dt=dt))


def read_recording(path: str | PathLike[str]) -> Any:
    """A recording's file as a ``pandas.DataFrame``: one row a step, over plant time in seconds.

    Columns are the entries of x, velocities ``v(theta)``, inputs ``u(force)`` and outputs ``y(angle)``.
    Needs the packages ``pandas`` and ``mcap-protobuf-support``.
    """
    pandas = needed("pandas", "table")
    reading, decoding = needed("mcap.reader", "table"), needed("mcap_protobuf.decoder", "table")
    with open(path, "rb") as file:
        reader = reading.make_reader(file, decoder_factories=[decoding.DecoderFactory()])
        first, steps = None, []
        for _, channel, _, message in reader.iter_decoded_messages():
            if channel.topic == "/step":
                steps.append(message)
            elif first is None and hasattr(message, "snapshot"):
                first = message
    if first is None:
        raise ValueError(f"`{path}` is no recording of plantd")
    model = first.model
    coordinates = [c.name for c in model.coordinates]
    dynamic = [c.name for c in model.coordinates if not c.prescribed]
    columns: dict[str, Any] = {}

    def add(names: Sequence[str], rows: list[Any]) -> None:
        for i, name in enumerate(names):
            columns[name] = [row[i] if i < len(row) else np.nan for row in rows]

    add(coordinates, [step.state.q for step in steps])
    add([f"p({name})" for name in dynamic], [step.state.p for step in steps])
    add([f"v({name})" for name in coordinates], [step.state.velocity for step in steps])
    add([f"u({name})" for name in input_names(model)], [step.u for step in steps])
    add([f"y({name})" for name in first.outputs], [step.outputs.y for step in steps])
    time = pandas.Index([step.state.time_s for step in steps], name="time")
    return pandas.DataFrame(columns, index=time)
