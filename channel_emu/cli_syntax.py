"""Reads the short spellings of the command line: ``exp:60ms``, ``poisson:1/30ms``, ``mu1=1/30,mu2=1/30``."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

import yaml

_UNITS_MS = {"": 1.0, "us": 1e-3, "ms": 1.0, "s": 1e3, "min": 6e4}
_LAWS = {"exp": "exponential", "det": "deterministic", "gamma": "gamma", "lognormal": "lognormal",
         "trace": "trace", "none": "none"}  # fmt: skip
_PARAMETER = {"gamma": "shape", "lognormal": "sigma"}


class SpellingError(ValueError):
    """A word that is not understood; the message says what was expected."""


def span_ms(text: str) -> float:
    """``30ms``, ``3s``, ``250us`` or a bare number of ms, in ms."""
    found = re.fullmatch(r"\s*([0-9.eE+-]+)\s*(us|ms|s|min)?\s*", text)
    try:
        value = float(found[1]) * _UNITS_MS[found[2] or ""] if found else math.nan
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value >= 0):
        raise SpellingError(f"{text!r} is not a span of time: expected something like 30ms or 3s")
    return value


def rate_per_ms(text: str) -> float:
    """``1/30ms``, ``1/30`` or ``0.033/ms`` or a bare number per ms, in 1/ms."""
    above, slash, below = text.partition("/")
    try:
        value = float(above)
        if slash:
            span = 1.0 if below.strip() == "ms" else 1e3 if below.strip() == "s" else span_ms(below)
            value = value / span
    except (ValueError, ZeroDivisionError):
        raise SpellingError(f"{text!r} is not a rate: expected something like 1/30ms or 0.03/ms") from None
    if not (math.isfinite(value) and value >= 0):
        raise SpellingError(f"{text!r} is not a rate: expected a finite number of at least 0")
    return value


def arrivals(text: str) -> dict[str, Any]:
    """``as-offered``, ``periodic:30ms``, ``poisson:1/30ms``, or by state ``mmpp:1/120ms,1/30ms``; bare
    ``mmpp`` is that, the thesis's rates (6.4.2)."""
    kind, _, rest = text.partition(":")
    if kind == "as-offered" and not rest:
        return {"process": "as-offered"}
    if kind == "periodic" and rest:
        return {"process": "periodic", "period_ms": span_ms(rest)}
    if text == "mmpp":
        return {"process": "poisson", "rate_per_ms": [1 / 120, 1 / 30]}
    if kind in ("poisson", "mmpp") and rest:
        rates = [rate_per_ms(word) for word in rest.split(",")]
        return {"process": "poisson", "rate_per_ms": rates if len(rates) > 1 else rates[0]}
    raise SpellingError(
        f"--arrivals {text!r}: expected as-offered, periodic:30ms, poisson:1/30ms, mmpp or "
        "mmpp:1/120ms,1/30ms"
    )


def service(text: str) -> dict[str, Any]:
    """``exp:60ms``, ``det:10ms``, ``gamma:60ms:SHAPE``, ``lognormal:60ms:SIGMA``, ``trace:FILE`` or none."""
    short, _, rest = text.partition(":")
    law = _LAWS.get(short)
    if law == "none":
        return {"law": "none"}
    if law == "trace" and rest:
        return {"law": "trace", "delays_ms": delays_ms(Path(rest))}
    words = rest.split(":")
    if law in ("exponential", "deterministic") and len(words) == 1 and rest:
        return {"law": law, "mean_ms": span_ms(rest)}
    if law in _PARAMETER and len(words) == 2:
        try:
            return {"law": law, "mean_ms": span_ms(words[0]), _PARAMETER[law]: float(words[1])}
        except ValueError:
            pass
    raise SpellingError(
        f"service {text!r}: expected exp:60ms, det:10ms, gamma:60ms:2, lognormal:60ms:0.5, trace:FILE or none"
    )


def service_by_state(text: str) -> dict[str, Any]:
    """The same law for each state of the chain, differing in the mean: ``exp:30ms,exp:60ms``."""
    parts = [service(word) for word in text.split(",")]
    if len({json.dumps({k: v for k, v in p.items() if k != "mean_ms"}) for p in parts}) != 1:
        raise SpellingError(f"--service-by-state {text!r}: expected one law, with a mean for each state")
    if any("mean_ms" not in p for p in parts):
        raise SpellingError(f"--service-by-state {text!r}: expected laws with a mean")
    return {**parts[0], "mean_ms": [p["mean_ms"] for p in parts]}


def chain(text: str) -> dict[str, Any]:
    """``mu1=1/30,mu2=1/30``, optionally ``scope=per-camera``, ``initial=s1``, ``slots=1ms``; or, for any
    number of states, the scenario's section as it stands there, ``{generator_per_ms: [[-1, 1], [2, -2]]}``.
    """
    if text.lstrip().startswith("{"):
        try:
            section = yaml.safe_load(text)
        except yaml.YAMLError:
            section = None
        if not isinstance(section, dict):
            raise SpellingError(
                f"--chain {text!r}: not a mapping; write {{generator_per_ms: [[-1, 1], [2, -2]]}}"
            )
        return section
    found: dict[str, Any] = {}
    for word in text.split(","):
        key, _, value = (part.strip() for part in word.partition("="))
        if key in ("mu1", "mu2") and value:
            found[f"{key}_per_ms"] = rate_per_ms(value)
        elif key in ("scope", "initial") and value:
            found[key] = value
        elif key == "slots" and value:
            found |= {"sampled": "slots", "slot_ms": span_ms(value)}
        else:
            expected = "mu1=1/30,mu2=1/30 (and scope=per-camera, initial=s1, slots=1ms)"
            raise SpellingError(f"--chain {text!r}: expected {expected}")
    return found


def delays_ms(path: Path) -> list[float]:
    """Delays from a file: one number of ms a line, or a trace of this emulator (its drawn delays)."""
    try:
        text = path.read_text()
    except (OSError, UnicodeDecodeError) as error:
        raise SpellingError(f"{path}: cannot be read: {error}") from None
    if text.startswith("{"):
        from channel_emu.model.trace import read

        return [r.drawn_ns / 1e6 for r in read(path).records if r.drawn_ns is not None]
    try:
        return [float(line) for line in text.split("\n") if line.strip() and not line.startswith("#")]
    except ValueError as error:
        raise SpellingError(f"{path}: expected one delay in ms a line: {error}") from None
