"""What a decision was worth: (5.19) for sets of views, (6.36)-(6.38) for waiting, every term apart.

    reward = make_reward("corrected", fidelity="moving")
    found = reward.of(publication)          # anything with psnr_db, psnr_moving_db, ssim, lpips, aaoi_ms
    found.total, found.terms, found.missing

(6.38) is r = -F_w, F_w = w_t age + w_p PSNR + w_s SSIM + w_l LPIPS. The thesis (6.5) prints w_p = -0.02,
w_s = +0.2, w_l = 0.3, w_t = 0.015 a millisecond: with w_s positive a better SSIM makes F_w larger and the
reward smaller, against (6.36)'s own purpose. The preset ``thesis`` keeps the printed value, so that its
figures can be repeated; ``corrected`` turns the sign and is the default.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Literal, Protocol

TERMS = ("psnr", "ssim", "distance", "age", "views")


class Scored(Protocol):
    """A score, as far as a reward looks at it: ``fidelity.scorer.Score`` and ``state.Publication`` are."""

    @property
    def psnr_db(self) -> float | None: ...
    @property
    def psnr_moving_db(self) -> float | None: ...
    @property
    def ssim(self) -> float | None: ...
    @property
    def lpips(self) -> float | None: ...


@dataclass(frozen=True)
class Rewarded:
    """total: sum of the terms that are known, None if none is. terms: weight times value by name, None for
    one whose metric is missing. missing: names of those; a total that lacks a term is not comparable with
    one that does not, so whoever learns from both says so or leaves it out (``complete``)."""

    total: float | None
    terms: dict[str, float | None]

    @property
    def missing(self) -> tuple[str, ...]:
        return tuple(name for name, value in self.terms.items() if value is None)

    @property
    def complete(self) -> bool:
        return not self.missing


@dataclass(frozen=True)
class Reward:
    """Weights of what is good (positive) and bad (negative): psnr a dB, ssim and distance a unit, age a
    millisecond of aAoI (6.35), views a view used: what sending, decoding and fitting it costs, for which the
    thesis has no term. A weight of zero is no term.

    fidelity: PSNR of the ``whole`` image or of its ``moving`` pixels; a mostly static scene hides from the
    whole image what age costs. SSIM and the distance are always of the whole image. distance_is: ``lpips``,
    or ``perceptual``, the stand-in where no LPIPS weights are installed; the term carries its name.
    """

    name: str
    psnr: float
    ssim: float
    distance: float
    age: float = 0.0
    fidelity: Literal["whole", "moving"] = "whole"
    distance_is: Literal["lpips", "perceptual"] = "lpips"
    views: float = 0.0

    def __post_init__(self) -> None:
        if not all(math.isfinite(getattr(self, term)) for term in TERMS):
            raise ValueError(f"reward {self.name}: weights must be finite")
        if self.fidelity not in ("whole", "moving"):
            raise ValueError(f"reward {self.name}: fidelity is whole or moving, not {self.fidelity!r}")
        if self.distance_is not in ("lpips", "perceptual"):
            raise ValueError(f"reward {self.name}: distance_is lpips or perceptual, not {self.distance_is!r}")

    def of(self, score: Scored, aaoi_ms: float | None = None, perceptual: float | None = None) -> Rewarded:
        """The reward of a score. aaoi_ms: mean age of the views used, at the present; None takes the score's
        own, where it has one (a publication does), and so does perceptual, the stand-in distance. A metric
        that is None or not finite is missing."""
        if aaoi_ms is None:
            aaoi_ms = getattr(score, "aaoi_ms", None)
        if perceptual is None:
            perceptual = getattr(score, "perceptual", None)
        psnr_db = score.psnr_db if self.fidelity == "whole" else score.psnr_moving_db
        distance = score.lpips if self.distance_is == "lpips" else perceptual
        found = {
            "psnr" if self.fidelity == "whole" else "psnr_moving": (self.psnr, psnr_db),
            "ssim": (self.ssim, score.ssim),
            self.distance_is: (self.distance, distance),
            "age": (self.age, aaoi_ms),
            "views": (self.views, getattr(score, "views", None)),
        }
        terms = {
            name: None if metric is None or not math.isfinite(metric) else weight * metric
            for name, (weight, metric) in found.items()
            if weight != 0.0
        }
        known = [term for term in terms.values() if term is not None]
        return Rewarded(math.fsum(known) if known else None, terms)


# Name -> reward. ``set``: (5.19) with the weights of 5.6.2; the others: -F_w with those of 6.5.
REWARDS = {
    "set": Reward("set", psnr=0.02, ssim=0.5, distance=-1.0),
    "thesis": Reward("thesis", psnr=0.02, ssim=-0.2, distance=-0.3, age=-0.015),
    "corrected": Reward("corrected", psnr=0.02, ssim=0.2, distance=-0.3, age=-0.015),
}


def make_reward(
    name: str = "corrected",
    fidelity: Literal["whole", "moving"] = "whole",
    distance_is: Literal["lpips", "perceptual"] = "lpips",
    **weights: float,
) -> Reward:
    """The named preset; ``weights`` (psnr, ssim, distance, age) replace some of its own. ValueError says
    what there is."""
    if name not in REWARDS:
        raise ValueError(f"reward {name!r} is not known; choose one of {', '.join(REWARDS)}")
    if unknown := set(weights) - set(TERMS):
        raise ValueError(f"reward {name}: no weight is called {', '.join(unknown)}: {', '.join(TERMS)}")
    preset = replace(REWARDS[name], fidelity=fidelity, distance_is=distance_is)
    return replace(preset, **weights)  # type: ignore[arg-type] # names were checked above


def available(reward: Reward, lpips_missing: str | None) -> Reward:
    """``reward`` without its term of distance where LPIPS cannot be had: a reward that always lacks a term
    would teach nothing."""
    return replace(reward, distance=0.0) if lpips_missing and reward.distance_is == "lpips" else reward
