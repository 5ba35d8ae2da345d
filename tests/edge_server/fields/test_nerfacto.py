"""The proposal-sampled field as a whole: it learns, repeats itself, keeps budgets, saves and resumes."""

from __future__ import annotations

import threading
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from edge_server.fields import Budget, View
from edge_server.fields.nerfacto import NerfactoField
from edge_server.fields.nerfacto_settings import EFFORTS, NerfactoSettings, help_text, make_settings
from edge_server.fields.ngp import NgpField
from edge_server.fields.registry import make_field
from edge_server.offline.still import synthetic
from tests.edge_server.fields.scenes import picture, psnr, ring
from tests.edge_server.fields.test_ngp import SMALL as SMALL_NGP
from tests.edge_server.fields.test_refinement import _displaced

SMALL = NerfactoSettings(
    levels=6, log2_table=12, finest_resolution=64, hidden=16, rays=1024, batch_samples=8192, samples=12,
    samples_start=16, bins=48, cells=32, proposal_cells=32, anneal=60, threads=2,
)  # fmt: skip
VIEWS = ring(13)
HELD, SEEN = VIEWS[6], VIEWS[:6] + VIEWS[7:]


def _score(field: NerfactoField, view: View = HELD) -> float:
    return psnr(field.render(view.camera_to_world, view.intrinsics).color, view.image / 255.0)


def _moved() -> list[View]:
    ball = np.array([0.3, 0, 0.5])
    return [replace(v, image=picture(v.intrinsics, v.camera_to_world, ball)) for v in SEEN]


@pytest.fixture(scope="module")
def trained() -> NerfactoField:
    field = NerfactoField(SMALL)
    field.fit(SEEN, Budget(steps=250))
    return field


def test_it_learns_a_view_it_has_not_seen(trained: NerfactoField) -> None:
    assert _score(trained) > 20.0  # the mean colour: below 16


def test_points_lie_on_surfaces(trained: NerfactoField) -> None:
    points, colors = trained.points(500)
    assert 100 < len(points) <= 500 and points.dtype == colors.dtype == np.float32
    ball = np.abs(np.linalg.norm(points - [0, 0, 0.5], axis=1) - 0.5)
    assert np.median(np.minimum(ball, np.abs(points[:, 2]))) < 0.12


def _same_state(a: NerfactoField, b: NerfactoField) -> None:
    one, two = a.state(), b.state()
    assert one.keys() == two.keys()
    for name in one.keys() - {"meta"}:
        np.testing.assert_array_equal(one[name], two[name], err_msg=name)


@pytest.mark.parametrize("extra", [{"exposure": True}, {"appearance": 3, "harmonics": 4}])
def test_results_are_equal_bit_for_bit_whatever_the_thread_count(extra: dict[str, Any]) -> None:
    fields = [NerfactoField(replace(SMALL, threads=threads, **extra)) for threads in (1, 2, 3)]
    reports = []
    for field in fields:
        field.fit(SEEN[:5], Budget(steps=15))
        reports.append(field.fit(SEEN, Budget(steps=10)))
    assert len({(r.loss, r.rays, r.samples) for r in reports}) == 1
    _same_state(fields[0], fields[1])
    _same_state(fields[1], fields[2])
    pictures = [f.render(HELD.camera_to_world, HELD.intrinsics) for f in fields]
    np.testing.assert_array_equal(pictures[0].color, pictures[1].color)


@pytest.mark.parametrize("appearance", [0, 3])
def test_resuming_continues_bit_for_bit(appearance: int) -> None:
    settings = replace(SMALL, appearance=appearance)
    a, b = NerfactoField(settings), NerfactoField(replace(settings, threads=1))
    a.fit(SEEN[:9], Budget(steps=25))
    b.load_state(a.state())
    for field in (a, b):
        field.fit(_moved(), Budget(steps=40))
    _same_state(a, b)
    assert a._cameras.meta() == b._cameras.meta()


def test_the_proposal_learns_where_surfaces_are(trained: NerfactoField) -> None:
    """Fewer samples do with it than without: that is what it is for."""
    even = NerfactoField(replace(SMALL, interlevel=0.0))
    even.fit(SEEN, Budget(steps=250))
    few = {"max_samples": 4}
    scores = []
    for field in (trained, even):
        color, _, _ = field.snapshot().render_pixels(
            HELD.camera_to_world, HELD.intrinsics, _pixels(HELD), **few
        )
        scores.append(psnr(color.reshape(HELD.image.shape), HELD.image / 255.0))
    assert scores[0] > scores[1] + 0.5


def _pixels(view: View) -> np.ndarray:
    v, u = np.mgrid[0 : view.intrinsics.height, 0 : view.intrinsics.width]
    return np.stack([u.ravel() + 0.5, v.ravel() + 0.5], axis=-1)


def test_a_warm_start_follows_what_moved(trained: NerfactoField) -> None:
    field, moved = NerfactoField(SMALL), _moved()
    field.load_state(trained.state())
    target = replace(HELD, image=picture(HELD.intrinsics, HELD.camera_to_world, np.array([0.3, 0, 0.5])))
    stale = _score(field, target)
    field.fit(moved, Budget(steps=100))
    assert _score(field, target) > stale + 2.0


