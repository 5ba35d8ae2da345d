"""Reads a scenario file: the cameras, the seed, and one section for each package to interpret.

The file is YAML::

    name: room
    description: one line for people
    seed: 7
    cameras: {count: 13, held_out: [cam00]}     # or ids: [a, b, c]; phase: spread
    source:  {...}     # camera_node.settings reads this
    channel: {...}     # channel_emu.model.settings
    edge:    {...}     # edge_server.settings

Sections are ``freshfield.settings``.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import msgspec
import numpy as np

from freshfield.frame import valid_id
from freshfield.limits import MAX_CAMERAS, MAX_IMAGE_SIDE_PX
from freshfield.payload import DEFAULT_CODEC
from freshfield.plugins import absolute
from freshfield.settings import ScenarioError, Settings, about, read_settings, within
from freshfield.untrusted import UntrustedError, read_text, read_yaml

# Label of every fidelity of a run without held-out cameras: on page, report, console and in metrics.
NOTHING_HELD_OUT = "training views, nothing is held out"
_HERE = Path(__file__).resolve()
_CHECKOUT = _HERE.parents[2] / "deploy" / "scenarios"
SCENARIO_FOLDER = _CHECKOUT if _CHECKOUT.is_dir() else _HERE.parent / "scenarios"
"""Folder of the shipped scenarios: in the checkout, else in the installed wheel."""


class Cameras(Settings, frozen=True):
    """The section ``cameras``.

    phase: of a synthetic world's cameras. ``locked``: all capture at the same instants, as in the thesis;
        ``spread``: each at its own seeded phase, like cameras without a common trigger.
    held_out_every: for moving cameras: the first of every so many captures of a training camera is sent as a frame of
        the held-out camera at the same index of the list instead; 0: held-out cameras are separate cameras.
    """

    count: Annotated[int, within(0, MAX_CAMERAS, "number of cameras, named cam00, cam01, ...")] = 0
    ids: Annotated[list[str], about("names of the cameras, instead of count")] = msgspec.field(default_factory=list)
    held_out: Annotated[list[str], about("cameras that are never trained on")] = msgspec.field(default_factory=list)
    phase: Literal["locked", "spread"] = "locked"
    held_out_every: Annotated[int, within(0, 10**6, "of so many captures of a moving camera, one is held out")] = 0


class ScenarioFile(Settings, frozen=True):
    """What a scenario file may hold; each package reads its own section."""

    cameras: Cameras = msgspec.field(default_factory=Cameras)
    name: Annotated[str, about("not given: the file's name")] = ""
    description: Annotated[str, about("one line for people")] = ""
    seed: Annotated[int, within(0, 2**63 - 1, "of every random stream")] = 0
    source: dict[str, Any] = msgspec.field(default_factory=dict)
    channel: dict[str, Any] = msgspec.field(default_factory=dict)
    edge: dict[str, Any] | None = None


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
    held_out_every: int = 0

    @property
    def training(self) -> tuple[str, ...]:
        """The cameras that are not held out."""
        return tuple(c for c in self.cameras if c not in self.held_out)

    def path_of(self, camera: str) -> str:
        """The camera whose captures ``camera`` sends: itself, unless it is held out and ``held_out_every`` is set."""
        if not self.held_out_every or camera not in self.held_out:
            return camera
        return self.training[self.held_out.index(camera)]

    @property
    def max_side_px(self) -> int:
        """Largest image side that the cameras may send: the larger of the source's width and height if both are
        given, else MAX_IMAGE_SIDE_PX; always that for kind ``camera``, because a camera that does not support the
        given size sends another."""
        if self.source.get("kind") == "camera":
            return MAX_IMAGE_SIDE_PX
        sides = [self.source.get(name) for name in ("width", "height")]
        whole = [side for side in sides if type(side) is int and side > 0]
        return max(whole) if len(whole) == len(sides) else MAX_IMAGE_SIDE_PX

    @property
    def codec(self) -> str | None:
        """How the cameras compress images; None without a source, and for a recording, whose own codec is sent."""
        told = self.source.get("kind") not in (None, "mcap")
        return str(self.source.get("codec", DEFAULT_CODEC)) if told else None

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

    path: the file, or the name of a shipped scenario, such as ``room``, even if a folder has that name.
    seed: replaces the file's seed.
    Raises ScenarioError.
    """
    file = Path(path)
    if not file.is_file() and file.suffix == "" and (SCENARIO_FOLDER / f"{file}.yaml").exists():
        file = SCENARIO_FOLDER / f"{file}.yaml"
    try:
        data = read_yaml(read_text(file))
    except OSError as error:
        shipped = ", ".join(sorted(p.stem for p in SCENARIO_FOLDER.glob("*.yaml")))
        raise ScenarioError(f"{file}: {error.strerror}; shipped scenarios: {shipped or 'none'}") from None
    except UnicodeDecodeError as error:
        raise ScenarioError(f"{file}: not YAML: {error}") from None
    except UntrustedError as error:
        raise ScenarioError(f"{file}: {error}") from None
    return parse(absolute(data, file.parent), file, seed)


def parse(data: Any, file: Path, seed: int | None = None) -> Scenario:
    """Check a scenario's mapping.

    data: the value of the YAML document. file: named in errors. seed: replaces that of ``data``.
    Raises ScenarioError.
    """
    if seed is not None and isinstance(data, dict):
        data = {**data, "seed": seed}
    file_settings = read_settings(ScenarioFile, data, f"{file}: ")
    found = file_settings.cameras
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
    held_out = tuple(dict.fromkeys(found.held_out))
    if found.held_out_every == 1 or (found.held_out_every and 2 * len(held_out) != len(ids)):
        raise ScenarioError(
            f"{file}: cameras.held_out_every: expected 2 or more, and as many held-out cameras as training cameras: "
            f"each shows captures of one of those; got {found.held_out_every}, {len(held_out)} of {len(ids)} held out"
        )
    return Scenario(
        path=file,
        name=file_settings.name or file.stem,
        seed=file_settings.seed,
        cameras=ids,
        held_out=held_out,
        description=file_settings.description,
        source=file_settings.source,
        channel=file_settings.channel,
        edge=file_settings.edge or {},
        phase=found.phase,
        held_out_every=found.held_out_every,
    )
