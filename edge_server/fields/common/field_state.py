"""The state of a trained field as plain arrays: the same for every device."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import asdict
from typing import Any

import numpy as np

from edge_server.fields.common.view_store import Arrays, Rig


def pack(name: str, settings: Any, rig: Rig, counters: dict[str, Any], arrays: Arrays) -> Arrays:
    """Everything in one dictionary of copies."""
    meta = {"version": 1, "field": name, "settings": asdict(settings), **counters, **rig.meta()}
    both = {"meta": np.array(json.dumps(meta)), **arrays, **rig.arrays()}
    return {name: np.array(array) for name, array in both.items()}


def unpack_meta(settings: Any, state: Arrays, name: str, shape: tuple[str, ...]) -> dict[str, Any]:
    """The facts in ``state``. ValueError unless it is a state of a field called ``name`` and was made with
    settings that agree in ``shape``; all others may differ."""
    try:
        meta = json.loads(str(state["meta"]))
        theirs = meta["settings"]
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"not a state of a field called {name}: {error!r}") from None
    made_by = meta.get("field", name)
    if made_by != name:
        raise ValueError(f"the state is that of a field called {made_by}, this one is {name}")
    for option in shape:
        mine = getattr(settings, option)
        mine = list(mine) if isinstance(mine, tuple) else mine  # as JSON has it
        if mine != theirs.get(option):
            raise ValueError(
                f"the state was made with {option} = {theirs.get(option)}, this field has {mine}"
            )
    return meta


@contextmanager
def all_or_nothing(field: Any) -> Iterator[None]:
    """Around the loading of a state: where that fails, ``field`` stays as it was. ValueError where the state
    lacks something, or holds something else. New arrays and objects must take the place of the old ones:
    what is written into these is not undone.
    """
    before = dict(vars(field))
    try:
        yield
    except BaseException as error:
        # Nothing is missing meanwhile: others may ask the field for a picture, and wait for their turn.
        vars(field).update(before)
        for name in vars(field).keys() - before.keys():
            delattr(field, name)
        if isinstance(error, KeyError):
            raise ValueError(f"the state lacks {error}") from None
        if isinstance(error, (TypeError, AttributeError, IndexError, ArithmeticError)):
            raise ValueError(f"the state is damaged: {error}") from None
        raise


def fill(wanted: Arrays, state: Arrays) -> None:
    """Copy the arrays of ``state`` into those of the same name; ValueError if one is missing or different."""
    for name, mine in wanted.items():
        if name not in state or state[name].shape != mine.shape or state[name].dtype != mine.dtype:
            raise ValueError(f"the state lacks {name!r}, {mine.dtype} of shape {mine.shape}")
    for name, mine in wanted.items():
        mine[...] = state[name]
