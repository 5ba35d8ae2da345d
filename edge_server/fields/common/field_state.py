"""The state of a field as plain arrays, the same for every device."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, TypeVar

import msgspec
import numpy as np

from edge_server.fields.common.view_store import Arrays, ViewStore

VERSION = 2  # of what ``pack_state`` writes

T = TypeVar("T")


def pack_state(settings: Any, view_store: ViewStore, counters: dict[str, Any], arrays: Arrays) -> Arrays:
    """The whole state of a field in one dictionary of copies. counters: facts, ready for JSON. arrays: what was
    learned."""
    about = {"version": VERSION, "field": settings.name, "settings": msgspec.structs.asdict(settings)}
    meta = {**about, **counters, **view_store.meta()}
    both = {"meta": np.array(json.dumps(meta)), **arrays, **view_store.arrays()}
    return {name: np.array(array) for name, array in both.items()}


def unpack_meta(
    settings: Any, state: Arrays, name: str, shape: tuple[str, ...], version: int = VERSION
) -> dict[str, Any]:
    """The facts in ``state``.

    shape: options in which the settings in ``state`` must agree with ``settings``; all others may differ.
    Raises ValueError unless this holds, all numbers are finite, and the state is that of a field called
    ``name``, of this ``version``.
    """
    try:
        meta = json.loads(str(state["meta"]))
        theirs = meta["settings"]
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"not a state of a field called {name}: {error!r}") from None
    made_by = meta.get("field", name)
    if made_by != name:
        raise ValueError(f"the state is that of a field called {made_by}, this one is {name}")
    if meta.get("version") != version:
        raise ValueError(f"the state has version {meta.get('version')}, this program reads {version}")
    for key, array in state.items():
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            raise ValueError(f"the state's {key} holds numbers that are not finite")
    for option in shape:
        mine = getattr(settings, option)
        mine = list(mine) if isinstance(mine, tuple) else mine  # as JSON has it
        if mine != theirs.get(option):
            raise ValueError(f"the state was made with {option} = {theirs.get(option)}, this field has {mine}")
    return meta


@contextmanager
def all_or_nothing(field: Any) -> Iterator[None]:
    """Around loading a state: if that fails, ``field`` gets back the attributes it had. The body must replace
    arrays and objects, not write into them, which is not undone. ValueError: the state lacks something or
    holds something else.
    """
    before = dict(vars(field))
    try:
        yield
    except BaseException as error:
        # No attribute is missing in between: other threads may ask the field for a picture.
        vars(field).update(before)
        for name in vars(field).keys() - before.keys():
            delattr(field, name)
        if isinstance(error, KeyError):
            raise ValueError(f"the state lacks {error}") from None
        if isinstance(error, (TypeError, AttributeError, IndexError, ArithmeticError)):
            raise ValueError(f"the state is damaged: {error}") from None
        raise


def load_arrays(wanted: Arrays, state: Arrays) -> None:
    """Copy the arrays of ``state`` into those of the same name. ValueError: one is missing or differs in
    shape or type."""
    for name, mine in wanted.items():
        if name not in state or state[name].shape != mine.shape or state[name].dtype != mine.dtype:
            raise ValueError(f"the state lacks {name!r}, {mine.dtype} of shape {mine.shape}")
    for name, mine in wanted.items():
        mine[...] = state[name]


def to_json(value: Any) -> Any:
    """Structs, named tuples and arrays as plain values, exact, ready for JSON."""
    return msgspec.to_builtins(value, enc_hook=np.ndarray.tolist)


def from_json(told: Any, kind: type[T]) -> T:
    """What ``to_json`` was given, of arrays of float64. ValueError: it is of another kind."""
    return msgspec.convert(told, kind, dec_hook=lambda _, numbers: np.array(numbers, dtype=np.float64))


def take_attributes(owner: Any, names: tuple[str, ...]) -> Arrays:
    """Copies of attributes that are arrays or numbers, by name."""
    return {name: np.array(getattr(owner, name)) for name in names}


def give_attributes(owner: Any, names: tuple[str, ...], state: Arrays) -> None:
    """Set the attributes that ``take_attributes`` took, to copies. KeyError: one is missing."""
    for name in names:
        array = np.array(state[name])
        setattr(owner, name, array if array.ndim else array.item())
