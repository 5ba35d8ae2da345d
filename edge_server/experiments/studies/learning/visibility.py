"""Measures how much of the moving bodies each camera sees, for an oracle policy and for testing embeddings.

It is computed from the scene itself, which no policy knows. A study uses it to find out why embeddings do or
do not help: whether they show motion, whether knowing it would help, and whether it was learned.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from typing import cast

import numpy as np
from numpy.typing import NDArray

from camera_node.config import WorldConfig, source_config
from edge_server.experiments.training.scheduler.episode import Choice, DecisionPoint
from edge_server.experiments.training.scheduler.setting import Setting
from edge_server.experiments.virtual.from_scenario import exact_scene

# A pixel shows a moving body if it differs by more than this, of 255, from the scene without moving bodies.
_DIFFERS = 12
# A camera sees motion if more than this share of its pixels shows a moving body.
SEES = 0.01
# Time constant with which the oracle discounts the age of a view.
_FRESH_MS = 100.0


class VisibleMotion:
    """Renders each image with and without the moving bodies. setting: must be of a synthetic world."""

    def __init__(self, setting: Setting) -> None:
        self._setting = setting
        self._known: dict[tuple[int, int], dict[str, float]] = {}

    def shares(self, moment: DecisionPoint) -> dict[str, float]:
        """Camera -> share of the pixels of its newest frame at a decision that show a moving body; cameras
        without a frame are left out."""
        at = moment.seed, moment.number
        if at not in self._known:
            self._known[at] = self._look(moment)
        return self._known[at]

    def _look(self, moment: DecisionPoint) -> dict[str, float]:
        scenario = self._setting.seeded(moment.seed, moves=True)
        scene, _ = exact_scene(scenario, cast(WorldConfig, source_config(scenario)))
        still = scene.with_world(dataclasses.replace(scene.world, moving_bodies=()), scene.period_s, False)
        found = {}
        for camera, arrival in moment.newest(moment.now_ns).items():
            t_s = (arrival.generated_ns % round(scene.period_s * 1e9)) * 1e-9
            seen, empty = (s.view(*s.cameras[camera]).image(t_s).astype(np.int16) for s in (scene, still))
            found[camera] = float((np.abs(seen - empty).max(axis=-1) > _DIFFERS).mean())
        return found


class SeesMotion:
    """An oracle policy: selects the ``k`` cameras that show most of the moving bodies, discounted by age."""

    def __init__(self, visible: VisibleMotion, k: int) -> None:
        self._sight, self._k = visible, k

    def choice(self, moment: DecisionPoint) -> Choice:
        """The choice at the instant of the decision; empty if no camera has reported."""
        shares, newest = self._sight.shares(moment), moment.newest(moment.now_ns)
        age_ms = {c: (moment.now_ns - a.generated_ns) / 1e6 for c, a in newest.items()}
        worth = {c: shares[c] * float(np.exp(-age_ms[c] / _FRESH_MS)) for c in newest}
        best = sorted(newest, key=lambda c: (-worth[c], age_ms[c]))[: self._k]
        return Choice(tuple(c for c in newest if c in best), moment.now_ns)


def embedding_areas(visible: VisibleMotion, moments: Sequence[DecisionPoint]) -> tuple[float, float]:
    """How well a linear rule predicts whether a camera sees motion, from the embedding of its frame and from
    the identity of the camera: areas under the ROC curve. The rules are fitted to every other episode and
    measured on the others; NaN if all cameras see motion, or none."""
    rows, names, seen, episodes = [], [], [], []
    for moment in moments:
        embeddings = moment.state.embeddings
        assert embeddings is not None
        for camera, share in visible.shares(moment).items():
            rows.append(embeddings[moment.cameras.index(camera)].astype(np.float64))
            names.append(moment.cameras.index(camera))
            seen.append(share > SEES)
            episodes.append(moment.seed)
    labels, which = np.array(seen), np.array(episodes)
    fitted = np.isin(which, np.unique(which)[::2])
    one_hot = np.eye(max(names) + 1)[names]
    embedding, camera_alone = (_area_of_rule(x, labels, fitted) for x in (np.array(rows), one_hot))
    return embedding, camera_alone


def _area_of_rule(x: NDArray[np.float64], labels: NDArray[np.bool_], fitted: NDArray[np.bool_]) -> float:
    """Area under the ROC curve of a linear rule by ridge regression.

    x: (rows, features).
    labels: (rows,).
    fitted: (rows,), whether the rule is fitted to the row; it is measured on the others.
    """
    spread = np.maximum(x[fitted].std(axis=0), 1e-6)
    scaled = np.hstack([(x - x[fitted].mean(axis=0)) / spread, np.ones((len(x), 1))])
    a, b = scaled[fitted], labels[fitted] - 0.5
    weights = np.linalg.solve(a.T @ a + 3.0 * np.eye(a.shape[1]), a.T @ b)
    return area(scaled[~fitted] @ weights, labels[~fitted])


def area(scores: NDArray[np.float64], labels: NDArray[np.bool_]) -> float:
    """Area under the ROC curve: how often a true row has a higher score than a false one; ties count half.
    NaN if all labels are the same. scores, labels: (rows,)."""
    true, false = scores[labels], scores[~labels]
    if not (len(true) and len(false)):
        return float("nan")
    above = (true[:, None] > false[None, :]).mean() + 0.5 * (true[:, None] == false[None, :]).mean()
    return float(above)
