"""Features of a step of a trajectory, (s_t, a_t) of 4.5.2, for the reward model and the policy."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from edge_server.viewpoints.candidates import Candidates
from edge_server.viewpoints.capture_planner import travel_m
from edge_server.viewpoints.viewpoint_constants import LIKENESS_RAD

Array = NDArray[np.float64]

GEOMETRY = (
    *(f"{n} within {w:g} rad" for w in LIKENESS_RAD for n in ("first view", "second view")),
    "way",
    "x",
    "y",
    "z",
    "x^2",
    "z^2",
)


class StepFeatures:
    """Features of taking each candidate next."""

    def __init__(self, candidates: Candidates) -> None:
        self.candidates, d = candidates, candidates.directions
        angle = np.arccos(np.clip(d @ d.T, -1.0, 1.0))
        self._alike = np.stack([np.exp(-((angle / width) ** 2)) for width in LIKENESS_RAD])
        self._way = np.stack([travel_m(candidates, k) for k in range(len(d))])
        at = candidates.poses[:, :3, 3] - candidates.target
        place = at / max(float(np.linalg.norm(at, axis=1).mean()), 1e-12)
        self._place = np.column_stack([place, place[:, 0] ** 2, place[:, 2] ** 2])

    def actions(self, order: Sequence[int]) -> Array:
        """(N, F) features, named by GEOMETRY, of each candidate as the next view after those of ``order``:
        how much better all reachable directions would be seen by their nearest and by their second nearest
        view; the way there in meters; the position, in mean distances to the target."""
        seen = list(order)
        columns = []
        for alike in self._alike:
            new = alike[:, self.candidates.reachable]
            nearest = np.sort(np.concatenate([np.zeros((2, new.shape[1])), new[seen]]), axis=0)[-2:]
            second, first = nearest
            columns.append(np.maximum(new - first, 0.0).mean(axis=1))
            columns.append((np.maximum(np.minimum(new, first), second) - second).mean(axis=1))
        way = self._way[seen[-1]] if seen else np.zeros(len(self._way))
        return np.column_stack([*columns, way, self._place])

    def trajectory(self, order: Sequence[int]) -> Array:
        """(F,) the sum of the steps' features, as (4.12) sums a reward that is linear in them."""
        return sum((self.actions(order[:t])[k] for t, k in enumerate(order)), np.zeros(len(GEOMETRY)))
