"""Settings that representations share; their texts become help and error messages."""

from __future__ import annotations

import re
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from typing import Any, ClassVar, TypeVar


def option(default: Any, text: str) -> Any:
    """A field of a settings class with its help text."""
    return field(default=default, metadata={"help": text})


MOST_THREADS = 1024
BATCH = 2048  # ``kernels.train.CHUNK``, samples; settings do not load kernels


@dataclass(frozen=True)
class FieldSettings:
    """What all representations share. Lengths in meters; None means: found from the cameras."""

    name: ClassVar[str]
    has_cuda: ClassVar[bool] = False  # whether the representation runs on a GPU, too

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
    min_views: int = option(2, "no density where fewer cameras than this look (at most all of them)")
    rate_end: float = option(0.1, "share of the learning rate that is left at the end of a fit")
    epsilon: float = option(5e-3, "Adam's epsilon: larger trusts rarely seen vertices less")
    age_tau_ms: float = option(
        0.0, "age relative to the newest view, in ms, at which a view's weight is 1/e; 0: all weigh 1"
    )
    mask_stale_ms: float = option(0.0, "mask moved pixels of views that are this many ms older than the newest; 0: off")
    mask_grow_px_s: float = option(0.0, "dilation of the mask of ``mask_stale_ms``, in pixels per second of age")
    refuse_beyond: float = option(
        2.5,
        "refuse views whose typical error is more than this many times the usual one; 0, or while cameras' "
        "exposures or poses are learned: refuse none",
    )
    seed: int = option(0, "seed of initial values and of all sampling")
    threads: int | None = option(
        None, "worker threads; results do not depend on it. None: $FRESHFIELD_THREADS, or one a core, at most 8"
    )
    nice: int = option(0, "niceness added to worker threads (Linux), 0 to 19; in a server 5")
    device: str = option("auto", "cpu, cuda (``ngp`` and ``splat`` only) or auto (cpu; never a GPU by itself)")

    def __post_init__(self) -> None:
        self._within(
            ("min_views", 0, 1000),
            ("rate_end", 1e-4, 1.0),
            # Adam divides by epsilon where there is no gradient to speak of.
            ("epsilon", 1e-10, 1e3),
            ("age_tau_ms", 0.0, 1e9),
            ("mask_stale_ms", 0.0, 1e9),
            ("mask_grow_px_s", 0.0, 1e6),
            ("refuse_beyond", 0.0, 1e6),
            ("seed", 0, (1 << 63) - 1),
            ("threads", 1, MOST_THREADS),
            ("nice", 0, 19),
        )
        if self.device not in ("auto", "cpu", "cuda"):
            raise ValueError(f"{self.name}: device must be auto, cpu or cuda, not {self.device!r}")
        if self.device == "cuda" and not self.has_cuda:
            raise ValueError(f"{self.name}: runs on CPUs only; use device cpu or auto, or the field ngp")
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
    """What representations with a network add."""

    hidden: int = option(32, "units of each hidden layer, a multiple of 4")
    hidden_layers: int = option(1, "hidden layers of the network")
    harmonics: int = option(1, "view dependence of color: 1 (none), 4 or 9 spherical harmonics")
    rays: int = option(4096, "maximum number of rays in a training step")
    batch_samples: int = option(16384, "maximum number of samples in a training step, a multiple of 2048")
    samples: int = option(192, "ray-marching steps across the scene's box, corner to corner")
    samples_start: int = option(64, "initial value of ``samples``: early, foggy fields need fewer")
    samples_ramp: int = option(600, "training steps after which ``samples`` is reached")
    cells: int = option(64, "cells a side of the occupancy grid, a multiple of 4")
    rate_net: float = option(2e-2, "learning rate of the network at the start of a fit")
    distortion: float = option(1e-2, "weight of the distortion loss, which concentrates density along rays")
    changed_share: float = option(0.25, "share of rays drawn from pixels that changed in the newest view")
    depth_guide: float | None = option(
        None,
        "weight of the penalty on density away from the depth that a plane sweep of the images finds; 0: "
        "off; None: 0.1 if the background is plain or there are six views at most, else 0",
    )
    guide_steps: int = option(300, "steps over which the weight ``depth_guide`` falls to 0")
    exposure: bool = option(False, "whether to learn each camera's exposure (gain and bias per channel)")
    refine_m: float = option(0.0, "largest correction of a camera's position, meters; 0: none")
    refine_deg: float = option(0.0, "largest correction of a camera's rotation, degrees; 0: none")

    def __post_init__(self) -> None:
        name = self.name
        self._within(
            ("hidden", 4, 256),
            ("hidden_layers", 1, 4),
            ("rays", 1, 1 << 20),
            ("batch_samples", BATCH, 1 << 22),
            ("samples", 8, 2048),
            ("samples_start", 8, 2048),
            ("samples_ramp", 0, 1 << 30),
            ("cells", 8, 256),
            ("rate_net", 0.0, 10.0),
            ("distortion", 0.0, 1e3),
            ("changed_share", 0.0, 1.0),
            ("depth_guide", 0.0, 1e3),
            ("guide_steps", 1, 1 << 30),
            ("refine_m", 0.0, 1.0),
            ("refine_deg", 0.0, 20.0),
        )
        if self.batch_samples % BATCH:
            raise ValueError(f"{name}: batch_samples must be a multiple of {BATCH}, not {self.batch_samples}")
        if self.hidden % 4 or self.cells % 4:
            raise ValueError(f"{name}: hidden ({self.hidden}) and cells ({self.cells}) must be multiples of 4")
        if self.harmonics not in (1, 4, 9):
            raise ValueError(f"{name}: harmonics must be 1, 4 or 9, not {self.harmonics}")
        super().__post_init__()


