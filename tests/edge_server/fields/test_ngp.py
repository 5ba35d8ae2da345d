"""The hash-grid field as a whole: it learns, repeats itself bit for bit, keeps budgets, saves and resumes."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest

from edge_server.fields import Budget, View
from edge_server.fields.ngp import NgpField
from edge_server.fields.ngp_settings import NgpSettings
from tests.edge_server.fields.scenes import picture, psnr, ring

SMALL = NgpSettings(
    levels=6, log2_table=12, finest_resolution=64, hidden=16, rays=1024, batch_samples=8192, samples=96,
    cells=32, levels_every=15, samples_ramp=100, threads=2,
)  # fmt: skip
VIEWS = ring(13)
HELD, SEEN = VIEWS[6], VIEWS[:6] + VIEWS[7:]


def _score(field: NgpField, view: View = HELD) -> float:
    return psnr(field.render(view.camera_to_world, view.intrinsics).color, view.image / 255.0)


@pytest.fixture(scope="module")
def trained() -> NgpField:
    field = NgpField(SMALL)
    field.fit(SEEN, Budget(steps=250))
    return field


def test_it_learns_a_view_it_has_not_seen(trained: NgpField) -> None:
    mean = np.mean([v.image for v in SEEN], axis=(0, 1, 2)) / 255.0
    assert psnr(mean, HELD.image / 255.0) < 16.0
    assert _score(trained) > 20.0


def test_depth_is_in_metres(trained: NgpField) -> None:
    out = trained.render(HELD.camera_to_world, HELD.intrinsics)
    middle = out.depth[22:26, 22:26]
    expected = np.linalg.norm(HELD.camera_to_world[:3, 3] - [0, 0, 0.45]) - 0.5
    assert abs(np.median(middle) - expected) < 0.25
    assert out.opacity.min() >= 0.0 and out.opacity.max() <= 1.0 + 1e-5


def test_points_lie_on_surfaces(trained: NgpField) -> None:
    points, colors = trained.points(500)
    assert 100 < len(points) <= 500 and points.dtype == colors.dtype == np.float32
    ball = np.abs(np.linalg.norm(points - [0, 0, 0.5], axis=1) - 0.5)
    assert np.median(np.minimum(ball, np.abs(points[:, 2]))) < 0.12
    assert colors.min() >= 0.0 and colors.max() <= 1.0


def _same_state(a: NgpField, b: NgpField) -> None:
    one, two = a.state(), b.state()
    assert one.keys() == two.keys()
    for name in one.keys() - {"meta"}:
        np.testing.assert_array_equal(one[name], two[name], err_msg=name)


def test_results_are_equal_bit_for_bit_whatever_the_thread_count() -> None:
    fields = [NgpField(replace(SMALL, threads=threads)) for threads in (1, 2, 2)]
    reports = []
    for field in fields:
        field.fit(SEEN[:5], Budget(steps=15))
        reports.append(field.fit(SEEN, Budget(steps=10)))
    assert len({(r.loss, r.rays, r.samples) for r in reports}) == 1
    _same_state(fields[0], fields[1])
    _same_state(fields[1], fields[2])
    pictures = [f.render(HELD.camera_to_world, HELD.intrinsics) for f in fields]
    np.testing.assert_array_equal(pictures[0].color, pictures[1].color)
    np.testing.assert_array_equal(pictures[0].depth, pictures[1].depth)


def test_a_smoothed_field_repeats_itself_and_is_smoother() -> None:
    small = replace(SMALL, base_resolution=8)  # coarse enough not to be hashed
    fields = [NgpField(replace(small, threads=n, smooth=s)) for n, s in ((1, 0.1), (3, 0.1), (2, 0.0))]
    for field in fields:
        field.fit(SEEN, Budget(steps=60))
    _same_state(fields[0], fields[1])

    def rough(field: NgpField) -> float:
        side = int(field._grid.resolution[0]) + 1
        cube = field._grid.table[: side**3].reshape(side, side, side, 2)
        return float(np.mean([np.square(np.diff(cube, axis=axis)).mean() for axis in range(3)]))

    assert rough(fields[0]) < 0.7 * rough(fields[2])
    assert _score(fields[0]) > 16.0


def test_another_seed_is_another_field() -> None:
    a, b = NgpField(SMALL), NgpField(replace(SMALL, seed=1))
    assert not np.array_equal(a.state()["table"], b.state()["table"])


def test_resuming_continues_bit_for_bit() -> None:
    moved = [
        replace(v, image=picture(v.intrinsics, v.camera_to_world, np.array([0.3, 0, 0.5]))) for v in SEEN
    ]
    a, b = NgpField(SMALL), NgpField(replace(SMALL, threads=1))
    a.fit(SEEN, Budget(steps=20))
    b.load_state(a.state())
    for field in (a, b):
        field.fit(moved, Budget(steps=20))  # depends on the remembered pictures: what has changed?
    _same_state(a, b)


def test_a_state_of_another_shape_is_refused() -> None:
    state = NgpField(SMALL).state()
    with pytest.raises(ValueError, match="hidden = 16"):
        NgpField(replace(SMALL, hidden=32)).load_state(state)
    with pytest.raises(ValueError, match="not a state"):
        NgpField(SMALL).load_state({"table": state["table"]})
    del state["net_v"]
    with pytest.raises(ValueError, match="net_v"):
        NgpField(SMALL).load_state(state)


def test_reset_forgets_everything() -> None:
    field = NgpField(SMALL)
    before = field.state()
    field.fit(SEEN, Budget(steps=5))
    field.reset()
    after = field.state()
    assert before.keys() == after.keys() and all((before[k] == after[k]).all() for k in before)


@pytest.mark.alone
def test_a_budget_in_seconds_is_kept(trained: NgpField) -> None:
    trained.fit(SEEN, Budget(seconds=0.3))  # by then it is known how long a step takes here
    reports = [trained.fit(SEEN, Budget(seconds=0.3)) for _ in range(5)]
    spent = np.median([r.seconds for r in reports])
    assert 0.85 * 0.3 <= spent <= 1.1 * 0.3 and all(r.steps > 3 for r in reports)


def test_a_snapshot_does_not_change_while_the_field_trains(trained: NgpField) -> None:
    snapshot = trained.snapshot()
    before = snapshot.render(HELD.camera_to_world, HELD.intrinsics).color
    trained.fit(SEEN, Budget(steps=5))
    np.testing.assert_array_equal(before, snapshot.render(HELD.camera_to_world, HELD.intrinsics).color)
    assert not np.array_equal(before, trained.render(HELD.camera_to_world, HELD.intrinsics).color)


def test_others_render_while_it_trains() -> None:
    field = NgpField(SMALL)
    field.fit(SEEN, Budget(steps=5))
    worker = threading.Thread(target=field.fit, args=(SEEN, Budget(steps=60)))
    worker.start()
    pictures = 0
    while worker.is_alive():
        out = field.snapshot().render(HELD.camera_to_world, HELD.intrinsics)
        assert np.isfinite(out.color).all()
        pictures += 1
    worker.join()
    assert pictures > 5, "rendering starved while the field trained"
    alone = NgpField(SMALL)
    alone.fit(SEEN, Budget(steps=5))
    alone.fit(SEEN, Budget(steps=60))
    _same_state(field, alone)


def test_fewer_samples_render_a_rougher_picture(trained: NgpField) -> None:
    snapshot = trained.snapshot()
    full = snapshot.render(HELD.camera_to_world, HELD.intrinsics)
    rough = snapshot.render(HELD.camera_to_world, HELD.intrinsics, max_samples=2)
    assert rough.opacity.mean() <= full.opacity.mean() + 1e-6
    assert not np.array_equal(full.color, rough.color)


def test_transparent_views_are_seen_against_the_background() -> None:
    views = []
    for view in SEEN:
        sky = (view.image == view.image[0, 0]).all(axis=-1)
        alpha = np.where(sky, 0, 255).astype(np.uint8)
        views.append(replace(view, image=np.dstack([view.image, alpha])))
    field = NgpField(replace(SMALL, background="white"))
    field.fit(views, Budget(steps=120))
    out = field.render(views[0].camera_to_world, views[0].intrinsics)
    clear = views[0].image[..., 3] == 0
    assert field.rig.box is not None and not field.rig.box.contracted
    assert out.color[clear].mean() > 0.9 and out.opacity[clear].mean() < 0.3
    assert out.opacity[~clear].mean() > 0.7


def test_no_views_do_nothing_and_the_report_says_so() -> None:
    field = NgpField(SMALL)
    before = field.state()
    report = field.fit([], Budget(seconds=5.0))
    assert report.steps == 0 and report.seconds < 0.5 and "no views" in report.note
    assert all((before[k] == v).all() for k, v in field.state().items())


def test_views_that_cannot_be_are_refused() -> None:
    field, good = NgpField(SMALL), SEEN[0]
    pose = good.camera_to_world.copy()
    pose[0, 3] = np.nan
    for wrong, text in (
        (replace(good, image=good.image[:-1]), "48 x 47"),
        (replace(good, image=good.image.astype(np.float32)), "uint8"),
        (replace(good, camera_to_world=pose), "finite"),
        (replace(good, intrinsics=replace(good.intrinsics, fx=0.0)), "focal"),
    ):
        with pytest.raises(ValueError, match=text):
            field.fit([wrong], Budget(steps=1))
    assert field.step == 0 and not field.rig.memory
