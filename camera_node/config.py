"""The scenario's ``source:`` section: what the cameras see, their frame rate, and how frames are compressed.

``kind`` chooses the dataclass in ``MODELS``, whose docstring ``camera-node sources`` prints. All keys are
checked here, with file and key in the message. Checks that need the data itself (does the folder hold this
camera?) are made when the source opens.
"""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from camera_node.bounds import Bounded, bounded, one_of
from freshfield.limits import MAX_IMAGE_SIDE_PX, MAX_STAMP_S
from freshfield.payload import CODECS
from freshfield.scenario import Scenario, ScenarioError, read_section

LOOPS = ("back-and-forth", "restart")
REPLAYS = ("once", "restart")
PAIRINGS = ("nearest", "interpolated")
BACKGROUNDS = ("white", "black", "keep")
ROBOTS = ("ur3e",)
FPS_RANGE = (0.01, 1000.0)
"""Bounds of a rate of captures or of a recording, frames a second."""
MAX_GAP_MS = 3.6e6
"""Longest time between a frame and its pose sample: poses an hour away belong to another recording."""
MAX_LATENCY_MS = 6e4
"""Longest latency of a camera: one that is a minute late is not live."""


@dataclass(frozen=True)
class SourceConfig(Bounded):
    """Keys of every kind.

    fps: captures per second (default: the recording's own, 15 for a world, 10 for photos). codec: jpeg, png
    or zstd. quality: JPEG quality, 1 to 100; from 90 up, color is not subsampled. effects: name ->
    parameters, or null (see ``camera-node effects``).
    """

    kind: str
    fps: float | None = bounded(None, *FPS_RANGE)
    codec: str = one_of("jpeg", CODECS)
    quality: int = bounded(92, 1, 100)
    effects: dict[str, dict[str, Any] | None] = field(default_factory=dict)


@dataclass(frozen=True)
class PathConfig(Bounded):
    """The tour that ``camera-node drive-arm`` makes: viewpoints on rings around a target, looking at it.

    target_m: target in the world. radius_m: distance from camera to target. elevations_deg: elevations of
    the rings. azimuths_deg: first and last azimuth of each ring (0 is on the target's -y side, 90 on its +x
    side). step_deg: between viewpoints of a ring. rolls_deg: allowed rotations of the camera about its
    optical axis; at each viewpoint, one that the arm reaches is used. speed_rad_s, acceleration_rad_s2:
    limits of the fastest joint. floor_m: minimum height (world z) of the joint centers beyond the shoulder.
    """

    target_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    radius_m: float = bounded(0.35, 1e-3, math.inf)
    elevations_deg: tuple[float, ...] = bounded((45.0, 65.0), -89.0, 89.0)
    azimuths_deg: tuple[float, float] = (-90.0, 90.0)
    step_deg: float = bounded(15.0, 1.0, 120.0)
    rolls_deg: tuple[float, ...] = bounded((0.0, 90.0, 180.0, 270.0), -360.0, 360.0)
    speed_rad_s: float = bounded(0.5, 1e-4, 3.14)
    acceleration_rad_s2: float = bounded(1.0, 1e-4, 40.0)
    floor_m: float = 0.05


@dataclass(frozen=True)
class ArmConfig(Bounded):
    """An arm whose joint states give cameras their poses (extra ``ur``).

    host: the controller's address. robot: ur3e. cameras: camera -> its hand-eye calibration, a file written
    by ``camera-node calibrate hand-eye``, relative to the scenario, or null before calibration (its poses are
    then those of the hand, as that command needs them). calibration: the robot's own ``calibration.conf``,
    relative to the scenario. base_m, base_yaw_deg: pose of the arm's base in the world. frequency_hz:
    joint states per second, 10 to 500. pairing: nearest or interpolated. max_gap_ms: a frame farther than
    this from a joint state is not sent. path: the tour of ``camera-node drive-arm``. simulated: deploy/up.py
    starts ``camera-node simulate-arm`` at ``host`` (an address of this machine, 127.0.0.2 and up) and drives
    it. teleop: keys of ``camera_node.robot.teleop.settings.TeleopConfig``, for ``camera-node teleop``.
    """

    host: str
    cameras: dict[str, str | None]
    robot: str = one_of("ur3e", ROBOTS)
    calibration: str | None = None
    base_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
    base_yaw_deg: float = 0.0
    frequency_hz: float = bounded(125.0, 10, 500)
    pairing: str = one_of("interpolated", PAIRINGS)
    max_gap_ms: float = bounded(20.0, 0, MAX_GAP_MS)
    path: PathConfig | None = None
    simulated: bool = False
    teleop: dict[str, Any] | None = None  # read by the command alone: a node that streams needs none of it

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.cameras:
            raise ValueError("cameras: expected at least one camera with its hand-eye calibration")
        # drive-arm does not ask before it moves a simulated arm: a real one must not pass for one.
        if self.simulated and not self.host.startswith("127."):
            raise ValueError(f"simulated: host is {self.host}, expected one of this machine's, such as 127.0.0.2")


