"""Plug-ins: third-party classes by name, each a source, policy, effect, fault, field or selector.

A name that is not built in is resolved in this order:

- ``FILE.py:CLASS``, a class of a file; FILE is looked for beside the scenario, then in the working directory;
- ``MODULE:CLASS``, a class of an installed module;
- the name of an entry point of an installed package, in the group ``freshfield.KIND`` (``freshfield.policy``, ...).

Only named classes are imported. Names come from a scenario file or the command line of the user who starts a program;
both are trusted like programs. Names in files from elsewhere (a run's folder, a recording, a message) are not loaded:
see ``refuse_foreign``.
"""

from __future__ import annotations

import ast
import difflib
import hashlib
import importlib
import importlib.util
import re
import sys
from collections.abc import Iterable, Mapping
from functools import cache
from importlib.metadata import entry_points
from pathlib import Path
from types import ModuleType
from typing import Any

from freshfield.settings import ScenarioError

KINDS = ("policy", "effect", "fault", "field", "selector", "source")
_OURS = ("camera_node", "channel_emu", "edge_server", "freshfield")
_FILE = re.compile(r"(?P<where>[^:]+\.py):(?P<name>[A-Za-z_]\w*)(?P<rest>(:.*)?)")
_MODULE = re.compile(r"(?P<where>[A-Za-z_]\w*(\.\w+)*):(?P<name>[A-Za-z_]\w*)(?P<rest>(:.*)?)")


class PluginError(ScenarioError):
    """A plug-in class cannot be used; the message says why."""


def is_reference(name: str) -> bool:
    """Whether a name is FILE.py:CLASS or MODULE:CLASS."""
    return any(pattern.fullmatch(name) for pattern in (_FILE, _MODULE))


def split_value(text: str) -> tuple[str, str]:
    """Split a name from the value after its last colon (``threshold:120``, ``mine.py:Mine:120``); "" if it has none."""
    match = _FILE.fullmatch(text) or _MODULE.fullmatch(text)
    if match is None:
        name, _, value = text.partition(":")
        return name, value
    return f"{match['where']}:{match['name']}", match["rest"][1:]


def find(kind: str, name: str, built_in: Iterable[str]) -> Any:
    """The plug-in class of this name. kind: one of KINDS. Raises PluginError; its message lists the known names,
    ``built_in`` first."""
    match = _FILE.fullmatch(name) or _MODULE.fullmatch(name)
    if match is not None:
        where, load = match["where"], _file_module if match.re is _FILE else importlib.import_module
        module = _imported(kind, where, lambda: load(where))
        found = getattr(module, match["name"], None)
        if not isinstance(found, type):
            classes = {each: value for each, value in vars(module).items() if isinstance(value, type)}
            there = [each for each, value in classes.items() if value.__module__.partition(".")[0] not in _OURS]
            raise PluginError(f"{kind} {name}: no class {match['name']} in it; there are: {', '.join(there) or 'none'}")
        return found
    entries = {entry.name: entry for entry in entry_points(group=f"freshfield.{kind}")}
    if name in entries:
        return _imported(kind, name, entries[name].load)
    known = [*built_in, *installed(kind)]
    near = difflib.get_close_matches(name, known, 1)
    raise PluginError(
        f"{kind} {name!r} is not known{f' (did you mean {near[0]}?)' if near else ''}; there are: {', '.join(known)}; "
        "one of your own is FILE.py:CLASS or MODULE:CLASS"
    )


def installed(kind: str) -> list[str]:
    """The names of the entry points of installed packages, sorted."""
    return sorted({entry.name for entry in entry_points(group=f"freshfield.{kind}")})


def absolute(data: Any, folder: Path) -> Any:
    """A scenario's content in which the FILE of each FILE.py:CLASS (key or value) is absolute if ``folder`` has the
    file, so that every process finds it."""
    if isinstance(data, Mapping):
        return {absolute(key, folder): absolute(value, folder) for key, value in data.items()}
    if isinstance(data, list):
        return [absolute(value, folder) for value in data]
    match = _FILE.fullmatch(data) if isinstance(data, str) else None
    if match is None or not (folder / Path(match["where"]).expanduser()).is_file():
        return data
    return f"{(folder / Path(match['where']).expanduser()).absolute()}:{match['name']}{match['rest']}"


