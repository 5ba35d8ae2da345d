"""``edge-server train-detector``: renders images, trains, exports and measures; every step is resumable."""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from dataclasses import asdict
from typing import Any

from edge_server.experiments.common.arguments import at_least, command_parser, run_command
from freshfield.files import out_folder, write_json

DESCRIPTION = """\
Train a small detector on variations of the synthetic scenes: the one whose backbone gives the default
embeddings.

  edge-server train-detector --out runs/detector              # about 15 minutes on two cores
  edge-server train-detector --quick --out runs/try           # a minute: every stage once, little is learned

Images and boxes are rendered (room, tower, tile with people, carts, balls and drums); the detector is
trained, exported to ONNX, and evaluated on scenes and cameras that it has never seen. After Ctrl-C the same
command continues; the same seed gives the same weights. In OUT: detector.onnx and detector.json (log and
quality). To use it:

  edge: {embedding: {model: runs/detector/detector.onnx}}
"""
HELD_OUT_WORLDS = 40
SIDE = 128  # pixels, of the pictures


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command; returns its exit status."""
    args = _parser().parse_args(argv)
    try:
        import onnx  # noqa: F401
        import onnxruntime  # noqa: F401
        import pycocotools  # noqa: F401
        import torch  # noqa: F401
    except ModuleNotFoundError as error:
        print(
            f"edge-server train-detector needs {error.name}: pip install 'freshfield[edge,embed,detector]'",
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
    from edge_server.experiments.training.detector.dataset import of_own_rigs, render
    from edge_server.experiments.training.detector.network import parameters
    from edge_server.experiments.training.detector.precision import measure
    from edge_server.experiments.training.detector.scenes import KINDS
    from edge_server.experiments.training.detector.training import Settings, train
    from edge_server.report.machine import machine, versions

    worlds, epochs, held = (20, 2, 4) if args.quick else (args.worlds, args.epochs, HELD_OUT_WORLDS)
    settings, out = Settings(args.seed, SIDE, worlds, epochs, args.rate), args.out
    out.mkdir(parents=True, exist_ok=True)
    known = render("train", worlds, SIDE, args.seed, out / "pictures")
    unseen = render("held-out", held, SIDE, args.seed, out / "pictures")
    model, log = train(known, settings, out / "checkpoint.pt")
    path = out / "detector.onnx"
    export.export_onnx(model, SIDE, path, {"author": "freshfield", "seed": args.seed})
    variance = export.add_projection(path, export.pooled_features(path, known.images))
    sets = {"unseen worlds": unseen, **{f"own rig of {name}": images for name, images in of_own_rigs(SIDE).items()}}
    detect = export.runner(path)
    results = {
        "settings": asdict(settings),
        "kinds": KINDS,
        "parameters": parameters(model),
        "pictures": {"train": len(known), "held_out": len(unseen)},
        "boxes": sum(map(len, known.boxes)),
        "bytes": path.stat().st_size,
        "quality": {name: measure(detect, images) for name, images in sets.items()},
        "projection_variance": variance,
        "epochs": log,
        "trained_s": round(sum(row["seconds"] for row in log), 1),
        "machine": machine(),
        "versions": versions(),
    }
    write_json(out / "detector.json", results, indent=1)
    return results


def show(results: dict[str, Any]) -> str:
    """The results as text."""
    pictures, size = results["pictures"]["train"], results["bytes"] / 1e3
    lines = [f"{results['parameters']} parameters ({size:.0f} kB), {pictures} pictures, {results['boxes']} boxes"]
    for where, found in results["quality"].items():
        lines.append(f"  {where:20} mAP@.5 {found['map50']:.3f}  mAP@.5:.95 {found['map50_95']:.3f}")
    return "\n".join(lines)


def _parser() -> argparse.ArgumentParser:
    parser = command_parser("train-detector", DESCRIPTION)
    add = parser.add_argument
    add("--out", type=out_folder, default="runs/detector", metavar="DIR", help="folder to write [%(default)s]")
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
    add("--quick", action="store_true", help="20 scenes, 2 epochs: to try it out")
    add("--json", action="store_true", help="print detector.json instead of a summary")
    return parser
