"""Boxes without area, masks that are empty or full, pictures that are flat, tiny or noise: the picture passes
whole and is counted, and nothing raises."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from edge_server.foreground import ForegroundConfig, ForegroundError
from edge_server.foreground.foreground import Foreground, Found, clipped, make_foreground
from edge_server.foreground.segment import grabcut

RNG = np.random.default_rng(0)
NOISE = RNG.integers(0, 256, (40, 60, 3), dtype=np.uint8)


class At:
    """A detector that always says the same, in pixels."""

    def __init__(self, box):
        self.box = box

    def of(self, camera, image):
        return None if self.box is None else Found(self.box)


def says(answer):
    """A segmentation that always says the same, or fails."""

    def segment(image, box):
        if answer is None:
            raise ForegroundError("broken")
        return np.full(image.shape[:2], answer)

    return segment


def cut(box, segmenter) -> Foreground:
    return Foreground(ForegroundConfig(box=(0, 0, 1, 1)), At(box), segmenter)


@pytest.mark.parametrize(
    "box, answer, counted",
    [
        (None, True, "not_detected"),
        ((10.0, 10.0, 10.0, 30.0), True, "empty_box"),
        ((10.0, 30.0, 20.0, 10.0), True, "empty_box"),
        ((100.0, 100.0, 120.0, 130.0), True, "empty_box"),
        ((-30.0, -30.0, 0.0, 0.0), True, "empty_box"),
        ((np.nan, 0.0, 10.0, 10.0), True, "empty_box"),
        ((0.0, 0.0, np.inf, 10.0), True, "empty_box"),
        ((0.0, 0.0, 30.0, 30.0), False, "empty_mask"),
        ((0.0, 0.0, 30.0, 30.0), True, "full_mask"),
        ((0.0, 0.0, 30.0, 30.0), None, "failed"),
    ],
)
def test_what_cannot_be_cut_passes_whole_and_is_counted(box, answer, counted):
    foreground = cut(box, says(answer))
    assert foreground.apply("cam00", NOISE)[0] is NOISE
    assert {name: n for name, n in vars(foreground.counts).items() if n} == {counted: 1}


@settings(max_examples=60)
@given(
    box=st.tuples(*[st.floats(-100, 200)] * 4),
    shape=st.tuples(st.integers(1, 40), st.integers(1, 40)),
    kind=st.sampled_from(["flat", "noise", "half"]),
    side=st.sampled_from([16, 32, 4096]),
)
def test_grabcut_with_any_box_on_any_picture(box, shape, kind, side):
    image = np.full((*shape, 3), 77, np.uint8)
    if kind == "noise":
        image = np.random.default_rng(1).integers(0, 256, (*shape, 3), dtype=np.uint8)
    elif kind == "half":
        image[: shape[0] // 2] = 200
    foreground = cut(box, partial(grabcut, iterations=1, side=side))
    out, _ = foreground.apply("cam00", image)
    assert sum(vars(foreground.counts).values()) == 1
    assert foreground.counts.failed == 0
    assert out is image or out.shape == (*shape, 4)
    if out is not image:
        alpha = out[..., 3]
        assert 0 < (alpha == 255).sum() < alpha.size and set(np.unique(alpha)) == {0, 255}
        left, top, right, bottom = clipped(box, shape[1], shape[0])
        outside = np.ones(shape, bool)
        # A shrunk mask knows its edge to a pixel of the size that it was found at.
        slack = 1 + int(np.ceil(max(shape) / side))
        outside[max(top - slack, 0) : bottom + slack, max(left - slack, 0) : right + slack] = False
        assert not alpha[outside].any()


def test_the_whole_picture_as_a_box_has_no_background_and_passes_whole():
    foreground = make_foreground(ForegroundConfig(box=(0.0, 0.0, 1.0, 1.0)))
    assert foreground.apply("cam00", NOISE)[0] is NOISE
    assert foreground.counts.full_mask == 1


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_a_model_that_gives_no_numbers_detects_nothing(value):
    pytest.importorskip("onnxruntime", reason="needs ONNX Runtime: pip install -e '.[embed]'")
    pytest.importorskip("onnx", reason="needs ONNX Runtime: pip install -e '.[embed]'")
    from edge_server.foreground.detector import decode

    good = np.array([[10.0, 10.0, 5.0, 5.0, 0.9, 0.1]]).T
    for row in range(6):
        table = np.tile(good, (1, 30))
        table[row, :] = value
        assert decode(table[None], 0.25, "test") == []
    flat = np.tile(good, (1, 30))
    flat[2] = 0.0
    assert decode(flat[None], 0.25, "test") == [], "boxes without area"
    assert len(decode(np.tile(good, (1, 30))[None], 0.25, "test")) == 1
