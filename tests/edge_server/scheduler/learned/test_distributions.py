"""Probabilities of sets against enumeration of all 2^N, and where they touch 0 and 1."""

from __future__ import annotations

import itertools

import numpy as np
import pytest
import torch

from edge_server.scheduler.learned import distributions as d
from edge_server.scheduler.learned.distributions import most_probable_set, sample_sets, set_log_probability

ALL = np.array(list(itertools.product((0.0, 1.0), repeat=4)))[1:]  # every non-empty set of four cameras


def every_set(logits, mask=None):
    """Log-probabilities of all non-empty sets of four cameras."""
    mask = np.ones(4) if mask is None else np.asarray(mask, float)
    rows = len(ALL)
    return set_log_probability(np, np.tile(logits, (rows, 1)), np.tile(mask, (rows, 1)), ALL)


@pytest.mark.parametrize("seed", range(2))
def test_log_probabilities_are_those_of_redrawing_until_not_empty(seed):
    logits = 2.0 * np.random.default_rng(seed).standard_normal(4)
    p = 1.0 / (1.0 + np.exp(-logits))
    each = np.prod(np.where(ALL > 0, p, 1.0 - p), axis=1)
    np.testing.assert_allclose(np.exp(every_set(logits)), each / (1.0 - np.prod(1.0 - p)), rtol=1e-12)


@pytest.mark.parametrize(
    "logits",
    [
        [-800.0, -801.0, -802.0, -800.0],
        [1e4, -1e4, 0.0, 3.0],
        [-13.8, -13.9, -13.8, -60.0],  # sum of odds about the bound between the two formulas
        [-27.7, -28.0, -29.0, -300.0],
    ],
)
def test_they_sum_to_one_wherever_the_logits_are(logits):
    logps = every_set(np.array(logits))
    assert np.isfinite(logps).all()
    np.testing.assert_allclose(np.exp(logps).sum(), 1.0, rtol=1e-9)


def test_cameras_that_never_reported_are_no_part_of_it_and_with_nobody_the_empty_set_is_certain():
    logits = np.array([0.3, -0.2, 50.0, 1.0])
    logps = every_set(logits, mask=[1, 1, 0, 1])
    allowed = ALL[:, 2] == 0
    np.testing.assert_allclose(np.exp(logps[allowed]).sum(), 1.0, rtol=1e-12)
    zero = np.zeros((1, 3))
    logits = torch.zeros((1, 3), dtype=torch.float64, requires_grad=True)
    logp = set_log_probability(torch, logits, torch.tensor(zero), torch.tensor(zero))
    logp.sum().backward()
    assert logp.item() == 0.0
    assert logits.grad is not None and not logits.grad.any()
    assert not sample_sets(zero, zero, np.random.default_rng(0)).any()
    assert not most_probable_set(zero, zero).any()


@pytest.mark.parametrize("scale", [1.0, 30.0, 1e4])
def test_gradients_are_finite_and_those_of_finite_differences(scale):
    rng = np.random.default_rng(4)
    values = scale * rng.standard_normal((6, 4)) - scale
    mask = np.ones((6, 4))
    mask[0, 1:] = 0.0
    chosen = np.zeros((6, 4))
    chosen[:, 0] = 1.0
    logits = torch.tensor(values, requires_grad=True)
    set_log_probability(torch, logits, torch.tensor(mask), torch.tensor(chosen)).sum().backward()
    assert logits.grad is not None
    assert torch.isfinite(logits.grad).all()
    for row, column in ((0, 0), (3, 2), (5, 0)):
        step = np.zeros_like(values)
        step[row, column] = 1e-4 * max(1.0, scale / 30.0)
        up, down = (set_log_probability(np, values + s, mask, chosen).sum() for s in (step, -step))
        slope = (up - down) / (2.0 * step[row, column])
        assert logits.grad[row, column].item() == pytest.approx(slope, abs=2e-5)


@pytest.mark.parametrize("logits", [[0.4, -1.0, -0.3, 0.9], [-6.0, -5.0, -7.0, -5.5], [-700.0, -701.0, -699.0, -702.0]])
def test_sets_are_drawn_as_often_as_their_probability_says(logits):
    logits = np.array(logits)
    count = 20_000
    drawn = sample_sets(np.tile(logits, (count, 1)), np.ones((count, 4)), np.random.default_rng(5))
    assert drawn.any(axis=1).all()
    codes = drawn @ (1 << np.arange(4))
    seen = np.bincount(codes, minlength=16)[ALL.astype(int) @ (1 << np.arange(4))] / count
    p = np.exp(every_set(logits))
    assert (np.abs(seen - p) < 4.5 * np.sqrt(p * (1 - p) / count) + 1e-9).all()


def test_the_most_probable_set_is_the_likeliest_of_all():
    rng = np.random.default_rng(6)
    for shift in (-3.0, 0.0, 3.0):
        for _ in range(50):
            logits = rng.standard_normal(4) + shift
            best = ALL[np.argmax(every_set(logits))]
            found = most_probable_set(logits[None], np.ones((1, 4)))[0]
            np.testing.assert_array_equal(found, best > 0)


def test_entropy_of_sets_and_of_omegas():
    even = np.zeros((1, 4))
    assert d.set_entropy(np, even, np.ones((1, 4)))[0] == pytest.approx(4 * np.log(2))
    assert d.set_entropy(np, even, np.array([[1.0, 0, 0, 1.0]]))[0] == pytest.approx(2 * np.log(2))
    assert d.set_entropy(np, np.array([[1e4, -1e4, 800.0, -800.0]]), np.ones((1, 4)))[0] == 0.0
    assert d.omega_entropy(np, even)[0] == pytest.approx(np.log(4))
    certain = np.array([[0.0, -1e4, -900.0]])
    assert d.omega_entropy(np, certain)[0] == 0.0
    assert np.isfinite(d.omega_log_probabilities(np, certain)).all()
