"""``edge-server train-perceptual``: fits the stand-in for LPIPS to real LPIPS and measures the
correlation."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.embed import MODELS, EmbeddingError
from edge_server.experiments.common.arguments import add_lpips, command_parser, run_command
from edge_server.fidelity.lpips_weights import open_lpips, weights_folder
from edge_server.fidelity.perceptual import COEFFICIENTS, DETECTOR, Layers, Perceptual, save_coefficients
from freshfield.files import out_folder, write_json

Array = NDArray[np.float64]

DESCRIPTION = """\
Fit the perceptual distance of the shipped detector's backbone (thesis 3.34, 3.35) to real LPIPS.

  edge-server train-perceptual --lpips ~/data/lpips --out runs/perceptual

Renderings of the synthetic scenes are distorted in ten ways (blur, noise, JPEG, exposure, stale, ghost,
coarse, displaced, floaters, warped) at random strength. Non-negative weights and a power are fitted to their
LPIPS; the rank correlation with LPIPS is measured on variations outside the fit, and on renderings of a field
in training. All of these are room, tower or tile; for other kinds of scenes, see the results with one scene
left out of the fit. Needs LPIPS weights; using the distance does not. In OUT: perceptual.npz and
perceptual.json.
"""
# Range of the power, and the start of its search.
POWERS, _START = (0.3, 2.0), 0.7
# Added to distances before taking their logarithm in the fit: a thousandth of the smallest relevant ones.
_NEAR = 1e-6
TRIES = 5  # number of distortions of each image
UNSEEN = "unseen variations"
_BATCH = 32
_REPORT_EVERY = 20  # batches


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit status."""
    args = _parser().parse_args(argv)

    def work() -> None:
        results = run(args)
        print(json.dumps(results) if args.json else show(results))

    stopped = f"the same command goes on with the pictures in {args.out}"
    try:
        return run_command("train-perceptual", work, (EmbeddingError, FitFailed), stopped)
    except ModuleNotFoundError as error:
        print(f"edge-server train-perceptual needs {error.name}: pip install 'freshfield[edge,embed]'", file=sys.stderr)
        return 2


class FitFailed(ValueError):
    """There is nothing to fit to; the message says what is missing."""


def run(args: argparse.Namespace) -> dict[str, Any]:
    """Render, distort, fit, measure and write; returns the contents of perceptual.json."""
    from edge_server.experiments.common.progress import Progress
    from edge_server.experiments.training.detector.dataset import LabeledImages, of_own_rigs, render, scenes_of
    from edge_server.experiments.training.detector.network import LAYERS
    from edge_server.experiments.training.detector.renderings import field_renderings

    lpips, missing = open_lpips(weights_folder(args.lpips), "alex")
    if lpips is None:
        raise FitFailed(f"real LPIPS is what is fitted to: {missing}")
    args.out.mkdir(parents=True, exist_ok=True)
    layers = Layers(MODELS / DETECTOR, tuple(f"model.{k}" for k in LAYERS))
    worlds, held, side = (8, 3, 64) if args.quick else (80, 20, 128)

    def distort(dataset: LabeledImages, purpose: str) -> tuple[NDArray[np.uint8], list[str]]:
        return pairs_of(dataset.images, np.random.default_rng([args.seed, *purpose.encode()]))

    def compare(pairs: NDArray[np.uint8], name: str) -> tuple[Array, Array]:
        """Differences (n, D) and LPIPS (n,)."""
        progress = Progress(len(pairs))
        x, y = [], []
        for first in range(0, len(pairs), _BATCH):
            shown, truth = (p[first : first + _BATCH] / 255.0 for p in (pairs[:, 0], pairs[:, 1]))
            x.append(layers.differences(shown, truth))
            y.append(lpips.batch(shown, truth))
            progress.advance(len(shown))
            if first // _BATCH % _REPORT_EVERY == _REPORT_EVERY - 1:
                progress.report(name, f"{first + len(shown)} of {len(pairs)} pairs", "compared")
        return np.concatenate(x), np.concatenate(y)

    folder = args.out / "pictures"
    known = render("perceptual", worlds, side, args.seed, folder)
    x, y = compare(distort(known, "perceptual")[0], "fit")
    weights, power = fit(x, y)
    unseen = render("perceptual-held-out", held, side, args.seed, folder)
    tests = {UNSEEN: distort(unseen, "unseen worlds")}
    for name, dataset in of_own_rigs(side).items():
        tests[f"own rig of {name}"] = distort(dataset, name)
    tests["field renderings"] = field_renderings(side, args.seed)
    rank, by_scene = {}, [Compared(x, y, scenes_of("perceptual", worlds, args.seed))]
    for name, (pairs, names) in tests.items():
        xt, yt = compare(pairs, name)
        rank[name] = correlation((xt @ weights) ** power, yt, names)
        if name == UNSEEN:
            by_scene.append(Compared(xt, yt, scenes_of("perceptual-held-out", held, args.seed)))
    split = np.split(weights, np.cumsum(layers.widths())[:-1])
    taps = tuple(layers.taps)
    Perceptual(layers, split, power)  # what is written can be read
    save_coefficients(args.out / COEFFICIENTS, taps, split, power)
    by_layer = [part.sum() for part in np.split((x * weights).sum(axis=0), np.cumsum(layers.widths())[:-1])]
    results = {
        "fitted_to": f"LPIPS-{lpips.network}",
        "pairs": len(y),
        "power": power,
        "seed": args.seed,
        "share_by_layer": {tap: round(float(s / sum(by_layer)), 3) for tap, s in zip(taps, by_layer)},
        "channels_used": int((weights > 0).sum()),
        "channels": len(weights),
        "unseen": rank,
        "scene_left_out_of_the_fit": left_out(by_scene),
    }
    write_json(args.out / "perceptual.json", results, indent=1)
    return results


