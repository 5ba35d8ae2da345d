"""What is learned from: a state as numbers, on one scale for all; rewards as printed and corrected, term by term."""

import math
from dataclasses import replace

import numpy as np
import pytest

from edge_server.experiments.rollouts.episode import Outcome
from edge_server.fidelity.scorer import Score
from edge_server.live.state import Publication
from edge_server.scheduler.learned.observation import observe
from edge_server.scheduler.learned.rewards import f_w, make_reward
from edge_server.scheduler.learned.state import StateLayout
from freshfield.geometry import Pose, look_at, so3_exp
from tests.edge_server.frames import frame
from tests.edge_server.scheduler.learned.problems import state
from tests.support import refused

MS = 1_000_000


def test_the_columns_are_semantics_age_pose_and_the_bit_of_who_reported():
    s = state(3, np.random.default_rng(0), d=4, silent=1)
    layout = StateLayout(("pose", "semantics", "age"), dim=4)
    found = layout.features(s)
    assert found.shape == (3, layout.width) == (3, 4 + 1 + 6 + 1)
    np.testing.assert_allclose(found[:2, :4], s.embeddings[:2] / 2.0)
    np.testing.assert_allclose(found[:2, 4], np.log1p(s.ages_ms[:2] / 100.0))
    np.testing.assert_allclose(found[:2, 5:11], s.poses[:2])
    np.testing.assert_array_equal(found[:, -1], [1, 1, 0])
    assert not found[2].any()


def test_standardised_embeddings_have_mean_zero_and_spread_one_over_the_cameras_that_reported():
    rng = np.random.default_rng(1)
    states = []
    for _ in range(200):
        s = state(5, rng, d=3, silent=1)
        z = 50.0 + s.embeddings * np.float32([1.0, 2.0, 4.0])
        z[4] = 1e6  # of a camera that is silent: nobody's
        z[0] = np.nan
        states.append(replace(s, embeddings=z))
    seen = np.concatenate([s.embeddings[s.reported] for s in states]).astype(np.float64)
    layout = StateLayout(("semantics",), dim=3).standardized(seen)
    z = np.sqrt(3) * np.concatenate([layout.features(s)[1:4, :3] for s in states])
    np.testing.assert_allclose(z.mean(axis=0), 0.0, atol=1e-3)
    np.testing.assert_allclose(z.std(axis=0), 1.0, atol=1e-3)
    assert not layout.features(states[0])[0, :3].any()


def test_a_wrong_layout_is_refused_by_name():
    for part, values, says in (
        ("color", {}, "color"),
        ("semantics", {}, "dim 0"),
        ("age", {"age_scale_ms": 0.0}, "positive"),
        ("semantics", {"dim": 2, "center": (0.0,), "spread": (1.0,)}, "2 values"),
        ("semantics", {"dim": 1, "center": (np.inf,), "spread": (1.0,)}, "finite"),
    ):
        refused(ValueError, says, StateLayout, (part,), **values)


class Colors:
    """Embeds a frame by its number; the third frame asked for has none."""

    def of(self, items):
        rows = np.array([[i.sequence, 1.0] for i in items], np.float32).reshape(-1, 2)
        return rows, np.arange(len(items)) != 2


def rig(scale=1.0, shift=(0.0, 0.0, 0.0)):
    out = {}
    for i, angle in enumerate((0.0, 1.5, 3.0, 4.5)):
        eye = scale * np.array([np.cos(angle), np.sin(angle), 0.5])
        matrix = look_at(eye, [0.0, 0.0, 0.0])
        matrix[:3, 3] += shift
        made = frame(f"c{i}", sequence=i, generated_ns=10 * i * MS, pose=Pose.from_matrix(matrix))
        out[f"c{i}"] = replace(made, received_ns=50 * MS)
    return out


