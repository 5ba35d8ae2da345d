"""The state of an ngp field as plain arrays: the same for every device."""

from __future__ import annotations

import json
from dataclasses import asdict
from typing import Any

import numpy as np

from edge_server.fields.ngp_rig import Arrays, Rig
from edge_server.fields.ngp_settings import NgpSettings

# A state fits a field that agrees in these; all other settings may differ.
_SHAPE = (
    "levels", "log2_table", "base_resolution", "finest_resolution", "hidden", "hidden_layers", "harmonics",
    "cells", "samples",
)  # fmt: skip


def pack(settings: NgpSettings, rig: Rig, counters: dict[str, int], arrays: Arrays) -> Arrays:
    """Everything in one dictionary of copies."""
    meta = {"version": 1, "settings": asdict(settings), **counters, **rig.meta()}
    both = {"meta": np.array(json.dumps(meta)), **arrays, **rig.arrays()}
    return {name: np.array(array) for name, array in both.items()}


def unpack_meta(settings: NgpSettings, state: Arrays) -> dict[str, Any]:
    """The facts in ``state``. ValueError unless it is a state and was made with a model of this shape."""
    try:
        meta = json.loads(str(state["meta"]))
        theirs = meta["settings"]
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"not a state of an ngp field: {error!r}") from None
    for name in _SHAPE:
        if getattr(settings, name) != theirs.get(name):
            raise ValueError(
                f"the state was made with {name} = {theirs.get(name)}, "
                f"this field has {getattr(settings, name)}"
            )
    return meta


def fill(wanted: Arrays, state: Arrays) -> None:
    """Copy the arrays of ``state`` into those of the same name; ValueError if one is missing or different."""
    for name, mine in wanted.items():
        if name not in state or state[name].shape != mine.shape or state[name].dtype != mine.dtype:
            raise ValueError(f"the state lacks {name!r}, {mine.dtype} of shape {mine.shape}")
    for name, mine in wanted.items():
        mine[...] = state[name]
