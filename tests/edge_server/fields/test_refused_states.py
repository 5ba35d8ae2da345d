"""A state that is refused leaves the field as it was, bit for bit, and the refusal is one line."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from edge_server.fields import Budget
from tests.edge_server.fields.scenes import ring
from tests.edge_server.fields.small import every_field, same_state, small

VIEWS = ring(5, size=24)
State = dict[str, Any]


def _without(name: str) -> Callable[[State], None]:
    return lambda state: state.pop(name)


def _said(change: Callable[[dict[str, Any]], Any]) -> Callable[[State], None]:
    def spoil(state: State) -> None:
        meta = json.loads(str(state["meta"]))
        change(meta)
        state["meta"] = np.array(json.dumps(meta))

    return spoil


def _last_array(state: State) -> str:
    """Of what is learned: what comes before it is right."""
    others = ("meta", "behind", "image", "pose", "moved")
    return [name for name in state if not name.startswith(others)][-1]


def _last_array_cut(state: State) -> None:
    state[_last_array(state)] = state[_last_array(state)][:-1]


def _last_array_not_finite(state: State) -> None:
    name = _last_array({n: a for n, a in state.items() if a.dtype.kind == "f"})
    state[name] = state[name].copy()
    state[name].flat[-1] = np.nan


def _image_cut(state: State) -> None:
    state["image_0"] = state["image_0"][:-1]


def _pose_lost(state: State) -> None:
    state["pose_1"] = np.full((4, 4), np.nan)


DAMAGE: dict[str, Callable[[State], Any]] = {
    "no background": _without("behind"),
    "no picture of a camera": _without("image_4"),
    "a picture that is too small": _image_cut,
    "a pose that is none": _pose_lost,
    "an array that is too short": _last_array_cut,
    "an array that is missing": lambda state: state.pop(_last_array(state)),
    "an array that holds NaN": _last_array_not_finite,
    "of a later version": _said(lambda meta: meta.update(version=10**9)),
    "of another kind of field": _said(lambda meta: meta.update(field="another")),
    "no facts": _without("meta"),
    "a step count that is none": _said(lambda meta: meta.update(step=None)),
    "cameras without a lens": _said(lambda meta: meta["cameras"][0].pop("fx")),
    "a box without a size": _said(lambda meta: meta["box"].update(radius_m=0.0)),
    "facts that are no facts": lambda state: state.update(meta=np.array("[1, 2]")),
}


@every_field
def test_a_refused_state_leaves_the_field_as_it_was(name: str) -> None:
    field, other = small(name), small(name)
    field.fit(VIEWS, Budget(steps=3))
    other.fit(VIEWS[:4], Budget(steps=1))
    other.fit([replace(v, image=255 - v.image) for v in VIEWS], Budget(steps=1))
    before, good = field.state(), other.state()
    shown = field.render(VIEWS[0].camera_to_world, VIEWS[0].intrinsics).color
    for damage, spoil in DAMAGE.items():
        bad = dict(good)
        spoil(bad)
        with pytest.raises(ValueError, match=r"state|camera") as caught:
            field.load_state(bad)
        assert "\n" not in str(caught.value), damage
        after = field.state()
        assert after.keys() == before.keys(), damage
        assert all(np.array_equal(after[key], before[key]) for key in before), damage
    np.testing.assert_array_equal(shown, field.render(VIEWS[0].camera_to_world, VIEWS[0].intrinsics).color)
    twin = small(name)
    twin.load_state(before)
    for either in (field, twin):  # nothing that a state does not hold was lost or gained either
        either.fit(VIEWS, Budget(steps=2))
    same_state(field, twin, settings=True)
    field.load_state(good)
    assert all(np.array_equal(field.state()[key], good[key]) for key in good)


@pytest.mark.parametrize(
    ("name", "other", "text"),
    [
        ("ngp", {"hidden": 32}, "hidden = 16"),
        ("nerfacto", {"appearance": 2}, "appearance = 0"),
        ("tensorf", {"density_rank": 16}, "density_rank = 8"),
        ("splat", {"sh_degree": 1}, "sh_degree = 0"),
        ("splat", {"gaussians": 100, "start": 100}, "holds 100 at most"),
    ],
)
def test_a_state_of_another_shape_is_refused(name: str, other: dict[str, Any], text: str) -> None:
    field = small(name)
    if name == "splat":  # which has no Gaussians before
        field.fit(VIEWS, Budget(steps=1))
    with pytest.raises(ValueError, match=text):
        small(name, **other).load_state(field.state())