@dataclass(frozen=True)
class HashGridSettings(TrainerSettings):
    """What representations with a hash grid add. Lengths in meters; None means: found from the cameras."""

    levels: int = option(8, "levels of the hash grid, coarse to fine")
    log2_table: int = option(16, "maximum number of vertices that a level stores, as a power of two")
    base_resolution: int = option(16, "cells a side of the coarsest level")
    finest_resolution: int | None = option(None, "cells a side of the finest level; None: about a pixel")
    rate: float = option(8e-2, "learning rate of the hash tables at the start of a fit")
    rate_net: float = option(3e-2, "learning rate of the network at the start of a fit")
    decay: float = option(0.0, "weight decay of the hash tables, per step, times the learning rate")
    smooth: float = option(1.5e-3, "weight of the total variation of the levels that are not hashed")
    levels_start: int = option(4, "levels in use at the start; finer ones are switched on later")
    levels_every: int = option(30, "steps after which one more level is switched on")
    samples_start: int = option(32, "initial value of ``samples``: early, foggy fields need fewer")

    def __post_init__(self) -> None:
        self._within(
            ("levels", 1, 24),
            ("log2_table", 8, 24),
            ("base_resolution", 2, 512),
            ("levels_start", 1, 24),
            ("levels_every", 0, 1 << 30),
            ("rate", 0.0, 10.0),
            ("decay", 0.0, 1e3),
            ("smooth", 0.0, 1e3),
            ("finest_resolution", 2, 4096),
        )
        super().__post_init__()


Settings = TypeVar("Settings", bound=FieldSettings)


def option_help(kind: type[FieldSettings]) -> dict[str, str]:
    """Option -> what it means, for command lines and documentation: its own before those it inherits."""
    own = {f.name: f.metadata["help"] for f in fields(kind)}
    declared = [name for part in kind.__mro__ for name in vars(part).get("__annotations__", ())]
    return {name: own[name] for name in declared if name in own}


def settings_from(
    kind: type[Settings], efforts: Mapping[str, Mapping[str, Any]], options: Mapping[str, Any], seed: int
) -> Settings:
    """Settings from plain options (a scenario's ``field`` section).

    kind: the settings class. efforts: preset -> its options. options: override those of the preset that
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
