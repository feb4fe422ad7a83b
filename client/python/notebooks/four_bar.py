# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # A four-bar linkage: a closed loop of joints
#
# Crank, coupler and rocker are three coordinates, and the loop is two constraint equations: one way to move is left.

# %%
import numpy as np

import plantd

client = plantd.launch()
model = client.get_model("four-bar")
print([c.name for c in model.coordinates], list(model.constraints), list(model.inputs))

# %% [markdown]
# ## Where it rests
#
# `settle` finds a configuration of least energy on the constraints, and what holds it there.

# %%
rest = client.settle("four-bar")
print("q =", rest.q, " stable", rest.stable)
equilibrium = plantd.v1.common_pb2.InitialState.Equilibrium(q=rest.q)
plant = client.plant("four-bar", initial=plantd.v1.common_pb2.InitialState(equilibrium=equilibrium))
print(plant.diagnose().degrees_of_freedom, "degree of freedom")
assert plant.diagnose().degrees_of_freedom == 1

# %% [markdown]
# ## The linearization on the constraints
#
# In x = (q, p) there are six states. Two of them, displacement and momentum along the one way to move, are enough:
# `reduced=True`.

# %%
lin = plant.linearize()
system = lin.ss(reduced=True)
modes = plant.analyze().modes
print(system.nstates, "states of", lin.a.shape[0])
for mode in modes:
    print(f"  {mode.frequency:.4f} Hz, damping ratio {mode.damping_ratio:.4f}")
poles = np.linalg.eigvals(system.A)
assert all(np.min(np.abs(poles - mode.eigenvalue)) < 1e-5 for mode in modes)

# %% [markdown]
# ## Motion
#
# Constraints hold to round-off in each step, and the energy error of a variational integrator stays bounded.

# %%
free = client.plant("four-bar")
energies, states = [], []
for _ in range(40):
    states += free.step(hold=25)
    energies.append(free.energy.total)
drift = np.ptp(energies)
print(f"energy {energies[0]:.6f} J, spread over {states[-1].time:g} s: {drift:.1e} J")
figure = client.plot(states, "four-bar")

# %% [markdown]
# ## A regulator about the rest
#
# The server solves on the constraints; the law takes the full state.

# %%
inputs = len(model.inputs)
law = client.solve_lqr("four-bar", state=plant.state, u=rest.u, q=[10] * 3 + [1] * 3, r=[1] * inputs)
print("spectral radius", law.spectral_radius)
assert law.spectral_radius < 1

# %%
client.close()
