"""Checks the types of a representation's options, before anything is made with them.

Otherwise ``exposure: "no"`` would count as yes, and with a rate of NaN a field would learn nothing. Ranges
are checked by the settings themselves.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from numbers import Integral, Real
from types import UnionType
from typing import Any, get_args, get_origin, get_type_hints


def checked(name: str, kind: type, options: Mapping[str, Any]) -> dict[str, Any]:
    """``options`` with the types that the settings class ``kind`` of representation ``name`` wants.

    ValueError: an option of another type. Unknown options are passed on unchecked.
    """
    hints = get_type_hints(kind)
    return {key: _typed(hints[key], f"{name}: {key}", v) if key in hints else v for key, v in options.items()}


def _typed(hint: Any, what: str, value: Any) -> Any:
    if isinstance(hint, UnionType):
        if value is None:
            return None
        hint = next(one for one in get_args(hint) if one is not type(None))
    if get_origin(hint) is tuple:
        parts = get_args(hint)
        any_length = parts[-1] is Ellipsis
        if not isinstance(value, (list, tuple)) or not (any_length or len(value) == len(parts)):
            wanted = "like [32, 64]" if any_length else f"of {len(parts)} numbers"
            raise ValueError(f"{what} must be a list {wanted}, not {value!r}")
        return tuple(_typed(parts[0], what, v) for v in value)
    if hint is float:
        return float(_number(what, value))
    right = {
        int: isinstance(value, Integral) and not isinstance(value, bool),
        bool: isinstance(value, bool),
        str: isinstance(value, str),
    }
    if not right.get(hint, True):
        wanted = {int: "a whole number", bool: "true or false", str: "text"}[hint]
        raise ValueError(f"{what} must be {wanted}, not {value!r}")
    return value


def _number(what: str, value: Any) -> Any:
    if isinstance(value, str):
        try:
            value = float(value)  # YAML takes 1e-3 for text
        except ValueError:
            raise ValueError(f"{what} must be a number, not {value!r}") from None
    if isinstance(value, bool) or not isinstance(value, Real) or not math.isfinite(value):
        raise ValueError(f"{what} must be a finite number, not {value!r}")
    return value
