"""Scheduling as gymnasium environments: at each step a decision, carried out by a real field fit in virtual time.

An episode is that of ``episode``: a deployment whose channel and motion come from the seed, and some decisions at
random instants. The field of a decision does not depend on the choices before it, so that a step is a contextual
bandit's (thesis 5.4, 6.3); the discount does not matter.
"""

from __future__ import annotations

import dataclasses
from abc import abstractmethod
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from edge_server.experiments.common.folders import folders_from
from edge_server.experiments.rollouts.episode import Episode, EpisodeFactory, mean_outcome
from edge_server.experiments.rollouts.rollout import choose
from edge_server.experiments.rollouts.setting import Setting, layout_of, reward_of
from edge_server.scheduler import Policy
from edge_server.scheduler.fixed import freshest
from edge_server.scheduler.learned.learning_constants import FEATURE_LIMIT, OMEGAS_MS
from edge_server.scheduler.policy import Epoch, SelectionWindow
from edge_server.scheduler.wait import Wait
from edge_server.settings import read_config
from freshfield.scenario import load

_UNUSED = np.random.default_rng(0)  # of policies that draw nothing


class _Chosen(Policy):
    """Selects given cameras at once; if none of them has reported, the freshest (K_t >= 1)."""

    name = "chosen"

    def __init__(self, cameras: tuple[str, ...]) -> None:
        super().__init__(None, _UNUSED)
        self._cameras = cameras

    def select(self, epoch: Epoch, window: SelectionWindow) -> tuple[str, ...]:
        return tuple(c for c in epoch.generated_ns if c in self._cameras) or freshest(epoch, 1)


class DecisionEnv(gymnasium.Env[NDArray[np.float32], Any]):
    """Base of both environments.

    observation_space: float32 (cameras, columns), ``StateLayout.features`` of the cameras' newest frames: age on a
        logarithmic scale, pose relative to the rig, and 1 for a camera that has reported.
    reward: that of ``edge-server train-scheduler``, from the held-out cameras; 0 where the update has no score, and
        ``info["missing"]`` then names the terms that it lacks.
    info of a step: psnr_db, psnr_moving_db, ssim, lpips, aaoi_ms, views, wait_ms of the update.
    """

    metadata = {"render_modes": []}  # noqa: RUF012
    reward_name: str

    def __init__(
        self,
        scenario: str | Path = "room",
        *,
        decisions: int = 16,
        steps: int = 20,
        size: int | None = 64,
        parts: tuple[str, ...] = ("age", "pose"),
        on: str = "moving",
        distance: str = "none",
        **setting: Any,
    ) -> None:
        """scenario: a file, or the name of a shipped one, with a held-out camera.
        decisions: of an episode. steps: of the optimizer per update.
        size: width and height of a synthetic scene's images; None: the scenario's.
        parts: of the state. on: whole or moving, the pixels of the reward's PSNR.
        distance: lpips or none, whether the reward has a term of LPIPS, where its weights are.
        setting: further fields of ``Setting``.
        Raises ScenarioError or ValueError."""
        opened = load(str(scenario))
        if size is not None and opened.source.get("kind") == "world":
            opened = dataclasses.replace(opened, source={**opened.source, "width": size, "height": size})
        folders = folders_from()
        made = Setting(opened, decisions=decisions, steps=steps, parts=parts, **setting)
        network = "none" if distance == "none" else read_config(opened).lpips
        self.reward, _ = reward_of(self.reward_name, on, folders.lpips, network)
        self.cameras = opened.training
        self._factory, self._layout = EpisodeFactory(made, folders), layout_of(made, parts)
        shape = (len(self.cameras), self._layout.width)
        self.observation_space = spaces.Box(-FEATURE_LIMIT, FEATURE_LIMIT, shape, np.float32)
        self._episode: Episode | None = None
        self._number = 0

    @abstractmethod
    def policy(self, action: Any) -> Policy:
        """The policy that decides as the action says."""

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """The next episode; a seed determines it and all that follow."""
        super().reset(seed=seed)
        self._episode = self._factory.episode(int(self.np_random.integers(2**31)))
        self._number = 0
        return self._observation(), {}

    def step(self, action: Any) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """Carry the decision out."""
        if self._episode is None or self._number == len(self._episode.points):
            raise gymnasium.error.ResetNeeded("the episode is over: call reset")
        choice = choose(self.policy(action), self._episode, self._number)
        outcome = mean_outcome(list(self._episode.evaluate(self._number, choice).values()))
        found = self.reward.of(outcome)
        self._number += 1
        info = {**dataclasses.asdict(outcome), "missing": found.missing}
        over = self._number == len(self._episode.points)
        return self._observation(), float(found.total or 0.0) if found.complete else 0.0, over, False, info

    def _observation(self) -> NDArray[np.float32]:
        assert self._episode is not None
        point = self._episode.points[min(self._number, len(self._episode.points) - 1)]
        return self._layout.features(point.state).astype(np.float32)


class SelectEnv(DecisionEnv):
    """``freshfield/Select-v0``: which cameras' newest frames an update uses (5.18). Action: int8 (cameras,), 1 for
    those it uses; where none of these has reported, the freshest is used."""

    reward_name = "set"

    def __init__(self, scenario: str | Path = "room", **arguments: Any) -> None:
        """As ``DecisionEnv``."""
        super().__init__(scenario, **arguments)
        self.action_space = spaces.MultiBinary(len(self.cameras))

    def policy(self, action: NDArray[np.int8]) -> Policy:
        return _Chosen(tuple(camera for camera, used in zip(self.cameras, action) if used))


class WaitEnv(DecisionEnv):
    """``freshfield/Wait-v0``: how long an update waits for frames that are generated meanwhile (6.34). Action: the
    number of one of ``omegas_ms``."""

    reward_name = "corrected"

    def __init__(
        self, scenario: str | Path = "room", *, omegas_ms: tuple[float, ...] = OMEGAS_MS["wait"], **arguments: Any
    ) -> None:
        """omegas_ms: waits to choose from. The others as ``DecisionEnv``."""
        super().__init__(scenario, **arguments)
        self.omegas_ms = omegas_ms
        self.action_space = spaces.Discrete(len(omegas_ms))

    def policy(self, action: int) -> Policy:
        return Wait(self.omegas_ms[int(action)], _UNUSED)