@dataclass(frozen=True)
class WorldConfig(SourceConfig):
    """A synthetic world. scene: ``room``, ``tile`` or ``tower``; width, height, horizontal_fov_deg: of its
    cameras; speed_m_per_s: of its motion. motion_seed: draws another motion of the same scene (path, sense,
    start, speed); not given: the scene's own. params: further parameters of the scene by name. arm: an arm
    that carries the cameras that it lists; their images are rendered from the simulated arm's true pose."""

    scene: str = "room"
    width: int | None = None
    height: int | None = None
    horizontal_fov_deg: float | None = None
    speed_m_per_s: float | None = None
    motion_seed: int | None = None
    params: dict[str, Any] = field(default_factory=dict)
    arm: ArmConfig | None = None

    def scene_parameters(self) -> dict[str, Any]:
        """Parameters of the scene by name: the fields above that were given, and ``params``."""
        names = ("width", "height", "horizontal_fov_deg", "speed_m_per_s", "motion_seed")
        given = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        return {**given, **self.params}


@dataclass(frozen=True)
class TrajectoryConfig(Bounded):
    """Poses from TUM files (``t tx ty tz qx qy qz qw``), one a camera, instead of the calibration's.

    files: camera -> file. pairing: nearest or interpolated. max_gap_ms: a frame further than this from its
    pose sample is not sent. start_s: the trajectory's time at the clip's first frame. hand_eye: the files are
    of the hand that holds the camera, and this one, of ``camera-node calibrate hand-eye --out``, says where.
    """

    files: dict[str, str]
    pairing: str = one_of("interpolated", PAIRINGS)
    max_gap_ms: float = bounded(50.0, 0, MAX_GAP_MS)
    start_s: float = bounded(0.0, -MAX_STAMP_S, MAX_STAMP_S)
    hand_eye: str = ""


@dataclass(frozen=True)
class RecordedConfig(SourceConfig):
    """Keys of all recorded data sets. data: folder or describing file, absolute or below the data folder.
    scale: image sizes are divided by it. loop: clips go back and forth, or restart. assignment: scenario
    camera -> the data set's camera, where the names differ."""

    data: str = ""
    scale: float = bounded(1.0, 1, math.inf)
    loop: str = one_of("back-and-forth", LOOPS)
    assignment: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.data:
            raise ValueError("data: missing: the data set's folder or JSON file")
        if getattr(self, "background", None) == "keep" and self.codec != "png":
            raise ValueError(f"background 'keep' sends alpha, which codec {self.codec!r} cannot; use png")


@dataclass(frozen=True)
class TransformsConfig(RecordedConfig):
    """nerfstudio, instant-ngp, NeRF-synthetic. background: color behind RGBA images;
    ``keep`` sends alpha and needs the codec png."""

    background: str = one_of("white", BACKGROUNDS)


@dataclass(frozen=True)
class VideoConfig(RecordedConfig):
    """Video files with a calibration JSON. data: the JSON, or the folder that holds it. files: camera ->
    video, relative to the JSON (default ``videos/<camera>.mp4`` or ``<camera>.mp4``)."""

    files: dict[str, str] = field(default_factory=dict)
    trajectory: TrajectoryConfig | None = None


@dataclass(frozen=True)
class LiveConfig(SourceConfig):
    """Keys of all kinds with real cameras. devices: camera -> its device (serial number; a number, path or
    address for kind ``camera``); needed if there is more than one. width, height: requested pixels.
    exposure_us: fixed exposure; not given: automatic. calibration: JSON of intrinsics and poses by camera, as
    for videos, relative to the scenario; without it intrinsics are the device's own, if it has any, and poses
    come from ``arm``. first_frame_s: seconds that a camera may take until its first frame."""

    devices: dict[str, str] = field(default_factory=dict)
    width: int = bounded(640, 8, MAX_IMAGE_SIDE_PX)
    height: int = bounded(400, 8, MAX_IMAGE_SIDE_PX)
    exposure_us: int | None = bounded(None, 1, 10**6)
    calibration: str | None = None
    arm: ArmConfig | None = None
    first_frame_s: float = bounded(3.0, 0.1, 60)


@dataclass(frozen=True)
class CameraConfig(LiveConfig):
    """Any camera or stream that OpenCV opens: a USB camera by number or path (/dev/v4l/by-id/...), a network
    camera by address (rtsp://...). It knows no intrinsics: ``calibration`` gives them. latency_ms: from
    exposure to arrival at the host, for drivers without time stamps; subtracted from the time of arrival."""

    latency_ms: float = bounded(0.0, 0, MAX_LATENCY_MS)


