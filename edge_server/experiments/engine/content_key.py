"""Keys of results: hashes of everything that determines a result."""

from __future__ import annotations

import ast
import dataclasses
import hashlib
import json
import platform
import sys
from collections.abc import Callable, Iterable
from functools import cache, partial
from pathlib import Path
from typing import Any

import msgspec

import camera_node
import channel_emu
import edge_server
import freshfield
from edge_server.experiments.engine.engine_constants import ASIDE
from edge_server.machine import versions
from freshfield.plugins import files_named

_PACKAGES = (freshfield, camera_node, channel_emu, edge_server)
_KEY_LENGTH = 40


def result_key(work: Callable[..., Any], inputs: Any, files: Iterable[Path | None] = ()) -> str:
    """The key of ``work(inputs)`` (hex). What a ``functools.partial`` binds is left out.

    inputs: a dataclass or JSON value; the order of names in mappings does not matter.
    files: files and folders whose contents the result depends on; None is skipped.
    Raises TypeError for inputs that JSON cannot hold, OSError for a file that cannot be read.
    """
    parts = {
        **surroundings(work),
        "work": f"{_unbound(work).__module__}.{_unbound(work).__qualname__}",
        "inputs": inputs,
        "files": [content_digest(path) for path in files if path is not None],
    }
    text = json.dumps(parts, sort_keys=True, default=plain)
    named = files_named(json.loads(text))
    if named:  # classes from outside: the code above does not cover them
        text += json.dumps([content_digest(file) for file in named])
    return hashlib.sha256(text.encode()).hexdigest()[:_KEY_LENGTH]


def surroundings(work: Callable[..., Any]) -> dict[str, Any]:
    """What the results of ``work`` depend on besides its inputs: code, versions of packages, kind of processor."""
    return {"code": code_digest(_unbound(work).__module__), "versions": _versions(), "processor": processor()}


def _unbound(work: Callable[..., Any]) -> Callable[..., Any]:
    """The function within ``functools.partial``."""
    while isinstance(work, partial):
        work = work.func
    return work


def plain(value: Any) -> Any:
    """``value`` as JSON has it, for ``json.dumps(default=...)``: dataclasses, structs, paths and NumPy's numbers.
    Raises TypeError for anything else."""
    if dataclasses.is_dataclass(value) and not isinstance(value, type):
        return {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    if isinstance(value, msgspec.Struct):
        return msgspec.structs.asdict(value)
    if isinstance(value, Path):
        return str(value)
    if hasattr(value, "item") and getattr(value, "ndim", None) == 0:
        return value.item()
    raise TypeError(f"{type(value).__name__} is no JSON value: inputs and results of repeated work must be")


_versions = cache(versions)


@cache
def processor() -> str:
    """The kind of processor that kernels are compiled for."""
    import llvmlite.binding as llvm  # what numba compiles with

    return f"{platform.machine()} {llvm.get_host_cpu_name()}"


# --- files -------------------------------------------------------------------------------------------------


def content_digest(path: Path) -> str:
    """Digest of a file's contents, or of a folder's files with their names. Raises OSError."""
    if not path.is_dir():
        return _file_digest(path, *_state(path))
    digest = hashlib.sha256()
    for file in sorted(file for file in path.rglob("*") if file.is_file()):
        digest.update(f"{file.relative_to(path).as_posix()}\0{_file_digest(file, *_state(file))}\n".encode())
    return digest.hexdigest()


def _state(path: Path) -> tuple[int, int]:
    """Size and time of the last change: a file that keeps both is read once a process."""
    stat = path.stat()
    return stat.st_size, stat.st_mtime_ns


@cache
def _file_digest(path: Path, size: int, changed_ns: int) -> str:
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


# --- code --------------------------------------------------------------------------------------------------


@cache
def code_digest(module: str = freshfield.__name__) -> str:
    """Digest of the code that a module may run: the syntax trees of all modules of this project but those ``ASIDE``,
    and of the module itself if it is a test's or a user's own. Docstrings and formatting do not count."""
    digest = hashlib.sha256()
    roots = [Path(str(package.__file__)).parent for package in _PACKAGES]
    files = {f"{root.name}/{file.relative_to(root)}": file for root in roots for file in sorted(root.rglob("*.py"))}
    if module.split(".")[0] not in (root.name for root in roots):
        files[module] = Path(str(sys.modules[module].__file__))
    for name, file in files.items():
        if not name.startswith(ASIDE):
            tree = ast.parse(file.read_bytes())
            _drop_docstrings(tree)
            digest.update(f"{name}\0{ast.dump(tree)}\n".encode())
    return digest.hexdigest()


def _drop_docstrings(tree: ast.Module) -> None:
    for node in ast.walk(tree):
        if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef | ast.AsyncFunctionDef):
            node.body = [
                s for s in node.body if not (isinstance(s, ast.Expr) and isinstance(s.value, ast.Constant))
            ] or [ast.Pass()]
