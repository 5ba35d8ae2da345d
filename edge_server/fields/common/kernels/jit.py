"""How kernels are compiled: without the GIL, with safe fast math, cached on disk, and without reference
counts of arrays."""

from __future__ import annotations

import hashlib
import inspect
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import FunctionType
from typing import Any

from numba import njit, types
from numba.core import cgutils
from numba.core.errors import TypingError
from numba.extending import intrinsic

try:
    import fcntl
except ImportError:  # not on Windows
    fcntl = None  # type: ignore[assignment]

# No "nnan"/"ninf": the kernels test for non-finite numbers, which those flags would optimize away.
FAST = {"contract", "reassoc", "arcp", "nsz"}


def _digest(fields: Path) -> str:
    """Digest of the kernel sources of all representations. Kernels elsewhere (``surface.kernels``) call
    parts of these only, and numba's own stamp covers the file that they stand in."""
    total = hashlib.sha256()
    for path in sorted([*fields.glob("*/kernels/*.py"), *fields.glob("*/threads/*.py")]):
        total.update(path.relative_to(fields).as_posix().encode() + path.read_bytes())
    return total.hexdigest()


SOURCES = _digest(Path(__file__).parents[2])


@intrinsic
def borrowed(typingctx: Any, value: Any) -> Any:
    """``value``, an array or a (nested) tuple, with arrays that are not reference counted.

    numba counts references wherever an array, or a tuple that holds some, is passed to a function or indexed,
    one atomic operation each: passing ten arrays on for every ray costs ten times what drawing the ray does.
    The caller of a kernel holds its arrays until it returns; a kernel returns none of them.
    """

    def strip(context: Any, builder: Any, kind: Any, given: Any) -> Any:
        if isinstance(kind, types.Array):
            array = context.make_array(kind)(context, builder, given)
            array.meminfo = cgutils.get_null_value(array.meminfo.type)
            return array._getvalue()
        if isinstance(kind, types.BaseTuple):
            parts = zip(kind, cgutils.unpack_tuple(builder, given), strict=True)
            return context.make_tuple(builder, kind, [strip(context, builder, k, p) for k, p in parts])
        if not isinstance(kind, types.Number | types.Boolean):
            raise TypingError(f"a kernel takes arrays, numbers and tuples of them, not {kind}")
        return given

    def codegen(context: Any, builder: Any, signature: Any, args: Any) -> Any:
        return strip(context, builder, signature.args[0], args[0])

    return value(value), codegen


# numpy's error model: no exception, and no branch, for a division by zero.
_compiled = partial(njit, nogil=True, fastmath=FAST, error_model="numpy", no_cfunc_wrapper=True)


def part(function: Callable[..., Any]) -> Any:
    """A function that kernels call, always inlined.

    Otherwise every caller's object code has a copy, and the copy that a process happens to load first serves
    all callers. Copies differ in the last bits, so results would depend on what was called before.
    """
    return _cached(_compiled(forceinline=True)(function))


def kernel(function: Callable[..., Any]) -> Any:
    """``njit`` with ``borrowed`` arguments, and a cache that depends on the sources of all kernels.

    ValueError: the function stands inside another one. All functions made there would share one cached code,
    since what they enclose is not part of the cache's key, unless ``__qualname__`` is set to a unique name.
    """
    if "<locals>" in function.__qualname__:
        raise ValueError(f"{function.__qualname__} needs a __qualname__ of its own to be a kernel")
    names = list(inspect.signature(function).parameters)
    text = f"def {function.__name__}({', '.join(names)}):\n"
    text += f"    return inside({', '.join(f'borrowed({name})' for name in names)})\n"
    scope = {"inside": _compiled(inline="always")(function), "borrowed": borrowed}
    exec(text, scope)
    outer = scope[function.__name__]
    assert isinstance(outer, FunctionType)
    # The cache finds a function's file by where it stands.
    place = {"co_filename": function.__code__.co_filename, "co_firstlineno": function.__code__.co_firstlineno}
    outer.__code__ = outer.__code__.replace(**place)
    for name in ("__module__", "__qualname__", "__doc__"):
        setattr(outer, name, getattr(function, name))
    return _cached(_compiled()(outer))


def _cached(dispatcher: Any) -> Any:
    """A compiled function, cached on disk.

    numba's own cache checks only the file a function stands in, but kernels inline functions of other files.
    The digest of all of them is made part of the cache's stamp, so that no outdated code runs.
    """
    dispatcher.enable_caching()
    file = dispatcher._cache._cache_file
    file._source_stamp = (*file._source_stamp, SOURCES)
    file.save = partial(_save_alone, Path(file._cache_path), file.save)
    file._load_index = partial(_load_index, file._load_index)
    return dispatcher


def _load_index(load: Callable[[], dict[Any, str]]) -> dict[Any, str]:
    """``load``; empty if the index names types that today's sources no longer have."""
    try:
        return load()
    except (AttributeError, ImportError):  # numba reads the types before it compares the stamp
        return {}


def _save_alone(folder: Path, save: Callable[..., None], key: Any, data: Any) -> None:
    """``save`` under a lock between processes: numba reads a function's index, changes and writes it, so that
    two processes that compile it for different types would overwrite each other's entries."""
    if fcntl is None:
        return save(key, data)
    with open(folder / ".lock", "w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        return save(key, data)


def is_stored(dispatcher: Any, types: tuple[Any, ...]) -> bool:
    """Whether a kernel is compiled for arguments of these numba types, in this process or on disk."""
    if types in dispatcher.overloads:
        return True
    cache, target = dispatcher._cache, dispatcher.targetctx
    target.refresh()
    return cache._index_key(types, target.codegen()) in cache._cache_file._load_index()
