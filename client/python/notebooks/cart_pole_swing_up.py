# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # A cart-pole swings up with a bounded force
#
# A search for the trajectory of least cost, and a regulator along it that the server computes.

# %%
import math

import numpy as np

import plantd

client = plantd.launch()
steps, dt = 150, 0.02
start = client.create_plant("cart-pole", at="hanging", dt=dt).state

# %% [markdown]
# ## What is wanted
#
# Upright at the end, with a force of at most 60 N. The desired states need not be a motion: here the pole hangs for the
# first half and stands for the second. Where the search begins matters; a push back and forth will do.

# %%
desired = np.zeros((steps + 1, 4))
desired[steps // 2 :, 1] = math.pi
push = 20 * np.sin(2 * math.pi * np.arange(steps) * dt / 1.5)[:, None]
guess = plantd.Trajectory(start, push)
search = client.optimize_trajectory(
    "cart-pole",
    guess,
    x=desired,
    q=[0.1, 1, 0.001, 0.01],
    r=[1e-4],
    q_final=[50, 500, 5, 50],
    input_bounds={"force": (-60, 60)},
    first_method="quasi-newton",
    first_iterations=10,
    max_iterations=300,
    dt=dt,
)
best = search.result
print("converged", best.converged, best.failure)
print(f"cost {best.cost:.4f}, largest force {np.abs(best.u).max():.2f} N")
print("last state", best.x[-1])
assert np.abs(best.u).max() < 60.1
assert abs(best.x[-1][1] - math.pi) < 0.1

# %%
figure = client.plot(best, "cart-pole", dt=dt)

# %% [markdown]
# ## Following it
#
# From a start that is a little off, open loop and with the regulator along the trajectory.

# %%
weights = {"q": [10, 100, 1, 1], "r": [0.01]}
law = plantd.GainSchedule(client.solve_trajectory_lqr("cart-pole", best.trajectory, **weights, dt=dt))
ends = {}
for name in ("open loop", "regulated"):
    with client.plant("cart-pole", q=[0.02, 0.05], dt=dt) as plant, plant.drive() as driver:
        states = [driver.plant.state]
        for k in range(steps):
            u = law(states[-1]) if name == "regulated" else best.u[k]
            states.append(driver.step(u))
    ends[name] = np.linalg.norm(states[-1].x - best.x[-1])
    print(f"{name}: {ends[name]:.3e} from the trajectory's end")
assert ends["regulated"] < 0.1 * ends["open loop"]
figure = client.plot(states)

# %%
client.close()
