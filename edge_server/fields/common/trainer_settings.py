"""Settings that representations share: options, whose texts become help and error messages, and numbers that
were tuned once, which are no options.
"""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar, TypeVar

MOST_THREADS = 1024
BATCH = 2048  # ``kernels.train.CHUNK``, samples; settings do not load kernels


def option(default: Any, text: str) -> Any:
    """A field of a settings class that users may set, with its help text."""
    return field(default=default, metadata={"help": text})


@dataclass(frozen=True)
class FieldSettings:
    """What all representations share. Lengths in meters; None means: found from the cameras.

    Tuned: no density where fewer than ``min_views`` cameras look (at most all of them); the share ``rate_end``
    of the learning rate is left at the end of a fit; Adam's ``epsilon``, with which rarely seen vertices are
    trusted less.
    """

    name: ClassVar[str]

    centre_m: tuple[float, float, float] | None = option(
        None, "center of the scene's box, x y z in meters; None: found from the cameras"
    )
    radius_m: float | None = option(None, "half the side of the scene's box, meters; None: found from the cameras")
    near_m: float | None = option(
        None, "near plane, meters: nothing closer to a camera is rendered; None: found from the cameras"
    )
    contracted: bool | None = option(
        None, "whether the scene extends beyond its box (rooms, outdoors); None: found from the cameras"
    )
    background: str = option("auto", "auto (plain, or the mean color), white, black, random, or '#rrggbb'")
    seed: int = option(0, "seed of initial values and of all sampling")
    threads: int | None = option(
        None, "worker threads; results do not depend on it. None: $FRESHFIELD_THREADS, or one a core, at most 8"
    )
    nice: int = option(0, "niceness added to worker threads (Linux), 0 to 19; in a server 5")
    min_views: int = 2
    rate_end: float = 0.1
    epsilon: float = 5e-3

    def __post_init__(self) -> None:
        self._within(("seed", 0, (1 << 63) - 1), ("threads", 1, MOST_THREADS), ("nice", 0, 19))
        named = self.background in ("auto", "white", "black", "random")
        if not named and not re.fullmatch("#[0-9a-fA-F]{6}", self.background):
            raise ValueError(
                f"{self.name}: background must be auto, white, black, random or a color like '#80c0ff', "
                f"not {self.background!r}"
            )
        for length in ("radius_m", "near_m"):
            if getattr(self, length) is not None and not 0 < getattr(self, length) < float("inf"):
                raise ValueError(f"{self.name}: {length} must be positive, not {getattr(self, length)}")

    def _within(self, *bounds: tuple[str, float, float]) -> None:
        """ValueError where an option is neither None nor in low..high: (option, low, high) each."""
        for key, low, high in bounds:
            value = getattr(self, key)
            if value is not None and not low <= value <= high:
                raise ValueError(f"{self.name}: {key} must be in {low}..{high}, not {value}")


@dataclass(frozen=True)
class TrainerSettings(FieldSettings):
    """What representations with a network add.

    Tuned: the network has ``hidden_layers`` layers of ``hidden`` units (multiples of 4) and learns at
    ``rate_net`` at the start of a fit. ``samples`` grows from ``samples_start`` over ``samples_ramp`` steps:
    early, foggy fields need fewer. The occupancy grid has ``cells`` cells a side (a multiple of 4).
    ``distortion`` weighs the loss that gathers density along rays. ``depth_guide`` weighs the penalty on
    density away from the depth that a plane sweep of the images finds (0: off; None: 0.1 if the background is
    plain or there are six views at most, else 0); it falls to 0 over ``guide_steps`` steps.
    """

    harmonics: int = option(1, "view dependence of color: 1 (none), 4 or 9 spherical harmonics")
    rays: int = option(4096, "maximum number of rays in a training step")
    batch_samples: int = option(16384, "maximum number of samples in a training step, a multiple of 2048")
    samples: int = option(192, "ray-marching steps across the scene's box, corner to corner")
    changed_share: float = option(0.25, "share of rays drawn from pixels that changed in the newest view")
    exposure: bool = option(False, "whether to learn each camera's exposure (gain and bias per channel)")
    refine_m: float = option(0.0, "largest correction of a camera's position, meters; 0: none")
    refine_deg: float = option(0.0, "largest correction of a camera's rotation, degrees; 0: none")
    hidden: int = 32
    hidden_layers: int = 1
    rate_net: float = 2e-2
    samples_start: int = 64
    samples_ramp: int = 600
    cells: int = 64
    distortion: float = 1e-2
    depth_guide: float | None = None
    guide_steps: int = 300

    def __post_init__(self) -> None:
        self._within(
            ("rays", 1, 1 << 20),
            ("batch_samples", BATCH, 1 << 22),
            ("samples", 8, 2048),
            ("changed_share", 0.0, 1.0),
            ("refine_m", 0.0, 1.0),
            ("refine_deg", 0.0, 20.0),
        )
        if self.batch_samples % BATCH:
            raise ValueError(f"{self.name}: batch_samples must be a multiple of {BATCH}, not {self.batch_samples}")
        if self.harmonics not in (1, 4, 9):
            raise ValueError(f"{self.name}: harmonics must be 1, 4 or 9, not {self.harmonics}")
        super().__post_init__()


@dataclass(frozen=True)
class HashGridSettings(TrainerSettings):
    """What representations with a hash grid add.

    Tuned: cells a side of the coarsest and of the finest level (None: about a pixel); learning rate of the
    tables at the start of a fit; weight ``smooth`` of the total variation of the levels that are not hashed;
    ``levels_start`` levels are in use at the start, and one more is switched on each ``levels_every`` steps.
    """

    levels: int = option(8, "levels of the hash grid, coarse to fine")
    log2_table: int = option(16, "maximum number of vertices that a level stores, as a power of two")
    base_resolution: int = 16
    finest_resolution: int | None = None
    rate: float = 8e-2
    rate_net: float = 3e-2
    smooth: float = 1.5e-3
    levels_start: int = 4
    levels_every: int = 30
    samples_start: int = 32

    def __post_init__(self) -> None:
        self._within(("levels", 1, 24), ("log2_table", 8, 24))
        super().__post_init__()


Settings = TypeVar("Settings", bound=FieldSettings)


def option_help(kind: type[FieldSettings]) -> dict[str, str]:
    """Option -> what it means, for command lines and documentation: its own before those it inherits."""
    own = {f.name: f.metadata["help"] for f in fields(kind) if "help" in f.metadata}
    declared = [name for part in kind.__mro__ for name in vars(part).get("__annotations__", ())]
    return {name: own[name] for name in declared if name in own}


def settings_from(
    kind: type[Settings], efforts: Mapping[str, Mapping[str, Any]], options: Mapping[str, Any], seed: int
) -> Settings:
    """Settings from plain options (a scenario's ``field`` section).

    kind: the settings class. efforts: preset -> its settings. options: override those of the preset that
    their ``effort`` names ("medium" by default). seed: of the field, unless ``options`` has one.
    ValueError: unknown option or effort (the message lists the known ones), or a value out of range.
    """
    given = dict(options)
    effort = given.pop("effort", "medium")
    if effort not in efforts:
        raise ValueError(f"{kind.name}: effort must be one of {', '.join(efforts)}, not {effort!r}")
    valid = option_help(kind)
    if unknown := sorted(set(given) - set(valid)):
        raise ValueError(f"{kind.name} has no option {', '.join(unknown)}; it has: effort, {', '.join(valid)}")
    return replace(kind(), **{"seed": seed, **efforts[effort], **given})
