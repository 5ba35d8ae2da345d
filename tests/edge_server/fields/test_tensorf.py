"""The vector-matrix field as a whole: it learns, repeats itself, keeps budgets, saves and resumes."""

from __future__ import annotations

import threading
from dataclasses import replace

import numpy as np
import pytest

from edge_server.fields import Budget, View
from edge_server.fields.ngp import NgpField
from edge_server.fields.registry import make_field
from edge_server.fields.tensorf import TensorfField, size_at
from edge_server.fields.tensorf_settings import EFFORTS, TensorfSettings, help_text, make_settings
from tests.edge_server.fields.scenes import picture, psnr, ring
from tests.edge_server.fields.test_ngp import SMALL as SMALL_NGP

SMALL = TensorfSettings(
    color_rank=8, resolution_start=16, resolution=64, upsample=(20, 60, 120), hidden=16, rays=1024,
    batch_samples=8192, samples=96, samples_ramp=100, cells=32, threads=2,
)  # fmt: skip
VIEWS = ring(13)
HELD, SEEN = VIEWS[6], VIEWS[:6] + VIEWS[7:]


def _score(field: TensorfField, view: View = HELD) -> float:
    return psnr(field.render(view.camera_to_world, view.intrinsics).color, view.image / 255.0)


def _moved() -> list[View]:
    ball = np.array([0.3, 0, 0.5])
    return [replace(v, image=picture(v.intrinsics, v.camera_to_world, ball)) for v in SEEN]


@pytest.fixture(scope="module")
def trained() -> TensorfField:
    field = TensorfField(SMALL)
    field.fit(SEEN, Budget(steps=250))
    return field


def test_it_learns_a_view_it_has_not_seen(trained: TensorfField) -> None:
    assert _score(trained) > 20.0  # the mean colour: below 16


def test_points_lie_on_surfaces(trained: TensorfField) -> None:
    points, colors = trained.points(500)
    assert 100 < len(points) <= 500 and points.dtype == colors.dtype == np.float32
    ball = np.abs(np.linalg.norm(points - [0, 0, 0.5], axis=1) - 0.5)
    assert np.median(np.minimum(ball, np.abs(points[:, 2]))) < 0.12


def _same_state(a: TensorfField, b: TensorfField) -> None:
    one, two = a.state(), b.state()
    assert one.keys() == two.keys()
    for name in one.keys() - {"meta"}:
        np.testing.assert_array_equal(one[name], two[name], err_msg=name)


@pytest.mark.parametrize("extra", [{}, {"smooth": 1e-3, "sparse": 1e-4, "harmonics": 4}])
def test_results_are_equal_bit_for_bit_whatever_the_thread_count(extra: dict[str, float]) -> None:
    fields = [TensorfField(replace(SMALL, threads=threads, **extra)) for threads in (1, 2, 3)]
    reports = []
    for field in fields:
        field.fit(SEEN[:5], Budget(steps=15))
        reports.append(field.fit(SEEN, Budget(steps=10)))
    assert len({(r.loss, r.rays, r.samples) for r in reports}) == 1
    _same_state(fields[0], fields[1])
    _same_state(fields[1], fields[2])
    pictures = [f.render(HELD.camera_to_world, HELD.intrinsics) for f in fields]
    np.testing.assert_array_equal(pictures[0].color, pictures[1].color)


@pytest.mark.parametrize("steps", [20, 30])  # where planes get finer, and elsewhere
def test_resuming_continues_bit_for_bit_across_an_upsampling(steps: int) -> None:
    a, b = TensorfField(SMALL), TensorfField(replace(SMALL, threads=1))
    a.fit(SEEN, Budget(steps=steps))
    b.load_state(a.state())
    for field in (a, b):
        field.fit(_moved(), Budget(steps=40))
    assert a._encoding.size > size_at(SMALL, a.rig.box, 29)
    _same_state(a, b)


def test_upsampling_hardly_changes_the_picture() -> None:
    field = TensorfField(replace(SMALL, upsample=(60,)))
    field.fit(SEEN, Budget(steps=59))
    before, table = field.render(HELD.camera_to_world, HELD.intrinsics).color, field._encoding.table
    field.step = 60
    field._grow()
    field._snapshot = None
    after = field.render(HELD.camera_to_world, HELD.intrinsics).color
    assert field._encoding.size == 64 and len(field._encoding.table) > len(table)
    assert psnr(before, after) > 35.0


