"""Reads a scenario file: the cameras, the seed, and one section for each package to interpret.

The file is YAML::

    name: room
    description: one line for people
    seed: 7
    cameras: {count: 13, held_out: [cam00]}     # or ids: [a, b, c]; phase: spread
    source:  {...}     # camera_node.config reads this
    channel: {...}     # channel_emu.model.config
    edge:    {...}     # edge_server.config

``read_section`` turns a mapping into a dataclass. It refuses unknown keys, wrong types and values out of
range, with one line that names the file, the key and what was expected.
"""

from __future__ import annotations

import dataclasses
import difflib
import sys
import types
import typing
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import msgspec
import numpy as np

from freshfield.frame import valid_id
from freshfield.limits import MAX_CAMERAS, MAX_IMAGE_SIDE_PX
from freshfield.settings import ScenarioError, Settings, about, read_settings, within
from freshfield.untrusted import UntrustedError, read_yaml

# Label of every fidelity of a run without held-out cameras: on page, report, console and in metrics.
NOTHING_HELD_OUT = "training views, nothing is held out"
T = TypeVar("T")
_HERE = Path(__file__).resolve()
_CHECKOUT = _HERE.parents[2] / "deploy" / "scenarios"
SCENARIO_FOLDER = _CHECKOUT if _CHECKOUT.is_dir() else _HERE.parent / "scenarios"
"""Folder of the shipped scenarios: in the checkout, else in the installed wheel."""


class Cameras(Settings, frozen=True):
    """The section ``cameras``.

    phase: of a synthetic world's cameras. ``locked``: all capture at the same instants, as in the thesis;
        ``spread``: each at its own seeded phase, like cameras without a common trigger.
    """

    count: Annotated[int, within(0, MAX_CAMERAS, "number of cameras, named cam00, cam01, ...")] = 0
    ids: Annotated[list[str], about("names of the cameras, instead of count")] = msgspec.field(default_factory=list)
    held_out: Annotated[list[str], about("cameras that are never trained on")] = msgspec.field(default_factory=list)
    phase: Literal["locked", "spread"] = "locked"


@dataclass(frozen=True)
class Scenario:
    """A parsed scenario file. The sections source, channel and edge stay mappings until their package reads
    them."""

    path: Path
    name: str
    seed: int
    cameras: tuple[str, ...]
    held_out: tuple[str, ...]
    description: str = ""
    source: dict[str, Any] = field(default_factory=dict)
    channel: dict[str, Any] = field(default_factory=dict)
    edge: dict[str, Any] = field(default_factory=dict)
    phase: str = "locked"

    @property
    def training(self) -> tuple[str, ...]:
        """The cameras that are not held out."""
        return tuple(c for c in self.cameras if c not in self.held_out)

    @property
    def max_side_px(self) -> int:
        """Bound on the image sides that the cameras send: the larger of the source's width and height if both
        are given, else MAX_IMAGE_SIDE_PX. It is that, too, for kind ``camera``, because a camera that does
        not support the given size sends its own."""
        if self.source.get("kind") == "camera":
            return MAX_IMAGE_SIDE_PX
        sides = [self.source.get(name) for name in ("width", "height")]
        whole = [side for side in sides if type(side) is int and side > 0]
        return max(whole) if len(whole) == len(sides) else MAX_IMAGE_SIDE_PX

    def phase_ns(self, camera: str, fps: float) -> int:
        """Delay of a camera's captures after the multiples of 1 / ``fps``, below 1 / ``fps``; see
        ``cameras.phase``."""
        return 0 if self.phase == "locked" else int(self.rng("phase", camera).random() * 1e9 / fps)

    def rng(self, purpose: str, camera: str | None = None) -> np.random.Generator:
        """The random stream of a purpose and camera. Streams are independent, so adding a camera does not
        change those of the others."""
        return np.random.default_rng(seed_sequence(self.seed, purpose, camera or ""))


