"""Checkpoints: what is saved comes back, whole or not at all."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest

from edge_server.fields import checkpoint

STATE = {"a": np.arange(6, dtype=np.float32).reshape(2, 3), "meta": np.array('{"x": 1}')}


def test_what_is_saved_comes_back_and_a_failed_save_leaves_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "deep" / "field.npz"
    checkpoint.save(path, STATE, {"field": "ngp", "step": 7})

    def no_room(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", no_room)
    with pytest.raises(OSError, match="No space"):
        checkpoint.save(path, {"a": np.zeros(3)})
    state, about = checkpoint.load(path)
    assert about == {"field": "ngp", "step": 7} and state.keys() == STATE.keys()
    np.testing.assert_array_equal(state["a"], STATE["a"])
    assert str(state["meta"]) == '{"x": 1}' and state["a"].dtype == np.float32
    assert [p.name for p in path.parent.iterdir()] == ["field.npz"]


def test_damage_is_told_clearly(tmp_path: Path) -> None:
    path = tmp_path / "field.npz"
    with pytest.raises(checkpoint.CheckpointError, match="no such checkpoint"):
        checkpoint.load(path)
    checkpoint.save(path, {"a": np.random.default_rng(0).random(5000)})
    whole = path.read_bytes()
    for damaged in (b"", b"garbage", whole[: len(whole) // 2], whole[:3000] + b"\0" * 40 + whole[3040:]):
        path.write_bytes(damaged)
        with pytest.raises(checkpoint.CheckpointError, match=r"field\.npz: damaged"):
            checkpoint.load(path)
    np.savez(path, a=np.zeros(3))
    with pytest.raises(checkpoint.CheckpointError, match="not a field's checkpoint"):
        checkpoint.load(path)


def test_objects_are_never_unpickled(tmp_path: Path) -> None:
    path = tmp_path / "field.npz"
    np.savez(path, __facts__=np.array([{"evil": 1}], dtype=object))
    with pytest.raises(checkpoint.CheckpointError, match="damaged"):
        checkpoint.load(path)
