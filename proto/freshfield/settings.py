"""Settings: the keys of a mapping in a scenario file, as a struct whose fields state bounds and help.

    class Blur(Settings, frozen=True):
        exposure_ms: Annotated[float, within(0, 1000, "time that the shutter is open")] = 20.0
        mode: Literal["mean", "max"] = "mean"

``read_settings`` turns a mapping into such a struct. It refuses unknown keys, wrong types and values out of range,
in one line that names the file, the key and what was expected. ``describe`` lists the keys for a command's output.
"""

from __future__ import annotations

import difflib
import json
import math
import re
import typing
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any, TypeVar

import msgspec
from msgspec import Meta

from freshfield.limits import MAX_ERROR_CHARS

T = TypeVar("T")
_AT = re.compile(r"(?P<what>.*?)(?: - at `(?:key` in `)?\$(?P<path>[^`]*)`)?", re.DOTALL)
_STEP = re.compile(r"\.(?P<name>\w+)|\[(?P<index>\d+)\]|(?P<any>\[\.\.\.\])")
_KINDS = {"int": "a whole number", "float": "a number", "str": "text", "bool": "true or false", "array": "a list"}
_KINDS["object"] = "a mapping"


class ScenarioError(ValueError):
    """An invalid scenario. The message is one line (file, key, what was expected), truncated if too long."""

    def __init__(self, message: str) -> None:
        super().__init__(message if len(message) <= MAX_ERROR_CHARS else f"{message[:MAX_ERROR_CHARS]} ...")


class Settings(msgspec.Struct, frozen=True, forbid_unknown_fields=True):
    """Base of all settings. A ``__post_init__`` that raises ValueError refuses combinations of values."""


def read_settings(model: type[T], mapping: Any, where: str) -> T:
    """Build a ``Settings`` from a mapping, strictly: a whole number is a number, nothing else is converted.

    model: the struct; fields may be numbers, text, truth values, Path, lists, tuples, mappings or structs.
    mapping: the value read from the file.
    where: file and key (``room.yaml: edge``) or the file alone (``room.yaml: ``), the beginning of every error.
    Raises ScenarioError, also for a ValueError of the struct's ``__post_init__``.
    """
    if not isinstance(mapping, dict):
        raise ScenarioError(f"{where.removesuffix(': ')}: expected a mapping, got {mapping!r:.100}")
    for path, value in _numbers(mapping):
        if not math.isfinite(value):
            raise ScenarioError(f"{_joined(where, path[1:])}: expected a number, got {value!r}")
    try:
        return msgspec.convert(mapping, model, dec_hook=_path)
    except msgspec.ValidationError as error:
        raise ScenarioError(_message(error, model, mapping, where)) from None


def within(lowest: float, highest: float, text: str) -> Meta:
    """Bounds (inclusive) and help of a number: ``Annotated[float, within(0, 90, "angle in degrees")]``."""
    return Meta(ge=lowest, le=None if math.isinf(highest) else highest, description=text)


def about(text: str) -> Meta:
    """Help of a field without bounds."""
    return Meta(description=text)


def as_mapping(settings: Settings) -> dict[str, Any]:
    """The mapping that ``read_settings`` would read into ``settings``, of plain values."""
    return typing.cast("dict[str, Any]", msgspec.to_builtins(settings, enc_hook=str))


def describe(model: type[Settings], leave_out: tuple[str, ...] = ()) -> list[str]:
    """One line for each key of a struct: name, default, what is allowed, and its help."""
    lines = []
    for field in msgspec.structs.fields(model):
        if field.name in leave_out:
            continue
        if field.required:
            default = "required"
        elif field.default is msgspec.NODEFAULT:
            default = "empty"
        else:
            default = told_default(field.default, _help(field.type))
        allowed, text = _allowed(field.type), _help(field.type)
        about = "; ".join(part for part in (default, allowed, text) if part)
        lines.append(f"    {field.name:22} {about}")
    return lines


def told_default(value: Any, text: str) -> str:
    """A default in words, as a scenario file writes it; empty if the help ``text`` says what happens without one."""
    if value in (None, "", ()):
        return "" if "not given: " in text else "not given"
    return f"default {value if isinstance(value, str) else json.dumps(msgspec.to_builtins(value, enc_hook=str))}"


def _path(kind: type, value: Any) -> Any:
    if kind is Path and isinstance(value, str):
        return Path(value)
    raise ValueError(f"expected a path, got {value!r}")


