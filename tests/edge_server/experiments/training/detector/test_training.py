"""The detector learns, repeats bit for bit, goes on where it stopped, and exports what it is."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest
import torch

from edge_server.experiments.training.detector.dataset import LabeledImages
from edge_server.experiments.training.detector.loss import assign, detection_loss, overlaps
from edge_server.experiments.training.detector.network import Detector
from edge_server.experiments.training.detector.scenes import KINDS
from edge_server.experiments.training.detector.training import BATCH, CheckpointError, Settings, augmented, train

SIDE = 64
SETTINGS = Settings(seed=1, side=SIDE, worlds=1, epochs=3, threads=1)


@pytest.fixture(autouse=True)
def _as_it_was():
    threads = torch.get_num_threads()
    yield
    torch.use_deterministic_algorithms(False)
    torch.set_num_threads(threads)


def squares(n: int) -> LabeledImages:
    """Bright squares (kind 2) and dark ones (kind 3) on gray."""
    rng = np.random.default_rng(0)
    images, boxes = np.full((n, SIDE, SIDE, 3), 110, np.uint8), []
    for image in images:
        side = int(rng.integers(12, 30))
        x, y = rng.integers(0, SIDE - side, 2)
        kind = int(rng.integers(2, 4))
        image[y : y + side, x : x + side] = 230 if kind == 2 else 20
        boxes.append(np.array([[x, y, x + side, y + side, kind]], np.float32))
    return LabeledImages(images, boxes)


def test_overlaps_of_boxes_worked_out_by_hand():
    box = torch.tensor([0.0, 0, 10, 10])
    others = torch.tensor([[0.0, 0, 10, 10], [5.0, 0, 15, 10], [20.0, 0, 30, 10]])
    iou, generalised = overlaps(box, others)
    assert iou.tolist() == pytest.approx([1.0, 1 / 3, 0.0], abs=1e-6)
    assert generalised.tolist() == pytest.approx([1.0, 1 / 3, -1 / 3], abs=1e-6)  # the last: a hull of 300, 200 covered


def predictions(truth):
    """Cells of a 64-pixel picture at stride 8, boxes that fit the truth the better the nearer the cell."""
    xy = (np.stack(np.meshgrid(np.arange(8), np.arange(8)), -1).reshape(-1, 2) + 0.5) * 8
    cells = np.concatenate([xy, np.full((64, 1), 8.0)], 1).astype(np.float32)
    low = np.array(truth[:2]) + 0.1 * (xy - np.mean([truth[:2], truth[2:4]], axis=0))
    boxes = np.concatenate([low, np.array(truth[2:4]) + low - truth[:2]], 1).astype(np.float32)
    return torch.from_numpy(boxes), torch.from_numpy(cells)


def test_the_cells_that_fit_best_are_taken_and_scored_by_how_well_they_fit():
    truth = [20.0, 20.0, 44.0, 44.0, 1.0]
    boxes, cells = predictions(truth)
    holds, which, score = assign(boxes, torch.full((64, 4), 0.5), cells, torch.tensor([truth]))
    assert 0 < len(holds) <= 10 and (which == 0).all()
    centres = cells[holds, :2]
    assert ((centres > 16) & (centres < 48)).all(), "inside, or half a stride beside"
    distance = (centres - 32).norm(dim=1)
    assert float(score[distance.argmin()]) == pytest.approx(float(score.max()), rel=1e-4)
    assert 0.0 < score.max() <= 1.0


def test_an_untrained_network_gives_every_thing_a_cell():
    truths = torch.tensor([[1.0, 1, 7, 7, 0], [10, 10, 60, 60, 1], [30, 30, 36, 36, 2]])
    _, cells = predictions(truths[0].tolist())
    nowhere = torch.zeros(64, 4)
    holds, which, _ = assign(nowhere, torch.zeros(64, 4), cells, truths)
    assert set(which.tolist()) == {0, 1, 2} and len(set(holds.tolist())) == len(holds)


def test_pictures_without_things_and_a_batch_of_only_these_have_a_finite_loss():
    model = Detector(len(KINDS))
    predicted = model.raw(torch.rand(2, 3, SIDE, SIDE))
    for truths in ([torch.zeros(0, 5)] * 2, [torch.zeros(0, 5), torch.tensor([[5.0, 5, 20, 20, 0]])]):
        score, box = detection_loss(predicted, truths)
        (score + box).backward(retain_graph=True)
        assert torch.isfinite(score) and torch.isfinite(box)
        assert all(torch.isfinite(p.grad).all() for p in model.parameters() if p.grad is not None)


def test_boxes_and_centres_of_the_output_belong_together():
    model = Detector(len(KINDS)).eval()
    with torch.no_grad():
        out = model(torch.rand(1, 3, 48, 80))[0]
        boxes, logits, cells = model.raw(torch.rand(1, 3, 48, 80))
    assert out.shape == (4 + len(KINDS), 6 * 10 + 3 * 5) and len(cells) == out.shape[1]
    assert cells[:, :2].amax(0).tolist() == [76.0, 44.0] and cells[60, 2] == 16
    inside = (cells[:, 0] >= boxes[0, :, 0]) & (cells[:, 0] <= boxes[0, :, 2])
    assert inside.all(), "distances are not negative"
    assert logits.sigmoid().max() < 0.2, "nothing is claimed before anything is learnt"


def test_augmentation_moves_boxes_with_the_picture():
    pictures = squares(60)
    checked = 0
    for k in range(60):
        image, boxes = augmented(pictures.images[k], pictures.boxes[k], np.random.default_rng(k))
        assert image.dtype == np.float32 and image.min() >= 0 and image.max() <= 1
        assert (boxes[:, :2] >= 0).all() and (boxes[:, 2:4] <= SIDE).all()
        if not len(boxes):
            continue
        left, top, right, bottom = boxes[0, :4].round().astype(int)
        inside = image[top + 3 : bottom - 3, left + 3 : right - 3].mean()
        bright = pictures.boxes[k][0, 4] == 2
        checked += 1
        assert inside > image.mean() if bright else inside < image.mean()
    assert checked > 50


@pytest.mark.slow
def test_it_learns_and_repeats_bit_for_bit_stopped_or_not(tmp_path):
    pictures = squares(2 * BATCH)
    settings = dataclasses.replace(SETTINGS, epochs=24)
    model, log = train(pictures, settings, tmp_path / "a.pt")
    losses = [row["score_loss"] + row["box_loss"] for row in log]
    assert len(log) == 24 and losses[-1] < 0.8 * losses[0]

    class Stop(Exception):
        pass

    from edge_server.experiments.training.detector import training

    saved = training._save

    def save_and_stop(*args):
        saved(*args)
        if len(args[-1]) == 3:
            raise Stop

    with pytest.MonkeyPatch.context() as patch, pytest.raises(Stop):
        patch.setattr(training, "_save", save_and_stop)
        train(pictures, settings, tmp_path / "b.pt")
    again, relog = train(pictures, settings, tmp_path / "b.pt")
    for key, value in model.state_dict().items():
        assert torch.equal(value, again.state_dict()[key]), key
    assert [r["box_loss"] for r in relog] == [r["box_loss"] for r in log]


def test_a_checkpoint_of_other_settings_or_none_at_all_is_refused(tmp_path):
    pictures = squares(BATCH)
    path = tmp_path / "c.pt"
    train(pictures, dataclasses.replace(SETTINGS, epochs=1), path)
    with pytest.raises(CheckpointError, match=r"c.pt: was trained with seed 1, not 2"):
        train(pictures, dataclasses.replace(SETTINGS, epochs=1, seed=2), path)
    path.write_bytes(b"nothing")
    with pytest.raises(CheckpointError, match="cannot be read"):
        train(pictures, dataclasses.replace(SETTINGS, epochs=1), path)