def seed_sequence(seed: int, purpose: str, camera: str = "") -> np.random.SeedSequence:
    """Seed sequence of one camera's random stream for one purpose. It depends on the camera's name, not on
    its place in a list, so cameras are independent of each other."""
    words = [seed & 0xFFFFFFFF, seed >> 32]
    for text in (purpose, camera):
        data = text.encode()
        words += [len(data), *(int.from_bytes(data[i : i + 4], "little") for i in range(0, len(data), 4))]
    return np.random.SeedSequence(words)


def load(path: str | Path, seed: int | None = None) -> Scenario:
    """Read and check a scenario file.

    path: the file, or the name of a shipped scenario, such as ``room``.
    seed: replaces the file's seed.
    Raises ScenarioError.
    """
    file = Path(path)
    if not file.exists() and file.suffix == "" and (SCENARIO_FOLDER / f"{file}.yaml").exists():
        file = SCENARIO_FOLDER / f"{file}.yaml"
    try:
        data = read_yaml(file.read_text())
    except OSError as error:
        shipped = ", ".join(sorted(p.stem for p in SCENARIO_FOLDER.glob("*.yaml")))
        raise ScenarioError(f"{file}: {error.strerror}; shipped scenarios: {shipped or 'none'}") from None
    except UnicodeDecodeError as error:
        raise ScenarioError(f"{file}: not YAML: {error}") from None
    except UntrustedError as error:
        raise ScenarioError(f"{file}: {error}") from None
    return parse(data, file, seed)


def parse(data: Any, file: Path, seed: int | None = None) -> Scenario:
    """Check a scenario's mapping.

    data: the value of the YAML document. file: named in errors. seed: replaces that of ``data``.
    Raises ScenarioError.
    """
    known = ("name", "description", "seed", "cameras", "source", "channel", "edge")
    if not isinstance(data, dict):
        raise ScenarioError(f"{file}: expected a mapping with the keys {', '.join(known)}")
    _refuse_unknown(data, known, f"{file}: ")
    if data.get("edge") is None:  # the edge chooses for itself
        data = {**data, "edge": {}}
    for key in ("source", "channel", "edge"):
        if not isinstance(data.get(key, {}), dict):
            raise ScenarioError(f"{file}: {key}: expected a mapping")
    found = read_settings(Cameras, data.get("cameras", {}), f"{file}: cameras")
    if bool(found.ids) == bool(found.count):
        raise ScenarioError(f"{file}: cameras: expected either count (1 to {MAX_CAMERAS}) or ids")
    ids = tuple(found.ids or (f"cam{i:02d}" for i in range(found.count)))
    for name in (*ids, *found.held_out):
        if not valid_id(name):
            raise ScenarioError(f"{file}: cameras: {name!r} is not an id (letters, digits, '.', '_', '-')")
    if len(set(ids)) != len(ids):
        raise ScenarioError(f"{file}: cameras.ids: the same id twice")
    for name in found.held_out:
        if name not in ids:
            raise ScenarioError(f"{file}: cameras.held_out: {name!r} is not one of the cameras")
    if len(set(found.held_out)) == len(ids):
        raise ScenarioError(f"{file}: cameras.held_out: every camera is held out, none is left to train on")
    number = data.get("seed", 0) if seed is None else seed
    if not isinstance(number, int) or isinstance(number, bool) or not 0 <= number < 2**63:
        raise ScenarioError(f"{file}: seed: expected a whole number from 0 to 2^63 - 1, got {number!r}")
    return Scenario(
        path=file,
        name=str(data.get("name", file.stem)),
        seed=number,
        cameras=ids,
        held_out=tuple(dict.fromkeys(found.held_out)),
        description=str(data.get("description", "")),
        source=dict(data.get("source", {})),
        channel=dict(data.get("channel", {})),
        edge=dict(data["edge"]),
        phase=found.phase,
    )


