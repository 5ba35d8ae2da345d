"""Python objects in a ``.npy`` file, without running code from it.

Such a file is a pickle, and a pickle is a program: here it may only build arrays, numbers, text, lists and
dictionaries.
"""

from __future__ import annotations

import pickle
from pathlib import Path
from typing import Any

import numpy as np

from camera_node.sources.datasets.records import DatasetError

_HARMLESS = {
    ("numpy._core.multiarray", "_reconstruct"),
    ("numpy._core.multiarray", "scalar"),
    ("numpy._core.numeric", "_frombuffer"),
    ("numpy", "ndarray"),
    ("numpy", "dtype"),
    ("_codecs", "encode"),  # how Python 2 and old protocols write bytes
}


class _Plain(pickle.Unpickler):
    def find_class(self, module: str, name: str) -> Any:
        module = module.replace("numpy.core", "numpy._core")  # what it was called before numpy 2
        if (module, name) not in _HARMLESS:
            raise pickle.UnpicklingError(f"it asks for {module}.{name}, which plain data does not need")
        return super().find_class(module, name)


def load_object(file: Path) -> Any:
    """The one object that ``numpy.save`` wrote. Raises DatasetError."""
    try:
        with file.open("rb") as stream:
            version = np.lib.format.read_magic(stream)
            head = (
                np.lib.format.read_array_header_1_0
                if version == (1, 0)
                else np.lib.format.read_array_header_2_0
            )
            shape, _, dtype = head(stream)
            if not dtype.hasobject or shape != ():
                raise DatasetError(f"{file}: expected one Python object, got an array of {dtype} {shape}")
            return _Plain(stream, encoding="latin1").load().item()
    except DatasetError:
        raise
    except FileNotFoundError:
        raise DatasetError(f"{file}: no such file") from None
    except Exception as error:  # a damaged pickle raises anything
        why = " ".join(str(error).split()) or type(error).__name__
        raise DatasetError(f"{file}: cannot be read: {why}; is it complete?") from None
