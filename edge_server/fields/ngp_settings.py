"""Settings of the hash-grid field: one dataclass whose texts become help and error messages."""

from __future__ import annotations

import re
from dataclasses import dataclass, field, fields, replace
from typing import Any


def _option(default: Any, text: str) -> Any:
    return field(default=default, metadata={"help": text})


@dataclass(frozen=True)
class NgpSettings:
    """What can be chosen about an ``NgpField``. Lengths in metres; None means: found from the cameras."""

    levels: int = _option(8, "levels of the hash grid, coarse to fine")
    log2_table: int = _option(16, "largest number of vertices a level stores, as a power of two")
    base_resolution: int = _option(16, "cells a side of the coarsest level")
    finest_resolution: int | None = _option(None, "cells a side of the finest level; None: about a pixel")
    hidden: int = _option(32, "units of each hidden layer, a multiple of 4")
    hidden_layers: int = _option(1, "hidden layers of the network")
    harmonics: int = _option(1, "view dependence of colour: 1 (none), 4 or 9 spherical harmonics")
    rays: int = _option(4096, "rays of one step at most")
    batch_samples: int = _option(16384, "samples of one step at most, in chunks of 2048")
    samples: int = _option(192, "steps across the scene's box, corner to corner")
    samples_start: int = _option(64, "the same at first: fog is cheaper to see through in long steps")
    samples_ramp: int = _option(600, "steps after which ``samples`` is reached")
    cells: int = _option(64, "cells a side of the occupancy grid, a multiple of 4")
    centre_m: tuple[float, float, float] | None = _option(None, "centre of the scene's box")
    radius_m: float | None = _option(None, "half the side of the scene's box")
    near_m: float | None = _option(None, "no density is seen nearer to a camera than this")
    contracted: bool | None = _option(None, "whether the scene goes on beyond its box (rooms, outdoors)")
    background: str = _option("auto", "auto (plain, or the mean colour), white, black, random, or '#rrggbb'")
    min_views: int = _option(2, "no density where fewer cameras than this look (never more than there are)")
    rate: float = _option(8e-2, "learning rate of the hash tables at the start of a fit")
    rate_net: float = _option(2e-2, "learning rate of the network at the start of a fit")
    rate_end: float = _option(0.1, "share of the learning rate that is left at the end of a fit")
    epsilon: float = _option(5e-3, "Adam's epsilon: larger trusts rarely seen vertices less")
    decay: float = _option(0.0, "pull of the tables' entries towards zero, per step and rate")
    distortion: float = _option(1e-2, "weight of the distortion loss: gathers each ray's density")
    sparsity: float = _option(0.0, "weight of the loss on optical depth: empties what no picture needs")
    near_fade: float = _option(0.0, "share of the cameras' distance over which gradients are held back")
    levels_start: int = _option(4, "levels in use at first; the finer ones follow (coarse to fine)")
    levels_every: int = _option(30, "steps after which one more level is switched on")
    changed_share: float = _option(0.25, "rays drawn from pixels that changed since the camera's last view")
    seed: int = _option(0, "seed of initial values and of all sampling")
    threads: int | None = _option(None, "worker threads; results do not depend on it. None: all cores")
    nice: int = _option(5, "how far workers lower their own priority (Linux)")
    device: str = _option("auto", "cpu (numba), cuda (torch) or auto")

    def __post_init__(self) -> None:
        for name, low, high in (
            ("levels", 1, 24),
            ("log2_table", 8, 24),
            ("base_resolution", 2, 512),
            ("hidden", 4, 256),
            ("hidden_layers", 1, 4),
            ("rays", 1, 1 << 20),
            ("batch_samples", 2048, 1 << 22),
            ("samples", 8, 2048),
            ("samples_start", 8, 2048),
            ("samples_ramp", 0, 1 << 30),
            ("cells", 8, 256),
            ("min_views", 0, 1000),
            ("levels_every", 0, 1 << 30),
        ):
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"ngp: {name} must be in {low}..{high}, not {getattr(self, name)}")
        if self.finest_resolution is not None and not 2 <= self.finest_resolution <= 4096:
            raise ValueError(f"ngp: finest_resolution must be in 2..4096, not {self.finest_resolution}")
        if self.hidden % 4 or self.cells % 4:
            raise ValueError(f"ngp: hidden ({self.hidden}) and cells ({self.cells}) must be multiples of 4")
        if self.harmonics not in (1, 4, 9):
            raise ValueError(f"ngp: harmonics must be 1, 4 or 9, not {self.harmonics}")
        if self.device not in ("auto", "cpu", "cuda"):
            raise ValueError(f"ngp: device must be auto, cpu or cuda, not {self.device!r}")
        named = self.background in ("auto", "white", "black", "random")
        if not named and not re.fullmatch("#[0-9a-fA-F]{6}", self.background):
            raise ValueError(
                "ngp: background must be auto, white, black, random or a colour like '#80c0ff', "
                f"not {self.background!r}"
            )
        for name in ("radius_m", "near_m"):
            if getattr(self, name) is not None and not 0 < getattr(self, name) < float("inf"):
                raise ValueError(f"ngp: {name} must be positive, not {getattr(self, name)}")


EFFORTS: dict[str, dict[str, Any]] = {
    "low": {"levels": 6, "log2_table": 14, "finest_resolution": 96, "batch_samples": 8192, "samples": 96},
    "medium": {},
    "high": {"log2_table": 17, "hidden": 64, "batch_samples": 32768, "rays": 8192, "samples": 256},
}


def make_settings(options: dict[str, Any], seed: int = 0) -> NgpSettings:
    """Settings from plain options (a scenario's ``field`` section). ``effort`` (low, medium, high) chooses
    a preset that the other options override. ValueError names an unknown option and lists the valid ones."""
    options = dict(options)
    effort = options.pop("effort", "medium")
    if effort not in EFFORTS:
        raise ValueError(f"ngp: effort must be one of {', '.join(EFFORTS)}, not {effort!r}")
    valid = [f.name for f in fields(NgpSettings)]
    unknown = sorted(set(options) - set(valid))
    if unknown:
        raise ValueError(f"ngp has no option {', '.join(unknown)}; it has: effort, {', '.join(valid)}")
    if options.get("centre_m") is not None:
        options["centre_m"] = tuple(float(c) for c in options["centre_m"])
    return replace(NgpSettings(), **{"seed": seed, **EFFORTS[effort], **options})


def help_text() -> dict[str, str]:
    """Option name -> what it means, for command lines and documentation."""
    return {f.name: f.metadata["help"] for f in fields(NgpSettings)}