def test_a_state_of_another_kind_or_shape_is_refused() -> None:
    state = NerfactoField(SMALL).state()
    with pytest.raises(ValueError, match="appearance = 0"):
        NerfactoField(replace(SMALL, appearance=2)).load_state(state)
    with pytest.raises(ValueError, match="a field called ngp, this one is nerfacto"):
        NerfactoField(SMALL).load_state(NgpField(SMALL_NGP).state())
    with pytest.raises(ValueError, match="not a state"):
        NerfactoField(SMALL).load_state({"table": state["table"]})


def test_reset_forgets_everything() -> None:
    field = NerfactoField(SMALL)
    before = field.state()
    field.fit(SEEN, Budget(steps=25))
    field.reset()
    after = field.state()
    assert before.keys() == after.keys() and all((before[k] == after[k]).all() for k in before)


@pytest.mark.alone
def test_a_budget_in_seconds_is_kept(trained: NerfactoField) -> None:
    trained.fit(SEEN, Budget(seconds=0.3))  # by then it is known how long a step takes here
    reports = [trained.fit(SEEN, Budget(seconds=0.3)) for _ in range(5)]
    spent = np.median([r.seconds for r in reports])
    assert 0.85 * 0.3 <= spent <= 1.1 * 0.3 and all(r.steps > 3 for r in reports)


def test_others_render_while_it_trains() -> None:
    field = NerfactoField(SMALL)
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
    alone = NerfactoField(SMALL)
    alone.fit(SEEN, Budget(steps=5))
    alone.fit(SEEN, Budget(steps=60))
    _same_state(field, alone)


def test_transparent_views_are_seen_against_the_background() -> None:
    views = []
    for view in SEEN:
        sky = (view.image == view.image[0, 0]).all(axis=-1)
        views.append(replace(view, image=np.dstack([view.image, np.where(sky, 0, 255).astype(np.uint8)])))
    field = NerfactoField(replace(SMALL, background="white"))
    field.fit(views, Budget(steps=150))
    out = field.render(views[0].camera_to_world, views[0].intrinsics)
    clear = views[0].image[..., 3] == 0
    assert out.color[clear].mean() > 0.9 and out.opacity[clear].mean() < 0.3
    assert out.opacity[~clear].mean() > 0.7


def test_it_is_registered_and_its_options_are_checked() -> None:
    field = make_field("nerfacto", {"bins": 40, "appearance": 4}, seed=5)
    assert isinstance(field, NerfactoField) and field.settings.bins == 40 and field.settings.seed == 5
    with pytest.raises(ValueError, match=r"no option density_rank; it has: effort, .*bins.*nice"):
        make_field("nerfacto", {"density_rank": 8})
    for wrong, text in (
        ({"bins": 4}, "bins must be in 8..1024, not 4"),
        ({"proposal_cells": 30}, "proposal_cells must be a multiple of 4"),
        ({"even": 1.5}, "even must be in 0.0..1.0"),
        ({"appearance": 99}, "appearance must be in 0..16"),
        ({"appearance": 4, "exposure": True}, "choose one"),
        ({"device": "cuda"}, "CPUs only"),
        ({"effort": "heroic"}, "low, medium, high"),
    ):
        with pytest.raises(ValueError, match=text):
            make_field("nerfacto", wrong)
    assert all(len(text) > 10 for text in help_text().values())
    low, medium, high = (make_settings({"effort": e}) for e in EFFORTS)
    assert low.samples < medium.samples < high.samples and medium == NerfactoSettings()


def test_appearances_take_up_what_differs_between_cameras() -> None:
    """A room's pictures with gains of 0.7 to 1.4; scored against the picture at the mean exposure."""
    still = synthetic("room", cameras=13, size=48)
    gains = np.exp(np.random.default_rng(2).permutation(np.linspace(-0.35, 0.35, 12)))
    views = [
        replace(v, image=np.clip(v.image * g + 0.5, 0, 255).astype(np.uint8))
        for v, g in zip(still.training, gains)
    ]
    scores, looks = [], None
    for appearance in (0, 4):
        field = NerfactoField(replace(SMALL, appearance=appearance))
        field.fit(views, Budget(steps=300))
        scores.append(_score(field, still.held_out[0]))
        looks = field._cameras.appearances
    assert scores[1] > scores[0] + 1.0
    assert looks is not None and set(looks.known) == {v.camera for v in views}
    values = np.array([known[0] for known in looks.known.values()])
    np.testing.assert_allclose(values.mean(axis=0), 0.0, atol=1e-9)
    # What is learnt is the gain: a straight line through the numbers tells it.
    fitted = np.linalg.lstsq(values, np.log(gains), rcond=None)[0]
    assert np.corrcoef(values @ fitted, np.log(gains))[0, 1] > 0.9


def test_appearance_costs_nothing_where_it_is_not_asked_for() -> None:
    field = NerfactoField(SMALL)
    field.fit(SEEN, Budget(steps=2))
    assert field._cameras.appearances is None and field._bins.looks.size == 0 and field._net.widths[-1] == 4


def test_wrong_poses_are_refined() -> None:
    """The shared trainer's refinement, through this field's own rendering."""
    views, scores = _displaced(SEEN, 0.02, 1.5), {}
    for on in (False, True):
        field = NerfactoField(replace(SMALL, refine_m=0.1 * on, refine_deg=4.0 * on))
        field.fit(views, Budget(steps=600))
        scores[on] = _score(field)
    assert scores[True] > scores[False] + 0.5
