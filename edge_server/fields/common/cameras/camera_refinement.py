"""Camera refinement while a field trains: each camera's appearance, and small corrections of its pose.

Both are off by default, cost nothing then, and serve every representation of ``trained_field``. Pictures are
rendered at the mean appearance and at the given pose.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import View
from edge_server.fields.common.cameras import camera_refinement_constants as tuned
from edge_server.fields.common.cameras.appearance import AppearanceEmbeddings
from edge_server.fields.common.cameras.pose_corrections import PoseCorrections
from edge_server.fields.common.kernels.rays import Views
from edge_server.fields.common.kernels.train import Batch
from edge_server.fields.common.ray_snapshot import RaySnapshot
from edge_server.fields.common.scene_box import SceneBox
from edge_server.fields.common.settings import TrainerSettings

Array = NDArray[np.float64]


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
        if self.poses is not None and step >= tuned.START and step % tuned.EVERY == 0:
            view, renderer = views[step // tuned.EVERY % len(views)], make_renderer()

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
        return {**looks, "poses": self.poses.meta() if self.poses else {}}

    def load(self, meta: dict[str, Any]) -> None:
        """Restore what ``meta`` returned; what is not enabled here is left out."""
        if self.appearances is not None:
            self.appearances.load(meta)
        if self.poses is not None:
            self.poses.load(meta.get("poses", {}))
