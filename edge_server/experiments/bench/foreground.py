"""Measures cost and gain of foreground segmentation, on images whose alpha is the truth (lego).

The images have no background, so they are composited over two: white, and clutter. The clutter depends only
on the viewing direction, so that all cameras see the same surroundings, infinitely far away. On the clutter a
field is fitted, with the same number of steps, to whole images, to segmented ones, and to the true alpha.
"""

from __future__ import annotations

import dataclasses
import statistics
import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from camera_node.sources.datasets.records import DatasetError
from edge_server.experiments.bench.run import RECORDINGS, BenchError, BenchRun, data_file
from edge_server.experiments.common.tables import markdown_table
from edge_server.experiments.scenes.recorded import load_recorded
from edge_server.fidelity.psnr import psnr
from edge_server.fields import Budget, View
from edge_server.fields.registry import make_field
from edge_server.foreground import BOX, GRABCUT, ForegroundConfig, Four
from edge_server.foreground.foreground import Foreground, make_foreground
from freshfield.geometry import world_rays
from freshfield.machine_load import LoadMeter

# Share of the image's side by which boxes are too large: the accuracy of a detector trained for the object.
BOX_MARGIN = 0.005
SIDES, ITERATIONS = (80, 160, 320), (1, 3, 5)
FIELD = "ngp"
_SEEN = 0.5  # alpha from which a pixel belongs to the object
_WAVES = 24
_CLUTTER_SEED = 17

Mask = NDArray[np.bool_]


def measure(run: BenchRun) -> dict[str, Any]:
    """Measure ``masks``: IoU and milliseconds of each segmentation, by background; and ``field``: PSNR on the
    object's pixels of held-out views after the same number of steps. Raises BenchError."""
    # Full size for masks, half for the field.
    large, small = _views(1.0), _views(2.0)
    some = large[:: 25 if run.quick else 10]
    load = LoadMeter()
    figures: dict[str, Any] = {"views": len(some), "size": [*some[0].image.shape[:2]], "masks": {}}
    for ground, compose in _BACKGROUNDS.items():
        figures["masks"][ground] = _masks(some, compose)
        print(f"  masks on {ground}: measured", flush=True)
    figures["field"] = _fields(small, steps=100 if run.quick else 500, seeds=1 if run.quick else 2)
    figures["outside_cores"] = load.outside_cores()
    return figures


def _views(scale: float) -> tuple[View, ...]:
    try:
        return load_recorded(data_file(RECORDINGS["lego"][0]), holdout="0", scale=scale).training
    except DatasetError as error:
        raise BenchError(str(error)) from None


def true_mask(view: View) -> Mask:
    """The object's pixels (H, W), by the image's alpha."""
    return view.image[..., 3] > 255 * _SEEN


def _white(view: View) -> NDArray[np.uint8]:
    return _composed(view, np.full((*view.image.shape[:2], 3), 255.0))


