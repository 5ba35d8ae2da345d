"""Trains a policy while it is used: the learning thread, its reward, and the log of its updates."""

from __future__ import annotations

import json
import logging
import threading
from pathlib import Path
from typing import Any

import numpy as np

from edge_server.scheduler.learned.ppo import Learner
from edge_server.scheduler.learned.rewards import Reward, Scored, make_reward, without_missing_lpips
from edge_server.scheduler.online.online_policy import OnlinePolicy
from edge_server.scheduler.registry import BANDIT, make_live_policy, parse_policy
from freshfield.files import Lines

log = logging.getLogger(__name__)

# Beside a policy that was trained without an evaluation (train-scheduler --test 0).
_DEFAULT_FALLBACK = "threshold:120"


class OnlineTrainer:
    """The learning thread, so that neither the loop nor scoring waits.

    policy: the policy that learns.
    reward: reward of a final score.
    out: folder for learning.jsonl, with a line for each update and each switch of who decides, and at the end
    for learnt.npz.
    """

    def __init__(self, policy: OnlinePolicy, reward: Reward, out: Path) -> None:
        self.policy = policy
        self.reward = reward
        self._out = out
        self._lines = Lines(out / "learning.jsonl")
        self._fallen_back = policy.fallen_back
        self._wake = threading.Condition()
        self._due, self._stopping = False, False
        self._thread = threading.Thread(target=self._main, name="online-trainer", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self, timeout_s: float = 10.0) -> None:
        with self._wake:
            self._stopping = True
            self._wake.notify()
        if self._thread.is_alive():
            self._thread.join(timeout_s)

    def close(self) -> None:
        """Write OUT/learnt.npz. OSError where it cannot be written."""
        self._lines.close()
        self.policy.save(self._out / "learnt.npz")

    def add_score(self, number: int, score: Scored) -> None:
        """Take the final score of update ``number``."""
        found = self.reward.of(score)
        due = self.policy.add_reward(number, found.total if found.complete else None)
        if self.policy.fallen_back != self._fallen_back:
            self._fallen_back = self.policy.fallen_back
            self._write({"number": number, "told": self.policy.summary(), **self.policy.status()})
        if due:
            with self._wake:
                self._due = True
                self._wake.notify()

    def _write(self, figures: dict[str, Any]) -> None:
        self._lines.write(json.dumps(figures))

    def _main(self) -> None:
        while True:
            with self._wake:
                self._wake.wait_for(lambda: self._due or self._stopping)
                if self._stopping:
                    return
                self._due = False
            try:
                figures = self.policy.learn()
            except Exception:  # one bad batch must stop neither the field's updates nor the policy's
                log.exception("a batch could not be learned from")
                continue
            if figures is not None:
                self._write(figures)


def open_online_trainer(
    path: Path, reward: str, fallback: str, rng: np.random.Generator, lpips_missing: str | None, out: Path
) -> OnlineTrainer:
    """Trainer of the learner in ``path``.

    reward, fallback: as in ``config.LearnConfig``.
    rng: as in ``OnlinePolicy``. lpips_missing: as in ``choose_reward``. out: as in ``OnlineTrainer``.
    Raises ValueError for an unknown reward or policy, a file that holds no learner, or a learner whose
    decisions hold for several updates.
    """
    learner = Learner.load(path)
    if learner.spec.hold_ms:
        raise ValueError(
            f"{path}: its decisions hold for {learner.spec.hold_ms:g} ms (--hold), and what several updates "
            "share cannot be learned live: run it without learning, or train one without --hold"
        )
    other = fallback or training_summary(path).get("best_fixed") or _DEFAULT_FALLBACK
    try:
        fixed = make_live_policy(*parse_policy(other), rng)
    except ValueError as error:
        raise ValueError(f"fallback: {error}") from None
    policy = OnlinePolicy(learner, fixed, f"{BANDIT}{path}", rng)
    chosen = choose_reward(learner.spec.action, reward, path, lpips_missing, learner.reward_fields)
    log.info("learning by the reward %s on the %s image, beside %s", chosen.name, chosen.fidelity, fixed.name)
    return OnlineTrainer(policy, chosen, out)


def training_summary(path: Path) -> dict[str, Any]:
    """What ``edge-server train-scheduler`` wrote beside checkpoint ``path``: ``reward_name``, ``on`` and
    ``best_fixed``, as far as they are known."""
    try:
        found = json.loads((path.parent / "summary.json").read_text())
    except (OSError, ValueError):
        return {}
    return {k: found[k] for k in ("reward_name", "on", "best_fixed") if isinstance(found.get(k), str)}


def choose_reward(
    action: str, given: str | None, path: Path, lpips_missing: str | None, reward_fields: dict[str, Any] | None = None
) -> Reward:
    """The reward to learn by: ``given``, else the training's reward, else the default of ``action``.

    action: the learner's, as in ``Spec``.
    given: NAME or NAME:moving; None or empty: not given.
    path: the checkpoint.
    lpips_missing: why there is no LPIPS (the reward then drops its LPIPS term); None where there is.
    reward_fields: fields of the training's reward, if the checkpoint has them.
    Raises ValueError for an unknown name or damaged fields.
    """
    if reward_fields is not None and not given:
        try:
            return without_missing_lpips(Reward(**reward_fields), lpips_missing)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{path}: damaged: its reward: {error}; give --learn a reward") from None
    known = training_summary(path)
    default = "set" if action == "select" else "corrected"
    name, _, on = (given or f"{known.get('reward_name', default)}:{known.get('on', 'whole')}").partition(":")
    return without_missing_lpips(make_reward(name, fidelity=on or "whole"), lpips_missing)
