"""A problem as a gymnasium environment: bring your own learner.

    environment = BanditEnvironment(problem, Spec("wait", layout, omegas_ms=(0, 60, 120)), cameras=18)
    stable_baselines3.PPO("MlpPolicy", environment).learn(20_000)

An episode is one decision. Observations are the features of ``StateLayout``, one row a camera; actions are
MultiBinary(N) for ``select``, Discrete(K) else. Needs the extra ``gym`` (pip install 'freshfield[gym]').
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.scheduler.learned.learner_spec import Spec
from edge_server.scheduler.learned.problem import Decision, Problem

try:
    import gymnasium
except ImportError as error:
    raise ImportError("the gymnasium environment needs gymnasium: pip install 'freshfield[gym]'") from error


class BanditEnvironment(gymnasium.Env):
    """``problem`` with ``cameras`` cameras, seen and acted on as ``spec`` says.

    An empty set cannot be carried out (K_t >= 1): the youngest camera is used instead, and ``info`` says
    ``forced``. What ``reset(seed)`` draws is decided by the seed; without one, the next decision follows, so
    that all decisions of a simulated episode are used before another is simulated.
    Where no reward could be had, learners that cannot take NaN get the mean of those so far (0 before the
    first), which says neither good nor bad of the action, and ``info`` says ``missing``.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012 (gymnasium's own form)

    def __init__(self, problem: Problem, spec: Spec, cameras: int) -> None:
        self._problem = problem
        self._spec = spec
        shape = (cameras, spec.layout.width)
        self.observation_space = gymnasium.spaces.Box(
            -spec.layout.limit, spec.layout.limit, shape, np.float64
        )
        self.action_space: gymnasium.Space[Any] = (
            gymnasium.spaces.MultiBinary(cameras)
            if spec.action == "select"
            else gymnasium.spaces.Discrete(len(spec.omegas_ms))
        )
        self._decision: Decision | None = None
        self._next: int | None = None
        self._known, self._mean = 0, 0.0  # of the rewards so far

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float64], dict[str, Any]]:
        super().reset(seed=seed)
        if seed is not None or self._next is None:
            self._next = int(self.np_random.integers(2**31))
        self._decision = self._problem.draw(self._next)
        self._next += 1
        return self._spec.layout.features(self._decision.state), {}

    def step(self, action: Any) -> tuple[NDArray[np.float64], float, bool, bool, dict[str, Any]]:
        if self._decision is None:
            raise RuntimeError("reset the environment first: an episode is one decision")
        decision, self._decision = self._decision, None
        state, forced = decision.state, False
        if self._spec.action == "select":
            action = np.asarray(action).astype(bool) & state.reported
            if not action.any() and state.reported.any():
                action[np.argmin(np.where(state.reported, np.nan_to_num(state.ages_ms), np.inf))] = True
                forced = True
        reward, terms = decision.reward(action)
        missing = not math.isfinite(reward)
        if not missing:
            self._known += 1
            self._mean += (float(reward) - self._mean) / self._known
        info = {"terms": terms, "forced": forced, "missing": missing}
        return self._spec.layout.features(state), self._mean if missing else float(reward), True, False, info
