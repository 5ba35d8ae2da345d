"""Every representation made small, and the views that tests fit it to.

``small_rays`` and ``splat.small`` have their classes, settings for images of 48 pixels (SMALL) and of 24 (TINY, for
hard cases), and REACHED_DB: the PSNR that a healthy field reaches in these tests. Another CPU rounds differently, which
costs tenths of a decibel.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from msgspec import structs

from edge_server.fields import View
from edge_server.fields.common.kernels.adam import PARAMETER_LIMIT
from edge_server.fields.registry import field_names
from tests.edge_server.fields import small_rays
from tests.edge_server.fields.scenes import picture, psnr, ring
from tests.edge_server.fields.splat import small as splat

NAMES = field_names()
CLASSES: dict[str, Any] = {**small_rays.CLASSES, "splat": splat.FIELD}
SMALL: dict[str, Any] = {**small_rays.SMALL, "splat": splat.SMALL}
TINY: dict[str, Any] = {**small_rays.TINY, "splat": splat.TINY}
REACHED_DB: dict[str, dict[str, float]] = {**small_rays.REACHED_DB, "splat": splat.REACHED_DB}
every_field = pytest.mark.parametrize("name", NAMES)

VIEWS = ring(13)
HELD, SEEN = VIEWS[6], VIEWS[:6] + VIEWS[7:]
ASIDE_M = np.array([0.3, 0.0, 0.5])  # where the ball has gone in ``moved``


def reaches(name: str, case: str, psnr_db: float, margin_db: float = 0.5) -> None:
    """Fails where a field falls behind what healthy ones reach (``REACHED_DB``)."""
    usual_db = REACHED_DB[name][case]
    assert psnr_db > usual_db - margin_db, f"{psnr_db:.2f} dB, usually {usual_db:.2f}"


def small(name: str, **changed: Any) -> Any:
    """A small field of that name, with other settings as ``changed`` says."""
    return CLASSES[name](structs.replace(SMALL[name], **changed))


def tiny(name: str, **changed: Any) -> Any:
    """A tiny field of that name, with other settings as ``changed`` says."""
    return CLASSES[name](structs.replace(TINY[name], **changed))


def healthy(field: Any, views: Sequence[View]) -> None:
    """Whatever has happened: nothing is out of bounds, neither a parameter nor a rendered image."""
    name = next(name for name, kind in CLASSES.items() if type(field) is kind)
    state = field.state()
    for array in splat.FINITE if name == "splat" else ("table", "net", "density", "behind"):
        assert np.isfinite(state[array]).all(), f"{array} is not finite"
    for view in (views[0], views[-1]):
        out = field.render(view.camera_to_world, view.intrinsics)
        assert all(np.isfinite(part).all() for part in (out.color, out.depth, out.opacity))
        assert out.color.min() >= 0.0 and out.color.max() <= 1.0 and out.depth.min() >= 0.0
        assert out.opacity.min() >= 0.0 and out.opacity.max() <= 1.0
        if name == "splat":
            splat.check_bounds(field, out)
        else:
            assert np.abs(state["table"]).max() <= PARAMETER_LIMIT


def score(field: Any, view: View = HELD) -> float:
    """PSNR of a view, dB; that of the views' mean color is below 16."""
    return psnr(field.render(view.camera_to_world, view.intrinsics).color, view.image / 255.0)


def moved(view: View) -> View:
    """The same camera's picture after the ball has gone aside."""
    return replace(view, image=picture(view.intrinsics, view.camera_to_world, ASIDE_M))


def cut_out(view: View) -> View:
    """The view with an alpha channel: its sky is transparent."""
    sky = (view.image == view.image[0, 0]).all(axis=-1)
    return replace(view, image=np.dstack([view.image, np.where(sky, 0, 255).astype(np.uint8)]))


def same_state(a: Any, b: Any, settings: bool = False) -> None:
    """Both hold the same numbers, bit for bit; with ``settings`` the same settings too, of which threads are one."""
    one, two = a.state(), b.state()
    assert one.keys() == two.keys()
    for name in one:
        if settings or not name.endswith("meta"):
            np.testing.assert_array_equal(one[name], two[name], err_msg=name)
