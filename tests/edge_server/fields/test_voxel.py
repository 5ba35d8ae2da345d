"""The voxel field as a whole: it learns, repeats itself, keeps budgets, saves and resumes."""

from __future__ import annotations

import threading
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from edge_server.fields import Budget, View
from edge_server.fields.ngp import NgpField
from edge_server.fields.registry import make_field
from edge_server.fields.voxel import VoxelField
from edge_server.fields.voxel_settings import EFFORTS, VoxelSettings, help_text, make_settings
from tests.edge_server.fields.scenes import mean_psnr, picture, psnr, ring
from tests.edge_server.fields.test_ngp import SMALL as SMALL_NGP

SMALL = VoxelSettings(sizes=(16, 32, 48), refine_at=(20, 60), rays=1024, cells=32, threads=2)
VIEWS = ring(13)
HELD, SEEN = VIEWS[6], VIEWS[:6] + VIEWS[7:]


def _score(field: VoxelField, view: View = HELD) -> float:
    return psnr(field.render(view.camera_to_world, view.intrinsics).color, view.image / 255.0)


def _moved() -> list[View]:
    ball = np.array([0.3, 0, 0.5])
    return [replace(v, image=picture(v.intrinsics, v.camera_to_world, ball)) for v in SEEN]


@pytest.fixture(scope="module")
def trained() -> VoxelField:
    field = VoxelField(SMALL)
    field.fit(SEEN, Budget(steps=250))
    return field


def test_it_learns_a_view_it_has_not_seen(trained: VoxelField) -> None:
    assert _score(trained) > 20.0  # the mean colour: below 16


def test_a_long_fit_is_no_worse_than_a_short_one() -> None:
    few, others = SEEN[::2], SEEN[1::2]  # few views are soon known by heart
    gains = []
    for settle in (SMALL.settle, 0.0):
        short, long = (VoxelField(replace(SMALL, settle=settle)) for _ in range(2))
        short.fit(few, Budget(steps=150))
        long.fit(few, Budget(steps=1200))
        gains.append(mean_psnr(long, others) - mean_psnr(short, others))
    assert gains[0] > -0.25 and gains[1] < -0.5


def test_points_lie_on_surfaces(trained: VoxelField) -> None:
    points, colors = trained.points(500)
    assert 100 < len(points) <= 500 and points.dtype == colors.dtype == np.float32
    ball = np.abs(np.linalg.norm(points - [0, 0, 0.5], axis=1) - 0.5)
    assert np.median(np.minimum(ball, np.abs(points[:, 2]))) < 0.12


def _same_state(a: VoxelField, b: VoxelField) -> None:
    one, two = a.state(), b.state()
    assert one.keys() == two.keys()
    for name in one.keys() - {"meta"}:
        np.testing.assert_array_equal(one[name], two[name], err_msg=name)


@pytest.mark.parametrize("extra", [{}, {"background": "random", "contracted": True}])
def test_results_are_equal_bit_for_bit_whatever_the_thread_count(extra: dict[str, Any]) -> None:
    fields = [VoxelField(replace(SMALL, threads=threads, **extra)) for threads in (1, 2, 3)]
    reports = []
    for field in fields:
        field.fit(SEEN[:5], Budget(steps=15))
        reports.append(field.fit(SEEN, Budget(steps=10)))
    assert len({(r.loss, r.rays, r.samples) for r in reports}) == 1
    _same_state(fields[0], fields[1])
    _same_state(fields[1], fields[2])
    pictures = [f.render(HELD.camera_to_world, HELD.intrinsics) for f in fields]
    np.testing.assert_array_equal(pictures[0].color, pictures[1].color)


def test_resuming_continues_bit_for_bit_across_an_upsampling() -> None:
    a, b = VoxelField(SMALL), VoxelField(replace(SMALL, threads=1))
    a.fit(SEEN, Budget(steps=30))
    b.load_state(a.state())
    for field in (a, b):
        field.fit(_moved(), Budget(steps=40))
    assert a._voxels.size == 48
    _same_state(a, b)


def test_upsampling_hardly_changes_the_picture() -> None:
    field = VoxelField(replace(SMALL, sizes=(32, 48), refine_at=(60,)))
    field.fit(SEEN, Budget(steps=60))
    before, table = field.render(HELD.camera_to_world, HELD.intrinsics).color, field._voxels.table
    field._grow(60)
    field._snapshot = None
    after = field.render(HELD.camera_to_world, HELD.intrinsics).color
    assert field._voxels.size == 48 and len(field._voxels.table) > len(table)
    assert psnr(before, after) > 26.0


def test_a_warm_start_follows_what_moved(trained: VoxelField) -> None:
    field, moved = VoxelField(SMALL), _moved()
    field.load_state(trained.state())
    target = replace(HELD, image=picture(HELD.intrinsics, HELD.camera_to_world, np.array([0.3, 0, 0.5])))
    stale = _score(field, target)
    field.fit(moved, Budget(steps=100))
    assert _score(field, target) > stale + 2.0


def test_a_state_of_another_kind_or_shape_is_refused() -> None:
    state = VoxelField(SMALL).state()
    with pytest.raises(ValueError, match=r"sizes = \[16, 32, 48\]"):
        VoxelField(replace(SMALL, sizes=(16, 32, 64))).load_state(state)
    with pytest.raises(ValueError, match="a field called ngp, this one is voxel"):
        VoxelField(SMALL).load_state(NgpField(SMALL_NGP).state())
    with pytest.raises(ValueError, match="not a state"):
        VoxelField(SMALL).load_state({"table": state["table"]})


