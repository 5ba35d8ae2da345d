"""Reads Python objects from a ``.npy`` file without running code from it.

Such a file is a pickle, and a pickle is a program. Here it can only build numbers, text, lists, dictionaries
and arrays. numpy's own array constructors trust the sizes that the pickle states and may crash; those here
build an array of numbers only from exactly as many bytes as it needs.
"""

from __future__ import annotations

import functools
import io
import math
import pickle
from collections.abc import Iterable
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from camera_node.sources.datasets.records import DatasetError
from freshfield.untrusted import read_bytes, refuse_expansion


class _Dtype:
    """Placeholder for a numpy.dtype of numbers or text: its code, such as ``f8``, and its byte order."""

    def __init__(self, code: str, *_: Any) -> None:
        self._code, self._order = str(code), "|"

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        self._order = state[1]

    def real(self) -> np.dtype[Any]:
        found = np.dtype(self._order + self._code if self._order in "<>" else self._code)
        if found.kind not in "biufcSUO" or found.fields is not None:
            raise pickle.UnpicklingError(f"arrays of {found} are no plain data")
        return found


class _Array:
    """Placeholder for a numpy.ndarray until its state is known. value: then the array."""

    value: Any = None

    def __setstate__(self, state: tuple[Any, ...]) -> None:
        _, shape, dtype, columns_first, raw = state
        if dtype.real().hasobject:
            if type(raw) is not list or len(shape) > 1 or math.prod(shape) != len(raw):
                raise pickle.UnpicklingError("an array of objects without its objects, or not in a row")
            self.value = raw if shape else raw[0]
        else:
            self.value = _array(raw, dtype, shape, "F" if columns_first else "C")


@functools.cache  # text that is referred to many times takes memory only once
def _bytes(text: str, encoding: str) -> bytes:
    if encoding != "latin1":
        raise pickle.UnpicklingError(f"it asks for the encoding {encoding}")
    return text.encode("latin1")


def _array(raw: Any, dtype: _Dtype, shape: tuple[int, ...], order: Any = "C") -> np.ndarray:
    data = _bytes(raw, "latin1") if isinstance(raw, str) else raw  # text is how old protocols write bytes
    if not isinstance(data, bytes | bytearray) or dtype.real().hasobject:
        raise pickle.UnpicklingError("an array of numbers without its bytes")
    return np.frombuffer(data, dtype.real()).reshape(shape, order=order)


def _scalar(dtype: _Dtype, raw: Any) -> Any:
    return _array(raw, dtype, ())[()]


_HARMLESS = {
    ("numpy._core.multiarray", "_reconstruct"): lambda *_: _Array(),
    ("numpy._core.multiarray", "scalar"): _scalar,
    ("numpy._core.numeric", "_frombuffer"): _array,
    ("numpy", "ndarray"): "ndarray",  # only to be named
    ("numpy", "dtype"): _Dtype,
    ("_codecs", "encode"): _bytes,
}


class _Plain(pickle._Unpickler):
    """Based on the unpickler in Python: the one in C allocates whatever size a few bytes claim."""

    dispatch: ClassVar[dict[int, Any]] = dict(pickle._Unpickler.dispatch)

    stack: list[Any]

    def load_build(self) -> None:
        state, built = self.stack.pop(), self.stack[-1]
        if not isinstance(built, _Array | _Dtype):
            raise pickle.UnpicklingError("it changes what is no array")
        built.__setstate__(state)

    dispatch[pickle.BUILD[0]] = load_build

    def find_class(self, module: str, name: str) -> Any:
        module = module.replace("numpy.core", "numpy._core")  # its name before numpy 2
        if (module, name) not in _HARMLESS:
            raise pickle.UnpicklingError(f"it asks for {module}.{name}, which plain data does not need")
        return _HARMLESS[module, name]


def load_object(file: Path) -> Any:
    """Load the single Python object that ``numpy.save`` wrote; arrays of objects in it become lists. Raises
    DatasetError."""
    try:
        stream = io.BytesIO(read_bytes(file))
        version = np.lib.format.read_magic(stream)
        head = np.lib.format.read_array_header_1_0 if version == (1, 0) else np.lib.format.read_array_header_2_0
        shape, _, dtype = head(stream)
        if not dtype.hasobject or shape != ():
            raise DatasetError(f"{file}: expected one Python object, got an array of {dtype} {shape}")
        found = _Plain(stream, encoding="latin1").load()
        refuse_expansion(found, len(stream.getvalue()), _parts)
        return _plain(found)
    except DatasetError:
        raise
    except FileNotFoundError:
        raise DatasetError(f"{file}: no such file") from None
    except Exception as error:  # a damaged pickle raises anything
        why = " ".join(str(error).split())[:200] or type(error).__name__
        raise DatasetError(f"{file}: cannot be read: {why}; is it complete?") from None
    finally:
        _bytes.cache_clear()


def _parts(value: Any) -> Iterable[Any]:
    if isinstance(value, dict):
        return (part for pair in value.items() for part in pair)
    if isinstance(value, _Array):
        return (value.value,)
    return value if isinstance(value, list | tuple | set | frozenset) else ()


def _plain(value: Any) -> Any:
    """The value with placeholders replaced by arrays."""
    if isinstance(value, _Array):
        return _plain(value.value)
    if isinstance(value, dict):
        return {_plain(k): _plain(v) for k, v in value.items()}
    return [_plain(v) for v in value] if isinstance(value, list | tuple) else value
