"""nerfstudio's nerfacto in its torch implementation, which runs without a GPU."""

from __future__ import annotations

import logging
import time
from collections.abc import Sequence
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.experiments.bench.peer.contestant import Contestant, PeerMissing, on_white
from edge_server.experiments.scenes.multiview_still import MultiviewStill
from edge_server.fields import View

# Rays per step; with the default of 4096 one step takes half a minute on two cores.
RAYS = 1024
# The usual settings for the scenes of the Blender data set: an object at the origin, cameras at a distance of
# 4.
BLENDER = {
    "near_plane": 2.0,
    "far_plane": 6.0,
    "proposal_initial_sampler": "uniform",
    "disable_scene_contraction": True,
    "background_color": "white",
}


def nerfacto(scene: str, still: MultiviewStill, seed: int) -> Contestant:
    """nerfacto with its defaults (for ``lego``: ``BLENDER``), but fewer rays per step and no refinement of
    the poses, which are exact. Raises PeerMissing if nerfstudio cannot be imported."""
    try:
        import torch
        import torchmetrics.image.lpip
        from nerfstudio.cameras.camera_optimizers import CameraOptimizerConfig
        from nerfstudio.data.scene_box import SceneBox
        from nerfstudio.models import nerfacto as peer
    except ImportError as error:
        raise PeerMissing(f"nerfstudio cannot be imported: {error}") from None
    # Replaced because the model makes an LPIPS network for its evaluation, which needs torchvision and a
    # download.
    torchmetrics.image.lpip.LearnedPerceptualImagePatchSimilarity = torch.nn.Identity
    logging.getLogger("nerfstudio").setLevel(logging.ERROR)
    torch.manual_seed(seed)
    blender = scene == "lego"
    place = (np.zeros(3), 1.0) if blender else _normalization(still.training)
    edge = 1.5 if blender else 1.0  # half side of the scene box, as in nerfstudio's loaders
    config = peer.NerfactoModelConfig(
        implementation="torch", camera_optimizer=CameraOptimizerConfig(mode="off"), **(BLENDER if blender else {})
    )
    box = SceneBox(aabb=torch.tensor([[-edge] * 3, [edge] * 3]))
    model = config.setup(scene_box=box, num_train_data=len(still.training), metadata={})
    model.train()
    parameters = [p for group in model.get_param_groups().values() for p in group]
    optimizer = torch.optim.Adam(parameters, lr=1e-2, eps=1e-15)
    training = _cameras(still.training, *place)
    pixels = torch.tensor(np.stack([on_white(v.image) for v in still.training]))
    count, height, width = pixels.shape[:3]
    generator = torch.Generator().manual_seed(seed)
    before, after = _callbacks(model)
    steps = 0

    def train(seconds: float) -> float:
        nonlocal steps
        began = time.perf_counter()
        model.train()
        while (spent := time.perf_counter() - began) < seconds:
            for call in before:
                call(step=steps)
            k = torch.randint(count, (RAYS, 1), generator=generator)
            y = torch.randint(height, (RAYS,), generator=generator)
            x = torch.randint(width, (RAYS,), generator=generator)
            outputs = model(training.generate_rays(camera_indices=k, coords=torch.stack([y, x], 1) + 0.5))
            batch = {"image": pixels[k[:, 0], y, x]}
            losses = model.get_loss_dict(outputs, batch, model.get_metrics_dict(outputs, batch))
            optimizer.zero_grad()
            sum(losses.values()).backward()
            optimizer.step()
            for call in after:
                call(step=steps)
            steps += 1
        return spent

    def render(view: View) -> NDArray[np.float32]:
        model.eval()
        with torch.no_grad():
            color: NDArray[np.float32] = model.get_outputs_for_camera(_cameras([view], *place))["rgb"].numpy()
        return color

    return Contestant(train, render, lambda: steps)


def _cameras(views: Sequence[View], centre: NDArray[np.float64], scale: float) -> Any:
    """Convert cameras to nerfstudio's: OpenGL's axes, positions (world - centre) * scale."""
    import torch
    from nerfstudio.cameras.cameras import Cameras, CameraType

    poses = np.stack([v.camera_to_world for v in views])
    poses[:, :3, 3] = (poses[:, :3, 3] - centre) * scale
    poses[:, :3, 1:3] *= -1.0
    lenses = [v.intrinsics for v in views]
    of = {n: torch.tensor([getattr(k, n) for k in lenses], dtype=torch.float32) for n in ("fx", "fy", "cx", "cy")}
    return Cameras(
        camera_to_worlds=torch.tensor(poses[:, :3], dtype=torch.float32),
        **of,
        width=lenses[0].width,
        height=lenses[0].height,
        camera_type=CameraType.PERSPECTIVE,
    )


def _callbacks(model: Any) -> tuple[list[Any], list[Any]]:
    """nerfacto's callbacks before and after a step: the annealing of its proposals."""
    from nerfstudio.engine.callbacks import TrainingCallbackAttributes, TrainingCallbackLocation

    attributes = TrainingCallbackAttributes(optimizers=None, grad_scaler=None, pipeline=None, trainer=None)
    where = (TrainingCallbackLocation.BEFORE_TRAIN_ITERATION, TrainingCallbackLocation.AFTER_TRAIN_ITERATION)
    calls = model.get_training_callbacks(attributes)
    before, after = ([partial(c.run_callback_at_location, location=w) for c in calls] for w in where)
    return before, after


def _normalization(views: Sequence[View]) -> tuple[NDArray[np.float64], float]:
    """Center and scale that put all cameras into [-1, 1]^3, as in nerfstudio's loader."""
    places = np.stack([v.camera_to_world[:3, 3] for v in views])
    centre = places.mean(axis=0)
    return centre, float(1.0 / np.abs(places - centre).max())
