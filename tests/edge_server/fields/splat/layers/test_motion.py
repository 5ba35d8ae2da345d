"""Motion from views: against a dense solution, in hard cases, and over time."""

from __future__ import annotations

import numpy as np
import pytest

from edge_server.fields.splat.layers.motion import DIFFERENCES, WINDOW, Motion, ViewRow
from edge_server.fields.splat.layers.settings import FIXED, FREE, KNOTS_PER_S

RADIUS_M = 3.0


def moving(count: int = 6, start_s: float = 10.0, seed: int = 0) -> Motion:
    rng = np.random.default_rng(seed)
    motion = Motion(RADIUS_M, rng)
    motion.choose_anchors(rng.normal(0, 0.3, (60, 3)), np.ones(60), count, start_s)
    return motion


def row(motion: Motion, instant_s: float, truth: np.ndarray, rng, rank: int = 2, strength: float = 1e4) -> ViewRow:
    """A camera that sees ``rank`` directions of every anchor, linearized at the motion's own displacement."""
    n = truth.size
    axes = np.linalg.qr(rng.normal(size=(3, 3)))[0][:rank]
    seen = np.kron(np.eye(n // 3), axes.T @ axes)
    mix = np.eye(n) + 0.1 * rng.normal(size=(n, n))
    matrix = strength * seen @ mix @ mix.T @ seen
    around = motion.at(instant_s).ravel()
    return ViewRow(instant_s, matrix, matrix @ (truth.ravel() - around), around)


def dense(motion: Motion, rows: list[ViewRow]) -> tuple[np.ndarray, np.ndarray]:
    """The reference: knots (FREE, K, 3) and covariance by a dense Cholesky factor, in the order of rows."""
    n = 3 * len(motion.anchors)
    a, b = np.zeros((WINDOW, n, WINDOW, n)), np.zeros((WINDOW, n))
    for r in rows:
        base, w = motion.weights(r.instant_s)
        whole = np.zeros(WINDOW)
        whole[base : base + 4] = w
        a += np.einsum("k,l,ij->kilj", whole, whole, r.matrix)
        b += np.outer(whole, r.vector + r.matrix @ r.around)
    steady, alike = motion._prior_weights()
    for k in range(3, WINDOW):
        d = np.zeros(WINDOW)
        d[k - 3 : k + 1] = DIFFERENCES
        a += steady * np.einsum("k,l,ij->kilj", d, d, np.eye(n))
    for k in range(1, WINDOW):
        d = np.zeros(WINDOW)
        d[k - 1 : k + 1] = -1, 1
        a += alike * np.einsum("k,l,ij->kilj", d, d, np.kron(motion._laplacian, np.eye(3)))
    size = FREE * n
    free = a[FIXED:, :, FIXED:].reshape(size, size)
    right = b[FIXED:].ravel() - a[FIXED:, :, :FIXED].reshape(size, -1) @ motion._knots[:FIXED].ravel()
    factor = np.linalg.cholesky(free)
    inverse = np.linalg.inv(factor)
    return (inverse.T @ (inverse @ right)).reshape(FREE, -1, 3), inverse.T @ inverse


def walk(t: float, count: int) -> np.ndarray:
    return np.outer(np.linspace(0.8, 1.2, count), [np.sin(t), 0.3 * np.cos(2 * t), 0.1 * t % 1.0])


@pytest.mark.parametrize("count, views", [(1, 20), (2, 3), (6, 60), (24, 40), (6, 0)])
def test_the_solution_is_that_of_a_dense_factor(count, views):
    motion, rng = moving(count), np.random.default_rng(1)
    rows = [row(motion, t, walk(t, count), rng) for t in rng.uniform(motion.oldest_s, motion.newest_s, views)]
    wanted, covariance = dense(motion, rows)
    for _ in range(3):
        assert motion.solve(rows) == 0
    deviation = np.sqrt(np.diagonal(covariance)).reshape(FREE, -1, 3)
    assert (np.abs(motion._knots[FIXED:] - wanted) / deviation).max() < 0.02


def test_rows_that_are_not_finite_or_too_old_are_left_out():
    motion, rng = moving(), np.random.default_rng(3)
    good = [row(motion, t, walk(t, 6), rng) for t in rng.uniform(motion.oldest_s, motion.newest_s, 20)]
    nan, huge = good[0].matrix.copy(), good[1].vector.copy()
    nan[3, 4], huge[0] = np.nan, np.inf
    bad = [good[0]._replace(matrix=nan), good[1]._replace(vector=huge), good[2]._replace(instant_s=np.nan)]
    late = [good[3]._replace(instant_s=t) for t in (141 / 15 - 1e-6, 152 / 15 + 1e-6)]  # of knots 139 to 151
    assert (motion.oldest_s, motion.newest_s) == pytest.approx((141 / 15, 152 / 15))
    twin = moving()
    twin.solve(good)
    assert motion.solve([*bad, *good, *late]) == 5
    np.testing.assert_array_equal(motion._knots, twin._knots)


def test_kept_sums_do_not_change_the_solution():
    motion, twin, rng = moving(), moving(), np.random.default_rng(4)
    rows = [row(motion, t, walk(t, 6), rng) for t in rng.uniform(motion.oldest_s, motion.newest_s, 30)]
    for k in (20, 30):
        motion.solve(rows[:k])
        motion.slide(motion.newest_s)
        twin._spans = []
        twin.solve(rows[:k])
        twin.slide(twin.newest_s)
    np.testing.assert_array_equal(motion._knots, twin._knots)


def followed(path, seconds: float, period_s: float = 1 / 15, cameras: int = 6):
    """Errors of the displacement at each update, shown one period after the newest view; the motion."""
    motion, rng = moving(), np.random.default_rng(5)
    rows, errors, t = [], [], 10.0
    while t < 10.0 + seconds:
        t += period_s
        motion.slide(t)
        for _ in range(cameras):
            taken = t - rng.uniform(0, 1.5 * period_s)
            rows.append(row(motion, taken, path(taken), rng))
        rows = [r for r in rows if r.instant_s >= motion.oldest_s]
        motion.solve(rows)
        errors.append(np.abs(motion.at(t) - path(t)).max())
    return np.array(errors), motion


def test_a_reversal_is_followed_within_the_window():
    speed = 1.0 / RADIUS_M
    errors, _ = followed(lambda t: np.full((6, 3), speed * (1.0 - abs(t - 11.0))), 2.0)
    assert errors[8:14].max() < 0.01
    assert errors[-10:].max() < 0.01


def test_two_minutes_neither_drift_nor_lose_precision():
    errors, motion = followed(lambda t: walk(t, 6), 120.0, cameras=2)
    assert errors[-300:].max() < 2 * errors[100:400].max()
    assert np.isfinite(motion._knots).all()


def test_displacements_pass_through_the_knots_and_go_straight_on():
    motion = moving(1)
    motion._knots = np.random.default_rng(8).normal(size=(WINDOW, 1, 3))
    for k in range(WINDOW):
        np.testing.assert_allclose(motion.at((motion._first + k) / KNOTS_PER_S), motion._knots[k], atol=1e-9)
    last = (motion._first + WINDOW - 1) / KNOTS_PER_S
    step = motion.at(last + 0.02) - motion.at(last)
    np.testing.assert_allclose(motion.at(last + 0.04) - motion.at(last), 2 * step, atol=1e-9)
    np.testing.assert_allclose(motion.at(last) - motion.at(last - 1e-6), step * 5e-5, rtol=1e-3)


def test_shares_fall_with_the_square_of_the_distance_and_the_nearest_anchor_comes_first():
    """As 1 / (d^2 + (reach / 4)^2), where the reach is 1: the median distance to the nearest other anchor."""
    motion = moving(3)
    motion.anchors = np.array([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0], [0.0, 2.0, 0.0]])
    motion._link()
    anchor, share = motion.attach(np.array([[0.25, 0.0, 0.0]]), 10.0)
    expected = 1.0 / (np.array([0.0625, 0.5625, 4.0625]) + 0.0625)
    assert anchor.tolist() == [[0, 1, 2]]
    np.testing.assert_allclose(share[0], expected / expected.sum(), rtol=1e-6)
    motion = moving(8)
    anchor, share = motion.attach(motion.anchors, 10.0)
    np.testing.assert_array_equal(anchor[:, 0], np.arange(8))
    np.testing.assert_allclose(share.sum(axis=1), 1.0, rtol=1e-6)
    with pytest.raises(ValueError, match="at least one point"):
        motion.choose_anchors(np.full((3, 3), np.nan), np.ones(3), 2, 10.0)


@pytest.mark.stability
@pytest.mark.parametrize("strength", [0.0, 1e-12, 1e18])
def test_views_of_one_instant_that_say_nothing_or_far_too_much(strength):
    """Of one direction only: the normal matrix is singular."""
    motion, rng = moving(), np.random.default_rng(1)
    motion.solve([row(motion, 10.0, walk(10.0, 6), rng, rank=1, strength=s) for s in (1e-12, 1e12, strength)])
    assert np.abs(motion.at(10.0)).max() < 3.0


@pytest.mark.stability
def test_anchors_that_coincide():
    motion = Motion(3.0, np.random.default_rng(0))
    for instant_s in (10.0, 12.0):
        motion.choose_anchors(np.zeros((5, 3)), np.zeros(5), 4, instant_s)
        motion.slide(instant_s + 1.0)
        motion.solve([])
        _, share = motion.attach(np.zeros((2, 3)), instant_s)
        np.testing.assert_allclose(share.sum(axis=1), 1.0, rtol=1e-6)
