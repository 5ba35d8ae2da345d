"""Fitting the stand-in: weights that are not negative, and ranks that follow what they were fitted to."""

from __future__ import annotations

import numpy as np
import pytest

from camera_node.synthetic.scene import make_scene
from edge_server.cli import main as edge_server
from edge_server.experiments.training.detector import renderings, scenes
from edge_server.experiments.training.detector.dataset import INSTANTS, scenes_of
from edge_server.experiments.training.detector.distortions import DISTORTIONS, distorted
from edge_server.experiments.training.detector.perceptual import TRIES, Compared, correlation, fit, left_out, pairs_of
from tests.conftest import data_dir

RNG = np.random.default_rng(6)


def made_up(power: float, n: int = 400) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Differences (n, D), what a distance of known weights says, and the weights."""
    rng = np.random.default_rng(6)
    x = rng.exponential(0.02, (n, 12)) * rng.uniform(0.05, 1.0, (n, 1))
    weights = np.where(np.arange(12) % 3 == 0, 0.0, rng.uniform(1, 8, 12))
    return x, (x @ weights) ** power, weights


@pytest.mark.parametrize("power", [0.5, 0.7, 1.0])
def test_a_distance_of_the_same_form_is_found_again(power):
    x, y, weights = made_up(power)
    found, fitted = fit(x, y)
    assert fitted == pytest.approx(power, rel=0.05)
    assert (found >= 0).all() and found == pytest.approx(weights, abs=0.1 * weights.max())
    told = correlation((x @ found) ** fitted, y, ["a"] * len(y))
    assert told["spearman"] > 0.999 and told["mean_absolute_error"] < 0.01


def test_with_a_scene_left_out_the_rank_is_of_weights_that_have_not_seen_it():
    """In either scene another channel is what counts."""
    rng = np.random.default_rng(6)

    def made(pictures: int) -> Compared:
        scenes = ["plain", "odd"] * pictures
        x = rng.exponential(0.02, (len(scenes) * TRIES, 2))
        return Compared(x, np.where(np.repeat(scenes, TRIES) == "odd", x[:, 0], x[:, 1]), scenes)

    found = left_out([made(40), made(20)])
    assert set(found) == {"plain", "odd"}
    for row in found.values():
        assert row["pairs"] == 60 * TRIES and row["spearman"] < 0.3
    alike = made(40)
    alike.y[:] = alike.x.sum(axis=1)
    assert all(row["spearman"] > 0.99 for row in left_out([alike]).values())


def test_the_scene_of_a_picture_is_the_one_it_was_rendered_from(monkeypatch):
    built = []

    def make(name, *given):
        built.append(name)
        return make_scene(name, *given)

    monkeypatch.setattr(scenes, "make_scene", make)
    told = scenes_of("perceptual", 12, 3)[::INSTANTS]
    for k, name in enumerate(told):
        built.clear()
        scenes.variation(3 * 1_000_003 + k, "perceptual", 16)
        assert built[0] == name  # a cart of the tower may come after it
    assert len(set(told)) > 1


def test_what_would_need_negative_weights_gets_zeros():
    x, y, _ = made_up(1.0)
    x[:, 0] = np.maximum(0.0, 0.1 - y)  # falls as the distance grows
    assert fit(x, y)[0][0] < 1e-3


@pytest.mark.parametrize("name", DISTORTIONS)
def test_every_distortion_changes_the_picture_and_repeats(name):
    image, other = (RNG.integers(0, 256, (48, 64, 3), dtype=np.uint8) for _ in range(2))
    one, again = (DISTORTIONS[name](image, other, np.random.default_rng(5)) for _ in range(2))
    assert np.shape(one) == image.shape and (one == again).all() and np.isfinite(one).all()
    assert not np.array_equal(np.clip(np.rint(one), 0, 255), image)


def test_pairs_are_a_function_of_the_seed():
    images = RNG.integers(0, 256, (3, 32, 32, 3), dtype=np.uint8)
    first, names = pairs_of(images, np.random.default_rng(1))
    again, _ = pairs_of(images, np.random.default_rng(1))
    assert first.shape == (15, 2, 32, 32, 3) and (first == again).all() and len(names) == 15
    assert (first[5:10, 1] == images[1]).all(), "beside each is what is true"
    shown, name = distorted(images[0], images[1], np.random.default_rng(2))
    assert shown.dtype == np.uint8 and set(name.split("+")) <= set(DISTORTIONS)


def test_without_lpips_there_is_nothing_to_fit_to(tmp_path, monkeypatch, capsys):
    monkeypatch.delenv("FRESHFIELD_LPIPS", raising=False)
    monkeypatch.delenv("FRESHFIELD_DATA", raising=False)
    monkeypatch.delenv("FRESHFIELD_DATA", raising=False)
    assert edge_server(["train-perceptual", "--quick", "--out", str(tmp_path)]) == 2
    assert "real LPIPS is what is fitted to" in capsys.readouterr().err


@pytest.mark.slow
def test_the_command_fits_and_says_how_well(tmp_path, capsys, monkeypatch):
    pytest.importorskip("onnxruntime", reason="the extra embed is not installed")
    monkeypatch.setattr(renderings, "STEPS", (5, 10))  # fog will do: most of the minutes are these fits
    out = tmp_path / "fit"
    words = ["train-perceptual", "--quick", "--lpips", str(data_dir("lpips"))]
    assert edge_server([*words, "--out", str(out)]) == 0
    assert "Spearman" in capsys.readouterr().out
    assert (out / "perceptual.npz").is_file() and (out / "perceptual.json").is_file()
