"""A checkpoint as a policy: its decisions are carried out as by fixed policies, kept on disk exactly, and explained."""

import re
from dataclasses import replace
from types import SimpleNamespace

import cv2
import numpy as np
import pytest

from edge_server.embed.settings import EmbeddingConfig
from edge_server.live.buffer import FrameBuffer
from edge_server.live.field_updater import FieldUpdater
from edge_server.report.explain_command import main
from edge_server.scheduler import Epoch, make_policy, parse_policy
from edge_server.scheduler.learned import learning_constants as tuned
from edge_server.scheduler.learned.actor import Decision
from edge_server.scheduler.learned.bandit import BanditPolicy
from edge_server.scheduler.learned.decision_record import FOLDER, DecisionWriter, read_decision
from edge_server.scheduler.learned.learner_spec import Spec
from edge_server.scheduler.learned.ppo import Learner
from edge_server.scheduler.learned.state import State, StateLayout
from edge_server.settings import read_config
from freshfield import scenario
from tests.edge_server.frames import frame, tiny_field
from tests.edge_server.scheduler.learned.problems import state
from tests.support import refusal, refused

MS = 1_000_000
OMEGAS_MS = (0.0, 40.0, 80.0)


def policy(action, favourite=None, **layout):
    """A policy that prefers one omega, by the bias of its last layer."""
    omegas = () if action == "select" else OMEGAS_MS
    learner = Learner(Spec(action, StateLayout(**(layout or {"parts": ("age",)})), omegas), 1)
    actor = learner.actor
    if favourite is not None:
        actor = replace(actor, weights={**actor.weights, "out_b": 9.0 * np.eye(len(OMEGAS_MS))[favourite]})
    return BanditPolicy(actor, "bandit:test", np.random.default_rng(0))


def epoch(now_ms, **generated_ms):
    """An epoch whose state has the cameras a, b and c."""
    names = ("a", "b", "c")
    ages = np.array([now_ms - generated_ms.get(c, np.nan) for c in names])
    s = State(ages, np.zeros((3, 6)), None, np.isfinite(ages), names)
    return Epoch(now_ms * MS, 7, {c: g * MS for c, g in generated_ms.items()}, lambda parts=(): s)


AT = epoch(200, a=190, b=80, c=150)


@pytest.mark.parametrize(
    ("action", "favourite", "then", "chosen"),
    [
        ("wait", 1, epoch(240, a=190, b=220, c=150), ("b",)),
        ("threshold", 2, AT, ("a", "c")),
        ("threshold", 0, AT, ("a",)),
    ],
)
def test_a_decision_is_carried_out_as_by_the_fixed_policy(action, favourite, then, chosen):
    p, fixed = policy(action, favourite), make_policy(action, OMEGAS_MS[favourite], np.random.default_rng(0))
    plan = p.plan(AT)
    assert plan == fixed.plan(AT) and p.select(then, plan) == fixed.select(then, plan) == chosen


def test_a_set_is_chosen_when_views_are_selected_and_is_never_empty():
    p = policy("select")
    actor = p.actor
    for bias, expected in ((9.0, {"a", "b"}), (-9.0, None)):
        p.actor = replace(actor, weights={**actor.weights, "out_b": np.array([bias])})
        chosen = p.select(epoch(100, a=50, b=0), p.plan(AT))
        assert set(chosen) == expected if expected else len(chosen) == 1
    assert p.last_decision is not None and p.last_decision.now_ns == 100 * MS and p.last_decision.number == 7


