"""Seconds to a quality, compared with peers on the same machine in the same run.

Peers: nerfstudio's nerfacto (its torch implementation, which is what runs without a GPU) where nerfstudio can
be imported, and our own field in plain torch, which does the same arithmetic as the kernels but for the
smoothness prior. Time spent on evaluation is not counted for anybody. nerfstudio is no dependency; to have it
as a peer: ``pip install nerfstudio`` in the same environment.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from camera_node.sources.datasets.records import DatasetError
from edge_server.experiments.bench.run import BenchError, BenchRun, open_recording
from edge_server.experiments.scenes.multiview_still import MultiviewStill
from edge_server.fidelity.psnr import psnr
from edge_server.fields import Budget, View
from edge_server.fields.ngp.field import NgpField
from edge_server.fields.ngp.settings import NgpSettings
from freshfield.machine_load import LoadMeter

TARGETS_DB = (20, 25)
QUICK_S, FULL_S = 60.0, 900.0
# Seconds of fitting between two evaluations: a peer needs ten seconds to render an image.
_FIRST_SLICE_S, _FIRST_PEER_SLICE_S, _GROWTH = 0.25, 4.0, 1.3
# Rays of a step of nerfacto: with its default of 4096 one step takes half a minute.
_RAYS = 1024
# Recordings, and by what their images are divided.
SCALES = {"lego": 4.0, "kitchen": 1.0}

# Trains for some seconds; renders a view to float32 (H, W, 3).
Contestant = tuple[Callable[[float], float], Callable[[View], np.ndarray]]


def measure(run: BenchRun) -> dict[str, Any]:
    """For every scene and contestant the seconds to each quality (None: not within ``limit_s``), and the
    ratio of a peer's time to that of our field; a lower bound where the peer did not reach it."""
    limit_s = QUICK_S if run.quick else FULL_S
    figures: dict[str, Any] = {"limit_s": limit_s, "nerfacto_missing": nerfacto_missing()}
    for name, scale in SCALES.items():
        try:
            still = open_recording(name, scale)
        except DatasetError as error:
            raise BenchError(str(error)) from None
        figures[name] = {"scene": still.describe(), **_race(still, limit_s)}
    return figures


def nerfacto_missing() -> str | None:
    """Why nerfacto cannot be measured here; None if it can."""
    try:
        import nerfstudio.models.nerfacto  # noqa: F401
    except ImportError as error:
        return f"nerfstudio cannot be imported: {error}"
    return None


def _race(still: MultiviewStill, limit_s: float) -> dict[str, Any]:
    ours = _seconds_to(*_ngp(still), still.held_out[0], limit_s, _FIRST_SLICE_S)
    rows: dict[str, Any] = {"ngp": ours}
    peers = {"plain_torch": _plain_torch, **({} if nerfacto_missing() else {"nerfacto": _nerfacto})}
    for name, enter in peers.items():
        row = rows[name] = _seconds_to(*enter(still), still.held_out[0], limit_s, _FIRST_PEER_SLICE_S)
        for target in TARGETS_DB:
            mine, theirs = ours[f"{target}_db_s"], row[f"{target}_db_s"]
            if mine is not None:
                row[f"{target}_db_ratio"] = (theirs or row["within_s"]) / mine
                row[f"{target}_db_reached"] = theirs is not None
    return rows


def _seconds_to(
    train: Callable[[float], float], render: Callable[[View], np.ndarray], truth: View, limit_s: float,
    slice_s: float,
) -> dict[str, Any]:  # fmt: skip
    load = LoadMeter()
    reached: dict[int, float | None] = dict.fromkeys(TARGETS_DB)
    spent, best = 0.0, 0.0
    while spent < limit_s and best < TARGETS_DB[-1]:
        spent += train(slice_s)
        slice_s *= _GROWTH
        best = max(best, psnr(render(truth), _on_white(truth.image)) or 0.0)
        for target in TARGETS_DB:
            if best >= target and reached[target] is None:
                reached[target] = spent
    return {
        **{f"{target}_db_s": seconds for target, seconds in reached.items()},
        "best_db": best,
        "within_s": spent,
        "outside_cores": load.outside_cores(),
    }


def _ngp(still: MultiviewStill) -> Contestant:
    field = NgpField(NgpSettings(device="cpu"))
    field.warm_up()
    return _of_field(field, still)


def _plain_torch(still: MultiviewStill) -> Contestant:
    from edge_server.fields.ngp.torch_field import NgpTorchField

    return _of_field(NgpTorchField(NgpSettings(device="cpu"), device="cpu"), still)


def _of_field(field: Any, still: MultiviewStill) -> Contestant:
    def train(seconds: float) -> float:
        spent: float = field.fit(still.training, Budget(seconds=seconds)).seconds
        return spent

    return train, lambda view: field.render(view.camera_to_world, view.intrinsics).color


