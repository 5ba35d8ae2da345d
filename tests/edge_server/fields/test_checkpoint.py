"""What is saved comes back, whole or not at all; a state that is refused leaves the field as it was, bit for bit."""

import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from edge_server.fields import Budget, checkpoint
from tests.edge_server.fields.scenes import ring
from tests.edge_server.fields.small import every_field, same_state, small
from tests.support import refused

VIEWS = ring(5, size=24)
STATE = {"a": np.arange(6, dtype=np.float32).reshape(2, 3), "meta": np.array('{"x": 1}')}


def test_what_is_saved_comes_back_and_a_failed_save_leaves_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "deep" / "field.npz"
    checkpoint.save(path, STATE, {"field": "ngp", "step": 7})

    def no_room(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", no_room)
    refused(OSError, "No space", checkpoint.save, path, {"a": np.zeros(3)})
    state, about = checkpoint.load(path)
    assert about == {"field": "ngp", "step": 7} and state.keys() == STATE.keys()
    np.testing.assert_array_equal(state["a"], STATE["a"])
    assert str(state["meta"]) == '{"x": 1}' and state["a"].dtype == np.float32
    assert [p.name for p in path.parent.iterdir()] == ["field.npz"]
    (other := tmp_path / "edge.json").touch()
    assert path.stat().st_mode == other.stat().st_mode  # who may read the rest of a run may read it


def test_damage_is_told_clearly(tmp_path: Path) -> None:
    path = tmp_path / "field.npz"
    refused(checkpoint.CheckpointError, "no such checkpoint", checkpoint.load, path)
    checkpoint.save(path, {"a": np.random.default_rng(0).random(5000)})
    whole = path.read_bytes()
    for damaged in (b"", b"garbage", whole[: len(whole) // 2], whole[:3000] + b"\0" * 40 + whole[3040:]):
        path.write_bytes(damaged)
        refused(checkpoint.CheckpointError, r"field\.npz: damaged", checkpoint.load, path)
    np.savez(path, a=np.zeros(3))
    refused(checkpoint.CheckpointError, "not a field's checkpoint", checkpoint.load, path)


def test_objects_are_never_unpickled(tmp_path: Path) -> None:
    path = tmp_path / "field.npz"
    np.savez(path, __facts__=np.array([{"evil": 1}], dtype=object))
    refused(checkpoint.CheckpointError, "damaged", checkpoint.load, path)


OF_ANOTHER_SHAPE = {
    "ngp": {"hidden": 32},
    "nerfacto": {"appearance": 2},
    "tensorf": {"density_rank": 16},
    "splat": {"sh_degree": 1},
}


def _damaged(good: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """By what is wrong with them, states like ``good`` that are not to be taken."""
    meta = json.loads(str(good["meta"]))
    kept = [name for name in good if not name.startswith(("meta", "behind", "image", "pose", "moved"))]
    last = [name for name in kept if good[name].dtype.kind == "f"][-1]  # what comes before it is right
    poisoned = good[last].copy()
    poisoned.flat[-1] = np.nan
    arrays = {
        "a picture that is too small": {"image_0": good["image_0"][:-1]},
        "a pose that is none": {"pose_1": np.full((4, 4), np.nan)},
        "an array that is too short": {kept[-1]: good[kept[-1]][:-1]},
        "an array that holds NaN": {last: poisoned},
        "facts that are no facts": {"meta": np.array("[1, 2]")},
    }
    facts = {
        "of a later version": {"version": 10**9},
        "of another kind of field": {"field": "another"},
        "a step count that is none": {"step": None},
        "cameras without a lens": {"cameras": [{k: v for k, v in meta["cameras"][0].items() if k != "fx"}]},
        "a box without a size": {"box": {**meta["box"], "radius_m": 0.0}},
        "of another shape": {"settings": {**meta["settings"], **OF_ANOTHER_SHAPE[meta["field"]]}},
    }
    damaged = {name: {**good, **change} for name, change in arrays.items()}
    damaged |= {name: {**good, "meta": np.array(json.dumps({**meta, **change}))} for name, change in facts.items()}
    for lost in ("behind", "image_4", "meta", kept[-1]):
        damaged[f"without {lost}"] = {name: array for name, array in good.items() if name != lost}
    return damaged


@every_field
def test_a_refused_state_leaves_the_field_as_it_was(name: str) -> None:
    field, other, twin = small(name), small(name), small(name)
    field.fit(VIEWS, Budget(steps=3))
    other.fit(VIEWS[:4], Budget(steps=1))
    other.fit([replace(v, image=255 - v.image) for v in VIEWS], Budget(steps=1))
    before, good = field.state(), other.state()
    twin.load_state(before)
    for damage, bad in _damaged(good).items():
        with pytest.raises(ValueError, match=r"state|camera") as caught:
            field.load_state(bad)
        assert "\n" not in str(caught.value), damage
        same_state(field, twin, settings=True)
    for either in (field, twin):  # nothing that a state does not hold was lost or gained either
        either.fit(VIEWS, Budget(steps=2))
    same_state(field, twin, settings=True)
    field.load_state(good)
    same_state(field, other, settings=True)


def test_more_gaussians_than_there_is_room_for_are_refused() -> None:
    field = small("splat")
    field.fit(VIEWS, Budget(steps=1))
    refused(ValueError, "holds 100 at most", small("splat", gaussians=100, start=100).load_state, field.state())
