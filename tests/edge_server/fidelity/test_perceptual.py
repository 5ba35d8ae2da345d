"""The stand-in for LPIPS: a distance by (3.34) and (3.35), never called LPIPS."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

pytest.importorskip("onnxruntime", reason="the extra embed is not installed")
pytest.importorskip("onnx", reason="the extra embed is not installed")

from edge_server.embed import MODELS
from edge_server.fidelity.images import ImageError
from edge_server.fidelity.perceptual import COEFFICIENTS, DETECTOR, MINIMUM_SIDE, Layers, Perceptual, open_perceptual
from edge_server.fidelity.scorer import Scorer, open_listed_perceptual

RNG = np.random.default_rng(8)


@pytest.fixture(scope="module")
def metric() -> Perceptual:
    found, missing = open_perceptual()
    assert found is not None, missing
    return found


def picture(height: int = 64, width: int = 80) -> np.ndarray:
    y, x = np.mgrid[0:height, 0:width]
    wave = np.stack([np.sin(x / 7), np.cos(y / 5), np.sin((x + y) / 9)], axis=-1)
    return 0.5 + 0.4 * wave


def test_equal_images_are_at_no_distance_and_it_is_symmetric(metric):
    a, b = picture(), np.clip(picture() + RNG.normal(0, 0.1, (64, 80, 3)), 0, 1)
    assert metric(a, a) == 0.0
    assert metric(a, b) == pytest.approx(metric(b, a), rel=1e-6) and metric(a, b) > 0


def test_it_is_the_formula(metric):
    """(3.35) written out: normalized features, weighted squares, mean over pixels, sum over layers."""
    a, b = picture(), picture()[::-1]
    total, first = 0.0, 0
    for tap, width in zip(metric._layers.taps, metric._layers.widths()):
        layer = Layers(MODELS / DETECTOR, (tap,))
        weights = metric._weights[first : first + width]
        first += width
        stack = np.stack([a, b]).transpose(0, 3, 1, 2).astype(np.float32)
        (features,) = layer._session.run(None, {layer._input: np.ascontiguousarray(stack)})
        unit = features / (np.linalg.norm(features.astype(np.float64), axis=1, keepdims=True) + 1e-10)
        weighted = np.sqrt(weights)[:, None, None] * (unit[0] - unit[1])
        total += (weighted**2).sum() / weighted[0].size
    assert metric(a, b) == pytest.approx(total**metric._power, rel=1e-5)


def test_what_cannot_be_scored_is_refused(metric):
    with pytest.raises(ImageError, match=f"at least {MINIMUM_SIDE} x {MINIMUM_SIDE} pixels, got 40 x 15"):
        metric(np.zeros((15, 40, 3)), np.zeros((15, 40, 3)))
    with pytest.raises(ImageError, match="rendering is 40 x 20 but"):
        metric(np.zeros((20, 40, 3)), np.zeros((21, 40, 3)))
    with pytest.raises(ImageError, match="NaN"):
        metric(np.full((20, 40, 3), np.nan), np.zeros((20, 40, 3)))


def test_weights_are_never_negative(metric):
    assert (metric._weights >= 0).all() and metric._weights.any()
    split = np.split(metric._weights, np.cumsum(metric._layers.widths())[:-1])
    split[0] = split[0] - 1.0
    with pytest.raises(ValueError, match="negative"):
        Perceptual(metric._layers, split, 1.0)


def test_missing_and_damaged_files_give_one_reason(tmp_path):
    found, missing = open_perceptual(tmp_path)
    assert found is None and str(tmp_path) in missing and "\n" not in missing
    for name in (DETECTOR, COEFFICIENTS):
        shutil.copy(MODELS / name, tmp_path)
    assert open_perceptual(tmp_path)[0] is not None
    with np.load(MODELS / COEFFICIENTS) as archive:
        arrays = dict(archive)
    for change in (
        {"w1": arrays["w0"]},
        {"power": np.array(np.nan)},
        {"w0": -arrays["w0"] - 1},
        {"taps": np.array(["model.99"])},
    ):
        np.savez(tmp_path / COEFFICIENTS, **{**arrays, **change})
        found, missing = open_perceptual(tmp_path)
        assert found is None and "cannot be used" in missing and "\n" not in missing
    (tmp_path / COEFFICIENTS).write_bytes((MODELS / COEFFICIENTS).read_bytes()[:200])
    assert open_perceptual(tmp_path)[0] is None


def test_a_score_has_it_only_where_it_is_listed_and_never_as_lpips():
    a, b = picture(), picture()[:, ::-1]
    without = Scorer(perceptual=open_listed_perceptual(())).score("c", a, 0, b, 0)
    listed = Scorer(perceptual=open_listed_perceptual(("perceptual",))).score("c", a, 0, b, 0)
    assert without.perceptual is None and without.lpips is None
    assert listed.perceptual is not None and listed.perceptual > 0 and listed.lpips is None
    small = Scorer(perceptual=open_listed_perceptual(("perceptual",))).score("c", a[:12], 0, b[:12], 0)
    assert small.perceptual is None
