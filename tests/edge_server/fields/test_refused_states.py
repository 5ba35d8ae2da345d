"""A state that is refused leaves the field as it was, bit for bit, and the refusal is one line."""

from __future__ import annotations

import json
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from edge_server.fields import Budget
from tests.edge_server.fields.scenes import ring
from tests.edge_server.fields.small import every_field, same_state, small

VIEWS = ring(5, size=24)
State = dict[str, Any]


def _damaged(good: State) -> dict[str, State]:
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


@pytest.mark.parametrize(
    ("name", "other", "text"),
    [
        ("ngp", {"hidden": 32}, "hidden = 16"),
        ("nerfacto", {"appearance": 2}, "appearance = 0"),
        ("tensorf", {"density_rank": 16}, "density_rank = 8"),
        ("splat", {"gaussians": 100, "start": 100}, "holds 100 at most"),
    ],
)
def test_a_state_of_another_shape_is_refused(name: str, other: dict[str, Any], text: str) -> None:
    field = small(name)
    if name == "splat":  # which has no Gaussians before
        field.fit(VIEWS, Budget(steps=1))
    with pytest.raises(ValueError, match=text):
        small(name, **other).load_state(field.state())
