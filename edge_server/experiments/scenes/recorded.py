"""Loads a recorded data set as the views of one instant, split into training and held-out views."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass
from pathlib import Path

from camera_node.sources.datasets.formats import open_dataset
from camera_node.sources.datasets.records import Dataset, DatasetError
from edge_server.fields import View

# Value of --holdout for the split that the data set itself defines.
OWN_SPLIT = "split"


@dataclass(frozen=True)
class Recorded:
    """Views of one instant.

    file: the file that was read.
    instant: the instant as text; empty if nothing moves.
    missing: number of entries of the file whose images do not exist.
    """

    file: Path
    training: tuple[View, ...]
    held_out: tuple[View, ...]
    instant: str = ""
    missing: int = 0


def load_recorded(
    path: Path, holdout: str = "8", scale: float = 1.0, frame: int = 0, name: str | None = None
) -> Recorded:
    """Load the views of a data set, with decoded images including alpha.

    path: the folder of a data set, or the file that describes it.
    holdout: ``8`` holds out every 8th view (the first, the ninth, ...), ``0`` none, ``split`` those that the
        data set itself keeps for testing; else names of images or cameras, separated by commas.
    scale: divides the image sizes.
    frame: number of the instant of a moving data set, from 0.
    name: name of the format (``sources.datasets.formats``); None recognizes it.
    Raises camera_node's DatasetError.
    """
    file, dataset = open_dataset(path, scale, name)
    views, instant = _views(dataset, frame)
    training, held_out = split(views, holdout, dataset.held_out)
    return Recorded(file, training, held_out, instant, dataset.missing)


def split(views: Sequence[View], holdout: str, own: Collection[str] = ()) -> tuple[tuple[View, ...], tuple[View, ...]]:
    """Split views into (training, held out) by ``holdout`` as in ``load_recorded``. own: names of the views
    that the data set itself holds out. Raises DatasetError."""
    every = int(holdout) if holdout.strip().isdigit() else None
    if holdout.strip() == OWN_SPLIT:
        if not own:
            raise DatasetError(f"--holdout {OWN_SPLIT}: this data set does not say what it keeps for testing")
        out = [view.camera in own for view in views]
    elif every is None:
        wanted = [name.strip() for name in holdout.split(",") if name.strip()]
        for name in wanted:
            if not any(_is_called(view, name) for view in views):
                some = ", ".join(v.camera for v in views[:6])
                raise DatasetError(f"--holdout: no image or camera {name!r} among {len(views)}: {some}, ...")
        out = [any(_is_called(view, name) for name in wanted) for view in views]
    else:
        out = [every > 0 and i % every == 0 for i in range(len(views))]
    training = tuple(v for v, is_out in zip(views, out) if not is_out)
    if not training:
        raise DatasetError(f"--holdout {holdout}: all {len(views)} views are held out, none is left to train on")
    return training, tuple(v for v, is_out in zip(views, out) if is_out)


def _is_called(view: View, name: str) -> bool:
    path = Path(view.camera)
    return name in (view.camera, path.name, path.stem)


def _views(dataset: Dataset, frame: int) -> tuple[list[View], str]:
    """One view per camera of a moving data set, else one per record; and the instant as text."""
    if dataset.moving:
        cameras = {camera: dataset.of(camera) for camera in dataset.cameras}
        count = min(len(records) for records in cameras.values())
        if not 0 <= frame < count:
            raise DatasetError(f"--frame {frame}: the recording has the frames 0 to {count - 1}")
        found = {camera: records[frame] for camera, records in cameras.items()}
        instant = f"frame {frame} of {count}"
    else:
        # Photos of one camera are distinguished by their names, those of a static rig by its cameras.
        rig = len(dataset.cameras) == len(dataset)
        found = {(r.camera if rig else r.name): r for r in dataset}
        instant = ""
    return [View(n, r.read(), r.camera_to_world, r.intrinsics) for n, r in found.items()], instant
