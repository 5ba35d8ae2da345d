"""The captures of a carried camera that a scenario describes, as views: what ``camera-node run`` streams of it in one
pass, such as a video with the trajectory of its tracker."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from camera_node.settings import RecordedConfig, source_config
from camera_node.sources.base import Source, pixels
from camera_node.sources.datasets.records import DatasetError
from camera_node.sources.registry import open_sources
from edge_server.experiments.scenes.recorded import MultiviewStill, split
from edge_server.fields import View
from edge_server.live.depth_in_image import depth_in_image
from freshfield.scenario import ScenarioError, load

SUFFIXES = (".yaml", ".yml")


def load_captures(file: Path, holdout: str | None = None) -> MultiviewStill:
    """The captures of a scenario's only training camera, of recorded data, at the scenario's rate and scale.

    holdout: as of ``load_recorded``; None: ``cameras.held_out_every`` of the scenario, else ``8``.
    Captures without a pose or image are left out, and a note says so. Raises DatasetError.
    """
    try:
        scenario = load(file)
        config = source_config(scenario)
        if not isinstance(config, RecordedConfig) or len(scenario.training) != 1:
            raise DatasetError(
                f"{file}: a fit takes scenarios of recorded data with one training camera, and its held-out one with "
                "cameras.held_out_every; else name the data set itself"
            )
        whole = replace(scenario, cameras=scenario.training, held_out=(), held_out_every=1)
        (source,) = open_sources(whole, config, whole.cameras).values()
    except ScenarioError as error:
        raise DatasetError(str(error)) from None
    views, wrong = _views(source, config)
    if not views:
        raise DatasetError(f"{file}: none of its captures can be used: {wrong[0] if wrong else 'there are none'}")
    chosen = holdout or str(scenario.held_out_every or 8)
    training, held_out = (tuple(views[name] for name in names) for names in split(list(views), chosen))
    notes = (f"{len(wrong)} captures cannot be read whole, first {wrong[0]}",) if wrong else ()
    return MultiviewStill(scenario.name, training, held_out, file, notes=notes, carried=True, timed=source.timed)


def _views(source: Source, config: RecordedConfig) -> tuple[dict[str, View], list[str]]:
    """Views of one pass by name, until the recording plays back or begins again; and what was wrong with others, a
    line each."""
    views: dict[str, View] = {}
    wrong: list[str] = []
    last = -1
    for tick in range(source.repeats_after or 0):
        content = source.content(tick)
        if content < last:
            break
        if content > last:  # else the rate is higher than the recording's
            name = f"{source.camera}/{content:04d}"
            try:
                shot = source.read(content)
                at_ns, image = round(tick * 10**9 / source.fps), pixels(shot, config.codec)
                views[name] = View(name, image, shot.pose.matrix(), shot.intrinsics, at_ns)
                if config.depth_every and (measured := source.depth(content, shot)) is not None:
                    views[name] = replace(views[name], depth=depth_in_image(measured, shot.intrinsics, 0))
            except (ValueError, OSError) as error:  # an image that was read stays, without its depth
                wrong.append(f"{name}: {error}")
        last = content
    source.release()
    return views, wrong
