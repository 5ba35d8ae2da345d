"""Camera refinement while a field trains: each camera's appearance, and small corrections of its pose.

Both are off by default, cost nothing then, and serve every representation of ``trained_field``. Pictures are
rendered at the mean appearance and at the given pose.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import View
from edge_server.fields.common.appearance import AppearanceEmbeddings
from edge_server.fields.common.kernels.rays import Views
from edge_server.fields.common.kernels.train import Batch
from edge_server.fields.common.ray_snapshot import RaySnapshot
from edge_server.fields.common.scene_box import SceneBox
from edge_server.fields.common.trainer_settings import TrainerSettings
from freshfield.geometry import so3_exp

Array = NDArray[np.float64]

START = 40  # steps before anything is corrected: first the scene must take shape
EVERY = 2  # steps between corrections of a pose, of one camera after the other
PIXELS = 384  # compared for one correction
_STEP_SHARE = 0.8  # of a Gauss-Newton step that is taken
_LONGEST = 1.0  # pixels, of one step in one parameter
_PRIOR = 1e-2  # squared error that a correction at its bound costs: without detail, poses stay as given
_OUTLIER = 0.15  # residual from which on a pixel counts less: something moved, or is hidden


@dataclass
class _Correction:
    given: Array  # (4, 4), the pose it belongs to: a camera with another pose starts anew
    rotation: Array  # (3,) rotation vector in radians, world axes
    shift_m: Array  # (3,) world axes


class PoseCorrections:
    """Bounded corrections of camera poses, found by comparing rendered pixels with the picture.

    A correction rotates a camera about its own center by exp(rotation) and shifts it. Gauss-Newton with
    finite differences of the rendered colors by small motions of the camera, so any representation will do.
    The mean correction of all cameras is kept at 0: the scene stays where it is.

    most_m, most_deg: largest shift in meters and largest rotation in degrees.
    """

    def __init__(self, most_m: float, most_deg: float) -> None:
        self.most_m, self.most_rad = most_m, np.deg2rad(most_deg)
        self.known: dict[str, _Correction] = {}

    def pose(self, view: View) -> Array:
        """The corrected camera_to_world (4, 4) of a view."""
        known, given = self._of(view), np.asarray(view.camera_to_world, dtype=np.float64)
        pose = given.copy()
        pose[:3, :3] = so3_exp(known.rotation) @ given[:3, :3]
        pose[:3, 3] += known.shift_m
        return pose

    def _of(self, view: View) -> _Correction:
        given = np.asarray(view.camera_to_world, dtype=np.float64)
        known = self.known.get(view.camera)
        if known is None or not np.allclose(known.given, given, atol=1e-3):
            known = self.known[view.camera] = _Correction(given, np.zeros(3), np.zeros(3))
        return known

    def correct(
        self,
        view: View,
        render: Callable[[Array, Array], NDArray[np.float32]],
        pixel_m: float,
        rng: np.random.Generator,
        background: NDArray[np.float32],
    ) -> None:
        """One Gauss-Newton step for one camera.

        view: the camera's view. render: (pose (4, 4), image points (N, 2)) -> colors (N, 3).
        pixel_m: width of a pixel at the scene, the scale of all parameters.
        rng: chooses the pixels. background: float32 (3,), behind transparent pixels.
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
        robust = 1.0 / (1.0 + (np.square(error).sum(axis=1, keepdims=True) / _OUTLIER**2))
        # Sums by einsum without BLAS: its order of summation depends on the number of threads.
        total = np.concatenate([known.rotation, known.shift_m]) / scale
        hessian = np.einsum("inc,jnc,nk->ij", slopes, slopes, robust, optimize=False) / PIXELS
        gradient = np.einsum("inc,nc,nk->i", slopes, error, robust, optimize=False) / PIXELS
        # The prior follows the bounds: without it, rotations and shifts, which look alike from afar, would be
        # confused.
        bounds = np.array([self.most_rad] * 3 + [self.most_m] * 3) / scale
        prior = _PRIOR / np.square(np.maximum(bounds, 1e-3))
        step = -_STEP_SHARE * np.linalg.solve(hessian + np.diag(prior), gradient + prior * total)
        if not np.isfinite(step).all():
            return
        step = np.clip(step, -_LONGEST, _LONGEST) * scale
        known.rotation, known.shift_m = known.rotation + step[:3], known.shift_m + step[3:]
        everyone = list(self.known.values())
        mean_rotation = np.mean([c.rotation for c in everyone], axis=0)
        mean_shift = np.mean([c.shift_m for c in everyone], axis=0)
        for c in everyone:
            c.rotation = _at_most(c.rotation - mean_rotation, self.most_rad)
            c.shift_m = _at_most(c.shift_m - mean_shift, self.most_m)


