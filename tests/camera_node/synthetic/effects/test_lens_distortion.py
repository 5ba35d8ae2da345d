"""Images are taken through the distorted lens; frames say so, or where cameras are not calibrated do not."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from camera_node.synthetic import make_scene
from camera_node.synthetic.effects import NO_EFFECTS, EffectError, load_effects
from camera_node.synthetic.placement import Part
from camera_node.synthetic.render import World
from camera_node.synthetic.shapes import Sphere
from camera_node.synthetic.source import WorldSource
from camera_node.synthetic.textures import Plain
from freshfield.geometry import se3_inverse
from tests.camera_node.synthetic.worlds import FLAT_LIGHT as FLAT

LENS = {"k1": -0.22, "k2": 0.05, "p1": 0.004, "p2": -0.003}


def made(**parameters):
    return load_effects({"lens_distortion": parameters}, lambda name: np.random.default_rng(0))


def test_a_ball_appears_where_opencv_projects_it():
    scene = make_scene("room", {"width": 256, "height": 192, "horizontal_fov_deg": 75.0, "supersample": 3})
    _, pose = scene.cameras["cam00"]
    k = scene.cameras["cam00"][0]
    matrix = np.array([[k.fx, 0, k.cx - 0.5], [0, k.fy, k.cy - 0.5], [0, 0, 1]])  # OpenCV counts pixel centers
    for x, y in ((0.0, 0.0), (1.05, 0.7), (-1.1, 0.6), (-1.0, -0.75), (0.9, 0.0)):
        in_camera = np.array([x, y, 2.0])
        ball = np.eye(4)
        ball[:3, 3] = (pose @ [*in_camera, 1.0])[:3]
        world = World((Part(Sphere(0.03), Plain((1.0, 1.0, 1.0)), ball),), (), FLAT)
        image = made(**LENS).extend(scene.with_world(world)).render("cam00", 0.0)[..., 0]
        v, u = np.mgrid[0:192, 0:256]
        centroid = np.array([(u * image).sum(), (v * image).sum()]) / image.astype(float).sum()
        points, _ = cv2.projectPoints(in_camera[None], np.zeros(3), np.zeros(3), matrix, np.array(list(LENS.values())))
        assert np.allclose(centroid, points[0, 0], atol=0.15)
        straight = k.project((se3_inverse(pose) @ ball[:, 3])[:3]) - 0.5
        if abs(x) > 0.5 and abs(y) > 0.5:
            assert np.linalg.norm(centroid - straight) > 5.0  # the test would notice a lens left out


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
