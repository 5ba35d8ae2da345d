"""``edge-server train-detector``: renders images, trains, exports and measures; every step is resumable."""

from __future__ import annotations

import argparse
import hashlib
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from edge_server.experiments.common.arguments import at_least, command_parser, run_command
from freshfield.files import out_folder, write_json

DESCRIPTION = """\
Train a small detector on variations of the synthetic scenes: the one whose backbone gives the default
embeddings, or one that finds an object to scan and segments it.

  edge-server train-detector --out runs/detector              # about 15 minutes on two cores
  edge-server train-detector --of tile --out runs/tile        # about 20
  edge-server train-detector --quick --out runs/try           # a minute: every stage once, little is learned

Images and boxes are rendered (room, tower, tile with people, carts, balls and drums; --of tile: the tile
among other things, with its masks); the detector is trained, exported to ONNX in float32 and in static int8,
and each export is evaluated on scenes and cameras that it has never seen. After Ctrl-C the same command
continues; the same seed gives the same weights. --start begins from the weights of an earlier training. In
OUT: detector_fp32.onnx, detector_int8.onnx, detector.json (log and quality), with --of tile tile_fp32.onnx
and so on. To use one:

  edge: {embedding: {model: runs/detector/detector_fp32.onnx}}
  edge: {foreground: {detector: runs/tile/tile_int8.onnx}}
"""
HELD_OUT_WORLDS = 40
SIDE = 128  # pixels, of the pictures


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit status."""
    args = _parser().parse_args(argv)
    try:
        import onnx  # noqa: F401
        import onnxruntime  # noqa: F401
        import torch  # noqa: F401
    except ModuleNotFoundError as error:
        print(f"edge-server train-detector needs {error.name}: pip install 'freshfield[edge,embed]'", file=sys.stderr)
        return 2
    from edge_server.experiments.training.detector.training import CheckpointError

    def work() -> None:
        results = run(args)
        print(json.dumps(results) if args.json else show(results))

    stopped = f"the same command goes on with what is in {folder(args)}"
    return run_command("train-detector", work, (CheckpointError, FloatingPointError), stopped)


def run(args: argparse.Namespace) -> dict[str, Any]:
    """Run all steps; returns the contents of detector.json."""
    from edge_server.experiments.training.detector import export
    from edge_server.experiments.training.detector.average_precision import measure
    from edge_server.experiments.training.detector.dataset import SUBJECTS, of_own_rigs, render
    from edge_server.experiments.training.detector.network import parameters
    from edge_server.experiments.training.detector.training import Settings, train
    from edge_server.report.machine import machine, versions

    worlds, epochs, held = (20, 2, 4) if args.quick else (args.worlds, args.epochs, HELD_OUT_WORLDS)
    subject, kinds, out = args.of, SUBJECTS[args.of], folder(args)
    start = "" if args.start is None else file_digest(args.start)
    settings = Settings(args.seed, SIDE, worlds, epochs, args.rate, subject=subject, start=start)
    out.mkdir(parents=True, exist_ok=True)
    pictures = out / "pictures"
    known = render("train", worlds, SIDE, args.seed, pictures, subject)
    unseen = render("held-out", held, SIDE, args.seed, pictures, subject)
    model, log = train(known, settings, out / "checkpoint.pt", args.start)
    name = "detector" if subject == "scenes" else subject
    fp32, int8 = out / f"{name}_fp32.onnx", out / f"{name}_int8.onnx"
    export.export_fp32(model, SIDE, fp32, {"author": "freshfield", "seed": args.seed}, kinds)
    more: dict[str, Any] = {}
    if known.masks is None:
        more["projection_variance"] = export.add_projection(fp32, export.pooled_features(fp32, known.images))
    step = max(1, len(known) // export.CALIBRATION_IMAGES)
    export.export_int8(fp32, known.images[::step][: export.CALIBRATION_IMAGES], int8)
    quality: dict[str, Any] = {}
    sets = {"unseen worlds": unseen}
    sets |= {f"own rig of {where}": p for where, p in of_own_rigs(SIDE, subject).items()}
    for path in (fp32, int8):
        detect = export.runner(path)
        quality[path.stem] = {where: measure(detect, p, kinds) for where, p in sets.items()}
        quality[path.stem]["bytes"] = path.stat().st_size
    if known.masks is None:
        more["int8_agreement"] = _agreement(fp32, int8, unseen.images)
    else:
        more["masks"] = _masks(fp32, int8, sets)
    results = {
        "settings": asdict(settings),
        "kinds": kinds,
        "parameters": parameters(model),
        "pictures": {"train": len(known), "held_out": len(unseen)},
        "boxes": sum(map(len, known.boxes)),
        "quality": quality,
        **more,
        "epochs": log,
        "trained_s": round(sum(row["seconds"] for row in log), 1),
        "machine": machine(),
        "versions": versions(),
    }
    write_json(out / f"{name}.json", results, indent=1)
    return results


def file_digest(path: Path) -> str:
    """SHA-256 of a file, in hexadecimal. Raises CheckpointError if it cannot be read."""
    from edge_server.experiments.training.detector.training import CheckpointError

    try:
        return hashlib.sha256(path.read_bytes()).hexdigest()
    except OSError as error:
        raise CheckpointError(f"--start {path}: cannot be read: {error.strerror}") from None


def folder(args: argparse.Namespace) -> Path:
    """The output folder."""
    default = Path("runs/detector" if args.of == "scenes" else f"runs/detector-{args.of}")
    return default if args.out is None else Path(args.out)


def _masks(fp32: Path, int8: Path, sets: dict[str, Any]) -> dict[str, Any]:
    """Quality of the masks of both files."""
    from edge_server.experiments.training.detector.mask_quality import measure_masks

    return {path.stem: {where: measure_masks(path, p) for where, p in sets.items()} for path in (fp32, int8)}


def _agreement(fp32: Path, int8: Path, images: Any) -> dict[str, float]:
    """Cosine similarities of both files' pooled features, after subtracting the float mean."""
    import numpy as np

    from edge_server.experiments.training.detector.export import pooled_features

    a, b = pooled_features(fp32, images), pooled_features(int8, images)
    a, b = a - a.mean(axis=0), b - a.mean(axis=0)
    cosine = (a * b).sum(axis=1) / (np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1) + 1e-12)
    return {"cosine_mean": round(float(cosine.mean()), 4), "cosine_min": round(float(cosine.min()), 4)}


