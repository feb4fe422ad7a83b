"""Environments of Gymnasium: one plant, or many that step in one call.

    import plantd
    from plantd.gym import PlantEnv, Task

    class Balance(Task):
        model = "cart-pole"
        action_limits = {"force": (-20, 20)}

        def start(self, rng):
            return {"q": [0, 3.1 + rng.uniform(-0.1, 0.1)]}

        def reward(self, state, action):
            return -((state.q[1] - 3.14159) ** 2), abs(state.q[1] - 3.14159) > 1

    env = PlantEnv(client, Balance())

Needs the package ``gymnasium`` (``pip install "plantd[gym]"``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any, SupportsFloat, cast

import gymnasium
import numpy as np
import numpy.typing as npt
from gymnasium.vector import AutoresetMode
from gymnasium.vector.utils import batch_space

from ._check import instead, shown
from ._client import Client
from ._handle import PlantHandle
from ._origin import input_names
from ._states import State

_Array = npt.NDArray[np.float64]


class Task:
    """What is to be learnt: a model, where episodes begin, what is good and when an episode ends."""

    #: Name of the model.
    model: str = ""
    #: Time step, s; 0 is the model's.
    dt: float = 0.0
    #: Steps after which an episode is truncated.
    horizon: int = 500
    #: Lowest and highest value of inputs, by name, where the model gives none or others are wanted.
    action_limits: Mapping[str, tuple[float, float]] = {}

    def start(self, rng: np.random.Generator) -> Mapping[str, Any]:
        """Where an episode begins: arguments of `Client.reset`, such as ``{"q": [0, 3.1]}`` or
        ``{"at": "upright"}``; where the scene says if not given."""
        return {}

    def observe(self, state: State) -> _Array:
        """What the agent sees of a state: configuration and velocity of all coordinates if not overridden."""
        return np.concatenate((state.q, state.velocity))

    def observation_space(self, model: Any) -> gymnasium.spaces.Box:
        """The space of that: limits of coordinates where the model gives them, no bounds elsewhere."""
        low = [c.limits.low if c.HasField("limits") else -np.inf for c in model.coordinates]
        high = [c.limits.high if c.HasField("limits") else np.inf for c in model.coordinates]
        # Nothing but stops enforces limits, and stops give way.
        reach = np.subtract(high, low)
        free = np.full(len(low), np.inf)
        return gymnasium.spaces.Box(
            np.concatenate((np.subtract(low, reach), -free)),
            np.concatenate((np.add(high, reach), free)),
            dtype=np.float64,
        )

    def reward(self, state: State, action: _Array) -> tuple[float, bool]:
        """The reward of having come to a state by an action, and whether the episode ends there."""
        raise NotImplementedError(f"`{type(self).__name__}` has no `reward`")


def _action_space(task: Task, model: Any) -> gymnasium.spaces.Box:
    names = input_names(model)
    limits = {names[given.u_index]: (given.limits.low, given.limits.high) for given in model.input_limits}
    for coordinate in model.coordinates:
        if coordinate.prescribed and coordinate.HasField("limits"):
            limits[coordinate.name] = (coordinate.limits.low, coordinate.limits.high)
    for name, pair in task.action_limits.items():
        if name not in names:
            raise ValueError(f"`action_limits`: there is no input `{name}`{instead(name, names)}")
        limits[name] = pair
    without = [name for name in names if name not in limits]
    if without:
        raise ValueError(
            f"model `{model.name}` gives no limits of input `{without[0]}`: `action_limits` of the task "
            f"is to say them, such as {{'{without[0]}': (-1, 1)}}"
        )
    low, high = zip(*(limits[name] for name in names))
    return gymnasium.spaces.Box(
        np.array(low, dtype=np.float64), np.array(high, dtype=np.float64), dtype=np.float64
    )


def _check_task(task: Any) -> None:
    if not isinstance(task, Task):
        raise TypeError(f"`task` is {shown(task)}; a `plantd.gym.Task` is needed")
    if not task.model:
        raise ValueError(f"`{type(task).__name__}` names no `model`")


class PlantEnv(gymnasium.Env[_Array, _Array]):
    """One plant as an environment. Actions are inputs, clipped to their limits; a step that fails ends the
    episode, with its error in ``info``."""

    metadata: dict[str, Any] = {"render_modes": []}

    def __init__(self, client: Client, task: Task):
        _check_task(task)
        self.task = task
        model = client.get_model(task.model)
        actions = _action_space(task, model)
        self._low, self._high = actions.low, actions.high
        self.action_space = cast("gymnasium.Space[_Array]", actions)
        self.observation_space = cast("gymnasium.Space[_Array]", task.observation_space(model))
        self.plant: PlantHandle = client.plant(task.model, dt=task.dt)
        self._steps = 0

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[_Array, dict[str, Any]]:
        """Begins an episode where the task says; ``options`` of the same form win."""
        super().reset(seed=seed)
        start = {**self.task.start(self.np_random), **(options or {})}
        self._steps = 0
        return self.task.observe(self.plant.reset(**start)), {}

    def step(self, action: _Array) -> tuple[_Array, SupportsFloat, bool, bool, dict[str, Any]]:
        """Takes one step of the plant."""
        u = np.clip(action, self._low, self._high)
        stepped = self.plant.client.step_many([self.plant.id], [u])
        self._steps += 1
        state, error = stepped.states[0], stepped.errors.get(0)
        reward, ends = self.task.reward(state, u)
        info = {} if error is None else {"error": str(error)}
        return self.task.observe(state), reward, ends or error is not None, self._steps >= self.task.horizon, info

    def close(self) -> None:
        """Deletes the plant."""
        self.plant.__exit__(None)


class PlantVectorEnv(gymnasium.vector.VectorEnv[_Array, _Array, _Array]):
    """Many plants as a vector environment: each step is one call to the server.

    An episode that has ended begins anew with the next step, whose action is not used (``NEXT_STEP``).
    """

    metadata: dict[str, Any] = {"render_modes": [], "autoreset_mode": AutoresetMode.NEXT_STEP}

    def __init__(self, client: Client, task: Task, num_envs: int):
        _check_task(task)
        if num_envs < 1:
            raise ValueError(f"`num_envs` is {num_envs}; at least 1 is needed")
        self.client, self.task, self.num_envs = client, task, num_envs
        model = client.get_model(task.model)
        actions = _action_space(task, model)
        self._low, self._high = actions.low, actions.high
        self.single_action_space = cast("gymnasium.Space[_Array]", actions)
        self.single_observation_space = cast("gymnasium.Space[_Array]", task.observation_space(model))
        self.action_space = batch_space(self.single_action_space, num_envs)
        self.observation_space = batch_space(self.single_observation_space, num_envs)
        self.plants = [client.plant(task.model, dt=task.dt) for _ in range(num_envs)]
        self._rngs: list[np.random.Generator] = [np.random.default_rng() for _ in self.plants]
        self._steps = np.zeros(num_envs, dtype=np.int64)
        self._ended = np.zeros(num_envs, dtype=bool)
        self._seen: _Array = np.zeros((num_envs, *self._shape))

    @property
    def _shape(self) -> Sequence[int]:
        shape = self.single_observation_space.shape
        assert shape is not None
        return shape

    def reset(
        self, *, seed: int | list[int | None] | None = None, options: dict[str, Any] | None = None
    ) -> tuple[_Array, dict[str, Any]]:
        """Begins episodes; environment i of a ``seed`` is the single one of ``seed + i``."""
        seeds = [seed + i for i in range(self.num_envs)] if isinstance(seed, int) else seed
        for i, own in enumerate(seeds or []):
            if own is not None:
                self._rngs[i], _ = gymnasium.utils.seeding.np_random(own)
        for i in range(self.num_envs):
            self._restart(i, options or {})
        return self._seen.copy(), {}

    def _restart(self, i: int, options: Mapping[str, Any]) -> None:
        start = {**self.task.start(self._rngs[i]), **options}
        self._seen[i] = self.task.observe(self.plants[i].reset(**start))
        self._steps[i], self._ended[i] = 0, False

    def step(self, actions: _Array) -> tuple[_Array, _Array, _Array, _Array, dict[str, Any]]:
        """Takes one step of all plants whose episode goes on."""
        u = np.clip(actions, self._low, self._high)
        rewards = np.zeros(self.num_envs)
        terminated, truncated = np.zeros(self.num_envs, dtype=bool), np.zeros(self.num_envs, dtype=bool)
        going = [i for i in range(self.num_envs) if not self._ended[i]]
        infos: dict[str, Any] = {}
        if going:
            stepped = self.client.step_many([self.plants[i].id for i in going], u[going])
            for row, (i, state) in enumerate(zip(going, stepped.states)):
                error = stepped.errors.get(row)
                rewards[i], ends = self.task.reward(state, u[i])
                terminated[i] = ends or error is not None
                self._seen[i] = self.task.observe(state)
                self._steps[i] += 1
                if error is not None:
                    infos = self._add_info(infos, {"error": str(error)}, i)
        truncated[going] = self._steps[going] >= self.task.horizon
        for i in set(range(self.num_envs)) - set(going):
            self._restart(i, {})
        self._ended = terminated | truncated
        return self._seen.copy(), rewards, terminated, truncated, infos

    def close_extras(self, **_: Any) -> None:
        """Deletes the plants."""
        for plant in self.plants:
            plant.__exit__(None)