def test_observing_gives_ages_poses_and_embeddings_in_the_cameras_order():
    newest = rig()
    del newest["c1"]
    s = observe(("c3", "c2", "c1", "c0"), newest, 100 * MS, Colors())
    np.testing.assert_array_equal(s.ages_ms, [70, 80, np.nan, 100])
    np.testing.assert_array_equal(s.reported, [True, True, False, True])
    assert s.cameras == ("c3", "c2", "c1", "c0")
    np.testing.assert_array_equal(s.embeddings, [[3, 1], [2, 1], [np.nan] * 2, [np.nan] * 2])
    np.testing.assert_allclose(so3_exp(s.poses[0, 3:]), newest["c3"].pose.matrix()[:3, :3], atol=1e-12)


def test_poses_do_not_depend_on_where_a_rig_stands_nor_on_its_size():
    names = ("c0", "c1", "c2", "c3")
    here = observe(names, rig(), 0).poses
    there = observe(names, rig(scale=20.0, shift=(100.0, -7.0, 3.0)), 0).poses
    np.testing.assert_allclose(here, there, atol=1e-9)
    np.testing.assert_allclose(np.linalg.norm(here[:, :3], axis=1).mean(), 1.0)


def score(psnr_db=25.0, psnr_moving_db=20.0, ssim=0.9, lpips=0.2):
    return Score("cam00", 0, psnr_db, psnr_moving_db, ssim, lpips, 0.0)


def outcome(aaoi_ms=60.0, ssim=0.9, views=3.0):
    return Outcome(25.0, 20.0, ssim, 0.2, aaoi_ms, views, 0.0)


def test_the_reward_of_sets_is_519():
    found = make_reward("set").of(score())
    assert found.terms == {"psnr": 0.5, "ssim": 0.45, "lpips": -0.2}
    assert found.total == pytest.approx(0.02 * 25 + 0.5 * 0.9 - 0.2)
    assert found.complete
    assert make_reward("set", fidelity="moving").of(score()).terms["psnr_moving"] == pytest.approx(0.4)


def test_the_reward_of_waiting_is_minus_f_w():
    expected = 0.015 * 60 - 0.02 * 25 + 0.2 * 0.9 + 0.3 * 0.2  # (6.36), (6.37) as printed
    row = {"psnr_db": 25.0, "ssim": 0.9, "lpips": 0.2, "aaoi_ms": 60.0}
    assert f_w(row) == pytest.approx({"f_w": expected, "f_w_corrected": expected - 2 * 0.2 * 0.9})
    assert f_w({**row, "lpips": None})["f_w"] is None
    assert make_reward("thesis").of(outcome()).total == pytest.approx(-expected)
    corrected = make_reward().of(outcome())
    assert corrected.total == pytest.approx(-expected + 2 * 0.2 * 0.9)
    assert corrected.terms["age"] == pytest.approx(-0.9)


@pytest.mark.parametrize("value", [None, math.nan, math.inf])
def test_a_missing_metric_is_reported_and_the_rest_stays_finite(value):
    found = make_reward("set").of(score(lpips=value))
    assert found.terms["lpips"] is None and found.missing == ("lpips",) and not found.complete
    assert found.total == pytest.approx(0.95)


def test_a_view_costs_its_price_in_a_simulated_update_and_in_a_live_one():
    priced = make_reward("set", views=-0.01)
    assert priced.of(outcome()).terms["views"] == pytest.approx(-0.03)
    assert priced.of(outcome()).total == pytest.approx(make_reward("set").of(outcome()).total - 0.03)
    live = Publication(0, 1.0, 10**9, None, ("a", "b"), (1.0, 2.0), 1.5, 100.0, psnr_db=20.0, ssim=0.5, lpips=0.1)
    assert priced.of(live).terms["views"] == pytest.approx(-0.02)
    assert priced.of(score()).missing == ("views",)  # a score alone does not know


def test_what_cannot_be_a_reward_is_refused():
    for words in ({"name": "best"}, {"name": "set", "fidelity": "all"}, {"name": "set", "age": math.nan}):
        refused(ValueError, "", make_reward, **words)
