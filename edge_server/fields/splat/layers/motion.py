"""Motion of a set of Gaussians: displacements of anchors at knots in time, estimated from every view at the
instant at which it was taken.

A Gaussian lies at p + sum_a s_a D_a(t), for its three nearest anchors a with shares s_a. D(t) is a
Catmull-Rom spline through the displacements X_k at knots 1 / KNOTS_PER_S apart, and a straight line past the
last. The last FREE knots are solved for together by least squares, the FIXED ones before them are given:

- a view at t, linearized at D(t) = D_0 into the normal matrix H and the gradient g of ``kernels.align``, requires
  H D(t) = H D_0 + g;
- an acceleration persists: X_k = X_k-1 + v + PERSISTENCE a, v and a the last differences, with a deviation of
  ``acceleration_m_per_s2`` dt^2;
- neighboring anchors move alike: their X_k - X_k-1 differ by ``neighbor_m_per_s`` dt.

A late view needs no special case: it constrains older knots.
"""

from __future__ import annotations

import copy
import json
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.field_state import give_attributes, take_attributes
from edge_server.fields.splat.layers import layer_constants as tuned
from edge_server.fields.splat.layers.kernels.solve import BAND, PAIRS, add_row, add_span, solve_knots

WINDOW = tuned.FREE + tuned.FIXED
_KEPT = ("anchors", "_knots", "_first")  # of a state
# x(k) = x(k-1) + v + r a as differences[0] x(k-3) + ... + differences[3] x(k) = 0
DIFFERENCES = np.array([-tuned.PERSISTENCE, 1.0 + 2.0 * tuned.PERSISTENCE, -2.0 - tuned.PERSISTENCE, 1.0])


class ViewRow(NamedTuple):
    """The constraint of one view on the displacements of the K anchors at its instant.

    instant_s: when it was taken, seconds.
    matrix: float64 (3K, 3K), normal matrix; the order is anchor by anchor, x y z.
    vector: float64 (3K,), right side: the step from ``around`` is the solution of matrix step = vector.
    around: float64 (3K,), displacements at which both were linearized.
    """

    instant_s: float
    matrix: NDArray[np.float64]
    vector: NDArray[np.float64]
    around: NDArray[np.float64]


class _Span(NamedTuple):
    """Views between the same two knots, and their sums, see ``kernels.solve.add_row``."""

    key: tuple[int, int]
    rows: list[ViewRow]
    base: int  # the first of the four knots that they bear on, within the window
    blocks: NDArray[np.float32]
    right: NDArray[np.float64]
    used: NDArray[np.int64]  # (1,), how many of the views were finite


