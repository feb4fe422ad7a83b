"""Energy over long runs in plantd and other engines.

    python3 tests/peers/drift.py [--steps N] [--out FOLDER]

Prints a table, and draws drift.svg; see SURVIVAL.md.
"""

import argparse
import math
import pathlib
import re

import compare
import engines
import mechanisms
from engines import number, show

# The run is cut into so many parts, each with so many energies.
PARTS, SAMPLES = 100, 64


def runs():
    """Name in the stress suite, mechanism at its start, time step, and the part of the steps that are taken."""
    pushed = [1.5 * math.sin(1 + i) for i in range(3)]
    yield "pendulum", mechanisms.pendulum() | dict(q0=[1.5]), 1e-3, 1.0
    yield "double pendulum", mechanisms.double_pendulum() | dict(q0=[1.5, 1.0]), 1e-3, 1.0
    yield "spherical pendulum on a ball joint", mechanisms.ball_pendulum() | dict(v0=pushed, gravity=9.81), 2e-3, 1.0
    yield "chain of 4 rods", mechanisms.chain(4) | dict(q0=[1.5, 0.0, 0.0, 0.0]), 5e-4, 1.0
    yield "four-bar linkage", mechanisms.four_bar(), 2e-3, 0.5


def follow(engine, steps):
    """Steps at the middle of each part, means of the energy, how far it swings from them, and the size of it all."""
    import numpy as np

    stride = max(1, steps // (PARTS * SAMPLES))
    means, swings, size = [], [], 0.0
    for _ in range(PARTS):
        energies = []
        for _ in range(SAMPLES):
            kinetic, potential = engine.energies()
            energies.append(kinetic + potential)
            size = max(size, kinetic)
            engine.advance(stride)
        means.append(np.mean(energies))
        swings.append(max(abs(energies - means[-1])))
    return (np.arange(PARTS) + 0.5) * SAMPLES * stride, np.array(means) / size, np.median(swings) / size


def drift(at, means):
    """Rise of a line through the means, and its standard error."""
    import numpy as np

    at = at - at.mean()
    slope = at @ means / (at @ at)
    rest = means - means.mean() - slope * at
    length = at[-1] - at[0]
    return slope * length, math.sqrt(rest @ rest / (len(at) - 2) / (at @ at)) * length


def cell(at, means, swing):
    rise, error = drift(at, means)
    if not math.isfinite(rise):
        return "lost"
    return f"{show(abs(rise)) if abs(rise) > 3 * error else f'≤ {show(3 * error)}'}, {show(swing)}"


def plot(curves, path):
    plt = compare.plots()
    figure, axes = plt.subplots(2, 3, figsize=(10, 6))
    for axis, (name, (own, lines)) in zip(axes.flat, curves.items()):
        for index, (engine, (at, means, _)) in enumerate(lines.items()):
            every = sorted({round(10 ** (k / 8)) for k in range(16)})
            points = [(at[k], abs(means[k] - means[0])) for k in every if k < PARTS and means[k] != means[0]]
            axis.loglog(*zip(*points), marker=".", linewidth=1, color=f"C{index + 1}", label=engine)
        axis.loglog(*own, marker="*", markersize=10, linestyle="", color="C0", label="plantd")
        axis.set_title(name, fontsize=10)
        axis.set(xlabel="steps", ylabel="energy from its start", ylim=(1e-16, 10))
        axis.minorticks_off()
        axis.grid(alpha=0.3)
    axes.flat[-1].axis("off")
    axes.flat[-1].legend(*axes.flat[0].get_legend_handles_labels(), fontsize=9, loc="center")
    figure.tight_layout()
    figure.savefig(path)


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--steps", type=int, default=1_000_000, help="of the other engines; half for the linkage")
    parser.add_argument("--out", type=pathlib.Path, default=compare.TARGET / "results")
    options = parser.parse_args()
    compare.enter_environment(__file__)
    for folder in (compare.TARGET / "build", options.out):
        folder.mkdir(parents=True, exist_ok=True)
    rows, curves = engines.stress("--only", "energy: "), {}
    print("\n".join(compare.conditions()), "\n")
    print("| drift, swing | plantd |", " | ".join(name for name, *_ in engines.ENGINES), "|")
    print("| --- | ---: |" + " ---: |" * len(engines.ENGINES))
    for name, m, dt, part in runs():
        row, lines, cells = rows[f"energy: {name}"], {}, []
        for engine, make, method in engines.ENGINES:
            try:
                lines[engine] = follow(make(m, dt, method), round(part * options.steps))
                cells.append(cell(*lines[engine]))
            except Exception as error:
                compare.say(f"{name}: {engine}: {error}")
                cells.append("refused")
        own = number("drift", row), number("oscillation", row)
        print(f"| {name} |", " | ".join([", ".join(map(show, own)), *cells]), "|", flush=True)
        steps = float(re.match(r"\S+", row)[0])
        curves[name] = ([steps], [own[0]]), lines
    plot(curves, options.out / "drift.svg")


if __name__ == "__main__":
    main()
