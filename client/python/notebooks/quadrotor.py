# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # A quadrotor on SO(3)
#
# The attitude of a body that flies is a rotation, not three angles: plantd keeps it as a ball joint whose entries of `q` are
# a rotation vector, and takes differences on the group. There is no attitude at which the model, its linearization or its
# regulator has a singularity of its own.

# %%
import numpy as np

import plantd

QUADROTOR = """
<mujoco model="notebook-quadrotor">
  <worldbody>
    <body name="frame" pos="0 0 1">
      <freejoint name="flight"/>
      <inertial pos="0 0 0.01" mass="0.8" diaginertia="0.004 0.0042 0.0075"/>
      <site name="front" pos="0.15 0 0.02"/> <site name="left" pos="0 0.15 0.02"/>
      <site name="back" pos="-0.15 0 0.02"/> <site name="right" pos="0 -0.15 0.02"/>
    </body>
  </worldbody>
  <actuator>
    <motor name="front" site="front" gear="0 0 1 0 0 0.012"/> <motor name="left" site="left" gear="0 0 1 0 0 -0.012"/>
    <motor name="back" site="back" gear="0 0 1 0 0 0.012"/> <motor name="right" site="right" gear="0 0 1 0 0 -0.012"/>
  </actuator>
  <keyframe><key name="hover" qpos="0 0 1 1 0 0 0" ctrl="1.962 1.962 1.962 1.962"/></keyframe>
</mujoco>
"""
client = plantd.launch()
model = client.create_model(QUADROTOR)
names = [c.name for c in model.coordinates]
groups = plantd.rotations(model)
print(names, "inputs", list(model.inputs))
print("where three entries are a rotation vector together:", groups)
(turn,) = groups

# %% [markdown]
# ## The linearization where it hovers
#
# Twelve states, four inputs: all of it can be steered, and nothing of it is stable by itself.

# %%
dt = 0.005
lin = client.linearize(model.name, at="hover", dt=dt)
print("rank of controllability", lin.controllability_rank, "of", lin.a.shape[0])
assert lin.controllability_rank == 12

# %% [markdown]
# ## A regulator, from upside down
#
# The law takes `log(R_reference' R)` as the error in attitude. It is linear in that error, and so it turns the quadrotor
# over from almost upside down along the shortest way.

# %%
law = client.solve_lqr(model.name, at="hover", q=[20, 20, 20, 4, 4, 4] + [5] * 6, r=[1] * 4, dt=dt)
tilt = 0.9 * np.pi
with client.plant(model.name, at="hover", dt=dt) as plant:
    start = plant.state.q.copy()
    start[turn : turn + 3] = [tilt, 0.0, 0.0]
    plant.reset(q=start)
    with plant.drive() as driver:
        states = [driver.plant.state]
        for _ in range(2400):
            states.append(driver.step(law(states[-1])))
errors = np.array([plantd.difference(law.x_reference, s.x, groups) for s in states])
angle = np.linalg.norm(errors[:, turn : turn + 3], axis=1)
print(f"attitude: {np.degrees(angle[0]):.0f} degrees off at first, {np.degrees(angle[-1]):.1e} at the end")
assert angle[0] > 2.8 and angle[-1] < 1e-3
figure = client.plot(states)

# %% [markdown]
# ## What a rotation vector hides
#
# Turning on about one axis the entries of `q` jump where the angle passes pi; the motion does not, and neither do differences
# on the group.

# %%
with client.plant(model.name, at="hover", dt=dt) as plant:
    velocity = np.zeros(6)
    velocity[turn] = 4.0
    plant.reset(q=plant.state.q, velocity=velocity)
    turning = [plant.state, *plant.step([law.u_reference], hold=399)]
entries = np.array([s.q[turn : turn + 3] for s in turning])
steps = np.array([plantd.difference(a.x, b.x, groups) for a, b in zip(turning, turning[1:])])
print(f"largest change of an entry of q in a step: {np.abs(np.diff(entries, axis=0)).max():.2f} rad")
print(f"largest rotation in a step: {np.linalg.norm(steps[:, turn : turn + 3], axis=1).max():.4f} rad")
assert np.linalg.norm(steps[:, turn : turn + 3], axis=1).max() < 0.05

# %%
client.close()