class Motion:
    """Anchors and their displacements.

    radius_m: meters of a scene unit.
    rng: generator for the choice of anchors.
    anchors: float64 (K, 3), scene units, places at which the displacement is 0; None: not chosen yet.
    acceleration_m_per_s2, neighbor_m_per_s: deviations of the prior.
    """

    def __init__(self, radius_m: float, rng: np.random.Generator) -> None:
        self.radius_m, self.rng = radius_m, rng
        self.acceleration_m_per_s2, self.neighbor_m_per_s = tuned.ACCELERATION_M_PER_S2, tuned.NEIGHBOR_M_PER_S
        self.forget()

    def forget(self) -> None:
        """Remove the anchors, as at the beginning."""
        self.anchors: NDArray[np.float64] | None = None
        self._knots = np.zeros((WINDOW, 0, 3))  # displacements
        self._first = 0  # number of the first knot: its instant times KNOTS_PER_S
        self._reach = tuned.FIRST_REACH  # typical distance from an anchor to the next
        self._laplacian = np.zeros((0, 0))  # (K, K), of the graph of neighbors
        self._band = np.zeros((0, BAND, 0, 0), np.float32)  # memory of ``solve``, see ``kernels.solve``
        self._spans: list[_Span] = []

    @property
    def oldest_s(self) -> float:
        """Views before this instant do not constrain free knots."""
        return (self._first + tuned.FIXED - 1) / tuned.KNOTS_PER_S

    @property
    def newest_s(self) -> float:
        """Views after this instant are too far ahead of the knots: ``slide`` first."""
        return (self._first + WINDOW) / tuned.KNOTS_PER_S

    def weights(self, instant_s: float) -> tuple[int, NDArray[np.float64]]:
        """The displacement at an instant is a sum of four knots times weights, float64 (4,); returns the
        first of the four, counted within the window, and the weights."""
        last, x = WINDOW - 1, max(instant_s * tuned.KNOTS_PER_S - self._first, 0.0)
        i = min(int(x), last)
        f = x - i
        base = min(max(i - 1, 0), WINDOW - 4)
        if i == last:
            return base, np.array([0.0, 0.0, -f, 1.0 + f])
        # Catmull-Rom; the neighbor that is missing at an end lies on the line through the two next to it.
        w = np.array([-f + 2 * f**2 - f**3, 2 - 5 * f**2 + 3 * f**3, f + 4 * f**2 - 3 * f**3, f**3 - f**2]) / 2
        if i == 0:
            w = np.array([w[1] + 2 * w[0], w[2] - w[0], w[3], 0.0])
        elif i == last - 1:
            w = np.array([0.0, w[0], w[1] - w[3], w[2] + 2 * w[3]])
        return base, w

    def at(self, instant_s: float) -> NDArray[np.float64]:
        """Displacements (K, 3) of the anchors at an instant, scene units."""
        base, w = self.weights(instant_s)
        return np.asarray(np.einsum("k,kac->ac", w, self._knots[base : base + 4]))

    def attach(self, points: NDArray[np.floating], instant_s: float) -> tuple[NDArray[np.int64], NDArray[np.float32]]:
        """The three nearest anchors of points (N, 3) at an instant, int64 (N, 3), and their shares, float32
        (N, 3), 1 / (distance^2 + (reach / 4)^2) normalized. With fewer anchors the rest have share 0."""
        assert self.anchors is not None
        d2 = _square_distances(points, self.anchors + self.at(instant_s))
        nearest = np.argsort(d2, axis=1, kind="stable")[:, : tuned.ATTACHED]
        share = 1.0 / (np.take_along_axis(d2, nearest, axis=1) + (self._reach / 4) ** 2)
        share /= share.sum(axis=1, keepdims=True)
        missing = ((0, 0), (0, tuned.ATTACHED - nearest.shape[1]))
        return np.pad(nearest, missing), np.pad(share, missing).astype(np.float32)

    def displaced(
        self, points: NDArray[np.float32], anchor: NDArray[np.int64], share: NDArray[np.float32], instant_s: float
    ) -> NDArray[np.float32]:
        """Places (N, 3) of points (N, 3) at an instant. anchor, share: see ``attach``."""
        moved = np.einsum("nm,nmc->nc", share, self.at(instant_s).astype(np.float32).take(anchor, axis=0))
        return (points + moved).astype(np.float32)

    def newest_knots(self, count: int) -> tuple[int, NDArray[np.float32]]:
        """Number of the first of the newest ``count`` knots, whose instant is number / KNOTS_PER_S, and their
        displacements (count, K, 3), scene units."""
        return self._first + WINDOW - count, self._knots[-count:].astype(np.float32)

    def choose_anchors(
        self, points: NDArray[np.floating], opacity: NDArray[np.floating], count: int, instant_s: float
    ) -> None:
        """Choose anchors anew: k-means of points, begun at points that are far from each other.

        points: (N, 3), places at the instant, at which the new anchors have displacement 0; their
            displacements at other instants are carried over from the anchors before.
        opacity: (N,), in [0, 1]: faint points do not begin a cluster.
        count: how many; at most N are chosen. ValueError: no point is finite.
        """
        sound = np.isfinite(points).all(axis=1)
        if not sound.any() or count < 1:
            raise ValueError("anchors need at least one point, and one of them")
        found = _cluster(points[sound].astype(np.float64), opacity[sound], count, self.rng)
        if self.anchors is None:
            self._knots = np.zeros((WINDOW, len(found), 3))
            self._first = int(np.floor(instant_s * tuned.KNOTS_PER_S)) + 2 - WINDOW
        else:
            now = self.at(instant_s)
            near = 1.0 / (_square_distances(found, self.anchors + now) + (self._reach / 4) ** 2) ** 2
            near /= near.sum(axis=1, keepdims=True)
            self._knots = np.einsum("ij,tjc->tic", near, self._knots - now)
        self.anchors = found
        self._link()

    def _link(self) -> None:
        """Update what depends on the anchors' positions: their neighbors and the distances to these."""
        assert self.anchors is not None
        count = len(self.anchors)
        d2 = _square_distances(self.anchors, self.anchors)
        np.fill_diagonal(d2, np.inf)
        self._reach = tuned.FIRST_REACH
        if count > 1:
            self._reach = max(float(np.sqrt(np.median(d2.min(axis=1)))), tuned.LEAST_REACH)
        near = np.argsort(d2, axis=1, kind="stable")[:, : min(tuned.NEIGHBORS, count - 1)]
        joined = np.zeros((count, count), np.bool_)
        np.put_along_axis(joined, near, True, axis=1)
        joined |= joined.T
        self._laplacian = np.diag(joined.sum(axis=1)) - joined.astype(np.float64)
        self._spans = []
        self._band = np.zeros((WINDOW, BAND, 3 * count, 3 * count), np.float32)

    def slide(self, instant_s: float) -> None:
        """Advance the window until its last knot is the one after an instant. New knots are predicted; after a pause
        longer than the window, motion is assumed to have stopped. An earlier instant changes nothing."""
        ahead = int(np.floor(instant_s * tuned.KNOTS_PER_S)) + 2 - WINDOW - self._first
        for _ in range(min(ahead, tuned.FREE)):
            x = self._knots
            self._knots = np.concatenate([x[1:], -np.einsum("k,kac->ac", DIFFERENCES[:3], x[-3:])[None]])
        for _ in range(min(ahead - tuned.FREE, WINDOW)):
            self._knots = np.concatenate([self._knots[1:], self._knots[-1:]])
        self._first += max(ahead, 0)

    def solve(self, rows: Sequence[ViewRow]) -> int:
        """Estimate the free knots from views, starting at the last solution. Returns the number of views left out
        because their instant does not constrain free knots or their numbers are not finite."""
        assert self.anchors is not None
        count = len(self.anchors)
        spans = self._sums(rows)
        self._band.fill(0.0)  # allocating it costs more: with 48 anchors it has 4 MB
        right = np.zeros((WINDOW, 3 * count))
        for span in spans:
            add_span(span.base, span.blocks, span.right, self._band, right)
        knots = np.ascontiguousarray(self._knots.transpose(0, 2, 1)).reshape(WINDOW, -1)
        steady, alike = self._prior_weights()
        iterations = np.zeros(1, np.int64)
        solve_knots(self._band, right, knots, tuned.FIXED, DIFFERENCES, steady, alike, self._laplacian, iterations)
        self._knots = np.ascontiguousarray(knots.reshape(WINDOW, 3, count).transpose(0, 2, 1))
        return len(rows) - sum(int(span.used[0]) for span in spans)

    def _sums(self, rows: Sequence[ViewRow]) -> list[_Span]:
        """Sums of the views that can be used, for each span of time between two knots. Sums of the
        last call are kept where views were only added since."""
        assert self.anchors is not None
        n, groups = 3 * len(self.anchors), dict[int, list[ViewRow]]()
        for row in rows:
            if self.oldest_s <= row.instant_s <= self.newest_s:
                i = min(int(row.instant_s * tuned.KNOTS_PER_S - self._first), WINDOW - 1)
                groups.setdefault(i, []).append(row)
        before, self._spans = {span.key: span for span in self._spans}, []
        for i, group in sorted(groups.items()):
            # Weights near the end of the window depend on where it ends.
            key = (self._first + i, self._first if i >= WINDOW - 2 else -1)
            span = before.get(key)
            if span is None or not _begins_with(group, span.rows):
                blocks, right = np.zeros((PAIRS, n, n), np.float32), np.zeros((BAND, n))
                span = _Span(key, [], 0, blocks, right, np.zeros(1, np.int64))
            for row in group[len(span.rows) :]:
                weights = self.weights(row.instant_s)[1]
                add_row(*row[1:], weights, span.blocks, span.right, span.used)
            self._spans.append(span._replace(rows=group, base=min(i - 1, WINDOW - BAND)))
        return self._spans

    def _prior_weights(self) -> tuple[float, float]:
        """1 / variance of the persistence of acceleration, and of neighbors moving alike, in scene units."""
        dt = 1.0 / tuned.KNOTS_PER_S
        steady, alike = self.acceleration_m_per_s2 * dt**2, self.neighbor_m_per_s * dt
        return (self.radius_m / steady) ** 2, (self.radius_m / alike) ** 2

    def copy(self) -> Motion:
        """A copy that later changes of this object do not affect."""
        return copy.copy(self)  # but for the memory of ``solve``, arrays are replaced as a whole, never written into

    def state(self) -> dict[str, NDArray]:
        """All of it as plain arrays. Without anchors there are none."""
        if self.anchors is None:
            return {}
        return {"rng": np.array(json.dumps(self.rng.bit_generator.state)), **take_attributes(self, _KEPT)}

    def load_state(self, state: dict[str, NDArray]) -> None:
        """Continue from ``state``, bit for bit."""
        if not state:
            self.forget()
            return
        self.anchors = np.array(state["anchors"])
        self._link()
        give_attributes(self, _KEPT, state)
        self.rng.bit_generator.state = json.loads(str(state["rng"]))


