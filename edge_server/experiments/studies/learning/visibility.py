"""What cameras really see of what moves: for rivals that know it, and for whether an embedding tells it.

Known from the scene itself, which no policy has. A study holds it beside what was learnt to say why looking
helps or does not: because the embedding does not tell, because nobody could use it, or because it was not
learnt.
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

# A pixel shows something that moves where it differs by more, of 255, from the scene without it.
_DIFFERS = 12
# A camera sees it where so much of its picture does.
SEES = 0.01
# How fast a view loses its worth: an age over which it falls to a third.
_FRESH_MS = 100.0


class Sight:
    """setting: of a world. Pictures are rendered anew, with and without what moves."""

    def __init__(self, setting: Setting) -> None:
        self._setting = setting
        self._known: dict[tuple[int, int], dict[str, float]] = {}

    def shares(self, moment: DecisionPoint) -> dict[str, float]:
        """Camera -> the share of its newest frame at a decision that shows something that moves, of those
        that have one."""
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


class Sees:
    """Chooses the ``k`` cameras that show most of what moves, young ones before old ones."""

    def __init__(self, sight: Sight, k: int) -> None:
        self._sight, self._k = sight, k

    def choice(self, moment: DecisionPoint) -> Choice:
        """At the instant of the decision; of none that has reported, nothing."""
        shares, newest = self._sight.shares(moment), moment.newest(moment.now_ns)
        age_ms = {c: (moment.now_ns - a.generated_ns) / 1e6 for c, a in newest.items()}
        worth = {c: shares[c] * float(np.exp(-age_ms[c] / _FRESH_MS)) for c in newest}
        best = sorted(newest, key=lambda c: (-worth[c], age_ms[c]))[: self._k]
        return Choice(tuple(c for c in newest if c in best), moment.now_ns)


def telling(sight: Sight, moments: Sequence[DecisionPoint]) -> tuple[float, float]:
    """How well embeddings tell a camera that sees something move from one that does not, and how well it is
    told by which camera it is: areas under the curve of linear rules, fitted to every other episode and
    measured on the rest. NaN where all see it, or none."""
    rows, names, seen, episodes = [], [], [], []
    for moment in moments:
        embeddings = moment.state.embeddings
        assert embeddings is not None
        for camera, share in sight.shares(moment).items():
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
    """Of the ridge-regressed linear rule; x (rows, features), labels (rows,), fitted (rows,): to which."""
    spread = np.maximum(x[fitted].std(axis=0), 1e-6)
    scaled = np.hstack([(x - x[fitted].mean(axis=0)) / spread, np.ones((len(x), 1))])
    a, b = scaled[fitted], labels[fitted] - 0.5
    weights = np.linalg.solve(a.T @ a + 3.0 * np.eye(a.shape[1]), a.T @ b)
    return area(scaled[~fitted] @ weights, labels[~fitted])


def area(scores: NDArray[np.float64], labels: NDArray[np.bool_]) -> float:
    """Area under the receiver's curve: how often a true one has the higher score, ties counting half. scores
    and labels (rows,); NaN where all labels are the same."""
    true, false = scores[labels], scores[~labels]
    if not (len(true) and len(false)):
        return float("nan")
    above = (true[:, None] > false[None, :]).mean() + 0.5 * (true[:, None] == false[None, :]).mean()
    return float(above)
