"""Cameras that somebody knocks: noticed by their own pictures, and shown from where they stand then."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from msgspec import structs

from edge_server.fields import Budget
from edge_server.fields.splat.layers import settings as tuned
from edge_server.fields.splat.layers.bump import degrees_of, find_turn
from edge_server.fields.splat.layers.layered_field import LayeredField
from freshfield.geometry import Pinhole, so3_exp
from tests.edge_server.fields.scenes import psnr, ring, seen
from tests.edge_server.fields.splat.layers.ball import SMALL, place_m

LENS = Pinhole.from_fov(96, 72, 60.0)
TEXTURE = np.random.default_rng(3).random((3, 8))


def _sky(turn: np.ndarray, lens: Pinhole = LENS) -> np.ndarray:
    """What a camera turned by ``turn`` (3, 3) sees of smooth colors at infinity, uint8 (H, W, 3)."""
    waves = np.sin(30.0 * (lens.rays() @ turn.T) @ (TEXTURE - 0.5) + 5.0 * TEXTURE[0])
    return (127.5 + 120.0 * waves[..., :3]).astype(np.uint8)


BENT = (-0.15, 0.02, 0.0, 0.0)
TURNS = [((0.0, 2.0, 0.0), (0.0,) * 4), ((-0.8, 0.5, 1.0), BENT), ((1.5, -2.5, 0.0), BENT)]


@pytest.mark.parametrize(("degrees", "distortion"), TURNS)
def test_a_turn_is_found_to_a_tenth_of_a_degree_beside_a_person(degrees, distortion):
    lens, turn = replace(LENS, distortion=distortion), so3_exp(np.deg2rad(degrees))
    frame = _sky(turn, lens)
    frame[10:60, 30:48] = (200, 30, 40)
    known = np.ones((72, 96), bool)
    known[:, :8] = False
    found = find_turn(_sky(np.eye(3), lens).astype(np.float32), known, frame, lens)
    assert found is not None and degrees_of(turn.T @ found) < 0.1


@pytest.mark.stability
@pytest.mark.parametrize("frame", ["the same", "a person", "black", "noise", "flat", "nothing known", "far off"])
def test_no_turn_is_found_where_there_is_none(frame):
    plate = _sky(np.eye(3))
    known = np.full((72, 96), frame != "nothing known")
    person = plate.copy()
    person[:, 20:60] = 30
    pictures = {
        "a person": person,
        "black": np.zeros_like(plate),
        "noise": np.random.default_rng(1).integers(0, 255, plate.shape).astype(np.uint8),
        "far off": _sky(so3_exp(np.deg2rad([0.0, 40.0, 0.0]))),
        "flat": np.full_like(plate, 90),
    }
    before = np.full_like(plate, 90) if frame == "flat" else plate
    assert find_turn(before.astype(np.float32), known, pictures.get(frame, plate), LENS) is None


CAMERAS, HELD = ring(7, 64)[:6], ring(7, 64)[6]
BUMPED_S, END_S, SCORED_S = 1.6, 3.6, 0.6


def _run(turn_deg: float, seconds: float = END_S) -> tuple[LayeredField, float]:
    """The field, and PSNR of the held-out view in the last second. The first camera turns at BUMPED_S."""
    field, scores = LayeredField(structs.replace(SMALL, threads=1)), []
    for frame in range(1, round(15 * seconds) + 1):
        t = frame / 15.0
        views, ball = [], place_m(t, 0.3)
        for k, view in enumerate(CAMERAS):
            stands = view.camera_to_world.copy()
            if k == 0 and t > BUMPED_S:
                stands[:3, :3] @= so3_exp(np.deg2rad([0.0, turn_deg, 0.0]))
            image, _ = seen(view.intrinsics, stands, ball, 0.3)
            views.append(replace(view, image=image.astype(np.uint8), generated_ns=round(t * 1e9)))
        field.fit(views, Budget(steps=20))
        if t > seconds - SCORED_S:
            truth, _ = seen(HELD.intrinsics, HELD.camera_to_world, ball, 0.3)
            scores.append(psnr(field.render(HELD.camera_to_world, HELD.intrinsics).color, truth / 255.0))
    return field, float(np.median(scores))


@pytest.mark.stability
def test_a_camera_that_is_bumped_is_noticed_said_and_shown_from_where_it_stands():
    """Two degrees cost at most .3 dB once its plate is known anew; exact cameras are left alone; a state resumes."""
    exact, exact_db = _run(0.0)
    bumped, bumped_db = _run(2.0)
    assert exact.troubles == () and all(camera.bumped is None for camera in exact.cameras.values())
    (trouble,) = bumped.troubles
    name = CAMERAS[0].camera
    assert trouble.startswith(f"{name} was bumped: all of its picture is turned by ")
    camera = bumped.cameras[name]
    turn = CAMERAS[0].camera_to_world[:3, :3].T @ camera.view.camera_to_world[:3, :3]
    assert abs(degrees_of(turn) - 2.0) < 0.2 and not bumped.refused
    assert bumped_db > exact_db - 0.3
    again = LayeredField(SMALL)
    again.load_state(bumped.state())
    assert again.troubles == bumped.troubles


@pytest.mark.stability
def test_a_camera_that_swings_is_bumped_once_it_stands_still():
    """Turns that do not agree for BUMP_FRAMES frames move nothing."""
    field, _ = _run(0.0, 1.6)
    camera = field.cameras[CAMERAS[0].camera]
    everything = np.ones(camera.plate.known.shape, bool)
    for frame in range(2 * tuned.BUMP_FRAMES):
        stands = CAMERAS[0].camera_to_world.copy()
        stands[:3, :3] @= so3_exp(np.deg2rad([0.0, 2.0 + frame % 2, 0.0]))
        image, _ = seen(HELD.intrinsics, stands, np.array([9.0, 9.0, 0.3]), 0.3)
        view = replace(CAMERAS[0], image=image.astype(np.uint8), generated_ns=round(1e9 * (2.0 + frame / 15.0)))
        assert camera.shows_turned(view, everything, lambda name: 0.05) and not camera.was_turned
