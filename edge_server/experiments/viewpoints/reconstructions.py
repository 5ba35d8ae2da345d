"""Reconstructions from different views, to be compared by people and simulated experts."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_server.experiments.viewpoints import capture_constants as tuned
from edge_server.experiments.viewpoints.stage import Stage
from edge_server.fidelity.images import to_bytes, to_unit
from edge_server.fields import Field
from edge_server.viewpoints.candidates import Candidates
from edge_server.viewpoints.capture_planner import Budget, Plan, plan_capture
from edge_server.viewpoints.experts import judge
from edge_server.viewpoints.registry import make_selector
from freshfield.files import write_bytes, write_json
from freshfield.geometry import so3_exp

Array = NDArray[np.float64]


def varied_plan(stage: Stage, k: int, views: int) -> Plan:
    """Plan ``k`` of many different ones: made by several selectors, every third of one side only."""
    rng = np.random.default_rng(k)
    candidates = stage.candidates
    if k % 3 == 1:
        angle = candidates.directions @ candidates.directions[rng.integers(len(candidates))]
        least = max(views, len(candidates) // 5)
        usable = [i for i in np.argsort(-angle) if candidates.reachable[i]]
        nearest = usable[: int(rng.integers(least, max(least + 1, len(candidates) // 2)))]
        candidates = candidates.within(np.isin(np.arange(len(candidates)), nearest))
    name = ("random", "random", "coverage")[k % 3]
    weight = float(rng.choice([0.0, 0.0, 0.5]))
    return plan_capture(candidates, make_selector(name), Budget(views=views), stage.take, seed=k, travel_weight=weight)


def taste_score(stage: Stage, field: Field, taste: str) -> float:
    """The score of a field by a taste (``experts.TASTES``), over the held-out views."""
    shown = [field.render(v.camera_to_world, v.intrinsics).color for v in stage.held_out]
    return judge(taste, shown, [to_unit(v.image, background=stage.background) for v in stage.held_out])


def viewing_path(candidates: Candidates, frames: int = tuned.PATH_FRAMES) -> list[Array]:
    """Poses (4, 4) along an arc round the target, through the middle of the reachable candidates."""
    reachable = np.flatnonzero(candidates.reachable)
    away = candidates.directions[reachable]
    pose = candidates.poses[reachable[np.argmax(away @ away.mean(axis=0))]]
    right, up, back = pose[:3, 0], -pose[:3, 1], -pose[:3, 2]
    low, high = np.quantile(np.arctan2(away @ right, away @ back), [0.1, 0.9])
    farthest = np.deg2rad(tuned.PATH_FARTHEST_DEG)
    made = []
    for angle in np.linspace(max(low, -farthest), min(high, farthest), frames):
        turn = so3_exp(angle * up)
        turned = np.eye(4)
        turned[:3, :3] = turn @ pose[:3, :3]
        turned[:3, 3] = candidates.target + turn @ (pose[:3, 3] - candidates.target)
        made.append(turned)
    return made


def sprite(stage: Stage, field: Field) -> bytes:
    """Render a reconstruction along the path, as a JPEG with PATH_FRAMES images, PATH_COLUMNS in a row."""
    lens = stage.candidates.lens
    lens = lens.scaled(min(1.0, tuned.PATH_WIDEST_PX / lens.width))
    shown = [to_bytes(field.render(pose, lens).color) for pose in viewing_path(stage.candidates)]
    columns = tuned.PATH_COLUMNS
    rows = [np.concatenate(shown[k : k + columns], axis=1) for k in range(0, tuned.PATH_FRAMES, columns)]
    bgr = np.concatenate(rows)[..., ::-1]
    return cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, tuned.PATH_JPEG_QUALITY])[1].tobytes()


def varied_plans(stage: Stage, count: int, views: int, seed: int) -> list[Plan]:
    """``count`` different plans; fewer if some of them are equal."""
    plans = [varied_plan(stage, seed * count + k, views) for k in range(count)]
    return list({tuple(plan.order): plan for plan in plans}.values())


def identity(stage: Stage, plans: Sequence[Plan], steps: int, seed: int) -> str:
    """Digest of everything that determines reconstructions: plans, held-out images and settings of the
    fits."""
    found = hashlib.sha256(repr(([p.order for p in plans], stage.options, steps, seed)).encode())
    for view in stage.held_out:
        found.update(view.image.tobytes())
    return found.hexdigest()[:16]


def sprites(
    stage: Stage, plans: list[Plan], steps: int, seed: int, folder: Path, progress: Callable[[int], None]
) -> list[bytes]:
    """The ``sprite`` of each plan, cached in ``folder``.

    progress: called with the index of each new one.
    Raises OSError.
    """
    about = {"scenario": stage.name, "made_of": identity(stage, plans, steps, seed)}
    files = [folder / f"{k:03d}.jpg" for k in range(len(plans))]
    try:
        if json.loads((folder / "about.json").read_text()) == about:
            return [file.read_bytes() for file in files]
    except (OSError, ValueError):
        pass
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "about.json").unlink(missing_ok=True)  # until all files are new
    for k, plan in enumerate(plans):
        write_bytes(files[k], sprite(stage, stage.fit(plan.views, steps, seed)))
        progress(k)
    write_json(folder / "about.json", about)
    return [file.read_bytes() for file in files]
