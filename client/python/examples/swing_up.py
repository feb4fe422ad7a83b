"""Swings the paper's pendulum up and regulates it along the way: python swing_up.py [ADDRESS]"""

import math
import sys

import numpy as np

import plantd

address = sys.argv[1] if len(sys.argv) > 1 else "http://127.0.0.1:50051"
paper = {"dt": 0.1, "paper": True}
desired = np.zeros((101, 2))
desired[50:, 0] = math.pi
with plantd.connect(address) as client:
    plant = client.create_plant("pendulum", q=[0.0], **paper)
    still = plantd.Trajectory(plant.state, np.zeros((100, 1)))
    cost = {"x": desired, "q": [1000, 1], "r": [50]}
    start = {"first_method": "quasi-newton", "first_iterations": 4}
    search = client.optimize_trajectory("pendulum", still, **cost, **start, tolerance=1e-6, **paper)
    for step in search:
        print(f"{step.iteration:3d}  {step.method:12}  cost {step.cost:14.6f}")
    best = search.result

    client.reset(plant.id, q=[1.0], p=[1.0])
    client.set_feedback(plant.id, trajectory=best.trajectory, q=[1, 1], r=[1])
    with client.drive(plant.id) as driver, client.follow_gains(plant.id) as law:
        state = driver.plant.state
        for _ in range(100):
            state = driver.step(law(state))
    client.delete_plant(plant.id)
error = np.linalg.norm(state.x - best.x[-1])
print(f"cost {best.cost:.6f}; from (1, 1) the error is {error:.1e} after 10 s")
sys.exit(0 if best.converged and abs(best.cost / 13297.378894617856 - 1) < 1e-9 and error < 1e-6 else 1)
