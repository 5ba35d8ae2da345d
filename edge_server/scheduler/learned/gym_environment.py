"""A bandit problem as a gymnasium environment, for other learners.

    environment = BanditEnvironment(problem, Spec("wait", layout, omegas_ms=(0, 60, 120)), cameras=18)
    stable_baselines3.PPO("MlpPolicy", environment).learn(20_000)

An episode is one decision. Observations are the features of ``StateLayout``, one row per camera; actions are
MultiBinary(N) for ``select``, otherwise Discrete(K). Needs the extra ``gym`` (pip install 'freshfield[gym]').
"""

from __future__ import annotations

import math
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from edge_server.scheduler.learned.learner_spec import Spec
from edge_server.scheduler.learned.state import State

try:
    import gymnasium
except ImportError as error:
    raise ImportError("the gymnasium environment needs gymnasium: pip install 'freshfield[gym]'") from error


class Round(Protocol):
    """One instant at which to decide. ``reward`` may be called repeatedly: every action starts from the same
    field, so that actions can be compared."""

    @property
    def state(self) -> State: ...

    def reward(self, action: Any) -> tuple[float, dict[str, float | None]]:
        """The reward (NaN where there is none) and its terms. action: (N,) bool, the cameras used, or the
        index of an omega."""
        ...


class Problem(Protocol):
    """A source of rounds."""

    def draw(self, seed: int) -> Round:
        """The round of ``seed``: the same seed, the same instant."""
        ...


class BanditEnvironment(gymnasium.Env):
    """``problem`` with ``cameras`` cameras; ``spec`` defines observations and actions.

    An empty set is not allowed (K_t >= 1): the youngest camera is used instead, and ``info["forced"]`` is
    true. ``reset(seed)`` starts at a round drawn with that seed; without one the next round follows, so that
    all decisions of a simulated episode are used before another is simulated. Where there is no reward, the
    mean so far (0 before the first) replaces it, because most learners cannot take NaN, and
    ``info["missing"]`` is true.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 (gymnasium's own form)

    def __init__(self, problem: Problem, spec: Spec, cameras: int) -> None:
        self._problem = problem
        self._spec = spec
        shape = (cameras, spec.layout.width)
        self.observation_space = gymnasium.spaces.Box(-spec.layout.limit, spec.layout.limit, shape, np.float64)
        self.action_space: gymnasium.Space[Any] = (
            gymnasium.spaces.MultiBinary(cameras)
            if spec.action == "select"
            else gymnasium.spaces.Discrete(len(spec.omegas_ms))
        )
        self._round: Round | None = None
        self._next: int | None = None
        self._count, self._mean = 0, 0.0  # of the rewards so far

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float64], dict[str, Any]]:
        super().reset(seed=seed)
        if seed is not None or self._next is None:
            self._next = int(self.np_random.integers(2**31))
        self._round = self._problem.draw(self._next)
        self._next += 1
        return self._spec.layout.features(self._round.state), {}

    def step(self, action: Any) -> tuple[NDArray[np.float64], float, bool, bool, dict[str, Any]]:
        """Carry out the decision, which ends the episode. Raises RuntimeError without ``reset`` before it."""
        if self._round is None:
            raise RuntimeError("reset the environment first: an episode is one decision")
        current, self._round = self._round, None
        state, forced = current.state, False
        if self._spec.action == "select":
            action = np.asarray(action).astype(bool) & state.reported
            if not action.any() and state.reported.any():
                action[np.argmin(np.where(state.reported, np.nan_to_num(state.ages_ms), np.inf))] = True
                forced = True
        reward, terms = current.reward(action)
        missing = not math.isfinite(reward)
        if not missing:
            self._count += 1
            self._mean += (float(reward) - self._mean) / self._count
        info = {"terms": terms, "forced": forced, "missing": missing}
        return self._spec.layout.features(state), self._mean if missing else float(reward), True, False, info
