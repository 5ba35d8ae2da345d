"""``edge-server explain``: what moved a decision of a run."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.report.style import BLUE, GREY, VERMILION, figure
from edge_server.scheduler.learned.decision_record import Recorded, read_decision
from edge_server.scheduler.learned.explain import Embed, Explanation, explain, occlusion
from freshfield.files import write_json

DESCRIPTION = """\
What moved a decision of a learnt policy (bandit:FILE): part of the state, camera, region of a picture.

  edge-server run room --policy bandit:runs/learnt/policy.npz --out runs/room
  edge-server explain runs/room                          # the newest decision
  edge-server explain runs/room --decision 123 --camera cam04

A run keeps its newest decisions in RUN/decisions, and so does edge-server simulate with --out. Shares are
Shapley values of the logit of what was done, against average cameras of the training: they sum to the whole.
Regions are found by painting them over and embedding the picture again; that needs a policy that looks at
pictures.
"""

# Cameras that have a bar of their own.
SHOWN = 20


def main(argv: Sequence[str] | None = None) -> int:
    """The command; returns its exit status."""
    raw = argparse.RawDescriptionHelpFormatter
    parser = argparse.ArgumentParser("edge-server explain", description=DESCRIPTION, formatter_class=raw)
    parser.add_argument("run", type=Path, metavar="RUN", help="folder of a run")
    parser.add_argument("--decision", type=int, metavar="N", help="number of the update [the newest kept]")
    parser.add_argument("--camera", metavar="NAME", help="whose picture [the one with the largest share]")
    parser.add_argument("--picture", type=Path, metavar="FILE", help="[RUN/decision-N.png]")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the figures there, too")
    args = parser.parse_args(argv)
    try:
        found = read_decision(args.run, args.decision)
        decided = found.decided
        told = explain(decided.actor, decided.state, decided.action)
        camera = _camera(args.camera, found, told)
        regions = None if camera is None else _regions_or_why(found, camera, asked=args.camera is not None)
        picture = args.picture or args.run / f"decision-{decided.number:06d}.png"
        draw(told, picture, camera, found.images.get(camera or ""), regions)
        if args.json is not None:
            write_json(args.json, _as_json(found, told, camera, regions), indent=1)
    except ValueError as error:
        print(f"edge-server explain: {error}", file=sys.stderr)
        return 2
    print(as_text(found, told, camera, regions))
    print(picture)
    return 0


def _camera(asked: str | None, found: Recorded, told: Explanation) -> str | None:
    """Whose picture is looked at; None: there are no pictures."""
    if asked is not None and asked not in found.images:
        there = ", ".join(found.images) or "none: this policy looks at no pictures"
        raise ValueError(f"--camera {asked}: no picture of it was kept; there are: {there}")
    if asked is not None or not found.images:
        return asked
    share = dict(zip(told.names, np.abs(told.cameras)))
    return max(found.images, key=lambda camera: share.get(camera, 0.0))


def _regions_or_why(found: Recorded, camera: str, asked: bool) -> NDArray[np.float64] | None:
    """What moved the decision in a picture. Where frames cannot be embedded again (the model's file is gone,
    the extra is not installed) the rest of the explanation stands: None, said why, unless it was asked
    for."""
    try:
        return _regions(found, camera)
    except ValueError as error:
        if asked:
            raise
        print(f"edge-server explain: no regions of a picture: {error}", file=sys.stderr)
        return None


def _regions(found: Recorded, camera: str) -> NDArray[np.float64]:
    decided = found.decided
    number = decided.state.cameras.index(camera)
    embed = _embedder(found)
    return occlusion(decided.actor, decided.state, decided.action, number, found.images[camera], embed)


def _embedder(found: Recorded) -> Embed:
    if found.embedding is None:
        raise ValueError("the run does not say what embedded its frames: regions cannot be found")
    from edge_server.embed import EmbeddingConfig, make_embedder

    try:
        config = EmbeddingConfig(**found.embedding)
    except TypeError as error:
        raise ValueError(f"the run's embedding is of another version: {error}") from None
    return make_embedder(config).embed


def as_text(
    found: Recorded, told: Explanation, camera: str | None, regions: NDArray[np.float64] | None
) -> str:
    """The explanation in lines."""
    p = np.exp(found.decided.logp)
    lines = [
        f"decision {found.decided.number}: {told.action} (probability {p:.2g}, "
        f"logit {told.firmness:+.3f}; of average cameras {told.usual:+.3f})",
        "by part of the state",
        *(f"  {name:12} {share:+.3f}" for name, share in told.parts.items()),
        "by camera (standard error)",
    ]
    order = np.argsort(-np.abs(told.cameras))[:SHOWN]
    lines += [f"  {told.names[i]:12} {told.cameras[i]:+.3f} ({told.cameras_error[i]:.3f})" for i in order]
    if len(told.cameras) > SHOWN:
        rest = told.cameras.sum() - told.cameras[order].sum()
        lines.append(f"  {len(told.cameras) - SHOWN} others    {rest:+.3f}")
    if camera is not None and regions is not None:
        row, column = np.unravel_index(int(np.abs(regions).argmax()), regions.shape)
        lines.append(
            f"in the picture of {camera} most by the region in row {row + 1}, column {column + 1} of "
            f"{regions.shape[0]} x {regions.shape[1]}: {regions[row, column]:+.3f}"
        )
    return "\n".join(lines)


def draw(
    told: Explanation,
    path: Path,
    camera: str | None,
    image: NDArray[np.uint8] | None,
    regions: NDArray[np.float64] | None,
) -> None:
    """Bars by part and by camera, and the picture with what moved the decision in it."""
    columns = 3 if image is not None and regions is not None else 2
    height = 1.4 + 0.16 * max(6, min(SHOWN, len(told.cameras)))
    with figure(path, 1, columns, height_inch=height) as (fig, axes):
        fig.suptitle(f"{told.action}: logit {told.firmness:+.2f}, of average cameras {told.usual:+.2f}")
        _bars(axes[0, 0], list(told.parts), np.array(list(told.parts.values())), None, "by part of the state")
        order = np.argsort(-np.abs(told.cameras))[:SHOWN]
        names = [told.names[i] for i in order]
        _bars(axes[0, 1], names, told.cameras[order], told.cameras_error[order], "by camera")
        if image is not None and regions is not None:
            at = axes[0, 2]
            at.imshow(image[..., :3])
            limit = float(np.abs(regions).max()) or 1.0
            extent = (0, image.shape[1], image.shape[0], 0)
            shown = at.imshow(regions, cmap="RdBu", vmin=-limit, vmax=limit, alpha=0.55, extent=extent)
            fig.colorbar(shown, ax=at, shrink=0.8, label="share of the logit")
            at.set_title(f"in the picture of {camera}")
            at.set_axis_off()


def _bars(axes: Any, names: list[str], shares: NDArray, errors: NDArray | None, title: str) -> None:
    at = np.arange(len(names))
    colours = [BLUE if share >= 0 else VERMILION for share in shares]
    axes.barh(at, shares, xerr=errors, color=colours, ecolor=GREY, height=0.7)
    axes.set_yticks(at, names)
    axes.invert_yaxis()
    axes.axvline(0.0, color=GREY, linewidth=0.8)
    axes.set_title(title)
    axes.set_xlabel("for (+), against (-)")


def _as_json(
    found: Recorded, told: Explanation, camera: str | None, regions: NDArray[np.float64] | None
) -> dict[str, Any]:
    return {
        "decision": found.decided.number,
        "action": told.action,
        "probability": float(np.exp(found.decided.logp)),
        "logit": told.firmness,
        "logit_of_average_cameras": told.usual,
        "parts": told.parts,
        "cameras": dict(zip(told.names, told.cameras.tolist())),
        "cameras_standard_error": dict(zip(told.names, told.cameras_error.tolist())),
        "picture_of": camera,
        "regions": None if regions is None else regions.tolist(),
    }


if __name__ == "__main__":
    sys.exit(main())
