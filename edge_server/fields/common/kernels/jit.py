"""How the kernels are compiled: without the GIL, with safe fast mathematics, cached on disk, and without
counting who holds an array."""

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

# No "nnan"/"ninf": the kernels test for non-finite numbers, which those flags would optimise away.
FAST = {"contract", "reassoc", "arcp", "nsz"}


def _digest() -> str:
    """Of all kernel sources."""
    total = hashlib.sha256()
    for path in sorted(Path(__file__).parents[2].glob("*/kernels/*.py")):
        total.update(path.relative_to(Path(__file__).parents[2]).as_posix().encode() + path.read_bytes())
    return total.hexdigest()


SOURCES = _digest()


@intrinsic
def borrowed(typingctx: Any, value: Any) -> Any:
    """``value``, an array or a tuple of whatever, whose arrays no longer know their owner.

    numba counts references wherever an array, or a tuple that holds some, is given to a function or a row is
    taken of it, one atomic operation each: passing ten arrays on for every ray costs ten times what drawing
    the ray does. Whoever calls a kernel holds its arrays until it returns; a kernel returns none of them.
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
    """A function that kernels call: it becomes a part of each of them.

    Left to itself, the compiler leaves a copy in every caller's object code, and the one that a process
    happens to load first serves all: copies differ in the last bits, so results would depend on what was
    called, or compiled, before.
    """
    return _cached(_compiled(forceinline=True)(function))


def kernel(function: Callable[..., Any]) -> Any:
    """``njit`` for arguments that are ``borrowed``, with a cache that knows what a kernel is made of.

    ValueError for a function within another one: all that this makes would share the first one's code, since
    what they enclose is not part of the cache's key. Its ``__qualname__`` can be set to a name of its own.
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
    # Where it stands says which file of the cache is its own.
    place = {"co_filename": function.__code__.co_filename, "co_firstlineno": function.__code__.co_firstlineno}
    outer.__code__ = outer.__code__.replace(**place)
    for name in ("__module__", "__qualname__", "__doc__"):
        setattr(outer, name, getattr(function, name))
    return _cached(_compiled()(outer))


def _cached(dispatcher: Any) -> Any:
    """A compiled function, kept on disk.

    numba's own cache looks at the file a function stands in; kernels here inline functions of other files,
    and would go on running yesterday's. The digest of all of them is made part of the cache's stamp.
    """
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