def _numbers(value: Any, path: str = "") -> Iterator[tuple[str, float]]:
    """Every float within a value of plain types, with its path."""
    if isinstance(value, float):
        yield path, value
    elif isinstance(value, dict):
        for key, each in value.items():
            yield from _numbers(each, f"{path}.{key}")
    elif isinstance(value, list | tuple):
        for index, each in enumerate(value):
            yield from _numbers(each, f"{path}[{index}]")


def _message(error: msgspec.ValidationError, model: type, mapping: dict[str, Any], where: str) -> str:
    """msgspec's message as one line that names the key, what was expected and what was given."""
    found = _AT.fullmatch(str(error))
    assert found is not None
    what, path = found["what"], where
    kind: Any = model
    value: Any = mapping
    for step in _STEP.finditer(found["path"] or ""):
        kind = bare_type(kind)
        if step["name"]:
            kind = next(f.type for f in msgspec.structs.fields(kind) if f.encode_name == step["name"])
            value, path = value[step["name"]], _joined(path, step["name"])
        elif step["index"]:
            kinds, index = typing.get_args(kind), int(step["index"])
            kind = kinds[index] if index < len(kinds) and kinds[index] is not Ellipsis else kinds[0]
            value, path = value[index], f"{path}[{index}]"
        else:
            kind = typing.get_args(kind)[1]
            key = next(k for k, v in value.items() if _refused(kind, v))
            value, path = value[key], f"{path}.{key}"
    if unknown := re.match(r"Object contains unknown field `(.*)`", what):
        known = [f.name for f in msgspec.structs.fields(bare_type(kind))]
        near = difflib.get_close_matches(unknown[1], known, n=1)
        hint = f"did you mean {near[0]!r}?" if near else f"expected one of {', '.join(known)}"
        return f"{_joined(path, unknown[1])}: unknown key; {hint}"
    if missing := re.match(r"Object missing required field `(.*)`", what):
        return f"{_joined(path, missing[1])}: missing"
    if what.startswith(("Expected ", "Invalid enum", "Number out of range")):
        quote = ": put it in quotes" if "`str`" in what and type(value) in (int, float) else ""
        return f"{path}: expected {_expected(what, kind)}, got {value!r:.100}{quote}"
    return f"{path}: {what}"


def _joined(path: str, name: str) -> str:
    return f"{path}{name}" if path.endswith(": ") else f"{path}.{name}"


def _refused(kind: Any, value: Any) -> bool:
    try:
        msgspec.convert(value, kind, dec_hook=_path)
    except msgspec.ValidationError:
        return True
    return False


def bare_type(kind: Any) -> Any:
    """A type without bounds and without None."""
    if typing.get_origin(kind) is Annotated:
        return bare_type(typing.get_args(kind)[0])
    options = [k for k in typing.get_args(kind) if k is not type(None)]
    return bare_type(options[0]) if type(None) in typing.get_args(kind) else kind


def _metas(kind: Any) -> list[Meta]:
    """Bounds and help of a type and of what it is made of, outermost first."""
    found = [m for m in getattr(kind, "__metadata__", ()) if isinstance(m, Meta)]
    for part in typing.get_args(kind):
        found += _metas(part) if typing.get_origin(kind) is not typing.Literal else []
    return found


def _allowed(kind: Any) -> str:
    """The bounds or choices of a type in words; empty if it has none."""
    bare = bare_type(kind)
    if typing.get_origin(bare) is typing.Literal:
        return f"one of {', '.join(map(str, typing.get_args(bare)))}"
    for meta in _metas(kind):
        low, high = (meta.gt if meta.ge is None else meta.ge), meta.le
        if low is not None and high is not None:
            return f"{_bound(low)} to {_bound(high)}"
        if low is not None:
            return f"{'more than' if meta.ge is None else 'at least'} {_bound(low)}"
    return ""


def _bound(value: float) -> str:
    return str(value) if isinstance(value, int) else f"{value:.10g}"


def _help(kind: Any) -> str:
    return next((m.description for m in _metas(kind) if m.description), "")


def _expected(what: str, kind: Any) -> str:
    """What msgspec expected, in words."""
    length = re.match(r"Expected `array` of length (>= )?(\d+)", what)
    if length:
        return f"a list of {length[2]} values{' or more' if length[1] else ''}"
    allowed = _allowed(kind)
    if allowed.startswith("one of"):
        return allowed
    name = re.match(r"Expected `(\w+)", what)
    word = name[1] if name else getattr(bare_type(kind), "__name__", "value")
    return ", ".join(part for part in (_KINDS.get(word, word), allowed) if part)