def files_named(data: Any) -> list[Path]:
    """The existing source files, sorted, of every plug-in class that a JSON value names, and what they import from
    their own folder; for a package, all of its files."""
    found, open_ = set[Path](), [data]
    while open_:
        value = open_.pop()
        if isinstance(value, Mapping):
            open_ += [*value.keys(), *value.values()]
        elif isinstance(value, list):
            open_ += value
        elif isinstance(value, str):
            _add_sources(_source(value), found)
    return sorted(found)


def _source(name: str) -> Path | None:
    """The file of FILE.py:CLASS, MODULE:CLASS or of an entry point; of a module in a package, the package's folder."""
    if (match := _FILE.fullmatch(name)) is not None:
        return Path(match["where"])
    match = _MODULE.fullmatch(name)
    module = match["where"] if match is not None else _installed_modules().get(split_value(name)[0])
    if not module:
        return None
    try:
        spec = importlib.util.find_spec(module.partition(".")[0])
    except (ImportError, ValueError):
        return None
    if spec is None or (spec.origin is None and not spec.submodule_search_locations):
        return None
    return Path(next(iter(spec.submodule_search_locations or ()), spec.origin or ""))


@cache
def _installed_modules() -> dict[str, str]:
    return {entry.name: entry.module for kind in KINDS for entry in entry_points(group=f"freshfield.{kind}")}


def _add_sources(path: Path | None, found: set[Path]) -> None:
    """Add a file and what it imports from its folder, or the files of a package's folder."""
    if path is not None and path.is_dir():
        found.update(path.rglob("*.py"))
    if path is None or path in found or not path.is_file():
        return
    found.add(path)
    if path.parent.name in ("site-packages", "dist-packages"):  # beside it is everything that is installed
        return
    try:
        tree = ast.parse(path.read_bytes())
    except (SyntaxError, ValueError):  # reported when it is imported
        return
    for node in ast.walk(tree):
        names = [alias.name for alias in node.names] if isinstance(node, ast.Import | ast.ImportFrom) else []
        if isinstance(node, ast.ImportFrom) and node.module:
            names = [node.module]
        for root in {name.partition(".")[0] for name in names}:
            _add_sources(path.parent / f"{root}.py", found)
            if (path.parent / root / "__init__.py").is_file():
                _add_sources(path.parent / root, found)


def short_name(name: str) -> str:
    """A name for display: FILE.py:CLASS without the folder."""
    match = _FILE.fullmatch(name)
    return name if match is None else f"{Path(match['where']).name}:{match['name']}{match['rest']}"


def refuse_foreign(kind: str, name: str, source: str, allowed: bool) -> None:
    """Raise PluginError if a possibly foreign file names a plug-in class, unless that is allowed.
    source: description of the file."""
    if is_reference(name) and not allowed:
        raise PluginError(
            f"{source} names the {kind} {name}, code from outside freshfield: to run it, if you trust it, "
            "say --allow-plugins"
        )


def _file_module(path: str) -> ModuleType:
    """The module of a file, executed once per process."""
    file = Path(path).expanduser().absolute()
    name = f"freshfield_plugin_{file.stem}_{hashlib.sha256(str(file).encode()).hexdigest()[:12]}"
    if name not in sys.modules:
        spec = importlib.util.spec_from_file_location(name, file)
        assert spec is not None and spec.loader is not None
        sys.modules[name] = importlib.util.module_from_spec(spec)
        try:
            spec.loader.exec_module(sys.modules[name])
        except BaseException:
            del sys.modules[name]
            raise
    return sys.modules[name]


def _imported(kind: str, name: str, load: Any) -> Any:
    try:
        return load()
    except Exception as error:  # whatever the code of others raises
        raise PluginError(f"{kind} {name}: cannot be imported: {type(error).__name__}: {error}") from error
