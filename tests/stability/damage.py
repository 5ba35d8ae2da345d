"""What every field must do whose parameters are damaged or whose cameras move."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from edge_server.fields import Budget, View
from tests.edge_server.fields.scenes import look_at, mean_psnr, picture
from tests.edge_server.fields.small import check_bounds


def healthy(field: Any, views: Sequence[View]) -> None:
    """Whatever has happened: nothing is out of bounds, neither a parameter nor a picture."""
    for view in (views[0], views[-1]):
        check_bounds(field, field.render(view.camera_to_world, view.intrinsics))


def counts_and_heals(field: Any, views: Sequence[View], damage: Callable[[Any], None], counted: bool) -> None:
    """What is not finite is left out, counted if it is a gradient, and gone 40 steps later."""
    field.fit(views, Budget(steps=30))
    damage(field)
    field._snapshot = None
    out = field.render(views[0].camera_to_world, views[0].intrinsics)
    assert np.isfinite(out.color).all() and np.isfinite(out.depth).all()
    report = field.fit(views, Budget(steps=40))
    assert field.dropped == report.dropped and (report.dropped > 0) == counted
    assert field.fit(views, Budget(steps=200)).dropped == 0, "still not finite 40 steps later"
    healthy(field, views)
    assert mean_psnr(field, views) > 15.0


def overflows_and_begins_anew(field: Any, views: Sequence[View], damage: Callable[[Any], None]) -> None:
    """Opaque everywhere: no gradient leads out of that, but a reset does, and nothing becomes NaN."""
    field.fit(views, Budget(steps=30))
    damage(field)
    field.fit(views, Budget(steps=20))
    out = field.render(views[0].camera_to_world, views[0].intrinsics)
    assert np.isfinite(out.color).all() and np.isfinite(out.depth).all() and out.color.max() <= 1.0
    assert all(np.isfinite(a).all() for a in field.state().values() if a.dtype.kind == "f")
    field.reset()
    field.fit(views, Budget(steps=200))
    healthy(field, views)
    assert mean_psnr(field, views) > 15.0


def follows_cameras_that_move(field: Any, still: Sequence[View]) -> float:
    """Four cameras, each elsewhere at every update; returns the mean PSNR of the last views, dB."""
    for update in range(30):
        views = []
        for view in still[:4]:
            eye = view.camera_to_world[:3, 3] + 0.05 * update * np.array([0.0, 0.0, 1.0])
            pose = look_at(eye, (0.0, 0.0, 0.4))
            views.append(replace(view, camera_to_world=pose, image=picture(view.intrinsics, pose)))
        field.fit(views, Budget(steps=5))
    healthy(field, views)
    return mean_psnr(field, views)
