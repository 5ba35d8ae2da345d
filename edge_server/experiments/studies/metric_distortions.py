"""Figure 3.6: PSNR, SSIM and LPIPS of a brightness shift, a blur and a ghost."""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from camera_node.synthetic import make_scene
from edge_server.experiments.common.drawn_images import draw_images
from edge_server.experiments.common.seed_table import Row, SeedTable
from edge_server.experiments.common.tables import markdown_table
from edge_server.experiments.studies.study import Study, StudyRequest
from edge_server.experiments.studies.verdicts import Claim, better, better_than_all
from edge_server.fidelity.lpips_weights import open_lpips
from edge_server.fidelity.psnr import psnr
from edge_server.fidelity.ssim import ssim

# The thesis's table.
THESIS = {
    "brightness shift": (18.45, 0.8046, 0.0276),
    "Gaussian blur": (24.99, 0.8214, 0.3234),
    "local ghosting": (23.95, 0.9329, 0.0660),
}
Unit = NDArray[np.float32]


def distortions(reference: Unit) -> dict[str, Unit]:
    """Figure 3.6's three distortions of an image (H, W, 3) in [0, 1], each with nearly the PSNR of the
    thesis, so that SSIM and LPIPS can be compared."""
    return {case: _with_psnr(reference, case, THESIS[case][0]) for case in THESIS}


def distorted(reference: Unit, case: str, strength: float) -> Unit:
    """Apply one distortion. case: a key of THESIS.

    strength: the shift of all values, the sigma of the blur in image widths, or the weight of a shifted copy.
    """
    height, width = reference.shape[:2]
    if case == "brightness shift":
        return np.clip(reference + strength, 0.0, 1.0).astype(np.float32)
    if case == "Gaussian blur":
        return np.asarray(cv2.GaussianBlur(reference, (0, 0), max(strength * width, 1e-3)), np.float32)
    rows, columns = slice(height // 4, 3 * height // 4), slice(width // 4, 3 * width // 4)
    ghost = reference.copy()
    copy = np.roll(reference, round(0.06 * width), axis=1)
    ghost[rows, columns] = (1.0 - strength) * reference[rows, columns] + strength * copy[rows, columns]
    return ghost


# Highest strength of each distortion.
_STRONGEST = {"brightness shift": 0.5, "Gaussian blur": 0.1, "local ghosting": 1.0}


def _with_psnr(reference: Unit, case: str, wanted_db: float) -> Unit:
    """The distortion that has a PSNR, by bisection: PSNR falls as the strength grows."""
    low, high = 0.0, _STRONGEST[case]
    for _ in range(24):
        middle = (low + high) / 2
        reached_db = psnr(distorted(reference, case, middle), reference)
        weak = reached_db is None or reached_db > wanted_db
        low, high = (middle, high) if weak else (low, middle)
    return distorted(reference, case, high)


def _cases(request: StudyRequest) -> list[int]:
    return list(request.repeats(8, 19))


def _measure(seeds: Sequence[int], request: StudyRequest) -> list[Row]:
    """The metrics of each artifact of each camera's image."""
    lpips, missing = open_lpips(request.folders.lpips)
    if missing:
        print(f"  LPIPS is left out: {missing}")
    rows: list[Row] = []
    for seed in seeds:
        reference = _reference(seed)
        for case, image in distortions(reference).items():
            found = {"psnr_db": psnr(image, reference), "ssim": ssim(image, reference)}
            lpips_ = None if lpips is None else lpips(image, reference)
            rows.append({"scene": "room", "case": case, "seed": seed, **found, "lpips": lpips_})
    return rows


def _reference(seed: int) -> Unit:
    scene = make_scene("room", {"count": 19, "width": 192, "height": 192})
    cameras = list(scene.cameras)
    return scene.render(cameras[seed % len(cameras)], 0.3 * seed).astype(np.float32) / 255.0


def _draw(request: StudyRequest, table: SeedTable) -> None:
    reference = _reference(0)
    shown = [
        (label, (im * 255).astype(np.uint8))
        for label, im in [("reference", reference), *distortions(reference).items()]
    ]
    draw_images(request.figure("metrics.png"), [("room", shown)])


def _table(table: SeedTable) -> str:
    kinds = (("psnr_db", 2), ("ssim", 4), ("lpips", 4))
    rows = [
        [case, *(table.mean_text(metric, digits, case=case) for metric, digits in kinds)]
        for (case,) in table.distinct("case")
    ]
    return markdown_table(["artifact", "PSNR (dB)", "SSIM", "LPIPS"], rows)


SHIFT, BLUR, GHOST = ({"case": case} for case in THESIS)
METRIC_DISTORTIONS = Study(
    "metrics",
    "What the three metrics say of three artifacts (figure 3.6)",
    _cases,
    _measure,
    ("ssim",),
    (
        Claim(
            "lowest for the brightness shift (figure 3.6's table).", better_than_all(SHIFT, (BLUR, GHOST), worse=True)
        ),
        Claim("highest for ghosting, against the prose (figure 3.6's table).", better_than_all(GHOST, (SHIFT, BLUR))),
        Claim("brightness shift < ghosting (figure 3.6's table).", better(SHIFT, GHOST), metrics=("lpips",)),
        Claim("ghosting < blur (figure 3.6's table).", better(GHOST, BLUR), metrics=("lpips",)),
    ),
    draw=(_draw,),
    tables=_table,
)
