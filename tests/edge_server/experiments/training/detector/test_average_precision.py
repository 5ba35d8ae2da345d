"""Average precision on cases that can be worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from edge_server.experiments.training.detector.average_precision import average_precision, box_iou, detections, measure
from edge_server.experiments.training.detector.dataset import LabeledImages
from edge_server.experiments.training.detector.scenes import KINDS

A, B = [0.0, 0.0, 10.0, 10.0], [20.0, 20.0, 30.0, 40.0]
FAR = [50.0, 50.0, 60.0, 60.0]
NONE = np.zeros((0, 5))


def found(*rows):
    return np.array(rows, dtype=float).reshape(-1, 5)


def true(*rows):
    return np.array(rows, dtype=float).reshape(-1, 4)


def test_overlap():
    shifted = [5.0, 0.0, 15.0, 10.0]
    assert box_iou(true(A, B), true(A, shifted, FAR)) == pytest.approx([[1, 1 / 3, 0], [0, 0, 0]] * np.ones((2, 3)))
    assert np.isfinite(box_iou(np.zeros((1, 4)), np.zeros((1, 4)))).all(), "boxes without area"


def test_everything_found_and_nothing_else():
    assert average_precision([found([*A, 0.9], [*B, 0.3])], [true(A, B)]) == pytest.approx(np.ones(10))


@pytest.mark.parametrize(
    ("images", "truth", "ap"),
    [
        # Precision 1 up to recall one half: 51 of 101 recalls, 0 beyond.
        ([[(A, 0.9)]], [[A, B]], 51 / 101),
        # A false alarm costs only where it scores higher.
        ([[(A, 0.9), (FAR, 0.1)]], [[A]], 1.0),
        ([[(A, 0.1), (FAR, 0.9)]], [[A]], 0.5),
        # A second detection of one thing is false. Right, wrong, right: 1 up to recall one half, then 2/3.
        ([[(A, 0.9), (A, 0.8), (B, 0.7)]], [[A, B]], (51 + 50 * 2 / 3) / 101),
        # Scores are ranked over all images.
        ([[(FAR, 0.9)], [(A, 0.5)]], [[A], [A]], 51 * 0.5 / 101),
    ],
)
def test_cases_worked_out_by_hand(images, truth, ap):
    detected = [found(*([*box, score] for box, score in image)) for image in images]
    assert average_precision(detected, [true(*boxes) for boxes in truth])[0] == pytest.approx(ap)


def test_stricter_overlaps_count_for_less():
    loose = [0.0, 0.0, 10.0, 13.0]  # overlaps A by 10/13 = .77
    ap = average_precision([found([*loose, 0.9])], [true(A)])
    assert ap == pytest.approx([1] * 6 + [0] * 4)


def test_the_better_match_is_taken():
    near = [1.0, 0.0, 11.0, 10.0]
    hits = average_precision([found([*A, 0.9], [*near, 0.8])], [true(near, A)], np.array([0.5, 0.9]))
    assert hits == pytest.approx([1.0, 1.0])


def test_nothing_true_and_nothing_found():
    assert np.isnan(average_precision([found([*A, 0.9])], [true()])).all()
    assert average_precision([NONE], [true(A)]) == pytest.approx(np.zeros(10))


def output(*rows: tuple[list[float], int, float], cells: int = 20) -> np.ndarray:
    """YOLO's output0 (4 + kinds, cells) with these (box, kind, score)."""
    out = np.zeros((4 + len(KINDS), cells), np.float32)
    for k, (box, kind, score) in enumerate(rows):
        left, top, right, bottom = box
        out[:4, k] = (left + right) / 2, (top + bottom) / 2, right - left, bottom - top
        out[4 + kind, k] = score
    return out


def test_overlapping_detections_of_one_kind_become_one():
    near = [0.5, 0.0, 10.5, 10.0]
    rows = detections(output((A, 1, 0.6), (near, 1, 0.8), (A, 2, 0.7), (FAR, 1, 0.5)))
    assert rows[:, 4] == pytest.approx([0.8, 0.7, 0.5]) and rows[:, 5].tolist() == [1, 2, 1]
    assert rows[0, :4] == pytest.approx(near)
    assert detections(output()).shape == (0, 6)


def test_measure_is_the_mean_over_the_kinds_that_are_there():
    boxes = [np.array([[*A, 0]], np.float32), np.array([[*B, 1]], np.float32)]
    pictures = LabeledImages(np.zeros((2, 64, 64, 3), np.uint8), boxes)

    def run(images):
        assert images.shape == (2, 3, 64, 64) and images.dtype == np.float32
        return np.stack([output((A, 0, 0.9)), output((FAR, 1, 0.9))])

    quality = measure(run, pictures)
    assert quality["map50"] == pytest.approx(0.5) and set(quality["by_kind"]) == {KINDS[0], KINDS[1]}
