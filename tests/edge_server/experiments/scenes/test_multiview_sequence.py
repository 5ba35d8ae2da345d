"""A moving scene played without end: pictures repeat, time does not."""

from __future__ import annotations

from functools import partial

import numpy as np
import pytest

from camera_node.sources.datasets.records import DatasetError
from edge_server.experiments.scenes.multiview_sequence import MultiviewSequence, recorded_sequence, synthetic_sequence
from edge_server.fidelity.moving_pixels import BOUND, LAGS_MS
from edge_server.fidelity.scorer import Scorer
from edge_server.fields import Rendering
from tests.conftest import data_dir
from tests.edge_server.experiments.sets import write_photos, write_recording


class Shows:
    """Renders one picture."""

    def __init__(self, image) -> None:
        self.image = image

    def render(self, pose, lens) -> Rendering:
        return Rendering((self.image / 255.0).astype(np.float32), np.zeros((1, 1)), np.zeros((1, 1)))


@pytest.fixture(scope="module")
def room() -> MultiviewSequence:
    return synthetic_sequence("room", cameras=4, size=32, fps=15.0, speed_m_per_s=1.0)


def test_a_synthetic_scene_repeats_but_its_time_goes_on(room: MultiviewSequence) -> None:
    first = room.training(0)
    assert [v.camera for v in first] == ["cam01", "cam02", "cam03"] and room.held_out == ("cam00",)
    loop = next(k for k in range(1, 1000) if room.key(k) == room.key(0))
    again = room.training(loop)
    assert all(a.image is b.image for a, b in zip(first, again))
    assert again[0].generated_ns == pytest.approx(loop / 15.0 * 1e9, abs=2)
    assert any(np.any(a.image != b.image) for a, b in zip(first, room.training(4)))


def test_scores_tell_moving_pixels_from_the_rest(room: MultiviewSequence) -> None:
    truth = room.truth(6)[0].image
    late = room.score(Shows(room.truth(0)[0].image), 6, Scorer())
    assert late.psnr_moving_db is not None and late.psnr_moving_db < late.psnr_db - 3.0
    assert 0.0 < late.moving_share < 0.5
    assert room.score(Shows(truth), 6, Scorer()).psnr_db > 60.0
    assert len(room.before("cam00", 0)) == len(LAGS_MS)  # before the first frame there was a scene, too


def test_a_recording_is_played_back_and_forth(tmp_path) -> None:
    sequence = recorded_sequence(write_recording(tmp_path, cameras=4, instants=4), "cam00")
    assert [sequence.key(k) for k in range(8)] == [0, 1, 2, 3, 2, 1, 0, 1]
    assert sequence.period_ms == pytest.approx(100.0)
    assert [v.generated_ns for v in sequence.training(5)] == [500_000_000] * 3
    # 60 and 120 ms before lies one frame, 200 ms two and 300 ms three; at the turn some are the same.
    seen = [next(k for k in range(4) if sequence.image("cam00", k) is i) for i in sequence.before("cam00", 4)]
    assert seen == [3, 2, 1]
    assert sequence.bounds["cam00"] >= BOUND


@pytest.mark.parametrize(
    ("make", "holdout", "told"),
    [
        (write_photos, "0", "nothing moves"),
        (write_recording, "0", "holds out no"),
        (partial(write_recording, instants=1), "cam00", "nothing moves"),
    ],
)
def test_what_cannot_be_followed_is_said(tmp_path, make, holdout: str, told: str) -> None:
    with pytest.raises(DatasetError, match=told):
        recorded_sequence(make(tmp_path), holdout)


def test_views_can_be_late(room: MultiviewSequence) -> None:
    views = room.training(6, late=1)
    assert [v.generated_ns for v in views] == pytest.approx([6e9 / 15, 5e9 / 15, 6e9 / 15], abs=1)
    assert views[1].image is room.training(5)[1].image


def test_the_real_recording_is_followed_frame_by_frame() -> None:
    sequence = recorded_sequence(data_dir("blender_kitchen") / "transforms.json", "cam00")
    assert sequence.period_ms == pytest.approx(1e3 / 30) and sequence.held_out == ("cam00",)
    assert len(sequence.training(0)) == 18 and sequence.key(45) == 43 and sequence.key(88) == 0
    late = sequence.score(Shows(sequence.truth(9)[0].image), 12, Scorer())  # 100 ms ago
    # Measured apart from this code: 100 ms of motion and the noise of the renderer leave 26.2 dB.
    assert late.psnr_db == pytest.approx(26.2, abs=1.5) and late.psnr_moving_db < late.psnr_db - 2.0
    assert 0.03 <= sequence.bounds["cam00"] < 0.1 and 0.03 < late.moving_share < 0.4
