"""``edge-server explain``: explains a recorded decision of a learned policy."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.command import command_parser, exit_status
from edge_server.matplotlib_figures import BLUE, GRAY, VERMILION, figure
from edge_server.report import report_constants as tuned
from edge_server.scheduler.learned.decision_record import RecordedDecision, read_decision
from edge_server.scheduler.learned.explain import EmbedImages, Explanation, explain, occlusion_map

DESCRIPTION = """\
Explain a decision of a learned policy (bandit:FILE): shares of the state's parts, cameras and image regions.

  edge-server run room --policy bandit:runs/learned/policy.npz --out runs/room
  edge-server explain runs/room                          # the newest decision
  edge-server explain runs/room --decision 123 --camera cam04

A run keeps its newest decisions in RUN/decisions, and so does edge-server simulate with --out.
Parts of the state have Shapley values of the action's logit, relative to the average camera in training: they
sum to the difference. A camera's share is the drop of the logit if it is replaced by an average one.
Shares of regions are found by occluding them and embedding the image again; that needs a policy with
embeddings in its state.
"""


def main(argv: Sequence[str] | None = None) -> int:
    """The command; returns its exit status."""
    parser = command_parser("edge-server explain", DESCRIPTION)
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of a run or simulation (its --out)")
    parser.add_argument("--decision", type=int, metavar="N", help="decision of update N [the newest kept]")
    parser.add_argument(
        "--camera", metavar="NAME", help="camera whose image regions to explain [that with the largest share]"
    )
    args = parser.parse_args(argv)
    return exit_status(parser.prog, lambda: _explain(args), ValueError)


def _explain(args: argparse.Namespace) -> None:
    found = read_decision(args.run, args.decision)
    decision = found.decision
    explanation = explain(decision.actor, decision.state, decision.action)
    camera = _camera(args.camera, found, explanation)
    regions = None if camera is None else _regions(found, camera, asked=args.camera is not None)
    picture = args.run / f"decision-{decision.number:06d}.png"
    draw(explanation, picture, camera, found.images.get(camera or ""), regions)
    print(as_text(found, explanation, camera, regions))
    print(picture)


def _camera(asked: str | None, found: RecordedDecision, explanation: Explanation) -> str | None:
    """The camera whose image is explained; None: there are no images."""
    if asked is not None and asked not in found.images:
        there = ", ".join(found.images) or "none: this policy does not use images"
        raise ValueError(f"--camera {asked}: no image of it was kept; there are: {there}")
    if asked is not None or not found.images:
        return asked
    share = dict(zip(explanation.names, np.abs(explanation.cameras)))
    return max(found.images, key=lambda camera: share.get(camera, 0.0))


def _regions(found: RecordedDecision, camera: str, asked: bool) -> NDArray[np.float64] | None:
    """Shares of the regions of the camera's image. If frames cannot be embedded again (the model's file is
    gone, the extra is not installed), this prints why and returns None; it raises ValueError if the user
    asked for the camera."""
    decision, image = found.decision, found.images[camera]
    try:
        number = decision.state.cameras.index(camera)
        return occlusion_map(decision.actor, decision.state, decision.action, number, image, _embedder(found))
    except ValueError as error:
        if asked:
            raise
        print(f"edge-server explain: no image regions: {error}", file=sys.stderr)
        return None


def _embedder(found: RecordedDecision) -> EmbedImages:
    if found.embedding is None:
        raise ValueError("the run does not name the embedder of its frames: regions cannot be explained")
    from edge_server.embed import make_embedder
    from edge_server.embed.settings import EmbeddingConfig

    try:
        config = EmbeddingConfig(**found.embedding)
    except TypeError as error:
        raise ValueError(f"the run's embedding is of another version: {error}") from None
    return make_embedder(config).embed


def as_text(found: RecordedDecision, e: Explanation, camera: str | None, regions: NDArray[np.float64] | None) -> str:
    """The explanation as lines of text."""
    p = np.exp(found.decision.logp)
    lines = [
        f"decision {found.decision.number}: {e.action} (probability {p:.2g}, "
        f"logit {e.logit:+.3f}; of average cameras {e.baseline_logit:+.3f})",
        "by part of the state",
        *(f"  {name:12} {share:+.3f}" for name, share in e.parts.items()),
        "by camera, if it were an average one",
    ]
    order = np.argsort(-np.abs(e.cameras))[: tuned.MOST_BARS]
    lines += [f"  {e.names[i]:12} {e.cameras[i]:+.3f}" for i in order]
    if camera is not None and regions is not None:
        row, column = np.unravel_index(int(np.abs(regions).argmax()), regions.shape)
        lines.append(
            f"in the picture of {camera} most by the region in row {row + 1}, column {column + 1} of "
            f"{regions.shape[0]} x {regions.shape[1]}: {regions[row, column]:+.3g}"
        )
    return "\n".join(lines)


def draw(
    e: Explanation, path: Path, camera: str | None, image: NDArray[np.uint8] | None, regions: NDArray[np.float64] | None
) -> None:
    """Draw bars by part and by camera, and the image with the shares of its regions."""
    columns = 3 if image is not None and regions is not None else 2
    height = 1.4 + 0.16 * max(6, min(tuned.MOST_BARS, len(e.cameras)))
    with figure(path, 1, columns, height_inch=height) as (fig, axes):
        fig.suptitle(f"{e.action}: logit {e.logit:+.2f}, of average cameras {e.baseline_logit:+.2f}")
        _bars(axes[0, 0], list(e.parts), np.array(list(e.parts.values())), "by part of the state")
        order = np.argsort(-np.abs(e.cameras))[: tuned.MOST_BARS]
        names = [e.names[i] for i in order]
        _bars(axes[0, 1], names, e.cameras[order], "by camera")
        if image is not None and regions is not None:
            at = axes[0, 2]
            at.imshow(image[..., :3])
            limit = float(np.abs(regions).max()) or 1.0
            extent = (0, image.shape[1], image.shape[0], 0)
            shown = at.imshow(regions, cmap="RdBu", vmin=-limit, vmax=limit, alpha=0.55, extent=extent)
            fig.colorbar(shown, ax=at, shrink=0.8, label="share of the logit")
            at.set_title(f"in the picture of {camera}")
            at.set_axis_off()


def _bars(axes: Any, names: list[str], shares: NDArray, title: str) -> None:
    at = np.arange(len(names))
    colors = [BLUE if share >= 0 else VERMILION for share in shares]
    axes.barh(at, shares, color=colors, height=0.7)
    axes.set_yticks(at, names)
    axes.invert_yaxis()
    axes.axvline(0.0, color=GRAY, linewidth=0.8)
    axes.set_title(title)
    axes.set_xlabel("for (+), against (-)")
