# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # A pendulum: from the linearization to a regulator
#
# `plantd.launch()` starts a server for this notebook alone, which ends with it.
# With a server that is running anyway it would be `plantd.connect("http://127.0.0.1:50051")`.

# %%
import math

import numpy as np

import plantd

client = plantd.launch()
model = client.get_model("pendulum")
print(model.description)
print("coordinates", [c.name for c in model.coordinates], "inputs", list(model.inputs))

# %% [markdown]
# ## The map and its linearization
#
# A plant is the discrete map $x_{k+1} = f(x_k, u_k)$ of a variational integrator, $x = (q, p)$ with the configuration $q$
# and the discrete momentum $p$. Its linearization is that of the very map that is simulated:
# $\delta x_{k+1} = A\,\delta x_k + B\,\delta u_k$.

# %%
lin = client.linearize("pendulum", at="upright")
print("A =", lin.a, sep="\n")
print("B =", lin.b, sep="\n")

# %% [markdown]
# A variational integrator is symplectic, so without damping $\det A = 1$: one pole outside the unit circle and its inverse
# inside. Upright the pendulum falls.

# %%
poles = np.linalg.eigvals(lin.a)
print("poles", poles, "determinant", np.linalg.det(lin.a))
assert abs(np.linalg.det(lin.a) - 1) < 1e-9 and max(abs(poles)) > 1
figure = client.analyze("pendulum", at="upright", outputs=["theta"], frequencies=np.logspace(-1, 1, 100)).plot()

# %% [markdown]
# The same as a system of python-control, with names and the time step. With `velocity=True` its states are
# $(q, \dot q)$ in place of $(q, p)$.

# %%
system = lin.ss(velocity=True)
print(system)

# %% [markdown]
# ## The regulator
#
# `solve_lqr` minimises $\sum \frac12 \delta x^\top Q\,\delta x + \frac12 \delta u^\top R\,\delta u$ about an equilibrium;
# the answer is the law $u = u_r - K (x - x_r)$ with the proof of its quality.

# %%
law = client.solve_lqr("pendulum", at="upright", q=[100, 1], r=[1])
print("K =", law.k, " spectral radius of the closed loop", law.spectral_radius)
assert law.spectral_radius < 1
assert np.allclose(np.sort(np.abs(np.linalg.eigvals(lin.a - lin.b @ law.k)))[-1], law.spectral_radius)

# %% [markdown]
# ## The closed loop
#
# The plant waits for its driver: one input, one step, one state. It is deleted at the end of the block.

# %%
with client.plant("pendulum", q=[math.pi - 0.5]) as plant, plant.drive() as driver:
    states = [driver.plant.state]
    for _ in range(300):
        states.append(driver.step(law(states[-1])))
print(f"{states[-1].time:.2f} s later: {states[-1].q[0] - math.pi:+.1e} rad from upright")
assert abs(states[-1].q[0] - math.pi) < 1e-3
figure = client.plot(states)

# %% [markdown]
# ## From how far does it work?
#
# A hundred starts at once: in each step every plant gets an input of its own, in one call.

# %%
starts = np.linspace(0, 2 * math.pi, 100)
plants = [client.plant("pendulum", q=[start]) for start in starts]
x = np.column_stack((starts, np.zeros(100)))
for _ in range(400):
    x = client.step_many(plants, [law(row) for row in x]).x
caught = np.abs(x[:, 0] - math.pi) < 0.01
print(f"{caught.sum()} of 100 starts end upright")
assert caught[45:55].all()

# %%
client.close()
