"""Balances a cart-pole from noisy measurements of two positions: python cart_pole_lqg.py [ADDRESS]"""

import math
import sys

import numpy as np

import plantd

address = sys.argv[1] if len(sys.argv) > 1 else "http://127.0.0.1:50051"
random, sigma = np.random.default_rng(1), np.array([0.005, 0.005])
with plantd.connect(address) as client:
    gain = client.solve_lqr("cart-pole", at="upright", q=[10, 100, 1, 1], r=[0.01])
    kalman = client.solve_kalman(
        "cart-pole",
        at="upright",
        outputs=["x", "theta"],
        measurement_noise=sigma**2,
        process_noise=[1e-8, 1e-8, 1e-6, 1e-6],
    )
    plant = client.create_plant("cart-pole", q=[0.1, math.pi - 0.05])
    state, errors = plant.state, []
    with client.drive(plant.id) as driver:
        for _ in range(2000):
            kalman.correct(state.q + sigma * random.standard_normal(2))
            errors.append(np.concatenate((kalman.x - state.x, state.x - gain.x_reference)))
            u = gain(kalman.x)
            kalman.predict(u)
            state = driver.step(u)
    client.delete_plant(plant.id)
estimate, motion = np.split(np.sqrt(np.mean(np.square(errors[1000:]), axis=0)), 2)
print("measured to", sigma, "estimated to", estimate[:2].round(5), "held to", motion[:2].round(5))
sys.exit(0 if all(estimate[:2] < 0.5 * sigma) and all(motion[:2] < 0.1) else 1)