def test_the_grid_is_as_fine_as_pixels_where_no_size_is_set() -> None:
    field = VoxelField(replace(SMALL, sizes=None, refine_at=(3, 6)))
    field.fit(SEEN, Budget(steps=8))
    assert field.rig.box is not None
    last = np.clip(field.rig.box.pixels_across, 64, 192)
    assert 0 <= field._voxels.size - last < 32 and field._sizes[0] < field._sizes[1] < field._sizes[2]
    other = VoxelField(field.settings)
    other.load_state(field.state())
    _same_state(field, other)


def test_reset_forgets_everything() -> None:
    field = VoxelField(SMALL)
    before = field.state()
    field.fit(SEEN, Budget(steps=25))
    field.reset()
    after = field.state()
    assert before.keys() == after.keys() and all((before[k] == after[k]).all() for k in before)


@pytest.mark.alone
def test_a_budget_in_seconds_is_kept(trained: VoxelField) -> None:
    trained.fit(SEEN, Budget(seconds=0.3))  # by then it is known how long a step takes here
    reports = [trained.fit(SEEN, Budget(seconds=0.3)) for _ in range(5)]
    spent = np.median([r.seconds for r in reports])
    assert 0.85 * 0.3 <= spent <= 1.1 * 0.3 and all(r.steps > 3 for r in reports)


def test_others_render_while_it_trains() -> None:
    """Snapshots stay what they were, also across an upsampling."""
    field = VoxelField(SMALL)
    field.fit(SEEN, Budget(steps=5))
    snapshot = field.snapshot()
    first = snapshot.render(HELD.camera_to_world, HELD.intrinsics).color
    worker = threading.Thread(target=field.fit, args=(SEEN, Budget(steps=60)))
    worker.start()
    pictures = 0
    while worker.is_alive():
        pictures += 1
        again = snapshot.render(HELD.camera_to_world, HELD.intrinsics).color
        np.testing.assert_array_equal(first, again)
        assert np.isfinite(field.render(HELD.camera_to_world, HELD.intrinsics).color).all()
    worker.join()
    assert pictures > 2, "it was over at once: nothing was tested"
    alone = VoxelField(SMALL)
    alone.fit(SEEN, Budget(steps=5))
    alone.fit(SEEN, Budget(steps=60))
    _same_state(field, alone)


def test_transparent_views_are_seen_against_the_background() -> None:
    views = []
    for view in SEEN:
        sky = (view.image == view.image[0, 0]).all(axis=-1)
        views.append(replace(view, image=np.dstack([view.image, np.where(sky, 0, 255).astype(np.uint8)])))
    field = VoxelField(replace(SMALL, background="white"))
    field.fit(views, Budget(steps=150))
    out = field.render(views[0].camera_to_world, views[0].intrinsics)
    clear = views[0].image[..., 3] == 0
    assert out.color[clear].mean() > 0.9 and out.opacity[clear].mean() < 0.3
    assert out.opacity[~clear].mean() > 0.7


def test_a_plain_background_is_known_to_be_empty_in_spite_of_noise() -> None:
    rng = np.random.default_rng(0)
    noise = [np.rint(rng.normal(0.0, 1.5, v.image.shape)) for v in SEEN]
    noisy = [replace(v, image=np.clip(v.image + n, 0, 255).astype(np.uint8)) for v, n in zip(SEEN, noise)]
    field = VoxelField(SMALL)
    field.fit(noisy, Budget(steps=2))
    assert field._outlines is not None
    alpha = field._outlines[1].pixels[:, 3]
    sky = np.concatenate([(v.image == v.image[0, 0]).all(axis=-1).ravel() for v in SEEN])
    assert alpha[sky].mean() < 1.0 and alpha[~sky].mean() > 250.0
    without = VoxelField(replace(SMALL, outline=0.0))
    without.fit(noisy, Budget(steps=2))
    assert without._outlines is not None and without._outlines[1].pixels.shape[1] == 3


def test_it_is_registered_and_its_options_are_checked() -> None:
    field = make_field("voxel", {"sizes": [16, 24], "refine_at": [10]}, seed=5)
    assert isinstance(field, VoxelField) and field.settings.sizes == (16, 24) and field.settings.seed == 5
    for wrong, text in (
        ({"levels": 3}, r"no option levels; it has: effort, sizes, .*nice"),
        ({"hidden": 16}, "no option hidden; it has"),
        ({"sizes": [32, 16]}, "sizes must be rising"),
        ({"sizes": [32, 48], "refine_at": [9, 12]}, "refine_at must be 1 rising"),
        ({"refine_at": [9, 9]}, "refine_at must be rising"),
        ({"parts": 0}, "parts must be in 1..64, not 0"),
        ({"device": "cuda"}, "CPUs only"),
        ({"effort": "heroic"}, "low, medium, high"),
    ):
        with pytest.raises(ValueError, match=text):
            make_field("voxel", wrong)
    assert all(len(text) > 10 for text in help_text().values())
    assert make_settings({"effort": "low"}).sizes == EFFORTS["low"]["sizes"]
    for effort in EFFORTS:
        make_settings({"effort": effort})
