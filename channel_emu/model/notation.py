"""Reads the short notation of scenarios and the command line, such as ``exp:60ms`` or ``poisson:1/30ms``."""

from __future__ import annotations

import json
import math
import re
from pathlib import Path
from typing import Any

from channel_emu.model.table import TableError, read_delays
from freshfield.untrusted import UntrustedError, read_yaml

_UNITS_MS = {"us": 1e-3, "ms": 1.0, "s": 1e3, "min": 6e4}
_DISTRIBUTIONS = {
    "exp": "exponential",
    "det": "deterministic",
    "gamma": "gamma",
    "lognormal": "lognormal",
    "trace": "trace",
    "none": "none",
}
_PARAMETER = {"gamma": "shape", "lognormal": "sigma"}


class NotationError(ValueError):
    """Text in the short notation that is invalid; the message says what was expected."""


def span_ms(text: str) -> float:
    """Parse ``30ms``, ``3s``, ``2min``, ``250us`` or a bare number of ms. Raises NotationError."""
    found = re.fullmatch(r"\s*([0-9.eE+-]+)\s*(us|ms|s|min)?\s*", text)
    try:
        value = float(found[1]) * _UNITS_MS[found[2] or "ms"] if found else math.nan
    except ValueError:
        value = math.nan
    if not (math.isfinite(value) and value >= 0):
        raise NotationError(f"{text!r} is not a span of time: expected something like 30ms or 3s")
    return value


def rate_per_ms(text: str) -> float:
    """Parse ``1/30ms``, ``1/30``, ``0.033/ms``, ``5/s`` or a bare number per ms. Raises NotationError."""
    above, slash, below = text.partition("/")
    try:
        span = 1.0 if not slash else _UNITS_MS.get(below.strip()) or span_ms(below)
        value = float(above) / span
    except (ValueError, ZeroDivisionError):
        value = math.nan
    if not (math.isfinite(value) and value >= 0):
        raise NotationError(f"{text!r} is not a rate: expected something like 1/30ms or 0.03/ms")
    return value


def fault(text: str) -> dict[str, Any]:
    """Parse a fault, ``NAME:VALUE``; the value is YAML, a mapping of parameters or the first parameter alone.

    Raises NotationError.
    """
    name, colon, value = text.partition(":")
    try:
        return {name: read_yaml(value) if colon else {}}
    except UntrustedError:
        raise NotationError(f"fault {text[:200]!r}: expected something like loss:0.1 or loss:[0.01, 0.3]") from None


def arrivals(text: str) -> dict[str, Any]:
    """Parse ``as-offered``, ``periodic:30ms``, ``poisson:1/30ms`` or, with one rate a chain state,
    ``mmpp:1/120ms,1/30ms``. Bare ``mmpp`` has these two rates, the thesis's (6.4.2). Raises NotationError."""
    kind, _, rest = text.partition(":")
    if text in ("as-offered", "periodic", "poisson"):
        return {"process": text}
    if kind == "periodic" and rest:
        return {"process": "periodic", "period_ms": span_ms(rest)}
    if text == "mmpp":
        return {"process": "poisson", "rate_per_ms": [1 / 120, 1 / 30]}
    if kind in ("poisson", "mmpp") and rest:
        rates = [rate_per_ms(word) for word in rest.split(",")]
        return {"process": "poisson", "rate_per_ms": rates if len(rates) > 1 else rates[0]}
    raise NotationError(f"{text!r}: expected as-offered, periodic:30ms, poisson:1/30ms, mmpp or mmpp:1/120ms,1/30ms")


def service(text: str, folder: Path) -> dict[str, Any]:
    """Parse ``exp:60ms``, ``det:10ms``, ``gamma:60ms:SHAPE``, ``lognormal:60ms:SIGMA``, ``trace:FILE`` or
    ``none``; or one distribution with a mean for each chain state, ``exp:30ms,exp:60ms``.

    folder: what FILE is relative to. Raises NotationError.
    """
    if text in _DISTRIBUTIONS.values():
        return {"law": text}
    short, _, rest = text.partition(":")
    law = _DISTRIBUTIONS.get(short)
    if law == "trace" and rest:
        try:
            return {"law": "trace", "delays_ms": read_delays(folder / rest)}
        except TableError as error:
            raise NotationError(str(error)) from None
    if "," in text:
        parts = [service(word, folder) for word in text.split(",")]
        if len({json.dumps({k: v for k, v in part.items() if k != "mean_ms"}) for part in parts}) != 1:
            raise NotationError(f"{text!r}: expected one distribution, with a mean for each state")
        if "mean_ms" not in parts[0]:
            raise NotationError(f"{text!r}: expected distributions with a mean")
        return {**parts[0], "mean_ms": [part["mean_ms"] for part in parts]}
    words = rest.split(":")
    if law in ("exponential", "deterministic") and len(words) == 1 and rest:
        return {"law": law, "mean_ms": span_ms(rest)}
    if law in _PARAMETER and len(words) == 2:
        try:
            return {"law": law, "mean_ms": span_ms(words[0]), _PARAMETER[law]: float(words[1])}
        except ValueError:
            pass
    raise NotationError(f"{text!r}: expected exp:60ms, det:10ms, gamma:60ms:2, lognormal:60ms:0.5, trace:FILE or none")


def chain(text: str) -> dict[str, Any]:
    """Parse ``mu1=1/30,mu2=1/30``, optionally with ``states=low/high``, ``scope=per-camera``,
    ``initial=low``. Raises NotationError."""
    found: dict[str, Any] = {}
    for word in text.split(","):
        key, _, value = (part.strip() for part in word.partition("="))
        if key in ("mu1", "mu2") and value:
            found[f"{key}_per_ms"] = rate_per_ms(value)
        elif key in ("scope", "initial") and value:
            found[key] = value
        elif key == "states" and value:
            found["states"] = value.split("/")
        else:
            raise NotationError(
                f"{text!r}: expected mu1=1/30,mu2=1/30 (and scope=per-camera, initial=s1); "
                "more states: a scenario's `chain:`"
            )
    return found