def pairs_of(images: NDArray[np.uint8], rng: np.random.Generator) -> tuple[NDArray[np.uint8], list[str]]:
    """Pairs (n, 2, H, W, 3) of a distorted and a true image, and the name of each distortion. Neighbors in
    ``images`` must be different instants of the same view."""
    from edge_server.experiments.training.detector.distortions import distorted

    pairs, names = [], []
    for k, image in enumerate(images):
        other = images[k ^ 1] if k ^ 1 < len(images) else images[k]
        for _ in range(TRIES):
            shown, name = distorted(image, other, rng)
            pairs.append((shown, image))
            names.append(name)
    return np.array(pairs), names


def fit(x: Array, y: Array) -> tuple[Array, float]:
    """Fit non-negative weights (D,) and a power so that (x @ weights)^power approximates y (n,), by least
    squares of the square roots, which gives small distances more weight."""
    from scipy.optimize import minimize

    scale = x.mean(axis=0) + 1e-9
    root = np.sqrt(y)

    def error(z: Array) -> tuple[float, Array]:
        """Mean squared error and its gradient at weights * scale and the power."""
        distance = x @ (z[:-1] / scale) + _NEAR
        found = distance ** (0.5 * z[-1])
        off = found - root
        slope = off * found / len(y)  # derivative of half the error, times the distance over half the power
        by_weight = x.T @ (slope * z[-1] / distance) / scale
        return float((off * off).mean()), np.append(by_weight, (slope * np.log(distance)).sum())

    start = np.append(np.full(x.shape[1], float(np.mean(y ** (1.0 / _START))) / x.shape[1]), _START)
    bounds = [(0.0, None)] * x.shape[1] + [POWERS]
    best = minimize(error, start, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 3000})
    return np.asarray(best.x[:-1] / scale), float(best.x[-1])


@dataclass(frozen=True)
class Compared:
    """Differences (n, D) and LPIPS (n,) of pairs, and the scene of each image, which has ``TRIES`` pairs."""

    x: Array
    y: Array
    scenes: list[str]

    def of(self, scene: str, others: bool = False) -> tuple[Array, Array]:
        """The pairs of a scene, or those of all others."""
        chosen = (np.repeat(self.scenes, TRIES) == scene) != others
        return self.x[chosen], self.y[chosen]


def left_out(known: Sequence[Compared]) -> dict[str, Any]:
    """``correlation`` for each scene, with weights and power fitted to the other scenes, to estimate the
    quality for a new scene. (The backbone was trained on variations of all of them.)"""
    found = {}
    for scene in sorted(set(known[0].scenes)):
        x, y = known[0].of(scene, others=True)
        if not len(y):
            continue
        weights, power = fit(x, y)
        xs, ys = (np.concatenate(part) for part in zip(*(some.of(scene) for some in known)))
        found[scene] = correlation((xs @ weights) ** power, ys, [scene] * len(ys))
        del found[scene]["spearman_by_distortion"]
    return found


def correlation(found: Array, true: Array, names: Sequence[str]) -> dict[str, Any]:
    """Spearman's and Pearson's correlation, the mean error, and Spearman's for each single distortion."""
    from scipy.stats import pearsonr, spearmanr

    by_name = {}
    for name in sorted(set(names)):
        chosen = np.array([n == name for n in names])
        if "+" not in name and chosen.sum() >= 20 and np.ptp(true[chosen]) > 0:
            by_name[name] = round(float(spearmanr(found[chosen], true[chosen]).statistic), 3)
    return {
        "pairs": len(true),
        "spearman": round(float(spearmanr(found, true).statistic), 4),
        "pearson": round(float(pearsonr(found, true).statistic), 4),
        "mean_absolute_error": round(float(np.abs(found - true).mean()), 4),
        "spearman_by_distortion": by_name,
    }


def show(results: dict[str, Any]) -> str:
    """The results as text."""
    lines = [f"fitted to {results['fitted_to']} on {results['pairs']} pairs, power {results['power']:.2f}"]
    left = {f"{name} not fitted to": row for name, row in results["scene_left_out_of_the_fit"].items()}
    for name, found in (results["unseen"] | left).items():
        lines.append(
            f"  {name:20} Spearman {found['spearman']:.3f}  Pearson {found['pearson']:.3f}  "
            f"mean error {found['mean_absolute_error']:.3f}  ({found['pairs']} pairs)"
        )
    return "\n".join(lines)


def _parser() -> argparse.ArgumentParser:
    parser = command_parser("train-perceptual", DESCRIPTION)
    add = parser.add_argument
    add_lpips(parser)
    add("--out", type=out_folder, default="runs/perceptual", metavar="DIR", help="folder to write [%(default)s]")
    add("--seed", type=int, default=0, metavar="N", help="random seed [%(default)s]")
    add("--quick", action="store_true", help="8 scenes, small images: to try it out")
    add("--json", action="store_true", help="print perceptual.json instead of a summary")
    return parser
