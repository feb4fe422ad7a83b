"""Figures, with matplotlib."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from ._arrays import Array
from ._extras import needed

if TYPE_CHECKING:
    from ._linearize import Analysis


def plot_table(table: Any) -> Any:
    """A figure of the columns of a table over time: configuration, momentum, velocity and input apart."""
    plt = needed("matplotlib.pyplot", "plot")
    groups: dict[str, list[str]] = {}
    for column in table.columns:
        kind, bracket, _ = str(column).partition("(")
        groups.setdefault(kind if bracket and kind in ("p", "v", "u", "y") else "q", []).append(column)
    labels = {
        "q": "configuration, m or rad",
        "v": "velocity, 1/s",
        "p": "momentum",
        "u": "input",
        "y": "outputs",
    }
    shown = [kind for kind in labels if kind in groups]
    figure, axes = plt.subplots(
        len(shown), 1, sharex=True, squeeze=False, figsize=(8, 1 + 2 * len(shown)), layout="constrained"
    )
    for kind, axis in zip(shown, axes[:, 0]):
        for column in groups[kind]:
            axis.plot(table.index, table[column], label=str(column))
        axis.set_ylabel(labels[kind])
        axis.grid(True, alpha=0.3)
        axis.legend(loc="upper right", fontsize="small")
    axes[-1, 0].set_xlabel("time, s")
    return figure


def _names(names: Sequence[str], count: int, letter: str) -> list[str]:
    if names and len(names) != count:
        raise ValueError(f"{len(names)} names are given; {count} are needed")
    return list(names) or [f"{letter}[{i}]" for i in range(count)]


def plot_matrix(k: Array, rows: Sequence[str], columns: Sequence[str], title: str) -> Any:
    """A figure of a matrix, a colour for each entry, with its number where there are few."""
    plt = needed("matplotlib.pyplot", "plot")
    height, width = k.shape
    figure, axis = plt.subplots(figsize=(2 + 0.9 * width, 1.5 + 0.6 * height), layout="constrained")
    bound = float(np.max(np.abs(k), initial=0.0)) or 1.0
    image = axis.imshow(k, cmap="RdBu_r", vmin=-bound, vmax=bound, aspect="auto")
    axis.set_xticks(range(width), _names(columns, width, "x"), rotation=45, ha="right")
    axis.set_yticks(range(height), _names(rows, height, "u"))
    axis.set_title(title)
    if k.size <= 64:
        for (row, column), value in np.ndenumerate(k):
            dark = abs(value) > 0.6 * bound
            axis.text(column, row, f"{value:.3g}", ha="center", va="center", color="w" if dark else "k")
    figure.colorbar(image)
    return figure


def plot_entries(steps: Sequence[int], k: Array, rows: Sequence[str], columns: Sequence[str]) -> Any:
    """A figure of the entries of matrices over steps, one part for each row."""
    plt = needed("matplotlib.pyplot", "plot")
    _, height, width = k.shape
    labels = _names(columns, width, "x")
    figure, axes = plt.subplots(
        height, 1, sharex=True, squeeze=False, figsize=(8, 1 + 2 * height), layout="constrained"
    )
    for row, (name, axis) in enumerate(zip(_names(rows, height, "u"), axes[:, 0])):
        for column, label in enumerate(labels):
            axis.plot(steps, k[:, row, column], label=label)
        axis.set_ylabel(f"gain of {name}")
        axis.grid(True, alpha=0.3)
        axis.legend(loc="upper right", fontsize="small")
    axes[-1, 0].set_xlabel("step")
    return figure


def plot_analysis(analysis: Analysis) -> Any:
    """A figure of the poles in the unit circle, and of the frequency responses where there are any."""
    plt = needed("matplotlib.pyplot", "plot")
    has_response = analysis.frequencies.size > 0
    figure = plt.figure(figsize=(11 if has_response else 5, 5), layout="constrained")
    grid = figure.add_gridspec(2, 2 if has_response else 1)
    poles = figure.add_subplot(grid[:, 0])
    angle = np.linspace(0, 2 * np.pi, 361)
    poles.plot(np.cos(angle), np.sin(angle), color="0.6", linewidth=1)
    values = np.array([mode.eigenvalue for mode in analysis.modes])
    decays = np.abs(values) < 1
    for chosen, color, label in [(decays, "tab:blue", "decays"), (~decays, "tab:red", "does not decay")]:
        if np.any(chosen):
            poles.plot(values[chosen].real, values[chosen].imag, "x", color=color, label=label)
    poles.set(xlabel="real", ylabel="imaginary", title="poles of the map", aspect="equal")
    poles.legend(loc="upper left", fontsize="small")
    if has_response:
        magnitude, phase = figure.add_subplot(grid[0, 1]), figure.add_subplot(grid[1, 1])
        inputs = analysis.response.shape[2]
        names = analysis.origin.input_names if analysis.origin else [f"u{i}" for i in range(inputs)]
        for row, output in enumerate(analysis.outputs):
            for column, name in enumerate(names):
                response = analysis.response[:, row, column]
                label = f"{output} / {name}"
                magnitude.loglog(analysis.frequencies, np.abs(response), label=label)
                phase.semilogx(analysis.frequencies, np.degrees(np.unwrap(np.angle(response))))
        magnitude.set(ylabel="magnitude")
        phase.set(ylabel="phase, degrees", xlabel="frequency, Hz")
        for axis in (magnitude, phase):
            axis.grid(True, which="both", alpha=0.3)
        magnitude.legend(fontsize="small")
    return figure
