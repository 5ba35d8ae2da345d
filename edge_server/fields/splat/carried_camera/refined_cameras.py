"""A scan's estimates of its cameras, and how to render the views of cameras that it does not train on."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Self

import numpy as np

from edge_server.fields import Correction, View
from edge_server.fields.common.cameras.pose_corrections import PoseCorrections
from edge_server.fields.splat.carried_camera.exposures import Exposures
from edge_server.fields.splat.snapshot import SplatSnapshot


@dataclass(frozen=True)
class RefinedCameras:
    """Pose corrections and exposures of the training views."""

    poses: PoseCorrections
    exposures: Exposures

    def copied(self) -> RefinedCameras:
        """A copy that later steps do not change."""
        exposures = Exposures()
        exposures.known = dict(self.exposures.known)
        return RefinedCameras(self.poses.copied(), exposures)

    def correction(self, view: View) -> Correction:
        """How to render ``view``: as learned, else interpolated from its neighbors in time."""
        learned = self.poses.learned_pose(view)
        if learned is not None:
            return Correction(learned, *self.exposures.of(view.camera))
        track = self._track_of(view)
        view = self.poses.taken_back(view, track)
        neighbors = self.poses.neighbors_in_time(view, track)
        return Correction(self.poses.pose_between(view, neighbors), *self.exposures.between(neighbors))

    def _track_of(self, view: View) -> str:
        """The track of the view's camera, else the one whose views of that time are nearest to it: held-out frames may
        come from a training camera."""
        tracks = self.poses.tracks()
        if view.camera in tracks or len(tracks) < 2:
            return view.camera if view.camera in tracks else "".join(tracks)

        def apart_m(track: str) -> float:
            near = [self.poses.known[name].given for name in self.poses.neighbors_in_time(view, track)]
            here = self.poses.taken_back(view, track).camera_to_world[:3, 3]
            return min((float(np.linalg.norm(pose[:3, 3] - here)) for pose in near), default=np.inf)

        return min(tracks, key=apart_m)


@dataclass(frozen=True)
class ScanSnapshot(SplatSnapshot):
    """cameras: their estimates; None: there are none."""

    cameras: RefinedCameras | None = None

    def copied(self) -> Self:
        cameras = None if self.cameras is None else self.cameras.copied()
        return replace(self, params=self.params.copy(), cameras=cameras)

    def correction(self, view: View) -> Correction | None:
        """See ``fields.RefinesCameras``."""
        return None if self.cameras is None else self.cameras.correction(view)
