"""How kernels are compiled: without the GIL, with safe fast math, cached on disk, and without reference
counts of arrays."""

from __future__ import annotations

import hashlib
import inspect
import os
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import FunctionType
from typing import Any

import numba
from numba import njit, types
from numba.core import cgutils
from numba.core.errors import TypingError
from numba.extending import intrinsic

# No "nnan"/"ninf": the kernels test for non-finite numbers, which those flags would optimize away.
FAST = {"contract", "reassoc", "arcp", "nsz"}


def cache_folder(root: Path) -> Path:
    """Where compiled kernels are kept: a folder in $NUMBA_CACHE_DIR, or in the user's cache, for each state of
    the sources. numba checks only the file that a function stands in, but kernels inline functions of others, and
    numbers of ``settings`` and ``*_constants``.

    root: the package whose folders called ``kernels`` count.
    """
    total = hashlib.sha256()
    names = ("settings.py", "*_constants.py")
    numbers = [path for room in ("fields", "surface") for name in names for path in root.glob(f"{room}/**/{name}")]
    for path in sorted([*root.rglob("kernels/*.py"), *numbers]):
        total.update(path.relative_to(root).as_posix().encode() + path.read_bytes())
    user = os.environ.get("XDG_CACHE_HOME") or "~/.cache"
    folder = os.environ.get("NUMBA_CACHE_DIR") or f"{user}/freshfield"
    return Path(folder, f"kernels-{total.hexdigest()[:16]}").expanduser()


numba.config.CACHE_DIR = str(cache_folder(Path(__file__).parents[3]))


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


def device_function(function: Callable[..., Any]) -> Any:
    """A function that kernels call, always inlined.

    Otherwise every caller's object code has a copy, and the copy that a process happens to load first serves
    all callers. Copies differ in the last bits, so results would depend on what was called before.
    """
    return _compiled(forceinline=True, cache=True)(function)


def kernel(function: Callable[..., Any]) -> Any:
    """``njit`` with ``borrowed`` arguments.

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
    return _compiled(cache=True)(outer)
