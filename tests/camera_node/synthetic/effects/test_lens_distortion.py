"""Images are taken through the distorted lens; frames say so, or where cameras are not calibrated do not."""

from __future__ import annotations

import numpy as np
import pytest

from camera_node.synthetic import make_scene
from camera_node.synthetic.effects import NO_EFFECTS, EffectError, load_effects
from camera_node.synthetic.source import WorldSource

LENS = {"k1": -0.22, "k2": 0.05, "p1": 0.004, "p2": -0.003}


def made(**parameters):
    return load_effects({"lens_distortion": parameters}, lambda name: np.random.default_rng(0))


def test_frames_carry_the_coefficients_unless_uncalibrated():
    scene = make_scene("room", {"width": 32, "height": 32, "supersample": 1})
    calibrated, naive = made(**LENS), made(**LENS, calibrated=False)
    seen = calibrated.extend(scene).cameras["cam03"][0]
    assert seen.distortion == tuple(LENS.values())
    assert calibrated.reported_lens(seen) == seen
    assert naive.extend(scene).cameras["cam03"][0] == seen
    assert naive.reported_lens(seen) == scene.cameras["cam03"][0]
    # The reported lens does not change the image, so both share what was rendered.
    shared, other, plain = (WorldSource("eye", scene, "cam03", 15, effects=e) for e in (calibrated, naive, NO_EFFECTS))
    assert shared.key() == other.key() != plain.key()
    assert np.array_equal(shared.image(2), other.image(2))


def test_a_lens_that_cannot_be_undone_is_refused_in_one_line():
    scene = make_scene("room", {"width": 32, "height": 32, "horizontal_fov_deg": 120.0})
    with pytest.raises(EffectError, match=r"lens_distortion: k1 -0.5, .* cannot be undone") as error:
        made(k1=-0.5).extend(scene)
    assert "\n" not in str(error.value)
