"""Finds strings that make the marionette dance as desired: python marionette_optimization.py [ADDRESS]"""

import math
import sys

import numpy as np

import plantd

address = sys.argv[1] if len(sys.argv) > 1 else "http://127.0.0.1:50051"
steps, swing = 1001, {"left_leg": -0.1, "right_leg": 0.1, "left_arm": 0.1, "right_arm": -0.1}
with plantd.connect(address) as client:
    coordinates = client.get_model("marionette").coordinates
    strings = [c for c in coordinates if c.prescribed]
    held = np.array([c.initial for c in strings])
    sway = np.sin(0.006 * math.pi * np.arange(steps))
    amplitude = [swing.get(c.name.removesuffix("_string_length"), 0.0) for c in strings]
    # Desired are the configurations of a motion of the strings, at rest at every step.
    plant = client.create_plant("marionette", paper=True)
    moved = client.step(plant.id, held + np.outer(sway, amplitude))
    desired = np.zeros((steps + 1, 2 * len(coordinates)))
    desired[:, : len(coordinates)] = [plant.state.q] + [state.q for state in moved]
    search = client.optimize_trajectory(
        "marionette",
        plantd.Trajectory(plant.state, np.tile(held, (steps, 1))),
        x=desired,
        q=[100] * (len(coordinates) - len(strings)) + [1] * (len(coordinates) + len(strings)),
        r=[0.1] * len(strings),
        first_method="quasi-newton",
        first_iterations=10,
        tolerance=1e-2,
        paper=True,
    )
    for step in search:
        print(f"{step.iteration:3d}  {step.method:12}  cost {step.cost:14.6f}")
    client.delete_plant(plant.id)
sys.exit(0 if search.result.converged and search.result.cost < 1472.6934 else 1)