def test_the_shipped_policy_has_a_name_that_a_file_of_ones_own_takes_over(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    shipped = f"bandit:{scenario.SCENARIO_FOLDER / 'card/policy.npz'}"
    assert make_policy(shipped, None, np.random.default_rng(0)).name == shipped
    data = {"cameras": {"count": 3}, "edge": {"policy": {"name": "bandit:card/policy.npz"}}}
    made = scenario.parse(data, tmp_path / "tiny.yaml")
    assert parse_policy("bandit:card/policy.npz")[0] == read_config(made).policy.name == shipped
    (tmp_path / "card").mkdir()
    (own := tmp_path / "card/policy.npz").write_bytes(b"")
    assert parse_policy("bandit:card/policy.npz")[0] == read_config(made).policy.name == f"bandit:{own}"


BRIGHTNESS = SimpleNamespace(name="brightness", dim=1)
"""Its name and how many numbers it gives are all that is asked of an embedder here."""


def updates(p, embedder=None):
    return FieldUpdater(FrameBuffer(("a", "b", "c")), p, tiny_field(), start_ns=0, embedder=embedder)


def test_a_policy_is_refused_where_there_are_no_embeddings_or_others_than_it_was_taught_with():
    p = policy("select", parts=("semantics",), dim=1)
    u = updates(make_policy("all", None, np.random.default_rng(0)))
    with pytest.raises(ValueError, match=r"edge\.embedding"):
        u.policy = p
    assert u.policy.name == "all"
    with pytest.raises(ValueError, match=r"embeddings of 2 numbers, .* brightness of 1"):
        updates(policy("select", parts=("semantics",), dim=2), BRIGHTNESS)
    other = policy("select", parts=("semantics",), dim=1, embedding="color")
    refused(ValueError, "trained with color", updates, other, BRIGHTNESS)
    updates(policy("select", parts=("semantics",), dim=1, embedding="brightness"), BRIGHTNESS)


def a_decision(number=0, seed=0, n=4, hold_ms=0.0):
    actor = Learner(Spec("select", StateLayout(("age", "pose", "semantics"), dim=3), hold_ms=hold_ms), seed).actor
    s = state(n, np.random.default_rng(number), d=3, silent=1)
    s = replace(s, frames={c: frame(c, sequence=number) for c in s.cameras[:2]})
    actions, logps = actor.act([s])
    return Decision(number, 10**9 * number, s, actions[0], float(logps[0]), actor)


def names(folder, pattern="*.npz"):
    return sorted(p.name for p in folder.glob(pattern))


def test_a_decision_comes_back_as_it_was(tmp_path):
    given = a_decision(7)
    DecisionWriter(tmp_path, EmbeddingConfig(dim=3)).write(given)
    found = read_decision(tmp_path, 7)
    back = found.decision
    assert (back.number, back.now_ns, back.logp) == (given.number, given.now_ns, given.logp)
    np.testing.assert_array_equal(back.action, given.action)
    for name in ("ages_ms", "poses", "embeddings", "reported"):
        np.testing.assert_array_equal(getattr(back.state, name), getattr(given.state, name))
    assert back.state.cameras == given.state.cameras and back.actor.digest == given.actor.digest
    assert found.embedding == {"model": "default", "dim": 3}
    shapes = {camera: image.shape for camera, image in found.images.items()}
    assert shapes == {"cam00": (24, 32, 3), "cam01": (24, 32, 3)}


def test_the_oldest_make_room(tmp_path, monkeypatch):
    monkeypatch.setattr(tuned, "KEPT_DECISIONS", 3)
    record = DecisionWriter(tmp_path)
    for number in range(6):
        record.write(a_decision(number, seed=number // 3))
    folder = tmp_path / FOLDER
    assert len(names(folder, "policy-*")) == 1
    assert names(folder, "0*") == ["000003.npz", "000004.npz", "000005.npz"]
    DecisionWriter(tmp_path).write(a_decision(6))  # another process of the same run goes on
    assert names(folder, "0*") == ["000004.npz", "000005.npz", "000006.npz"]
    monkeypatch.setattr(tuned, "KEPT_DECISIONS_BYTES", 1)
    large = DecisionWriter(tmp_path / "large")
    for number in range(2):
        large.write(a_decision(number))
        assert names(tmp_path / "large" / FOLDER, "0*") == [f"{number:06d}.npz"]  # the newest, however large


def test_a_run_that_begins_anew_in_the_same_folder_forgets_the_earlier_one(tmp_path):
    for seed, numbers in ((0, range(4)), (1, range(2))):
        writer = DecisionWriter(tmp_path)
        for number in numbers:
            writer.write(a_decision(number, seed=seed))
    assert names(tmp_path / FOLDER, "0*") == ["000000.npz", "000001.npz"]
    assert read_decision(tmp_path).decision.number == 1


def test_a_decision_that_is_held_is_that_of_later_updates_too(tmp_path):
    record = DecisionWriter(tmp_path)
    for number in (5, 9):
        record.write(a_decision(number, hold_ms=1000.0))
    assert [read_decision(tmp_path, n).decision.number for n in (5, 8, 9, 40)] == [5, 5, 9, 9]
    record.write(a_decision(50))
    refused(ValueError, r"update 51 has no decision .* that of update 50", read_decision, tmp_path, 51)


def test_damage_is_named(tmp_path):
    DecisionWriter(tmp_path).write(a_decision(0))
    path = tmp_path / FOLDER / "000000.npz"
    whole = path.read_bytes()
    path.write_bytes(whole[: len(whole) // 2])
    refused(ValueError, r"000000\.npz: damaged", read_decision, tmp_path, 0)
    path.write_bytes(whole)
    next((tmp_path / FOLDER).glob("policy-*")).write_bytes(b"nothing")
    refused(ValueError, r"damaged: .*policy-", read_decision, tmp_path, 0)


def test_a_decision_by_ages_is_explained(tmp_path, capsys):
    actor, s = policy("wait").actor, state(3, np.random.default_rng(0))
    (action,), (logp,) = actor.act([s])
    DecisionWriter(tmp_path).write(Decision(4, 0, s, np.asarray(action), float(logp), actor))
    assert main([str(tmp_path)]) == 0
    said = capsys.readouterr().out
    assert said.startswith("decision 4: wait ")
    assert "cam02" in said and "in the picture" not in said
    logit, average = re.search(r"logit (\S+); of average cameras (\S+)\)", said).groups()
    shares = [float(share) for share in re.findall(r"^  cam\d+ +(\S+)", said, re.MULTILINE)]
    assert len(shares) == 3 and sum(shares) == pytest.approx(float(logit) - float(average), abs=0.003)
    assert cv2.imread(str(tmp_path / "decision-000004.png")).shape[1] > 500


def test_regions_are_found_with_what_embedded_the_frames(tmp_path, capsys):
    pytest.importorskip("onnxruntime", reason="the extra embed is not installed")
    from tests.edge_server.embed.graphs import detector

    DecisionWriter(tmp_path, EmbeddingConfig(str(detector(tmp_path / "d.onnx")), 3)).write(a_decision(2))
    assert main([str(tmp_path), "--decision", "2", "--camera", "cam01"]) == 0
    said = re.search(r"the picture of cam01 most by the region in .* of 8 x 8: (\S+)", capsys.readouterr().out)
    assert abs(float(said[1])) > 0


def test_where_frames_cannot_be_embedded_again_the_rest_is_told(tmp_path, capsys):
    DecisionWriter(tmp_path, None).write(a_decision(2))
    assert main([str(tmp_path)]) == 0
    told = capsys.readouterr()
    assert "by part of the state" in told.out and "does not name the embedder" in told.err
    assert "does not name the embedder" in refusal(capsys, main, tmp_path, "--camera", "cam01")