def show(results: dict[str, Any]) -> str:
    """The results as text."""
    pictures = results["pictures"]["train"]
    lines = [f"{results['parameters']} parameters, {pictures} pictures, {results['boxes']} boxes"]
    for name, sets in results["quality"].items():
        lines.append(f"{name}: {sets['bytes'] / 1e3:.0f} kB")
        for where, found in sets.items():
            if isinstance(found, dict):
                lines.append(f"  {where:20} mAP@.5 {found['map50']:.3f}  mAP@.5:.95 {found['map50_95']:.3f}")
    for name, by_set in results.get("masks", {}).items():
        lines.append(f"masks of {name}:")
        for where, found in by_set.items():
            words = [f"found {100 * found['found']:.1f} %", f"IoU {found['iou'] or 0.0:.3f}"]
            if found["false_alarms"] is not None:
                words.append(f"false alarms {100 * found['false_alarms']:.1f} %")
            lines.append(f"  {where:30} {', '.join(words)}")
    if "int8_agreement" in results:
        agreement = results["int8_agreement"]["cosine_mean"]
        lines.append(f"embedding of int8 against fp32: mean cosine {agreement:.4f}")
    return "\n".join(lines)


def _parser() -> argparse.ArgumentParser:
    parser = command_parser("train-detector", DESCRIPTION)
    add = parser.add_argument
    add(
        "--of",
        choices=("scenes", "tile"),
        default="scenes",
        help="what to detect: people, carts, balls and drums (scenes), or the tile with its mask [%(default)s]",
    )
    add(
        "--out",
        type=out_folder,
        metavar="DIR",
        help="folder to write [runs/detector; with --of tile runs/detector-tile]",
    )
    add("--seed", type=int, default=0, metavar="N", help="random seed [%(default)s]")
    add(
        "--worlds",
        type=at_least(20),
        default=400,
        metavar="N",
        help="number of training scenes, 8 images each [%(default)s]",
    )
    add("--epochs", type=at_least(1), default=18, metavar="N", help="training epochs [%(default)s]")
    add("--rate", type=float, default=2e-3, help="learning rate [%(default)s]")
    add("--start", type=Path, metavar="FILE", help="checkpoint.pt of an earlier training to begin from")
    add("--quick", action="store_true", help="20 scenes, 2 epochs: to try it out")
    add("--json", action="store_true", help="print detector.json instead of a summary")
    return parser
