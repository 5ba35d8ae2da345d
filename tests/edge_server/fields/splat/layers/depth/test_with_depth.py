"""The field in layers before few cameras that measure depth, or whose plates tell it by stereo: a ball that moves."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest
from msgspec import structs
from numpy.typing import NDArray

from edge_server.fields import Budget
from edge_server.fields.splat.layers import layer_constants as layer_numbers
from edge_server.fields.splat.layers.depth import layer_depth_constants as depth_numbers
from edge_server.fields.splat.layers.layered_field import LayeredField
from tests.edge_server.fields.scenes import seen
from tests.edge_server.fields.small import same_state
from tests.edge_server.fields.splat.layers.ball import SMALL, Change, Rig

RIG = Rig((0, 2, 4), held=1)
WITHOUT = Rig((0, 1, 3), held=2, size=64, depth=False)
CAMERAS, HELD = RIG.cameras, RIG.held
SEEDS = (0, 1, 2)
HALF_SECOND = 8  # frames
pytestmark = pytest.mark.usefixtures("shown_soon")

Spoil = Callable[[int, int, NDArray[np.float32]], NDArray[np.float32] | None]


def _noise(camera: int, frame: int, depth: NDArray[np.float32]) -> NDArray[np.float32]:
    return np.random.default_rng([5, camera, frame]).uniform(0.1, 9.0, depth.shape).astype(np.float32)


_MEASURED: dict[str, Spoil] = {
    "all": lambda camera, frame, depth: depth,
    "nothing": lambda camera, frame, depth: None,
    "each fifth": lambda camera, frame, depth: depth if frame % 5 == 0 else None,
    "two of three cameras": lambda camera, frame, depth: None if camera == 1 else depth,
    "holes, NaN, infinite": lambda camera, frame, depth: np.full_like(depth, (0.0, np.nan, np.inf)[camera]),
    "constant": lambda camera, frame, depth: np.full_like(depth, 1.0),
    "inverted": lambda camera, frame, depth: np.where(depth > 0, 1.0 / np.maximum(depth, 1e-3), 0).astype(np.float32),
    "millimeters": lambda camera, frame, depth: depth * np.float32(1000.0),
    "noise": _noise,
    "one camera ten times too far": lambda camera, frame, depth: depth * np.float32(10.0 if camera == 0 else 1.0),
    "ten times too far, later": lambda camera, frame, depth: depth * np.float32(10.0 if frame > 20 else 1.0),
    "half of the image": lambda camera, frame, depth: np.where(np.arange(48) < 24, depth, 0).astype(np.float32),
}


def _changed(kind: str) -> Change:
    return lambda camera, frame, view: replace(view, depth=_MEASURED[kind](camera, frame, view.depth))


@cache
def _shown(kind: str, seed: int = 0) -> tuple[LayeredField, list[float]]:
    """The field after 40 frames, and PSNR of each frame of the last half second."""
    field = LayeredField(structs.replace(SMALL, seed=seed))
    return field, RIG.curve(field, 40, _changed(kind))[-HALF_SECOND:]


def test_depth_lets_layers_begin_sooner_and_shows_what_is_between_the_cameras() -> None:
    assert RIG.run(LayeredField(SMALL), range(14), cameras=1).tracker is not None
    field = RIG.run(LayeredField(SMALL), range(13))
    assert field.tracker is not None and field.supervision.early
    assert all(" " not in view.camera for view in field.views) and len(field.still.views) > len(field.views)
    field, shown_db = _shown("all")
    assert not field.supervision.early and field.supervision.with_depth
    assert shown_db[-1] > _shown("nothing")[1][-1] + 0.3


def test_it_tells_what_no_camera_has_seen() -> None:
    shown = _shown("all")[0].snapshot()
    unseen = shown.unseen(HELD.camera_to_world, HELD.intrinsics)
    _, distance = seen(HELD.intrinsics, HELD.camera_to_world)
    assert unseen is not None and unseen[~np.isfinite(distance)].mean() > 0.9 > 0.5 > unseen[distance < 9].mean()
    surfaces, camera = shown.surfaces, CAMERAS[0]
    depth = surfaces.meshes.depth[: camera.image[..., 0].size].reshape(camera.image.shape[:2])
    on_axis = camera.intrinsics.rays() / camera.intrinsics.rays()[..., 2:]
    offsets = (depth[..., None] * on_axis)[depth > 0] @ camera.camera_to_world[:3, :3].T
    shares = [surfaces.unseen_points(camera.camera_to_world[:3, 3] + far * offsets).mean() for far in (0.8, 1.0, 1.5)]
    assert shares[:2] == [0.0, 0.0] and shares[2] > 0.9


@pytest.mark.parametrize(("kind", "lost_db"), [("each fifth", 1.0), ("two of three cameras", 1.5)])
def test_depth_of_some_frames_or_cameras_does(kind: str, lost_db: float) -> None:
    field, shown_db = _shown(kind)
    assert field.supervision.with_depth and shown_db[-1] > _shown("all")[1][-1] - lost_db


def test_depth_of_another_instant_says_nothing_of_what_moves() -> None:
    """The plates keep it; the moving set takes only what was measured within BODY_GAP_NS of the image."""
    gaps_ns = (0, depth_numbers.BODY_GAP_NS, -depth_numbers.BODY_GAP_NS - 1)
    field = LayeredField(SMALL)
    RIG.run(field, range(16), lambda k, frame, v: replace(v, depth_ns=v.generated_ns + gaps_ns[k]), steps=5)
    measured = {o.camera for o in field.observations if o.view.depth is not None}
    assert measured == {view.camera for view in CAMERAS[:2]}
    plate = field.cameras[CAMERAS[2].camera].depth
    assert field.tracker is not None and plate is not None and plate.count.any()


@pytest.mark.parametrize(("rig", "frames"), [(RIG, 12), (WITHOUT, 20)])
def test_it_resumes_bit_for_bit(rig: Rig, frames: int) -> None:
    field, other = LayeredField(SMALL), LayeredField(SMALL)
    rig.run(field, range(frames), steps=5)
    other.load_state(field.state())
    for each in (field, other):
        rig.run(each, range(frames, frames + 8), steps=5)
    assert field.supervision.with_depth
    same_state(field, other, settings=True)


def test_depth_of_another_size_is_refused() -> None:
    view = replace(RIG.frame(0, 0), depth=np.ones((3, 4), np.float32))
    with pytest.raises(ValueError, match="cam00: depth must be float32 of shape"):
        LayeredField(SMALL).fit([view], Budget(steps=1))


# Cameras whose depth the page then says is not used. Noise, and a unit that changes later, are refused by frames.
_NAMED = dict.fromkeys(("inverted", "millimeters"), ("cam00", "cam02", "cam04"))
_NAMED |= {"constant": ("cam00", "cam04"), "one camera ten times too far": ("cam00",)}
# The others are refused or believed by the rules that ``test_surfaces`` and ``test_depth_plate`` hold.
_QUICK = ("holes, NaN, infinite", "one camera ten times too far")


@pytest.mark.stability
@pytest.mark.parametrize(
    "kind", [pytest.param(k, marks=[pytest.mark.slow] * (k not in _QUICK)) for k in list(_MEASURED)[4:]]
)
def test_broken_depth_costs_little(kind: str) -> None:
    """Three trainings, since a single one differs between processors by up to 1 dB."""
    shown_db = []
    for seed in SEEDS:
        field, of_seed_db = _shown(kind, seed)
        shown_db += of_seed_db
        assert field.layered and len(field.cameras) == 3
        assert tuple(said.split()[3] for said in field.troubles) == _NAMED.get(kind, ())
    # A constant depth of the right order of magnitude, before cameras that share little, is believed.
    without_db = np.mean([_shown("nothing", seed)[1] for seed in SEEDS])
    assert np.mean(shown_db) > without_db - (2.5 if kind == "constant" else 0.5)


# --- by stereo --------------------------------------------------------------------------------------


def test_stereo_shows_what_is_between_few_cameras(monkeypatch: pytest.MonkeyPatch) -> None:
    scores = []
    monkeypatch.setattr(layer_numbers, "PLAIN_CAMERAS", 0)
    for most in (0, layer_numbers.STEREO_CAMERAS):
        monkeypatch.setattr(layer_numbers, "STEREO_CAMERAS", most)
        field = WITHOUT.run(LayeredField(SMALL), range(36))
        assert field.supervision.with_depth == (most > 0)
        scores.append(WITHOUT.score(field, 35))
    assert scores[1] > scores[0] + 1.0


@pytest.mark.parametrize(("plain_rows", "plain"), [(0, False), (14, True), (64, False)])
def test_with_more_cameras_stereo_is_used_where_some_of_the_plates_is_plain(plain_rows, plain, monkeypatch) -> None:
    """Of the images the uppermost rows show a plain sky, which the others would, too, but for a grain."""
    monkeypatch.setattr(layer_numbers, "STEREO_CAMERAS", 2)
    monkeypatch.setattr(layer_numbers, "PLAIN_CAMERAS", 3)
    grain = np.random.default_rng(0).integers(-12, 13, WITHOUT.held.image.shape)
    grain[:plain_rows] = 0
    field = LayeredField(SMALL)
    WITHOUT.run(
        field, range(24), lambda k, n, v: replace(v, image=np.clip(v.image + grain, 0, 255).astype(np.uint8)), steps=5
    )
    stereo = field.supervision.depth is not None and field.supervision.depth.stereo is not None
    assert field.supervision.plain == field.supervision.with_depth == stereo == plain
    again = LayeredField(SMALL)
    again.load_state(field.state())
    assert again.supervision.plain == plain


def test_with_a_budget_in_seconds_it_is_found_beside() -> None:
    field = WITHOUT.run(LayeredField(SMALL), range(20), seconds=0.02)
    while field.static.training and not field.static.ready:
        WITHOUT.run(field, range(20, 21), seconds=0.02)
    assert field.static.ready and len(field.still.views) > 3
    field.static.stop()
