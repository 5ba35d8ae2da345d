"""Figure 3.6: PSNR, SSIM and LPIPS of a brightness shift, a blur and a ghost."""

from __future__ import annotations

from itertools import pairwise

import cv2
import numpy as np
from numpy.typing import NDArray

from camera_node.synthetic import make_scene
from edge_server.experiments.common.statistics import Interval, all_of, interval, paired
from edge_server.experiments.studies.drawing import draw_images
from edge_server.experiments.studies.study import Study, StudyRequest, Table, Verdict, number
from edge_server.fidelity.lpips_weights import open_lpips
from edge_server.fidelity.psnr import psnr
from edge_server.fidelity.ssim import ssim
from freshfield.files import write_csv

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


class Metrics(Study):
    name = "metrics"
    title = "What the three metrics say of three artefacts (figure 3.6)"

    def report(self, request: StudyRequest, table: Table) -> list[Verdict]:
        lpips, missing = open_lpips(request.folders.lpips)
        scores: dict[str, dict[str, list[float | None]]] = {}
        examples: list[tuple[str, Unit]] = []
        scene = make_scene("room", {"count": 19, "width": 192, "height": 192})
        cameras = list(scene.cameras)
        for seed in request.repeats(8, 19):
            name = cameras[seed % len(cameras)]
            reference = scene.render(name, 0.3 * seed).astype(np.float32) / 255.0
            for case, image in distortions(reference).items():
                into = scores.setdefault(case, {"psnr": [], "ssim": [], "lpips": []})
                into["psnr"].append(psnr(image, reference))
                into["ssim"].append(ssim(image, reference))
                if lpips is not None:
                    into["lpips"].append(lpips(image, reference))
            if not examples:
                examples = [("reference", reference), *distortions(reference).items()]
        shown = [(label, (image * 255).astype(np.uint8)) for label, image in examples]
        draw_images(request.out / "metrics.png", [("room", shown)])
        rows = []
        for case, found in scores.items():
            psnr_db, ssim_, lpips_ = (number(interval(found[m]).mean, 4) for m in ("psnr", "ssim", "lpips"))
            rows.append({"case": case, "psnr_db": psnr_db, "ssim": ssim_, "lpips": lpips_, "seeds": len(found["psnr"])})
        write_csv(request.out / "metrics.csv", rows)
        verdicts = [
            self._ordering(scores, "ssim", "lowest for the brightness shift", "brightness shift", True),
            self._ordering(scores, "ssim", "highest for ghosting, against the prose", "local ghosting", False),
        ]
        if missing:
            print(f"  LPIPS is left out: {missing}")
            return verdicts
        order = [scores[c]["lpips"] for c in ("brightness shift", "local ghosting", "Gaussian blur")]
        gaps = [_gap(b, a) for a, b in pairwise(order)]
        text = ", ".join(f"{interval(values).mean:.3f}" for values in order)
        claim = "brightness shift < ghosting < blur (figure 3.6's table)."
        rising = all_of(gap.above(0.0) for gap in gaps)
        return [*verdicts, Verdict("LPIPS", claim, text + ".", rising, min(gaps, key=lambda gap: gap.mean))]

    def _ordering(self, scores: dict, metric: str, claim: str, case: str, lowest: bool) -> Verdict:
        mine = scores[case][metric]
        gaps = [_gap(v[metric], mine) if lowest else _gap(mine, v[metric]) for c, v in scores.items() if c != case]
        answer = all_of(gap.above(0.0) for gap in gaps)
        text = ", ".join(f"{c} {interval(v[metric]).mean:.3f}" for c, v in scores.items())
        return Verdict(
            metric.upper(), f"{claim} (figure 3.6's table).", text + ".", answer, min(gaps, key=lambda gap: gap.mean)
        )


def _gap(a: list[float | None], b: list[float | None]) -> Interval:
    """a - b, seed by seed."""
    return paired(dict(enumerate(a)), dict(enumerate(b)))
