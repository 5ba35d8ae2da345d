"""Exposures in closed form: found exactly up to their damping, in a fixed gauge, and bounded."""

from __future__ import annotations

import numpy as np
import pytest

from edge_server.fields.splat.carried_camera import settings as tuned
from edge_server.fields.splat.carried_camera.exposures import Exposures

R = np.random.default_rng(3).uniform(0.1, 0.9, (400, 3))


def _sums(exposures: Exposures, camera: str, image: np.ndarray) -> np.ndarray:
    """What a step sums: (3, MOMENTS)."""
    gain, bias = exposures.of(camera)
    t = (image - bias) / gain
    return np.stack([part.sum(axis=0) for part in (np.ones_like(R), R, R * R, t, R * t)], axis=1)


def test_gain_and_bias_are_found_and_errors_count_as_in_the_image() -> None:
    exposures, gain, bias = Exposures(), np.array([1.3, 0.8, 1.0]), np.array([0.05, -0.1, 0.2])
    image = gain * R + bias
    for _ in range(40):
        exposures.learn("a", _sums(exposures, "a", image))
    found = exposures.of("a")
    # The damped least squares, solved as a matrix.
    for c in range(3):
        normal = np.array([[np.mean(R[:, c] ** 2), R[:, c].mean()], [R[:, c].mean(), 1.0]])
        right = [np.mean(R[:, c] * image[:, c]) + tuned.TOWARDS_ONE, image[:, c].mean()]
        expected = np.linalg.solve(normal + tuned.TOWARDS_ONE * np.eye(2), right)
        np.testing.assert_allclose(found[:, c], expected, atol=1e-5)
    assert np.abs(found[0] * R + found[1] - image).max() < 0.05
    row = exposures.row("a")
    np.testing.assert_allclose(row, [*found[0], *found[1], np.square(found[0]).mean()], rtol=1e-6)
    np.testing.assert_array_equal(exposures.row("unknown"), [1, 1, 1, 0, 0, 0, 1])


def test_the_gauge_is_mean_gain_one_and_mean_bias_zero_and_between_is_between() -> None:
    exposures = Exposures()
    exposures.load({"a": [[0.8] * 3, [0.1] * 3], "b": [[1.8] * 3, [0.0] * 3]})
    exposures.center()
    a, b = exposures.of("a"), exposures.of("b")
    np.testing.assert_allclose(a[0] * b[0], 1.0)
    np.testing.assert_allclose(a[0] / b[0], 0.8 / 1.8)
    np.testing.assert_allclose(a[1], -b[1])
    middle = exposures.between({"a": 0.5, "b": 0.5})
    np.testing.assert_allclose(middle, [[1.0] * 3, [0.0] * 3], atol=1e-12)
    np.testing.assert_allclose(exposures.between({"b": 1.0}), b)
    np.testing.assert_array_equal(exposures.between({}), [[1.0] * 3, [0.0] * 3])
    again = Exposures()
    again.load(exposures.meta())
    assert again.meta() == exposures.meta()


@pytest.mark.stability
def test_no_sums_lead_out_of_bounds() -> None:
    exposures, nothing = Exposures(), np.zeros((3, 5))
    exposures.center()
    for bad in (nothing, np.full((3, 5), np.nan), np.full((3, 5), np.inf)):
        exposures.learn("a", bad)
        assert not exposures.known
    black, blown = _sums(exposures, "a", np.zeros_like(R)), _sums(exposures, "a", np.full_like(R, 50.0))
    for sums in (black, blown, np.full((3, 5), 1e30), -np.full((3, 5), 1e-30)):
        for _ in range(20):
            exposures.learn("a", sums)
            exposures.center()
        gain, bias = exposures.of("a")
        assert gain.min() >= tuned.GAINS[0] and gain.max() <= tuned.GAINS[1] and np.abs(bias).max() <= tuned.MOST_BIAS
