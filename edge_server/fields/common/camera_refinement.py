"""What a field may learn about its cameras: each one's exposure, and small errors of its pose.

Both are off unless asked for, cost nothing then, and serve every representation of ``trained_field``.
Pictures are rendered at the mean exposure and, for a known camera, at the pose that is asked for.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import View
from edge_server.fields.common.kernels.rays import Views
from edge_server.fields.common.ray_snapshot import NgpSnapshot
from edge_server.fields.common.scene_box import SceneBox
from freshfield.geometry import so3_exp

Array = NDArray[np.float64]

START = 40  # steps before anything is corrected: first the scene must be told from the camera
_SHARE = 0.1  # of the least-squares answer of one step's rays that is believed
_DAMPING = 0.02  # in least squares: a camera that sees one plain colour learns a bias at most
_GAIN, _BIAS = 3.0, 0.3  # bounds: gain in 1/3..3

EVERY = 2  # steps between corrections of a pose, of one camera after the other
PIXELS = 384  # compared for one correction
_TRUST = 0.8  # of a Gauss-Newton step that is taken
_LONGEST = 1.0  # pixels, of one step in one parameter
_PRIOR = 1e-2  # of the squared error, at the bound: a picture that says nothing leaves the pose as given
_OUTLIER = 0.15  # residual from which on a pixel counts less: something moved, or is hidden


class Exposures:
    """Per camera and channel, the ``a`` and ``b`` that bring its pictures to the common exposure:
    a picture + b. The mean over cameras is kept at a = 1 (geometric) and b = 0."""

    def __init__(self) -> None:
        self.known: dict[str, Array] = {}  # camera -> (3, 2)

    def rows(self, cameras: list[str]) -> NDArray[np.float32]:
        """float32 (V, 3, 2) for the kernels."""
        unity = np.array([[1.0, 0.0]] * 3)
        for camera in cameras:
            self.known.setdefault(camera, unity.copy())
        return np.array([self.known[camera] for camera in cameras], dtype=np.float32)

    def learn(self, cameras: list[str], sums: Array) -> None:
        """One step. sums: float64 (V, 3, 5); per view and channel, over its rays: their number, and the sums
        of t, t^2, e and e t, where t is the corrected pixel and e = rendered - t."""
        n, t, tt, e, et = np.moveaxis(sums, -1, 0)
        m = np.maximum(n, 1.0)
        # Damped least squares for e = p t + q, per ray; (V, 3) each.
        a11, a12, a22 = tt / m + _DAMPING, t / m, 1.0 + _DAMPING
        determinant = a11 * a22 - a12 * a12
        p = (a22 * et / m - a12 * e / m) / determinant
        q = (a11 * e / m - a12 * et / m) / determinant
        believed = _SHARE * np.minimum(n / 32.0, 1.0)  # little, where there were few rays
        for k, camera in enumerate(cameras):
            now = self.known[camera]
            step = 1.0 + believed[k] * np.clip(p[k], -0.5, 0.5)
            new = np.stack([step * now[:, 0], step * now[:, 1] + believed[k] * q[k]], axis=-1)
            if np.isfinite(new).all():
                self.known[camera] = new
        self._centre()

    def _centre(self) -> None:
        both = np.array(list(self.known.values()))
        both[..., 0] = np.clip(both[..., 0], 1.0 / _GAIN, _GAIN)
        both[..., 0] /= np.exp(np.log(both[..., 0]).mean(axis=0))
        both[..., 1] = np.clip(both[..., 1] - both[..., 1].mean(axis=0), -_BIAS, _BIAS)
        for camera, pair in zip(self.known, both):
            self.known[camera] = pair


@dataclass
class _Correction:
    given: Array  # (4, 4): another pose is another error
    turn: Array  # (3,) radians, world axes
    shift_m: Array  # (3,) world axes


class Poses:
    """Bounded corrections of the poses of cameras, found by comparing rendered pixels with the picture.

    A correction turns a camera about its own centre by exp(turn) and shifts it. Gauss-Newton with the
    derivatives of rendered colours by small motions of the camera, which ask nothing of a representation
    but to be rendered. The mean correction of all cameras is kept at 0: the scene stays where it is.
    """

    def __init__(self, most_m: float, most_deg: float) -> None:
        self.most_m, self.most_rad = most_m, np.deg2rad(most_deg)
        self.known: dict[str, _Correction] = {}

    def pose(self, view: View) -> Array:
        """The corrected camera_to_world (4, 4) of a view."""
        known, given = self._of(view), np.asarray(view.camera_to_world, dtype=np.float64)
        pose = given.copy()
        pose[:3, :3] = so3_exp(known.turn) @ given[:3, :3]
        pose[:3, 3] += known.shift_m
        return pose

    def _of(self, view: View) -> _Correction:
        given = np.asarray(view.camera_to_world, dtype=np.float64)
        known = self.known.get(view.camera)
        if known is None or not np.allclose(known.given, given, atol=1e-3):
            known = self.known[view.camera] = _Correction(given, np.zeros(3), np.zeros(3))
        return known

    def correct(
        self, view: View, render: Callable[[Array, Array], NDArray[np.float32]], pixel_m: float,
        rng: np.random.Generator, background: NDArray[np.float32],
    ) -> None:  # fmt: skip
        """One Gauss-Newton step for one camera.

        render: (pose (4, 4), image points (N, 2)) -> colours (N, 3). pixel_m: what a pixel spans at the
        scene, the scale of all parameters.
        """
        known, camera = self._of(view), view.intrinsics
        column = rng.integers(0, camera.width, PIXELS)
        row = rng.integers(0, camera.height, PIXELS)
        points = np.stack([column + 0.5, row + 0.5], axis=-1)
        seen = view.image[row, column] / 255.0
        if seen.shape[1] == 4:
            seen = seen[:, :3] * seen[:, 3:] + background * (1.0 - seen[:, 3:])
        scale = np.array([1.0 / camera.fx] * 3 + [pixel_m] * 3)
        base = self.pose(view)
        here = render(base, points).astype(np.float64)
        slopes = np.empty((6, *here.shape))
        for k in range(6):
            moved, by = base.copy(), 0.5 * scale[k]
            axis = np.eye(3)[k % 3] * by
            if k < 3:
                moved[:3, :3] = so3_exp(axis) @ base[:3, :3]
            else:
                moved[:3, 3] += axis
            slopes[k] = (render(moved, points) - here) / 0.5  # per pixel's worth of motion
        error = here - seen
        trust = 1.0 / (1.0 + (np.square(error).sum(axis=1, keepdims=True) / _OUTLIER**2))
        # Sums by einsum without BLAS: its order of summation depends on the number of threads.
        total = np.concatenate([known.turn, known.shift_m]) / scale
        curve = np.einsum("inc,jnc,nk->ij", slopes, slopes, trust, optimize=False) / PIXELS
        slope = np.einsum("inc,nc,nk->i", slopes, error, trust, optimize=False) / PIXELS
        # How far an error may plausibly go is what the bounds say: without that, turning and shifting, which
        # look alike from afar, would be confused.
        bounds = np.array([self.most_rad] * 3 + [self.most_m] * 3) / scale
        prior = _PRIOR / np.square(np.maximum(bounds, 1e-3))
        step = -_TRUST * np.linalg.solve(curve + np.diag(prior), slope + prior * total)
        if not np.isfinite(step).all():
            return
        step = np.clip(step, -_LONGEST, _LONGEST) * scale
        known.turn, known.shift_m = known.turn + step[:3], known.shift_m + step[3:]
        everyone = list(self.known.values())
        mean_turn = np.mean([c.turn for c in everyone], axis=0)
        mean_shift = np.mean([c.shift_m for c in everyone], axis=0)
        for c in everyone:
            c.turn = _at_most(c.turn - mean_turn, self.most_rad)
            c.shift_m = _at_most(c.shift_m - mean_shift, self.most_m)


class CameraErrors:
    """What one field knows of its cameras' errors; does nothing where nothing is asked for."""

    def __init__(self, exposure: bool, most_m: float, most_deg: float) -> None:
        self.exposures = Exposures() if exposure else None
        self.poses = Poses(most_m, most_deg) if most_m > 0 or most_deg > 0 else None

    @property
    def asked(self) -> bool:
        """Whether any error is to be learnt. Then a view that looks wrong may only not be understood yet."""
        return self.exposures is not None or self.poses is not None

    def corrected(self, views: Sequence[View], data: Views, box: SceneBox) -> Views:
        """``data`` as it is to be read with what is known by now."""
        if self.exposures is not None:
            data = data._replace(exposure=self.exposures.rows([v.camera for v in views]))
        if self.poses is not None:
            poses = np.stack([self.poses.pose(view) for view in views])
            data = data._replace(
                rotation=np.ascontiguousarray(poses[:, :3, :3]),
                origin=np.ascontiguousarray(box.normalise(poses[:, :3, 3])),
            )
        return data

    def learn(
        self, views: Sequence[View], data: Views, box: SceneBox, step: int, seed: int,
        sums: NDArray[np.float64], live: Callable[[], NgpSnapshot],
    ) -> Views:  # fmt: skip
        """After ``step``: learn from it; returns the corrected data. sums: float64 (chunks, V, 3, 5), what
        ``kernels.train`` found, cleared. live: makes a renderer of the field."""
        news = False
        if self.exposures is not None:
            if step >= START:
                self.exposures.learn([v.camera for v in views], sums.sum(axis=0))
                news = True
            sums[...] = 0.0
        if self.poses is not None and step >= START and step % EVERY == 0:
            view, renderer = views[step // EVERY % len(views)], live()

            def render(pose: Array, points: Array) -> NDArray[np.float32]:
                return renderer.render_pixels(pose, view.intrinsics, points)[0]

            rng = np.random.default_rng(np.random.SeedSequence([seed, step, 1]))
            pixel_m = box.distance_m / view.intrinsics.fx
            self.poses.correct(view, render, pixel_m, rng, renderer.background)
            news = True
        return self.corrected(views, data, box) if news else data

    def meta(self) -> dict[str, Any]:
        """What a state keeps, ready for JSON, to the last bit."""
        return {
            "exposures": {c: p.tolist() for c, p in self.exposures.known.items()} if self.exposures else {},
            "poses": {
                name: [c.given.tolist(), c.turn.tolist(), c.shift_m.tolist()]
                for name, c in (self.poses.known.items() if self.poses else ())
            },
        }

    def load(self, meta: dict[str, Any]) -> None:
        """Undo ``meta``; what this field was not asked to learn is left out."""
        if self.exposures is not None:
            self.exposures.known = {c: np.array(p) for c, p in meta.get("exposures", {}).items()}
        if self.poses is not None:
            known = meta.get("poses", {}).items()
            self.poses.known = {name: _Correction(*map(np.array, parts)) for name, parts in known}


def _at_most(vector: Array, most: float) -> Array:
    length = float(np.linalg.norm(vector))
    return vector if length <= most else vector * (most / length)