def read_section(cls: type[T], mapping: Any, where: str) -> T:
    """Build a dataclass from a mapping, strictly by its annotations.

    cls: dataclass with fields of int, float, bool, str, Path, list, dict, tuple, dataclasses, or unions of
        them with None. A float field takes any finite number, an int field no float.
    mapping: the value read from the file.
    where: file and key, the beginning of every error.
    Raises ScenarioError, also for a ValueError of the dataclass's ``__post_init__``, which checks ranges.
    """
    if issubclass(cls, Settings):
        return read_settings(cls, mapping, where)
    if not isinstance(mapping, dict):
        raise ScenarioError(f"{where}: expected a mapping, got {mapping!r}")
    hints = typing.get_type_hints(cls)
    given = sorted(dataclasses.fields(cls), key=lambda f: bool(f.kw_only))  # type: ignore[arg-type]
    fields = {f.name: f for f in given if f.init}  # in the order of messages: keyword-only fields come last
    _refuse_unknown(mapping, tuple(fields), f"{where}.")
    values = {key: _convert(value, hints[key], f"{where}.{key}") for key, value in mapping.items()}
    for name, spec in fields.items():
        no_default = spec.default is dataclasses.MISSING and spec.default_factory is dataclasses.MISSING
        if name not in values and no_default:
            raise ScenarioError(f"{where}.{name}: missing")
    try:
        return cls(**values)
    except ScenarioError:
        raise
    except ValueError as error:
        raise ScenarioError(f"{where}: {error}") from None


def _convert(value: Any, hint: Any, where: str) -> Any:
    origin = typing.get_origin(hint)
    if origin in (typing.Union, types.UnionType):
        options = typing.get_args(hint)
        if value is None and type(None) in options:
            return None
        errors = []
        for option in options:
            if option is type(None):
                continue
            try:
                return _convert(value, option, where)
            except ScenarioError as error:
                errors.append(error)
        raise errors[0]
    if hint is Any:
        return value
    if origin is list or hint is list:
        if not isinstance(value, list):
            raise ScenarioError(f"{where}: expected a list, got {value!r}")
        args = typing.get_args(hint)
        return [_convert(v, args[0], f"{where}[{i}]") for i, v in enumerate(value)] if args else list(value)
    if origin is tuple:
        args = typing.get_args(hint)
        if not isinstance(value, list | tuple) or (args[-1] is not Ellipsis and len(value) != len(args)):
            count = "" if args[-1] is Ellipsis else f"{len(args)} "
            raise ScenarioError(f"{where}: expected a list of {count}values, got {value!r}")
        kinds = [args[0]] * len(value) if args[-1] is Ellipsis else args
        return tuple(_convert(v, k, f"{where}[{i}]") for i, (v, k) in enumerate(zip(value, kinds)))
    if origin is dict or hint is dict:
        if not isinstance(value, dict):
            raise ScenarioError(f"{where}: expected a mapping, got {value!r}")
        args = typing.get_args(hint)
        return {str(k): _convert(v, args[1], f"{where}.{k}") for k, v in value.items()} if args else dict(value)
    if dataclasses.is_dataclass(hint):
        return read_section(typing.cast(type, hint), value, where)
    if hint is float:
        number = isinstance(value, int | float) and not isinstance(value, bool)
        if not (number and abs(value) <= sys.float_info.max):  # also of a whole number that no float holds
            raise ScenarioError(f"{where}: expected a number, got {value!r}")
        return float(value)
    if hint is Path:
        if not isinstance(value, str):
            raise ScenarioError(f"{where}: expected a path, got {value!r}")
        return Path(value)
    names = {int: "a whole number", str: "text", bool: "true or false"}
    if type(value) is not hint:
        quote = ": put it in quotes" if hint is str and type(value) in (int, float) else ""
        raise ScenarioError(f"{where}: expected {names.get(hint, hint)}, got {value!r}{quote}")
    return value


def _refuse_unknown(mapping: dict[Any, Any], known: tuple[str, ...], prefix: str) -> None:
    for key in mapping:
        if key not in known:
            near = difflib.get_close_matches(str(key), known, n=1)
            hint = f"did you mean {near[0]!r}?" if near else f"expected one of {', '.join(known)}"
            raise ScenarioError(f"{prefix}{key}: unknown key; {hint}")