@dataclass(frozen=True)
class OakConfig(LiveConfig):
    """Luxonis OAK cameras through depthai 3 (extra ``oak``). socket: which of the device's cameras. iso: with
    exposure_us. rectify: straighten the picture on the device; otherwise its lens goes with the frame, as
    well as four coefficients describe it."""

    socket: str = "CAM_A"
    iso: int = bounded(400, 100, 1600)
    rectify: bool = False


@dataclass(frozen=True)
class RealsenseConfig(LiveConfig):
    """Intel RealSense D400 cameras, their color stream (extra ``realsense``)."""


@dataclass(frozen=True)
class DynerfConfig(RecordedConfig):
    """DyNeRF (Neural 3D Video). data: the folder with ``cam*.mp4`` and ``poses_bounds.npy``."""


@dataclass(frozen=True)
class ZjuConfig(RecordedConfig):
    """ZJU-MoCap. data: the folder with ``annots.npy`` and the cameras' folders of images. recorded_fps: of
    the recording, whose files do not tell. masks: a folder of masks (``mask_cihp``) that cut the person out;
    background: what goes behind the person."""

    recorded_fps: float = bounded(50.0, *FPS_RANGE)
    masks: str | None = None
    background: str = one_of("black", BACKGROUNDS)


@dataclass(frozen=True)
class EyefulConfig(RecordedConfig):
    """Eyeful Tower. data: a scene's folder with ``cameras.json``. images: folder of images in it (default:
    the smallest of ``images-jpeg-1k``, ``-2k``, ``-4k``, ``images-jpeg``). Cameras are called as their
    folders: name them in cameras.ids, or in assignment."""

    images: str | None = None


@dataclass(frozen=True)
class ColmapConfig(RecordedConfig):
    """A COLMAP model, text or binary. data: the folder that holds it, itself or in ``sparse/0``. images:
    folder of images (default ``images``). background: what goes under transparent ones."""

    images: str | None = None
    background: str = one_of("white", BACKGROUNDS)


@dataclass(frozen=True)
class McapConfig(SourceConfig):
    """A session that ``edge-server run --record`` wrote, replayed message by message: the same bytes and
    poses, stamps shifted to now. file: the recording. loop: ``once`` from first to last, after which the
    node ends, or ``restart`` over and over, in step with nodes elsewhere. assignment: scenario camera -> the
    recording's, where the names differ. fps, codec and quality are the recording's own."""

    file: str = ""
    loop: str = one_of("once", REPLAYS)
    assignment: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        super().__post_init__()
        if not self.file:
            raise ValueError("file: missing: the recording")
        if self.effects:
            raise ValueError("effects: a recording is replayed as it was; leave them out")


# kind -> its keys
MODELS: dict[str, type[SourceConfig]] = {
    "world": WorldConfig,
    "transforms": TransformsConfig,
    "video": VideoConfig,
    "dynerf": DynerfConfig,
    "zju": ZjuConfig,
    "eyeful": EyefulConfig,
    "colmap": ColmapConfig,
    "mcap": McapConfig,
    "camera": CameraConfig,
    "oak": OakConfig,
    "realsense": RealsenseConfig,
}


@contextlib.contextmanager
def errors_of(where: str) -> Iterator[None]:
    """Context in which a ValueError becomes a ScenarioError that begins with ``where`` (file and key)."""
    try:
        yield
    except ValueError as error:
        raise ScenarioError(f"{where}: {error}") from None


def source_config(scenario: Scenario) -> SourceConfig:
    """The checked ``source:`` section. Raises ScenarioError."""
    where = f"{scenario.path}: source"
    kind = scenario.source.get("kind")
    if not isinstance(kind, str) or kind not in MODELS:
        raise ScenarioError(f"{where}.kind: expected one of {', '.join(MODELS)}, got {kind!r}")
    return read_section(MODELS[kind], scenario.source, where)


def find_data(name: str, scenario: Scenario, base: Path | None, key: str = "data") -> Path:
    """Locate the file or folder ``name`` that the scenario gives as ``source.key``.

    name: absolute, or relative to the data folder. base: the data folder (--data); None: $FRESHFIELD_DATA.
    Raises ScenarioError if there is no data folder, or nothing at the path.
    """
    where = f"{scenario.path}: source.{key}"
    path = Path(name).expanduser()
    if not path.is_absolute():
        folder = base or (Path(os.environ["FRESHFIELD_DATA"]) if os.environ.get("FRESHFIELD_DATA") else None)
        if folder is None:
            raise ScenarioError(
                f"{where}: {name!r} is looked for in the data folder: give --data DIR or set FRESHFIELD_DATA"
            )
        path = folder / path
    if not path.exists():
        raise ScenarioError(f"{where}: {path} does not exist; --data or FRESHFIELD_DATA names the folder above")
    return path
