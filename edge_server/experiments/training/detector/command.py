"""``edge-server train-detector``: renders, trains, exports and measures; every step is resumable."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from edge_server.experiments.common.arguments import command_parser, run_command

DESCRIPTION = """\
Train the small detector whose backbone gives the default embeddings, on variations of our own scenes.

  edge-server train-detector --out runs/detector              # about 15 minutes on two cores
  edge-server train-detector --quick --out runs/try           # a minute: everything once, little learnt

Pictures and boxes are rendered (room, tower, tile with people, carts, balls and drums), the detector is
trained, exported to ONNX in float32 and in static 8 bits, and each is measured on worlds and cameras that
it has never seen. Ctrl-C stops after which the same command goes on; the same seed gives the same weights.
In OUT: detector_fp32.onnx, detector_int8.onnx, detector.json (log and quality). Use one:

  edge: {embedding: {model: runs/detector/detector_fp32.onnx}}
"""
HELD_OUT_WORLDS = 40


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit status."""
    args = _parser().parse_args(argv)
    try:
        import onnx  # noqa: F401
        import onnxruntime  # noqa: F401
        import torch  # noqa: F401
    except ModuleNotFoundError as error:
        print(
            f"edge-server train-detector needs {error.name}: pip install 'freshfield[edge,embed]'",
            file=sys.stderr,
        )
        return 2
    from edge_server.experiments.training.detector.training import CheckpointError

    def work() -> None:
        results = run(args)
        print(json.dumps(results) if args.json else show(results))

    stopped = f"the same command goes on with what is in {args.out}"
    return run_command("train-detector", work, (CheckpointError, FloatingPointError), stopped)


def run(args: argparse.Namespace) -> dict[str, Any]:
    """Run all steps; returns the contents of detector.json."""
    from edge_server.experiments.training.detector import export
    from edge_server.experiments.training.detector.average_precision import measure
    from edge_server.experiments.training.detector.dataset import of_own_rigs, render
    from edge_server.experiments.training.detector.network import parameters
    from edge_server.experiments.training.detector.scenes import KINDS
    from edge_server.experiments.training.detector.training import Settings, train
    from edge_server.report.machine import machine, versions
    from freshfield.files import write_json

    settings = Settings(args.seed, worlds=20, epochs=2) if args.quick else Settings(args.seed)
    args.out.mkdir(parents=True, exist_ok=True)
    side, pictures = settings.side, args.out / "pictures"
    known = render("train", settings.worlds, side, args.seed, pictures)
    unseen = render("held-out", 4 if args.quick else HELD_OUT_WORLDS, side, args.seed, pictures)
    model, log = train(known, settings, args.out / "checkpoint.pt")
    fp32, int8 = args.out / "detector_fp32.onnx", args.out / "detector_int8.onnx"
    export.export_fp32(model, side, fp32, {"author": "freshfield", "seed": args.seed})
    spread = export.add_projection(fp32, export.pooled_features(fp32, known.images))
    step = max(1, len(known) // export.CALIBRATION_IMAGES)
    export.export_int8(fp32, known.images[::step][: export.CALIBRATION_IMAGES], int8)
    quality: dict[str, Any] = {}
    rigs = of_own_rigs(side)
    for path in (fp32, int8):
        detect = export.runner(path)
        sets = {"unseen worlds": unseen, **{f"own rig of {name}": p for name, p in rigs.items()}}
        quality[path.stem] = {name: measure(detect, p) for name, p in sets.items()}
        quality[path.stem]["bytes"] = path.stat().st_size
    results = {
        "settings": asdict(settings), "kinds": KINDS, "parameters": parameters(model),
        "pictures": {"train": len(known), "held_out": len(unseen)}, "boxes": sum(map(len, known.boxes)),
        "quality": quality, "projection_variance": spread,
        "int8_agreement": _agreement(fp32, int8, unseen.images), "epochs": log,
        "trained_s": round(sum(row["seconds"] for row in log), 1),
        "machine": machine(), "versions": versions(),
    }  # fmt: skip
    write_json(args.out / "detector.json", results, indent=1)
    return results


def _agreement(fp32: Path, int8: Path, images: Any) -> dict[str, float]:
    """Cosines between both files' pooled features, after subtracting the float mean."""
    import numpy as np

    from edge_server.experiments.training.detector.export import pooled_features

    a, b = pooled_features(fp32, images), pooled_features(int8, images)
    a, b = a - a.mean(axis=0), b - a.mean(axis=0)
    cosine = (a * b).sum(axis=1) / (np.linalg.norm(a, axis=1) * np.linalg.norm(b, axis=1) + 1e-12)
    return {"cosine_mean": round(float(cosine.mean()), 4), "cosine_min": round(float(cosine.min()), 4)}


def show(results: dict[str, Any]) -> str:
    """The results as text."""
    pictures, agreement = results["pictures"]["train"], results["int8_agreement"]["cosine_mean"]
    lines = [f"{results['parameters']} parameters, {pictures} pictures, {results['boxes']} boxes"]
    for name, sets in results["quality"].items():
        lines.append(f"{name}: {sets['bytes'] / 1e3:.0f} kB")
        for where, found in sets.items():
            if isinstance(found, dict):
                lines.append(f"  {where:20} mAP@.5 {found['map50']:.3f}  mAP@.5:.95 {found['map50_95']:.3f}")
    lines.append(f"embedding of int8 against fp32: mean cosine {agreement:.4f}")
    return "\n".join(lines)


def _parser() -> argparse.ArgumentParser:
    parser = command_parser("train-detector", DESCRIPTION)
    add = parser.add_argument
    add("--out", type=Path, default=Path("runs/detector"), metavar="DIR", help="[%(default)s]")
    add("--seed", type=int, default=0, help="[%(default)s]")
    add("--quick", action="store_true", help="20 worlds, 2 epochs: to try it out")
    add("--json", action="store_true", help="print detector.json instead of a summary")
    return parser
