# ---
# jupyter:
#   jupytext:
#     text_representation:
#       extension: .py
#       format_name: percent
# ---

# %% [markdown]
# # A robot from URDF, with noisy sensors and a Kalman filter
#
# A robot as robotics packages describe it becomes a plant; its joints get encoders with noise, and a filter on the very map
# that runs estimates the state for a regulator.

# %%
import numpy as np

import plantd

ARM = """
<robot name="notebook-arm">
  <link name="base"/>
  <link name="upper"><inertial><origin xyz="0 0 0.2"/><mass value="2"/>
    <inertia ixx="0.03" iyy="0.03" izz="0.002" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="fore"><inertial><origin xyz="0 0 0.15"/><mass value="1"/>
    <inertia ixx="0.01" iyy="0.01" izz="0.001" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="shoulder" type="continuous"><parent link="base"/><child link="upper"/><axis xyz="0 1 0"/></joint>
  <joint name="elbow" type="continuous"><parent link="upper"/><child link="fore"/><origin xyz="0 0 0.4"/>
    <axis xyz="0 1 0"/></joint>
</robot>
"""
client = plantd.launch()
model = client.create_model(ARM)
joints = [c.name for c in model.coordinates]
print(joints, "inputs", list(model.inputs))
assert joints == ["shoulder", "elbow"]

# %% [markdown]
# ## Regulator and filter about the upright posture
#
# The regulator needs the momenta, which no encoder measures. The filter finds them from the angles: its covariances are
# those of the noise of a step.

# %%
dt, sigma = 0.005, 0.003
law = client.solve_lqr(model.name, q=[100, 100, 1, 1], r=[0.02, 0.02], dt=dt)
kalman = client.solve_kalman(
    model.name,
    outputs=joints,
    measurement_noise=[sigma**2] * 2,
    process_noise=[1e-10, 1e-10, 1e-7, 1e-7],
    dt=dt,
)
print("spectral radius of the loop", law.spectral_radius)

# %% [markdown]
# ## The loop over noisy encoders
#
# Sensors belong to the plant: their noise is a hash of seed, name and step, and so it is the same in each run and over each
# link. `driver.outputs` has what they deliver.


# %%
def run(estimate: bool):
    """The closed loop from a start that is off; states, and errors of the filter."""
    kalman.reset()
    with client.plant(model.name, q=[0.05, -0.03], dt=dt) as plant:
        plant.set_channels([dict(name=f"{j}_encoder", coordinate=j, noise=sigma) for j in joints], seed=7)
        measured = plant.get_channels().outputs.y
        with plant.drive() as driver:
            states, errors, former = [driver.plant.state], [], measured
            mass = plant.dynamics().mass_matrix
            for _ in range(1000):
                if estimate:
                    x = kalman.correct(measured)
                else:
                    # Angles as they are measured, momenta from their differences.
                    x = np.concatenate((measured, mass @ (measured - former) / dt))
                errors.append(x - states[-1].x)
                u = law(x)
                if estimate:
                    kalman.predict(u)
                former = measured
                states.append(driver.step(u))
                measured = driver.outputs.y
    return states, np.array(errors)


filtered, errors = run(estimate=True)
crude, _ = run(estimate=False)
settled = slice(400, None)
estimated = np.sqrt(np.mean(errors[settled, :2] ** 2))
print(f"encoders are off by {sigma:g} rad, the estimate by {estimated:.1e} rad")
assert estimated < sigma / 2

# %% [markdown]
# Without the filter the noise goes through the differences into the torques, and the arm shakes.


# %%
def shaking(states):
    """Root mean square of the joints' velocities, once it has settled."""
    return np.sqrt(np.mean(np.array([s.velocity for s in states[settled]]) ** 2))


print(f"the arm shakes at {shaking(filtered):.4f} rad/s with the filter, {shaking(crude):.4f} rad/s without")
assert shaking(filtered) < 0.5 * shaking(crude)
figure = client.plot(filtered)

# %%
client.close()
