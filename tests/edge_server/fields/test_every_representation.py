"""What every representation must do: learn, repeat itself bit for bit, keep budgets, save, resume, refuse."""

import threading
from functools import lru_cache
from typing import Any

import numpy as np
import pytest

from edge_server.export.viewed_field import ViewedField
from edge_server.fields import Budget
from edge_server.fields.common.cameras import camera_refinement_constants as refinement
from edge_server.fields.common.kernels.volume_rendering import Weights
from edge_server.fields.common.supervision import pack_cameras
from tests.edge_server.fields import small as made


@lru_cache
def _trained(name: str) -> Any:
    field = made.small(name)
    field.fit(made.SEEN, Budget(steps=250))
    return field


@made.every_field
def test_it_learns_a_view_it_has_not_seen_and_depth_in_meters(name: str) -> None:
    made.reaches(name, "held out", made.score(_trained(name)))
    depth = _trained(name).render(made.HELD.camera_to_world, made.HELD.intrinsics).depth[22:26, 22:26]
    expected = np.linalg.norm(made.HELD.camera_to_world[:3, 3] - [0, 0, 0.45]) - 0.5
    # Gaussians are soft: the mean of a pixel's depths lies somewhat behind the surface.
    low, high = (-0.1, 0.4) if name == "splat" else (-0.25, 0.25)
    assert low < np.median(depth) - expected < high


@pytest.mark.parametrize("name", ["ngp", "nerfacto", "tensorf"])
def test_shipped_settings_regularize(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    field, given = made.small(name), []
    run = field.pool.run
    monkeypatch.setattr(field.pool, "run", lambda kernel, *args: given.extend(args) or run(kernel, *args))
    field.fit(made.SEEN, Budget(steps=1))
    weights = next(arg for arg in given if isinstance(arg, Weights))
    assert weights.distortion == np.float32(0.01) and weights.guide == np.float32(0.1)


@made.every_field
def test_a_warm_start_follows_what_moved(name: str) -> None:
    field, target = made.small(name), made.moved(made.HELD)
    field.load_state(_trained(name).state())
    stale = made.score(field, target)
    field.fit([made.moved(v) for v in made.SEEN], Budget(steps=100))
    assert made.score(field, target) > stale + 2.0
    made.reaches(name, "moved", made.score(field, target))


@pytest.mark.parametrize(
    ("name", "extra"),
    [("ngp", {}), ("nerfacto", {"appearance": 3, "sh_degree": 1}), ("tensorf", {"sh_degree": 1}), ("splat", {})],
)
def test_results_are_the_seeds_bit_for_bit_whatever_the_thread_count(name: str, extra: dict[str, Any]) -> None:
    differing = {"threads": 1}, {"threads": 3}, {"seed": 1}
    one, three, other = (made.small(name, **changed, **extra) for changed in differing)
    reports = []
    for field in (one, three, other):
        field.fit(made.SEEN[:5], Budget(steps=15))
        reports.append(field.fit(made.SEEN, Budget(steps=10)))
    assert len({(r.loss, r.rays, r.samples) for r in reports[:2]}) == 1
    made.same_state(one, three)
    first, second = (field.render(made.HELD.camera_to_world, made.HELD.intrinsics) for field in (one, three))
    np.testing.assert_array_equal(first.color, second.color)
    np.testing.assert_array_equal(first.depth, second.depth)
    learned = "params" if name == "splat" else "table"
    assert not np.array_equal(one.state()[learned], other.state()[learned])


@made.every_field
def test_resuming_continues_bit_for_bit(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also across a change of size; what was learned of cameras, and has changed in pictures, is remembered, too."""
    monkeypatch.setattr(refinement, "START", 4)
    extra = {"nerfacto": {"appearance": 3}, "tensorf": {"refine_m": 0.05, "refine_deg": 2.0}}.get(name, {})
    a, b = made.small(name, **extra), made.small(name, threads=1, **extra)
    a.fit(made.SEEN[:9], Budget(steps=20))  # where tensorf's planes get finer
    before = a.state()
    b.load_state(before)
    for field in (a, b):
        field.fit([made.moved(v) for v in made.SEEN], Budget(steps=40))
    if name == "tensorf":
        assert a.state()["table"].size > before["table"].size
    made.same_state(a, b)
    if extra:
        assert a._cameras.meta() == b._cameras.meta()
    if name == "tensorf":
        box = a.view_store.box
        origin = a._cameras.corrected(made.SEEN, pack_cameras(made.SEEN, box), box).origin
        learned = np.stack([a._cameras.poses.pose(view)[:3, 3] for view in made.SEEN])
        np.testing.assert_array_equal(origin, box.normalise(learned))
        exported = np.stack([ViewedField(name, b, b.views).pose(view)[:3, 3] for view in made.SEEN])
        np.testing.assert_array_equal(exported, learned)
        assert a.learned_pose(made.HELD) is None, "its error is not known"
        assert any(np.abs(shift).max() > 0 for _, shift, *_ in a._cameras.meta()["poses"].values())


@made.every_field
def test_without_views_nothing_is_done_and_reset_forgets_everything(name: str) -> None:
    field, new = made.small(name), made.small(name)
    report = field.fit([], Budget(seconds=5.0))
    assert report.steps == 0 and report.seconds < 0.5 and "no views" in report.note
    made.same_state(field, new)
    made.healthy(field, made.SEEN)
    field.fit(made.SEEN, Budget(steps=25))
    field.reset()
    made.same_state(field, new)


@made.every_field
def test_others_render_while_it_trains(name: str) -> None:
    """Snapshots stay what they were, also where the field grows meanwhile, and who looks changes nothing."""
    field = made.small(name)
    field.fit(made.SEEN, Budget(steps=5))
    snapshot = field.snapshot()
    first = snapshot.render(made.HELD.camera_to_world, made.HELD.intrinsics).color
    worker = threading.Thread(target=field.fit, args=(made.SEEN, Budget(steps=60)))
    worker.start()
    pictures = 0
    while worker.is_alive():
        again = snapshot.render(made.HELD.camera_to_world, made.HELD.intrinsics).color
        np.testing.assert_array_equal(first, again)
        assert np.isfinite(field.snapshot().render(made.HELD.camera_to_world, made.HELD.intrinsics).color).all()
        pictures += 1
    worker.join()
    assert pictures > 5, "rendering starved while the field trained"
    assert not np.array_equal(first, field.render(made.HELD.camera_to_world, made.HELD.intrinsics).color)
    alone = made.small(name)
    alone.fit(made.SEEN, Budget(steps=5))
    alone.fit(made.SEEN, Budget(steps=60))
    made.same_state(field, alone)


@made.every_field
def test_transparent_views_are_seen_against_the_background(name: str) -> None:
    views = [made.cut_out(view) for view in made.SEEN]
    field = made.small(name, background="white")
    field.fit(views, Budget(steps=120))
    out = field.render(views[0].camera_to_world, views[0].intrinsics)
    clear = views[0].image[..., 3] == 0
    assert field.view_store.box is not None and not field.view_store.box.contracted
    assert out.color[clear].mean() > 0.9 and out.opacity[clear].mean() < 0.3
    assert out.opacity[~clear].mean() > 0.7