def _clutter(view: View) -> NDArray[np.uint8]:
    """Composite over waves in all directions and some edges, in all colors, with the object's contrast."""
    _, rays = world_rays(view.intrinsics, view.camera_to_world)
    rng = np.random.default_rng(_CLUTTER_SEED)
    waves = rng.normal(0.0, 9.0, (_WAVES, 3))
    shades = np.sin(rays @ waves.T + rng.uniform(0.0, 2 * np.pi, _WAVES))
    edges = np.sign(shades[..., : _WAVES // 3])
    mixed = np.concatenate([shades, edges], axis=-1) @ rng.normal(0.0, 1.0, (_WAVES + _WAVES // 3, 3))
    return _composed(view, 127.5 + 100.0 * np.tanh(mixed / 6.0))


def _composed(view: View, ground: NDArray[np.float64]) -> NDArray[np.uint8]:
    alpha = view.image[..., 3:] / 255.0
    return np.rint(view.image[..., :3] * alpha + ground * (1.0 - alpha)).astype(np.uint8)


_BACKGROUNDS: dict[str, Callable[[View], NDArray[np.uint8]]] = {"white": _white, "clutter": _clutter}


def true_box(view: View, margin: float = BOX_MARGIN) -> Four:
    """Left, top, right, bottom around the object, as shares of the image."""
    mask = true_mask(view)
    h, w = mask.shape
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    left, top = max(columns[0] / w - margin, 0.0), max(rows[0] / h - margin, 0.0)
    return left, top, min((columns[-1] + 1) / w + margin, 1.0), min((rows[-1] + 1) / h + margin, 1.0)


def _masks(views: Sequence[View], compose: Callable[[View], NDArray[np.uint8]]) -> dict[str, Any]:
    """By segmentation: mean and worst IoU with the truth, and median milliseconds per image."""
    boxes = {view.camera: true_box(view) for view in views}
    composed = [(view.camera, compose(view), true_mask(view)) for view in views]
    ways = {BOX: ForegroundConfig(boxes=boxes, segment=BOX)}
    for side in SIDES:
        for iterations in ITERATIONS:
            ways[f"{GRABCUT} side {side} x{iterations}"] = ForegroundConfig(
                boxes=boxes, segment=GRABCUT, side=side, iterations=iterations
            )
    found = {}
    for name, config in ways.items():
        cut = make_foreground(config)
        ious, spent_ms = [], []
        for camera, image, truth in composed:
            begun = time.perf_counter()
            rgba, _ = cut.apply(camera, image)
            spent_ms.append(1e3 * (time.perf_counter() - begun))
            ious.append(_iou(_foreground_mask(rgba), truth))
        found[name] = {
            "iou": statistics.fmean(ious),
            "worst": min(ious),
            "ms": statistics.median(spent_ms),
            "whole": len(composed) - cut.counts.masked,
        }
    return found


def _foreground_mask(image: NDArray[np.uint8]) -> Mask:
    """The pixels that an image still shows; all if it was passed on whole."""
    return image[..., 3] > 0 if image.shape[2] == 4 else np.ones(image.shape[:2], np.bool_)


def _iou(a: Mask, b: Mask) -> float:
    return float((a & b).sum() / max(int((a | b).sum()), 1))


def _fields(views: Sequence[View], steps: int, seeds: int) -> dict[str, Any]:
    """By set of training images: PSNR on the object's pixels of the held-out views (every eighth), mean and
    range over seeds; IoU of the training masks; seconds of fitting."""
    training = [view for k, view in enumerate(views) if k % 8]
    held_out = views[::8]
    boxes = {view.camera: true_box(view) for view in training}
    whole = [dataclasses.replace(view, image=_clutter(view)) for view in training]
    sets: dict[str, list[View]] = {"whole": whole}
    for name, segment, doubt in (
        (BOX, BOX, 1.0),
        (f"{GRABCUT}, doubt 1", GRABCUT, 1.0),
        (f"{GRABCUT}, doubt 0.3", GRABCUT, 0.3),
        (f"{GRABCUT}, doubt 0", GRABCUT, 0.0),
    ):
        cut = make_foreground(ForegroundConfig(boxes=boxes, segment=segment, doubt=doubt))
        sets[name] = [_cut(cut, view) for view in whole]
    sets["true alpha"] = [_with_alpha(seen, view) for seen, view in zip(whole, training)]
    found: dict[str, Any] = {"steps": steps, "seeds": seeds, "rows": {}}
    truths = [(view, view.image[..., :3] / 255.0, view.image[..., 3] == 255) for view in held_out]
    for name, fitted in sets.items():
        dbs, spent_s = [], []
        for seed in range(seeds):
            field = make_field(FIELD, {}, seed=seed)
            report = field.fit(fitted, Budget(steps=steps))
            spent_s.append(report.seconds)
            scores = [
                psnr(field.render(view.camera_to_world, view.intrinsics).color, truth, mask)
                for view, truth, mask in truths
            ]
            dbs.append(statistics.fmean(score for score in scores if score is not None))
        found["rows"][name] = {
            "object_db": statistics.fmean(dbs),
            "spread_db": max(dbs) - min(dbs),
            "iou": statistics.fmean(_iou(_foreground_mask(v.image), true_mask(o)) for v, o in zip(fitted, training)),
            "fit_s": statistics.median(spent_s),
        }
        print(f"  field on {name}: {found['rows'][name]['object_db']:.2f} dB on the object", flush=True)
    return found


def _cut(cut: Foreground, view: View) -> View:
    image, weight = cut.apply(view.camera, view.image)
    return dataclasses.replace(view, image=image, weight=weight)


def _with_alpha(seen: View, view: View) -> View:
    """``seen`` with the true mask: the object's edges include the background's color, as with any mask."""
    mask = true_mask(view)
    image = np.dstack([np.where(mask[..., None], seen.image, 0), np.where(mask, 255, 0)]).astype(np.uint8)
    return dataclasses.replace(seen, image=image)


def table(figures: dict[str, Any]) -> str:
    """Two tables: masks, field."""
    h, w = figures["size"]
    about = (
        f"lego at {w} x {h}, {figures['views']} views, box known to {100 * BOX_MARGIN:g} % of a side; "
        f"one thread; outside cores: {figures['outside_cores']}"
    )
    grounds = [figures["masks"][ground] for ground in _BACKGROUNDS]
    masks = [
        (
            name,
            *(c for m in grounds for c in (f"{m[name]['iou']:.3f} ({m[name]['worst']:.3f})", f"{m[name]['ms']:.1f}")),
        )
        for name in grounds[0]
    ]
    field = figures["field"]
    base = field["rows"]["whole"]["object_db"]
    fits = [
        (
            name,
            f"{row['iou']:.3f}",
            f"{row['object_db']:.2f}",
            f"{row['spread_db']:.2f}",
            f"{row['object_db'] - base:+.2f}",
            f"{row['fit_s']:.1f}",
        )
        for name, row in field["rows"].items()
    ]
    of_fits = (
        f"{FIELD}, {field['steps']} steps on 200 x 200 over clutter, {field['seeds']} seeds; PSNR on the "
        "object's pixels of 13 held-out views"
    )
    return "\n\n".join(
        (
            about,
            markdown_table(("segmentation", "IoU on white (worst)", "ms", "IoU on clutter (worst)", "ms"), masks),
            of_fits,
            markdown_table(("fitted to", "mask IoU", "dB", "spread", "against whole", "fit s"), fits),
        )
    )
