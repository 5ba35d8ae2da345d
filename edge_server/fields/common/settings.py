"""Settings that representations share: options, whose texts become help and error messages, and what was tuned once
for each representation, which is no option: it has no text.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal, TypeVar

import msgspec
from msgspec import Meta

from edge_server.fields import field_constants as tuned
from freshfield.settings import ScenarioError, Settings, about, read_settings, within

BATCH = 2048  # ``kernels.train.CHUNK``, samples; settings do not load kernels

ShDegree = Annotated[Literal[0, 1], about("degree of the spherical harmonics of color; 0: the same from everywhere")]


class FieldSettings(Settings, frozen=True):
    """What all representations share. Lengths in meters; None means: found from the cameras.

    Tuned: no density where fewer than ``min_views`` cameras look (at most all of them); the share ``rate_end``
    of the learning rate is left at the end of a fit; Adam's ``epsilon``, with which rarely seen vertices are
    trusted less.
    """

    name: ClassVar[str]

    center_m: Annotated[
        tuple[float, float, float] | None,
        about("center of the scene's box, x y z in meters; not given: found from the cameras"),
    ] = None
    radius_m: Annotated[
        Annotated[float, Meta(gt=0)] | None,
        about("half the side of the scene's box, meters; not given: found from the cameras"),
    ] = None
    near_m: Annotated[
        Annotated[float, Meta(gt=0)] | None,
        about("near plane, meters: nothing closer to a camera is rendered; not given: found from the cameras"),
    ] = None
    contracted: Annotated[
        bool | None, about("whether the scene goes on beyond its box (rooms, outdoors); not given: found from cameras")
    ] = None
    background: Annotated[str, about("auto (plain, or the mean color), white, black, or '#rrggbb'")] = "auto"
    seed: Annotated[int, within(0, (1 << 63) - 1, "seed of initial values and of all sampling")] = 0
    threads: Annotated[
        Annotated[int, Meta(ge=1, le=1024)] | None,
        about("worker threads; results do not depend on it; not given: $FRESHFIELD_THREADS, or one a core, at most 8"),
    ] = None
    nice: Annotated[int, within(0, 19, "niceness added to worker threads (Linux); in a server 5")] = 0
    min_views: int = tuned.MIN_VIEWS
    rate_end: float = tuned.RATE_END
    epsilon: float = tuned.EPSILON

    @property
    def module(self) -> str:
        """The module within ``edge_server.fields`` whose ``make`` makes the field."""
        return f"{self.name}.field"

    def __post_init__(self) -> None:
        if not re.fullmatch("auto|white|black|#[0-9a-fA-F]{6}", self.background):
            raise ValueError(
                f"background: expected auto, white, black or a color like '#80c0ff', got {self.background!r}"
            )


class TrainerSettings(FieldSettings, frozen=True):
    """What representations with a network add.

    Tuned: the network has ``hidden_layers`` layers of ``hidden`` units (multiples of 4) and learns at
    ``rate_net`` at the start of a fit. ``samples`` grows from ``samples_start`` over ``samples_ramp`` steps:
    early, foggy fields need fewer. The occupancy grid has ``cells`` cells a side (a multiple of 4).
    ``appearance`` numbers are learned for each camera. ``distortion`` weighs the loss that gathers density along
    rays. ``depth_guide`` weighs the penalty on density away from the depth that a plane sweep of the images finds
    (0: off; None: 0.1 if the background is plain or there are six views at most, else 0); it falls to 0 over
    ``guide_steps`` steps.
    """

    sh_degree: ShDegree = 0
    rays: Annotated[int, within(1, 1 << 20, "maximum number of rays in a training step")] = 4096
    batch_samples: Annotated[
        int, within(BATCH, 1 << 22, "maximum number of samples in a training step, a multiple of 2048")
    ] = 16384
    samples: Annotated[int, within(8, 2048, "ray-marching steps across the scene's box, corner to corner")] = 192
    changed_share: Annotated[float, within(0, 1, "share of rays drawn from pixels that changed in the newest view")] = (
        0.25
    )
    refine_m: Annotated[float, within(0, 1, "largest correction of a camera's position, meters; 0: none")] = 0.0
    refine_deg: Annotated[float, within(0, 20, "largest correction of a camera's rotation, degrees; 0: none")] = 0.0
    hidden: int = tuned.HIDDEN
    hidden_layers: int = tuned.HIDDEN_LAYERS
    rate: float = tuned.RATE
    rate_net: float = tuned.RATE_NET
    samples_start: int = tuned.SAMPLES_START
    samples_ramp: int = tuned.SAMPLES_RAMP
    cells: int = tuned.OCCUPANCY_CELLS
    distortion: float = tuned.DISTORTION
    appearance: int = 0
    depth_guide: float | None = None
    guide_steps: int = tuned.GUIDE_STEPS

    def __post_init__(self) -> None:
        if self.batch_samples % BATCH:
            raise ValueError(f"batch_samples: expected a multiple of {BATCH}, got {self.batch_samples}")
        super().__post_init__()


Chosen = TypeVar("Chosen", bound=FieldSettings)


def option_help(kind: type[FieldSettings]) -> dict[str, str]:
    """Option -> what it means, for command lines and documentation: its own before those it inherits."""
    texts = {
        f.name: meta.description
        for f in msgspec.structs.fields(kind)
        for meta in getattr(f.type, "__metadata__", ())
        if meta.description
    }
    declared = [name for part in kind.__mro__ for name in vars(part).get("__annotations__", ())]
    return {name: texts[name] for name in declared if name in texts}


def settings_from(kind: type[Chosen], options: Mapping[str, Any], seed: int) -> Chosen:
    """Settings from plain options (a scenario's ``field`` section).

    kind: the settings class. seed: of the field, unless ``options`` has one.
    ScenarioError: unknown option (the message lists the known ones), or a value it cannot have.
    """
    valid = option_help(kind)
    if unknown := sorted(set(options) - set(valid)):
        raise ScenarioError(f"{kind.name} has no option {', '.join(unknown)}; it has: {', '.join(valid)}")
    return read_settings(kind, {"seed": seed, **options}, kind.name)
