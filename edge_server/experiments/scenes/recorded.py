"""Loads a recorded data set as the views of one instant, split into training and held-out views."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from camera_node.sources.datasets.formats import open_dataset
from camera_node.sources.datasets.records import Dataset, DatasetError, PosedImage
from edge_server.experiments import experiment_constants as tuned
from edge_server.fidelity.images import BLACK, Color
from edge_server.fields import View

# Value of --holdout for the split that the data set itself defines.
OWN_SPLIT = "split"


@dataclass(frozen=True)
class MultiviewStill:
    """The views of one instant that a field is fitted to and scored on.

    file: the file that was read, or the scene.
    instant: the instant as text; empty if nothing moves.
    missing: number of entries of the file whose images do not exist.
    notes: what a user should know of how the files were read.
    background: color behind transparent images.
    carried: the views are those of one camera that was carried about, photos or frames.
    timed: they are frames with times: a recording, whose poses come from a tracker. Poses of photos were found from
        the photos themselves, or are exact.
    """

    name: str
    training: tuple[View, ...]
    held_out: tuple[View, ...]
    file: Path
    instant: str = ""
    missing: int = 0
    notes: tuple[str, ...] = ()
    background: Color = BLACK
    carried: bool = False
    timed: bool = False

    def describe(self) -> str:
        image = self.training[0].image
        return f"{self.name}: {len(self.training)} views of {image.shape[1]} x {image.shape[0]}"


def load_recorded(
    path: Path, holdout: str | None = "8", scale: float = 1.0, frame: int = 0, name: str | None = None
) -> MultiviewStill:
    """Load the views of a data set, with decoded images including alpha.

    path: the folder of a data set, or the file that describes it.
    holdout: ``8`` holds out every 8th view (the first, the ninth, ...), ``0`` none, ``split`` those that the
        data set itself keeps for testing; else names of images or cameras, separated by commas. None: ``split`` if it
        keeps any, else ``8``. What it keeps for testing is never trained on.
    scale: divides the image sizes.
    frame: number of the instant of a moving data set, from 0.
    name: name of the format (``sources.datasets.formats``); None recognizes it.
    Raises camera_node's DatasetError.
    """
    file, dataset = open_dataset(path, scale, name)
    if dataset.carried:  # its frames are views of one scene, like photos
        dataset = replace(dataset, images=tuple(replace(record, camera="") for record in dataset))
    found, instant = _records(dataset, frame)
    own = [key for key, record in found.items() if record.name in dataset.held_out]
    training, held_out = split(list(found), holdout or (OWN_SPLIT if own else "8"), own)
    wrong: dict[str, Exception] = {}
    views = {key: _view(key, found[key], wrong) for key in (*training, *held_out)}
    blank = [
        key for key, v in views.items() if v.weight is not None and not (v.weight > tuned.LEAST_SCORED_WEIGHT).any()
    ]
    if not set(training) - set(blank):
        raise DatasetError(f"{file}: masks leave nothing of the training images: are they inverted?")
    notes = dataset.notes
    if blank:
        notes += (f"masks leave nothing of {len(blank)} images, first {blank[0]}: they are not used",)
    if wrong:
        first, error = next(iter(wrong.items()))
        notes += (f"the depth of {len(wrong)} images cannot be used, first {first}: {error}",)
    trained, kept = (tuple(views[k] for k in keys if k not in blank) for keys in (training, held_out))
    return MultiviewStill(
        file.resolve().parent.name,
        trained,
        kept,
        file,
        instant,
        dataset.missing,
        notes,
        carried=dataset.cameras == ("",),
        timed=all(record.time_s is not None for record in dataset),
    )


def split(names: Sequence[str], holdout: str, own: Collection[str] = ()) -> tuple[list[str], list[str]]:
    """Split views into (training, held out) by ``holdout`` as in ``load_recorded``. own: names of the views
    that the data set itself holds out. Raises DatasetError."""
    # 0012 is the name of an image, as 0012.jpg has it.
    every = int(holdout) if holdout.strip().isdigit() and str(int(holdout)) == holdout.strip() else None
    if holdout.strip() == OWN_SPLIT:
        if not own:
            raise DatasetError(f"--holdout {OWN_SPLIT}: this data set does not say what it keeps for testing")
        out = set(own)
    elif every is None:
        wanted = [name.strip() for name in holdout.split(",") if name.strip()]
        for name in wanted:
            if not any(_is_called(view, name) for view in names):
                some = ", ".join(names[: tuned.NAMED_VIEWS])
                raise DatasetError(f"--holdout: no image or camera {name!r} among {len(names)}: {some}, ...")
        out = {view for view in names if any(_is_called(view, name) for name in wanted)}
    else:
        out = set(names[::every]) if every else set()
    training = [name for name in names if name not in out and name not in own]
    if not training:
        raise DatasetError(f"--holdout {holdout}: all {len(names)} views are held out, none is left to train on")
    return training, [name for name in names if name in out]


def _is_called(view: str, name: str) -> bool:
    path = Path(view)
    return str(Path(name)) in (view, path.name, path.stem)


def _records(dataset: Dataset, frame: int) -> tuple[dict[str, PosedImage], str]:
    """One image per camera of a moving data set, else all, by the names of their views; and the instant as text.

    Frames are those of the slowest camera, from the first one that all have; of the others it is the image nearest in
    time. Raises DatasetError."""
    if not dataset.moving:
        if frame:
            raise DatasetError(f"--frame {frame}: this data set has no frames of several cameras: leave it out")
        # Photos of one camera are distinguished by their names, those of a static rig by its cameras.
        rig = len(dataset.cameras) == len(dataset)
        return {(r.camera if rig else r.name): r for r in dataset}, ""
    cameras = {camera: dataset.of(camera) for camera in dataset.cameras}
    if len(cameras) == 1:
        raise DatasetError(
            f"one camera, {dataset.cameras[0]}, and times: there is one view of each instant; if nothing "
            "moves, leave out the times"
        )
    slowest = max(cameras.values(), key=_apart_s)
    near_s = 0.5 * _apart_s(slowest) + 1e-6
    begin_s = max(records[0].time_s or 0.0 for records in cameras.values()) - near_s
    slowest = tuple(record for record in slowest if (record.time_s or 0.0) >= begin_s) or slowest
    if not 0 <= frame < len(slowest):
        raise DatasetError(f"--frame {frame}: the recording has the frames 0 to {len(slowest) - 1}")
    t_s = slowest[frame].time_s or 0.0
    found = {
        camera: min(records, key=lambda record: abs((record.time_s or 0.0) - t_s))
        for camera, records in cameras.items()
    }
    for camera, record in found.items():
        if abs((record.time_s or 0.0) - t_s) > near_s:
            raise DatasetError(f"--frame {frame}: camera {camera} has no image near {t_s:g} s: choose another frame")
    return found, f"frame {frame} of {len(slowest)}"


def _apart_s(records: Sequence[PosedImage]) -> float:
    """Mean time between a camera's images."""
    return ((records[-1].time_s or 0.0) - (records[0].time_s or 0.0)) / max(1, len(records) - 1)


def _view(name: str, record: PosedImage, wrong: dict[str, Exception]) -> View:
    """wrong: gets what is wrong with the image's depth, if the view has to do without it."""
    weight = None if record.weight is None else record.weight()
    depth = None
    if record.depth is not None:
        from edge_server.live.depth_in_image import depth_in_image

        try:
            depth = depth_in_image(record.depth(), record.intrinsics, 0)
        except (ValueError, OSError) as error:
            wrong[name] = error
    at_ns = round(1e9 * (record.time_s or 0.0))
    return View(name, record.read(), record.camera_to_world, record.intrinsics, at_ns, weight=weight, depth=depth)
