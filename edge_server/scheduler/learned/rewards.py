"""The reward of a decision: (5.19) for sets of views, (6.36)-(6.38) for waiting, term by term.

    reward = make_reward("corrected", fidelity="moving")
    found = reward.of(publication)          # anything with psnr_db, psnr_moving_db, ssim, lpips, aaoi_ms
    found.total, found.terms, found.missing

(6.38) is r = -F_w. The thesis (6.5) prints w_s = +0.2: a better SSIM then makes F_w larger and the reward smaller,
contrary to the purpose of (6.36). The preset ``thesis`` keeps the printed sign, so that its figures can be
reproduced; ``corrected``, the default, reverses it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any, Literal

from edge_server.scheduler.learned import learning_constants as tuned


@dataclass(frozen=True)
class RewardTerms:
    """A reward, term by term.

    total: sum of the known terms; None if none is known. Totals are comparable only if ``complete``.
    terms: weight times value by name; None if the metric is missing.
    """

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
    """Weights of the metrics, positive where more is better. A weight of zero leaves the term out.

    psnr: per dB. ssim, distance: per unit. age: per millisecond of aAoI (6.35).
    views: per used view, for the cost of sending, decoding and fitting it; the thesis has no such term.
    fidelity: PSNR of the ``whole`` image or of its ``moving`` pixels; in a mostly static scene the whole
    image hides the cost of age. SSIM and the distance are always of the whole image.
    """

    name: str
    psnr: float
    ssim: float
    distance: float
    age: float = 0.0
    fidelity: Literal["whole", "moving"] = "whole"
    views: float = 0.0

    def __post_init__(self) -> None:
        if not all(math.isfinite(weight) for weight in vars(self).values() if not isinstance(weight, str)):
            raise ValueError(f"reward {self.name}: weights must be finite")
        if self.fidelity not in ("whole", "moving"):
            raise ValueError(f"reward {self.name}: fidelity is whole or moving, not {self.fidelity!r}")

    def of(self, score: Any) -> RewardTerms:
        """The reward of a score, which has ``psnr_db``, ``psnr_moving_db``, ``ssim`` and ``lpips``; ``aaoi_ms`` and
        ``views`` are read if it has them, as a publication does. A metric that is absent, None or not finite counts
        as missing."""
        psnr_db = score.psnr_db if self.fidelity == "whole" else score.psnr_moving_db
        found = {
            "psnr" if self.fidelity == "whole" else "psnr_moving": (self.psnr, psnr_db),
            "ssim": (self.ssim, score.ssim),
            "lpips": (self.distance, score.lpips),
            "age": (self.age, getattr(score, "aaoi_ms", None)),
            "views": (self.views, getattr(score, "views", None)),
        }
        terms = {
            name: None if metric is None or not math.isfinite(metric) else weight * metric
            for name, (weight, metric) in found.items()
            if weight != 0.0
        }
        known = [term for term in terms.values() if term is not None]
        return RewardTerms(math.fsum(known) if known else None, terms)


# Name -> reward. ``set``: (5.19) with the weights of 5.6.2; the others: -F_w (6.38).
REWARDS = {
    "set": Reward("set", psnr=tuned.SET_P, ssim=tuned.SET_S, distance=tuned.SET_L),
    "thesis": Reward("thesis", psnr=-tuned.W_P, ssim=-tuned.W_S, distance=-tuned.W_L, age=-tuned.W_T),
    "corrected": Reward("corrected", psnr=-tuned.W_P, ssim=tuned.W_S, distance=-tuned.W_L, age=-tuned.W_T),
}


def f_w(row: Mapping[str, Any]) -> dict[str, float | None]:
    """``f_w``: F_w of (6.36) and (6.37); ``f_w_corrected``: with the sign of SSIM reversed. Smaller is better. Ages in
    slots of 1 ms; None if a metric is missing.

    row: with psnr_db, ssim, lpips and aaoi_ms.
    """
    found = {"f_w": REWARDS["thesis"].of(SimpleNamespace(**row))}
    found["f_w_corrected"] = REWARDS["corrected"].of(SimpleNamespace(**row))
    return {name: -r.total if r.complete and r.total is not None else None for name, r in found.items()}


def make_reward(name: str = "corrected", fidelity: str = "whole", **others: Any) -> Reward:
    """The preset ``name``, with ``fidelity`` and other fields of ``Reward`` replaced. Raises ValueError for an unknown
    name; the message lists the known ones."""
    if name not in REWARDS:
        raise ValueError(f"reward {name!r} is not known; choose one of {', '.join(REWARDS)}")
    return replace(REWARDS[name], fidelity=fidelity, **others)  # type: ignore[arg-type] # checked by Reward
