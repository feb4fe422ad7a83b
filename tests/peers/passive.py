"""Energy of the robots of eight kinds without drives over a million steps; writes models/import/PASSIVE.md

  pip install ./client/python pytest
  cargo build --release -p plantd-server -p plantd-client
  python3 tests/peers/passive.py [--steps 1000000] [--server http://127.0.0.1:50051] [ROBOT ...]

The robots are those of `tests/robots` without actuators and dampers (flying ones without weight), moving as the test
`client/python/tests/test_robots.py` lets them. The largest error of the energy in each hundredth of the run is put
over what is exchanged between kinetic and potential energy, and a straight line is laid through these parts of the
run: what it wins or loses over the whole run is the drift.
"""

import argparse
import pathlib
import sys
import time
import warnings

import numpy as np

import plantd
from importing import ROOT, connected, write

sys.path.insert(0, str(ROOT / "client/python/tests"))
from test_robots import PASSIVE, ROBOTS, moving, passive, run  # noqa: E402

#: Looks at the energy in a run; between two of them the plant steps by itself.
LOOKS = 500
PARTS = 100


def measured(client, file, dt, steps):
    """Exchanged energy, errors of the parts of the run over it, drift over it, steps a second."""
    with warnings.catch_warnings():
        # Contacts, limits and equalities, which are softer in MuJoCo.
        warnings.simplefilter("ignore", UserWarning)
        model = client.create_model(passive((ROBOTS / file).read_text()), name="passive-robot")
    try:
        q, v = moving(client, model)
        plant = client.create_plant(model.name, q=q, velocity=v, dt=dt)
        energies, began = [], time.monotonic()
        for look in range(LOOKS + 1):
            if look:
                run(client, plant, steps // LOOKS)
            energy = client.dynamics(plant=plant.id).energy
            energies.append((energy.kinetic, energy.potential))
        speed = steps / (time.monotonic() - began)
        client.delete_plant(plant.id)
    finally:
        client.delete_model(model.name)
    kinetic, potential = np.array(energies).T
    exchanged = max(kinetic.max(), np.ptp(potential))
    errors = (kinetic + potential - kinetic[0] - potential[0]) / exchanged
    slope = np.polyfit(np.linspace(0, 1, len(errors)), errors, 1)[0]
    worst = [abs(part).max() for part in np.array_split(errors, PARTS)]
    return exchanged, worst, slope, speed


def main():
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--server", help="address of one that runs; by default one is started")
    parser.add_argument("--binaries", type=pathlib.Path, default=ROOT / "target" / "release")
    parser.add_argument("--steps", type=int, default=1_000_000)
    parser.add_argument("robots", nargs="*", help="files of `tests/robots`; all if none is named")
    options = parser.parse_args()
    rows, is_good = [], True
    with connected(options) as client:
        for file, dt, _, band in PASSIVE:
            if options.robots and file not in options.robots:
                continue
            try:
                exchanged, worst, drift, speed = measured(client, file, dt, options.steps)
            except plantd.PlantdError as error:
                rows.append(f"| {file} | {dt * 1e3:g} | not finished: {error} | | | |")
                is_good = False
            else:
                is_good &= max(worst) < band
                cells = [f"{exchanged:.2g}", f"{worst[0]:.0e}", f"{max(worst):.0e}", f"{drift:+.0e}"]
                rows.append(f"| {file} | {dt * 1e3:g} | {' | '.join(cells)} |")
                print(f"{file}: {speed:.0f} steps a second", file=sys.stderr, flush=True)
            print(rows[-1], flush=True)
    if not options.robots:
        text = (
            f"The robots of `tests/robots` without actuators and dampers (the quadrotor without weight, the biped on springs), over {options.steps} steps of the midpoint "
            "rule: the energy that is exchanged between kinetic and potential (J), the largest error of the "
            "total over it in the first hundredth of the run and in all of it, and what a straight line through the errors "
            "wins over the whole run."
        )
        columns = ("robot", "step, ms", "exchanged", "first hundredth", "whole run", "line")
        write("PASSIVE.md", "Robots without drives", text, "passive.py", columns, rows)
    sys.exit(0 if is_good else 1)


if __name__ == "__main__":
    main()
