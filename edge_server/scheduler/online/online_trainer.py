"""Lessons for a policy that learns while it is used: the thread, the reward, what is written down."""

from __future__ import annotations

import json
import logging
import threading
from pathlib import Path
from typing import Any

import numpy as np

from edge_server.scheduler import BANDIT, make_live_policy
from edge_server.scheduler.learned.ppo import Learner
from edge_server.scheduler.learned.rewards import Reward, Scored, available, make_reward
from edge_server.scheduler.online.online_policy import Apprentice
from freshfield.files import Lines

log = logging.getLogger(__name__)

# Beside what was trained without a contest (train-scheduler --test 0).
_USUAL_FALLBACK = "threshold:120"


class Lessons:
    """The thread that learns, so that neither the loop nor scoring waits. out: gets learning.jsonl, a line
    for each update and for each change of who decides, and at the end learnt.npz."""

    def __init__(self, apprentice: Apprentice, reward: Reward, out: Path) -> None:
        self.apprentice = apprentice
        self.reward = reward
        self._out = out
        self._lines = Lines(out / "learning.jsonl")
        self._fallen_back = apprentice.fallen_back
        self._wake = threading.Condition()
        self._due, self._ending = False, False
        self._thread = threading.Thread(target=self._main, name="lessons", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self, timeout_s: float = 10.0) -> None:
        with self._wake:
            self._ending = True
            self._wake.notify()
        if self._thread.is_alive():
            self._thread.join(timeout_s)

    def close(self) -> None:
        """Keep what has been learnt: OUT/learnt.npz. OSError where it cannot be written."""
        self._lines.close()
        self.apprentice.save(self._out / "learnt.npz")

    def _write(self, figures: dict[str, Any]) -> None:
        self._lines.write(json.dumps(figures))

    def scored(self, number: int, score: Scored) -> None:
        """The scores of an update are final."""
        found = self.reward.of(score)
        due = self.apprentice.scored(number, found.total if found.complete else None)
        if self.apprentice.fallen_back != self._fallen_back:
            self._fallen_back = self.apprentice.fallen_back
            self._write({"number": number, "told": self.apprentice.told(), **self.apprentice.status()})
        if due:
            with self._wake:
                self._due = True
                self._wake.notify()

    def _main(self) -> None:
        while True:
            with self._wake:
                self._wake.wait_for(lambda: self._due or self._ending)
                if self._ending:
                    return
                self._due = False
            try:
                found = self.apprentice.learn()
            except Exception:  # one bad batch must not end the updates of the field, nor of the policy
                log.exception("a batch could not be learnt from")
                continue
            if found is not None:
                self._write(found)


def open_lessons(
    path: Path,
    reward: str,
    fallback: str,
    rng: np.random.Generator,
    lpips_missing: str | None,
    out: Path,
) -> Lessons:
    """Lessons for the learner in ``path``. reward, fallback: as ``config.LearnConfig`` has them. ValueError
    for a reward or policy that is not known, or a file that is no learner."""
    learner, known = Learner.load(path), of_training(path)
    name, _, value = (fallback or known.get("best_fixed") or _USUAL_FALLBACK).partition(":")
    try:
        fixed = make_live_policy(name, float(value) if value else None, rng)
    except ValueError as error:
        raise ValueError(f"fallback: {error}") from None
    apprentice = Apprentice(learner, fixed, f"{BANDIT}{path}", rng)
    by = reward_for(learner.spec.action, reward, path, lpips_missing, learner.taught_by)
    log.info("learning by the reward %s on the %s image, beside %s", by.name, by.fidelity, fixed.name)
    return Lessons(apprentice, by, out)


def of_training(path: Path) -> dict[str, Any]:
    """What ``edge-server train-scheduler`` left beside a checkpoint: ``reward``, ``on`` and ``best_fixed``,
    those that are known."""
    try:
        found = json.loads((path.parent / "summary.json").read_text())
    except (OSError, ValueError):
        return {}
    return {k: found[k] for k in ("reward_name", "on", "best_fixed") if isinstance(found.get(k), str)}


def reward_for(
    spec_action: str,
    given: str | None,
    path: Path,
    lpips_missing: str | None,
    taught_by: dict[str, Any] | None = None,
) -> Reward:
    """The reward to learn by: ``given`` (NAME or NAME:moving), else the one of the training, else the usual
    one. taught_by: as the checkpoint has it. Without LPIPS its term is left out: a reward that always lacks
    one would teach nothing. ValueError for a name that is not known, or where the checkpoint's is none."""
    if taught_by is not None and not given:
        try:
            return available(Reward(**taught_by), lpips_missing)
        except (TypeError, ValueError) as error:
            raise ValueError(f"{path}: damaged: its reward: {error}; give --learn a reward") from None
    known = of_training(path)
    usual = "set" if spec_action == "select" else "corrected"
    name, _, on = (given or f"{known.get('reward_name', usual)}:{known.get('on', 'whole')}").partition(":")
    reward = make_reward(name, fidelity=on or "whole")  # type: ignore[arg-type]
    return available(reward, lpips_missing)
