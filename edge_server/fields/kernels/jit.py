"""How the kernels are compiled: without the GIL, with safe fast mathematics, and cached on disk."""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

from numba import njit

try:
    import fcntl
except ImportError:  # not on Windows
    fcntl = None  # type: ignore[assignment]

# No "nnan"/"ninf": the kernels test for non-finite numbers, which those flags would optimise away.
FAST = {"contract", "reassoc", "arcp", "nsz"}


def _digest() -> str:
    """Of all kernel sources."""
    total = hashlib.sha256()
    for path in sorted(Path(__file__).parent.glob("*.py")):
        total.update(path.name.encode() + path.read_bytes())
    return total.hexdigest()


SOURCES = _digest()


def part(function: Callable[..., Any]) -> Any:
    """A ``kernel`` that other kernels call: it becomes a part of each of them.

    Left to itself, the compiler leaves a copy in every caller's object code, and the one that a process
    happens to load first serves all: copies differ in the last bits, so results would depend on what was
    called, or compiled, before.
    """
    return kernel(function, forceinline=True)


def kernel(function: Callable[..., Any], **options: Any) -> Any:
    """``njit`` with a cache that knows what a kernel is made of.

    numba's own cache looks at the file a function stands in; kernels here inline functions of other files,
    and would go on running yesterday's. The digest of all of them is made part of the cache's stamp.
    """
    # numpy's error model: no exception, and no branch, for a division by zero.
    dispatcher = njit(nogil=True, fastmath=FAST, error_model="numpy", no_cfunc_wrapper=True, **options)(
        function
    )
    dispatcher.enable_caching()
    file = dispatcher._cache._cache_file
    file._source_stamp = (*file._source_stamp, SOURCES)
    file.save = partial(_save_alone, Path(file._cache_path), file.save)
    return dispatcher


def _save_alone(folder: Path, save: Callable[..., None], key: Any, data: Any) -> None:
    """``save``, one process at a time: numba reads a function's index, changes and writes it, and two that
    compile the same function for other types would each name the other's code."""
    if fcntl is None:
        return save(key, data)
    with open(folder / ".lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        return save(key, data)


def is_stored(dispatcher: Any, types: tuple[Any, ...]) -> bool:
    """Whether a kernel need not be compiled for arguments of these numba types: it was, here or on disk."""
    if types in dispatcher.overloads:
        return True
    cache, target = dispatcher._cache, dispatcher.targetctx
    target.refresh()
    return cache._index_key(types, target.codegen()) in cache._cache_file._load_index()