def _nerfacto(still: MultiviewStill) -> Contestant:
    """nerfacto with its own defaults, but fewer rays a step, white ground and no refinement of exact poses.

    Poses go in with OpenGL's axes, centred and scaled as nerfstudio's own loader does it.
    """
    import torch
    import torchmetrics.image.lpip
    from nerfstudio.cameras.camera_optimizers import CameraOptimizerConfig
    from nerfstudio.cameras.cameras import Cameras, CameraType
    from nerfstudio.data.scene_box import SceneBox
    from nerfstudio.engine.callbacks import TrainingCallbackAttributes, TrainingCallbackLocation
    from nerfstudio.models import nerfacto

    # The model makes an LPIPS network for its own evaluation, which needs torchvision and a download.
    torchmetrics.image.lpip.LearnedPerceptualImagePatchSimilarity = torch.nn.Identity
    logging.getLogger("nerfstudio").setLevel(logging.ERROR)
    torch.manual_seed(0)
    centre, scale = _normalisation(still.training)

    def cameras(views: Sequence[View]) -> Any:
        poses = np.stack([v.camera_to_world for v in views])
        poses[:, :3, 3] = (poses[:, :3, 3] - centre) * scale
        poses[:, :3, 1:3] *= -1.0
        lenses = [v.intrinsics for v in views]
        return Cameras(
            camera_to_worlds=torch.tensor(poses[:, :3], dtype=torch.float32),
            **{n: torch.tensor([getattr(k, n) for k in lenses], dtype=torch.float32)
               for n in ("fx", "fy", "cx", "cy")},
            width=lenses[0].width,
            height=lenses[0].height,
            camera_type=CameraType.PERSPECTIVE,
        )  # fmt: skip

    plain = still.training[0].image.shape[2] == 4
    model = nerfacto.NerfactoModelConfig(
        implementation="torch",
        background_color="white" if plain else "last_sample",
        camera_optimizer=CameraOptimizerConfig(mode="off"),
    ).setup(
        scene_box=SceneBox(aabb=torch.tensor([[-1.0, -1.0, -1.0], [1.0, 1.0, 1.0]])),
        num_train_data=len(still.training),
        metadata={},
    )
    model.train()
    groups = model.get_param_groups()
    optimizer = torch.optim.Adam([p for g in groups.values() for p in g], lr=1e-2, eps=1e-15)
    training = cameras(still.training)
    pixels = torch.tensor(np.stack([_on_white(v.image) for v in still.training]))
    count, height, width = pixels.shape[:3]
    generator = torch.Generator().manual_seed(0)
    nothing = TrainingCallbackAttributes(optimizers=None, grad_scaler=None, pipeline=None, trainer=None)
    callbacks = model.get_training_callbacks(nothing)  # the annealing of its proposals
    steps = 0

    def train(seconds: float) -> float:
        nonlocal steps
        began = time.perf_counter()
        model.train()
        while (spent := time.perf_counter() - began) < seconds:
            for callback in callbacks:
                callback.run_callback_at_location(steps, TrainingCallbackLocation.BEFORE_TRAIN_ITERATION)
            k = torch.randint(count, (_RAYS, 1), generator=generator)
            y = torch.randint(height, (_RAYS,), generator=generator)
            x = torch.randint(width, (_RAYS,), generator=generator)
            coords = torch.stack([y, x], 1) + 0.5
            bundle = training.generate_rays(camera_indices=k, coords=coords)
            outputs = model(bundle)
            batch = {"image": pixels[k[:, 0], y, x]}
            losses = model.get_loss_dict(outputs, batch, model.get_metrics_dict(outputs, batch))
            optimizer.zero_grad()
            sum(losses.values()).backward()
            optimizer.step()
            for callback in callbacks:
                callback.run_callback_at_location(steps, TrainingCallbackLocation.AFTER_TRAIN_ITERATION)
            steps += 1
        return spent

    def render(view: View) -> np.ndarray:
        model.eval()
        with torch.no_grad():
            color = model.get_outputs_for_camera(cameras([view]))["rgb"]
        out: np.ndarray = color.numpy()
        return out

    return train, render


def _normalisation(views: Sequence[View]) -> tuple[np.ndarray, float]:
    """Centre and scale that put all cameras into [-1, 1]^3, as nerfstudio's loader does."""
    places = np.stack([v.camera_to_world[:3, 3] for v in views])
    centre = places.mean(axis=0)
    return centre, float(1.0 / np.abs(places - centre).max())


def _on_white(image: np.ndarray) -> np.ndarray:
    unit = image.astype(np.float32) / 255.0
    if unit.shape[2] == 4:
        alpha = unit[..., 3:]
        unit = unit[..., :3] * alpha + (1.0 - alpha)
    return unit
