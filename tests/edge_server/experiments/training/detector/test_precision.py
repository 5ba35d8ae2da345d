"""Average precision on cases that can be worked out by hand, and what a network's output decodes to."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("pycocotools", reason="the extra detector is not installed")
pytest.importorskip("onnxruntime", reason="the extra embed is not installed")

from edge_server.experiments.training.detector.precision import average_precision, detections

A, B, FAR = [0.0, 0, 10, 10], [20.0, 20, 30, 40], [50.0, 50, 60, 60]


def of(found, true, kind=0):
    rows = [np.array([[*box, score, kind] for box, score in boxes]).reshape(-1, 6) for boxes in found]
    truth = [np.array([[*box, kind] for box in boxes]).reshape(-1, 5) for boxes in true]
    return average_precision(rows, truth)


@pytest.mark.parametrize(
    ("found", "true", "ap50"),
    [
        ([[(A, 0.9)]], [[A, B]], 51 / 101),  # precision 1 up to recall one half: 51 of 101 recalls
        ([[(FAR, 0.9), (A, 0.1)]], [[A]], 0.5),
        ([[]], [[A]], 0.0),
        ([[(A, 0.9)], [(FAR, 0.5)]], [[A], [B]], 51 / 101),  # of two images, each box in its own
    ],
)
def test_average_precision(found, true, ap50):
    row = of(found, true)["by_kind"]["person"]
    assert row["ap50"] == pytest.approx(ap50) and row["true"] == sum(map(len, true))


def test_a_box_that_is_off_counts_at_the_ious_that_it_has():
    shifted = [2.0, 0, 12, 10]  # IoU 2/3: at .5, .55, .6 and .65 of ten
    row = of([[(shifted, 0.9)]], [[A]], kind=2)["by_kind"]["ball"]
    assert row["ap50"] == pytest.approx(1.0) and row["ap50_95"] == pytest.approx(0.4)


def test_cells_become_boxes_and_neighbors_of_one_kind_one():
    output = np.zeros((4 + 4, 4), np.float32)
    output[:4] = np.array([[10, 10, 8, 8], [11, 10, 8, 8], [10, 10, 8, 8], [40, 40, 8, 8]]).T
    output[4, 0], output[4, 1], output[5, 2] = 0.9, 0.8, 0.7
    found = detections(output)
    assert found[:, 4].tolist() == pytest.approx([0.9, 0.7]) and found[:, 5].tolist() == [0, 1]
    assert found[0, :4].tolist() == [6, 6, 14, 14]
    assert detections(np.zeros((8, 3), np.float32)).shape == (0, 6)