class CameraRefinement:
    """Appearances and pose corrections of one field's cameras, each None unless enabled.

    embeddings: float32 (V, A), appearances of the views in training; A = 0: none.
    """

    def __init__(self, settings: TrainerSettings) -> None:
        s = settings
        self.seed = s.seed
        self.appearances = AppearanceEmbeddings(s.appearance, s.seed) if s.appearance else None
        self.poses = PoseCorrections(s.refine_m, s.refine_deg) if s.refine_m > 0 or s.refine_deg > 0 else None
        self.embeddings = np.zeros((0, 0), np.float32)

    @property
    def enabled(self) -> bool:
        """Whether anything is to be learned."""
        return not (self.appearances is self.poses is None)

    def corrected(self, views: Sequence[View], data: Views, box: SceneBox) -> Views:
        """``data`` with the corrections known by now; also updates ``embeddings``."""
        cameras = [v.camera for v in views]
        self.embeddings = np.zeros((len(views), 0), np.float32)
        if self.appearances is not None:
            self.embeddings = self.appearances.rows(cameras)
        if self.poses is not None:
            poses = np.stack([self.poses.pose(view) for view in views])
            data = data._replace(
                rotation=np.ascontiguousarray(poses[:, :3, :3]),
                origin=np.ascontiguousarray(box.normalise(poses[:, :3, 3])),
            )
        return data

    def learn(
        self,
        views: Sequence[View],
        data: Views,
        box: SceneBox,
        step: int,
        batch: Batch,
        make_renderer: Callable[[], RaySnapshot],
    ) -> Views:
        """Learn from a step; returns the corrected data.

        step: number of steps made. batch: of the last one.
        make_renderer: returns a renderer of the field as it is.
        """
        changed, cameras = False, [v.camera for v in views]
        if self.appearances is not None:
            self.appearances.learn(cameras, batch.d_embeddings, int(batch.rays.sum()))
            changed = True
        if self.poses is not None and step >= START and step % EVERY == 0:
            view, renderer = views[step // EVERY % len(views)], make_renderer()

            def render(pose: Array, points: Array) -> NDArray[np.float32]:
                return renderer.render_pixels(pose, view.intrinsics, points)[0]

            rng = np.random.default_rng(np.random.SeedSequence([self.seed, step, 1]))
            pixel_m = box.distance_m / view.intrinsics.fx
            self.poses.correct(view, render, pixel_m, rng, renderer.background)
            changed = True
        return self.corrected(views, data, box) if changed else data

    def meta(self) -> dict[str, Any]:
        """What a state keeps: exact, ready for JSON."""
        looks = self.appearances.meta() if self.appearances else {}
        return {
            **looks,
            "poses": {
                name: [c.given.tolist(), c.rotation.tolist(), c.shift_m.tolist()]
                for name, c in (self.poses.known.items() if self.poses else ())
            },
        }

    def load(self, meta: dict[str, Any]) -> None:
        """Restore what ``meta`` returned; what is not enabled here is left out."""
        if self.appearances is not None:
            self.appearances.load(meta)
        if self.poses is not None:
            known = meta.get("poses", {}).items()
            self.poses.known = {name: _Correction(*map(np.array, parts)) for name, parts in known}


def _at_most(vector: Array, most: float) -> Array:
    length = float(np.linalg.norm(vector))
    return vector if length <= most else vector * (most / length)
