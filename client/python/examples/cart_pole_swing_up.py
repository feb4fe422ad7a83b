"""Swings a cart-pole up with a bounded force and keeps it there: python cart_pole_swing_up.py [ADDRESS]"""

import math
import sys

import numpy as np

import plantd

address = sys.argv[1] if len(sys.argv) > 1 else "http://127.0.0.1:50051"
limit, steps = 60.0, 400
with plantd.connect(address) as client:
    plant = client.create_plant("cart-pole", at="hanging")
    upright = np.tile([0.0, math.pi, 0.0, 0.0], (steps + 1, 1))
    # A push back and forth with the period in which the pole swings.
    push = 20 * np.sin(2 * math.pi / 192 * np.arange(steps)).reshape(-1, 1)
    weights = {"q": [100, 100, 1, 1], "r": [0.1]}
    search = client.optimize_trajectory(
        "cart-pole",
        plantd.Trajectory(plant.state, push),
        x=upright,
        q=[0.1, 0.1, 0.01, 0.01],
        r=[0.001],
        q_final=[1e4, 1e4, 1e3, 1e3],
        input_bounds={"force": (-limit, limit)},
        bound_tolerance=0.01,
        projection=(weights["q"], weights["r"]),
    )
    for step in search:
        print(f"{step.iteration:3d}  {step.method:12}  cost {step.cost:14.6f}")
    best = search.result

    client.set_feedback(plant.id, trajectory=best.trajectory, **weights)
    with client.drive(plant.id) as driver:
        state = driver.plant.state
        with client.follow_gains(plant.id) as law:
            for _ in range(steps):
                state = driver.step(law(state))
        print(f"up to {state.q[1] - math.pi:+.1e} rad")
        client.set_feedback(plant.id, at="upright", **weights)
        with client.follow_gains(plant.id) as law:
            for _ in range(500):
                state = driver.step(law(state))
    client.delete_plant(plant.id)
off = np.abs(state.x - upright[0]).max()
print(f"largest force {np.abs(best.u).max():.3f} N; off upright by {off:.1e} after 9 s")
sys.exit(0 if best.converged and np.abs(best.u).max() < limit + 0.01 and off < 1e-2 else 1)
