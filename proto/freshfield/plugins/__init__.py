"""Classes from outside freshfield, by name: a source, policy, effect, fault, field or selector of somebody else.

A name that is not built in is, in this order,

- ``FILE.py:CLASS``, a class of a file; FILE is looked for beside the scenario, then in the working directory;
- ``MODULE:CLASS``, a class of an installed module;
- the name of an entry point of an installed package, in the group ``freshfield.KIND`` (``freshfield.policy``, ...).

Nothing is imported that nobody names. A name comes from a scenario file or from the command line of whoever starts a
program: both are trusted as programs are. What others wrote (a run's folder, a recording, a message) names nothing
that is loaded: see ``refuse_foreign``.
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
    """A class from outside cannot be used; the message says why."""


def is_reference(name: str) -> bool:
    """Whether a name is FILE.py:CLASS or MODULE:CLASS."""
    return any(pattern.fullmatch(name) for pattern in (_FILE, _MODULE))


def split_value(text: str) -> tuple[str, str]:
    """A name and what follows its last colon, as in ``threshold:120`` or ``mine.py:Mine:120``; empty: nothing does."""
    match = _FILE.fullmatch(text) or _MODULE.fullmatch(text)
    if match is None:
        name, _, value = text.partition(":")
        return name, value
    return f"{match['where']}:{match['name']}", match["rest"][1:]


def find(kind: str, name: str, built_in: Iterable[str]) -> Any:
    """The class of this name, which is not built in. kind: one of KINDS. Raises PluginError; its message lists what
    there is, ``built_in`` first."""
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
    """A scenario's content with the FILE of each FILE.py:CLASS, in keys and values, made absolute where ``folder`` has
    it, so that every process finds it."""
    if isinstance(data, Mapping):
        return {absolute(key, folder): absolute(value, folder) for key, value in data.items()}
    if isinstance(data, list):
        return [absolute(value, folder) for value in data]
    match = _FILE.fullmatch(data) if isinstance(data, str) else None
    if match is None or not (folder / Path(match["where"]).expanduser()).is_file():
        return data
    return f"{(folder / Path(match['where']).expanduser()).absolute()}:{match['name']}{match['rest']}"


def files_named(data: Any) -> list[Path]:
    """The source files, sorted, of every class from outside that a JSON value names, as far as they exist, with what
    they import from their own folder; of a package, all of its files."""
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
    except (SyntaxError, ValueError):  # said where it is imported
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
    """A name for people: without the folder of FILE.py:CLASS."""
    match = _FILE.fullmatch(name)
    return name if match is None else f"{Path(match['where']).name}:{match['name']}{match['rest']}"


def refuse_foreign(kind: str, name: str, source: str, allowed: bool) -> None:
    """Raise PluginError if a file that somebody else may have written names a class outside, unless that is allowed.
    source: what the file is."""
    if is_reference(name) and not allowed:
        raise PluginError(
            f"{source} names the {kind} {name}, code from outside freshfield: to run it, if you trust it, "
            "say --allow-plugins"
        )


def _file_module(path: str) -> ModuleType:
    """The module of a file, executed once a process."""
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