def test_a_warm_start_follows_what_moved(trained: TensorfField) -> None:
    field, moved = TensorfField(SMALL), _moved()
    field.load_state(trained.state())
    target = replace(HELD, image=picture(HELD.intrinsics, HELD.camera_to_world, np.array([0.3, 0, 0.5])))
    stale = _score(field, target)
    field.fit(moved, Budget(steps=100))
    assert _score(field, target) > stale + 2.0


def test_a_state_of_another_kind_or_shape_is_refused() -> None:
    state = TensorfField(SMALL).state()
    with pytest.raises(ValueError, match="density_rank = 8"):
        TensorfField(replace(SMALL, density_rank=16)).load_state(state)
    with pytest.raises(ValueError, match="a field called ngp, this one is tensorf"):
        TensorfField(SMALL).load_state(NgpField(SMALL_NGP).state())
    with pytest.raises(ValueError, match="not a state"):
        TensorfField(SMALL).load_state({"table": state["table"]})


def test_reset_forgets_everything() -> None:
    field = TensorfField(SMALL)
    before = field.state()
    field.fit(SEEN, Budget(steps=25))
    field.reset()
    after = field.state()
    assert before.keys() == after.keys() and all((before[k] == after[k]).all() for k in before)


@pytest.mark.alone
def test_a_budget_in_seconds_is_kept(trained: TensorfField) -> None:
    trained.fit(SEEN, Budget(seconds=0.3))  # by then it is known how long a step takes here
    reports = [trained.fit(SEEN, Budget(seconds=0.3)) for _ in range(5)]
    spent = np.median([r.seconds for r in reports])
    assert 0.85 * 0.3 <= spent <= 1.1 * 0.3 and all(r.steps > 3 for r in reports)


def test_others_render_while_it_trains() -> None:
    """Snapshots stay what they were, also across an upsampling."""
    field = TensorfField(SMALL)
    field.fit(SEEN, Budget(steps=5))
    snapshot = field.snapshot()
    first = snapshot.render(HELD.camera_to_world, HELD.intrinsics).color
    worker = threading.Thread(target=field.fit, args=(SEEN, Budget(steps=60)))
    worker.start()
    while worker.is_alive():
        again = snapshot.render(HELD.camera_to_world, HELD.intrinsics).color
        np.testing.assert_array_equal(first, again)
        assert np.isfinite(field.render(HELD.camera_to_world, HELD.intrinsics).color).all()
    worker.join()
    alone = TensorfField(SMALL)
    alone.fit(SEEN, Budget(steps=5))
    alone.fit(SEEN, Budget(steps=60))
    _same_state(field, alone)


def test_transparent_views_are_seen_against_the_background() -> None:
    views = []
    for view in SEEN:
        sky = (view.image == view.image[0, 0]).all(axis=-1)
        views.append(replace(view, image=np.dstack([view.image, np.where(sky, 0, 255).astype(np.uint8)])))
    field = TensorfField(replace(SMALL, background="white"))
    field.fit(views, Budget(steps=150))
    out = field.render(views[0].camera_to_world, views[0].intrinsics)
    clear = views[0].image[..., 3] == 0
    assert out.color[clear].mean() > 0.9 and out.opacity[clear].mean() < 0.3
    assert out.opacity[~clear].mean() > 0.7


def test_it_is_registered_and_its_options_are_checked() -> None:
    field = make_field("tensorf", {"density_rank": 16, "upsample": [10, 20]}, seed=5)
    assert isinstance(field, TensorfField) and field.settings.upsample == (10, 20)
    with pytest.raises(ValueError, match=r"no option levels; it has: effort, density_rank, .*nice"):
        make_field("tensorf", {"levels": 3})
    for wrong, text in (
        ({"density_rank": 4}, "density_rank must be in 8..64, not 4"),
        ({"color_rank": 12}, "multiple of 8"),
        ({"upsample": [20, 10]}, "rising"),
        ({"resolution": 2}, "resolution must be in 4..1024"),
        ({"device": "cuda"}, "CPUs only"),
        ({"effort": "heroic"}, "low, medium, high"),
    ):
        with pytest.raises(ValueError, match=text):
            make_field("tensorf", wrong)
    assert all(len(text) > 10 for text in help_text().values())
    assert make_settings({"effort": "low"}).color_rank == EFFORTS["low"]["color_rank"]
