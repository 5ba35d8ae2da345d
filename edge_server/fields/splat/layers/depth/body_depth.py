"""What a frame's measured depth says of what moves: where it is, new Gaussians there, and where nothing is.

Imported only where frames bring depth.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.scene_box import SceneBox
from edge_server.fields.splat.kernels.optimizer_step import clamp_gaussians
from edge_server.fields.splat.kernels.project import COLOR, OPACITY, QUATERNION, SCALE
from edge_server.fields.splat.layers.depth import layer_depth_constants as tuned
from edge_server.fields.splat.layers.depth.kernels.body_depth import count_seen_through, measure_body
from edge_server.fields.splat.layers.observations import FixedCamera, Observation, Observations


def measured_frames(observations: Observations, cameras: dict[str, FixedCamera]) -> list[Observation]:
    """The newest frame with depth of each camera, oldest first, with ``Observation.body_m``; none where these frames
    measured nothing that moves."""
    newest: dict[str, Observation] = {}
    for o in observations:
        if o.view.depth is not None and o.instant_s >= observations.newest_s - tuned.BODY_AGE_S:
            newest[o.camera] = o
    for o in newest.values():
        if o.body_m is None:
            o.body_m = body_depth(o, cameras[o.camera])
    pixels = sum(int((o.body_m > 0.0).sum()) for o in newest.values() if o.body_m is not None)
    return sorted(newest.values()) if pixels >= tuned.BODY_PIXELS else []


def body_depth(observation: Observation, camera: FixedCamera) -> NDArray[np.float32]:
    """Depth of what moves in a frame, float32 (H, W), in the frame's meters, 0 elsewhere."""
    depth, image, plate = observation.view.depth, observation.view.image, camera.depth
    assert depth is not None and plate is not None
    inverse, body = np.empty_like(depth), np.empty_like(depth)
    # Where neither color nor depth of the plate is known, nothing tells what moves from what stands still. Where its
    # color is known, it is too far or too dark to be measured: what is measured there is nearer.
    tells = camera.plate.known | (plate.count >= tuned.LEAST)
    where, color = observation.foreground & tells, camera.plate.picture
    measure_body(depth, where, image, color, plate.samples, plate.count, inverse, body)
    return body


def seed_at_depth(
    observation: Observation, camera: FixedCamera, box: SceneBox, columns: int, all_pixels: bool
) -> NDArray[np.float32]:
    """Parameters of a new Gaussian in each pixel with ``body_m`` that is shown wrongly, float32 (N, columns).

    all_pixels: in each pixel with ``body_m``.
    """
    view, body_m = observation.view, observation.body_m
    assert body_m is not None
    y, x = np.nonzero((body_m > 0.0) & (all_pixels | observation.shown_wrongly(tuned.BODY_WRONG)))
    lens, pose, depth_m = view.intrinsics, view.camera_to_world, camera.depth_scale * body_m[y, x].astype(np.float64)
    rays = lens.rays(np.stack([x + 0.5, y + 0.5], axis=-1))
    places_m = (rays * (depth_m / rays[:, 2])[:, None]) @ pose[:3, :3].T + pose[:3, 3]
    params = np.zeros((len(x), columns), np.float32)
    params[:, :3] = box.normalise(places_m)
    params[:, SCALE:QUATERNION] = np.log(tuned.BODY_SEED_PX * depth_m / (lens.fx * box.radius_m))[:, None]
    params[:, QUATERNION] = 1.0
    params[:, OPACITY] = np.log(tuned.BODY_OPACITY / (1.0 - tuned.BODY_OPACITY))
    params[:, COLOR : COLOR + 3] = view.image[y, x] / 255.0
    clamp_gaussians(params)
    return params


def seen_through(
    places: Sequence[NDArray[np.float32]], frames: Sequence[Observation], cameras: dict[str, FixedCamera], box: SceneBox
) -> NDArray[np.bool_]:
    """Whether a frame measured something behind each Gaussian, bool (N,).

    places: for each frame float32 (N, 3), the Gaussians at its instant, scene units.
    """
    through = np.zeros(len(places[0]), np.int32)
    for points, o in zip(places, frames, strict=True):
        if o.view.depth is not None:
            camera = cameras[o.camera]
            scale = np.float32(camera.depth_scale / box.radius_m)
            count_seen_through(camera.row, points, o.view.depth, scale, through)
    return through > 0