def _cluster(
    points: NDArray[np.float64], opacity: NDArray[np.floating], count: int, rng: np.random.Generator
) -> NDArray[np.float64]:
    """Centers (at most ``count``, 3) of clusters of points (N, 3)."""
    count = min(count, len(points))
    centers = [points[rng.integers(len(points))]]
    d2 = np.full(len(points), np.inf)
    for _ in range(count - 1):
        d2 = np.minimum(d2, ((points - centers[-1]) ** 2).sum(axis=1))
        centers.append(points[np.argmax(d2 * np.minimum(opacity, tuned.CLUSTER_OPACITY))])
    found = np.array(centers)
    for _ in range(tuned.CLUSTER_ROUNDS):
        nearest = _square_distances(points, found).argmin(axis=1)
        size = np.bincount(nearest, minlength=count)
        total = np.stack([np.bincount(nearest, points[:, c], count) for c in range(3)], axis=-1)
        found = np.where(size[:, None] > 0, total / np.maximum(size, 1)[:, None], found)
    return found


def _begins_with(rows: list[ViewRow], first: list[ViewRow]) -> bool:
    """Whether ``rows`` begins with the very same rows."""
    return len(rows) >= len(first) and all(a is b for a, b in zip(first, rows, strict=False))


def _square_distances(a: NDArray[np.floating], b: NDArray[np.floating]) -> NDArray[np.float64]:
    """(N, M), of points (N, 3) and (M, 3)."""
    return ((a[:, None].astype(np.float64) - b[None]) ** 2).sum(axis=-1)
