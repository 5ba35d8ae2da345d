"""The scenario's ``source:`` section: what the cameras see, their frame rate, and how frames are compressed.

``kind`` chooses the struct in ``MODELS``, or a plug-in class (``own_class``), whose docstring and keys
``freshfield scenario keys source`` prints. All keys are checked here, with file and key in the message. Checks that
need the data itself (does the folder hold this camera?) are made when the source opens.
"""

from __future__ import annotations

import contextlib
import math
import os
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from msgspec import field

from camera_node.node_constants import MAX_GAP_MS, MAX_STAMP_S
from camera_node.robot.arm.settings import ArmConfig
from freshfield import plugins
from freshfield.limits import MAX_IMAGE_SIDE_PX
from freshfield.payload import DEFAULT_CODEC
from freshfield.scenario import Scenario
from freshfield.settings import ScenarioError, Settings, about, read_settings, within

if TYPE_CHECKING:
    from camera_node.sources.base import Source

Background = Literal["white", "black", "keep"]
FPS_RANGE = (0.01, 1000.0)
"""Bounds of a capture or recording rate, frames a second."""
# Captures a second where a scenario gives no rate: of a synthetic world, of a device, of photos without times.
WORLD_FPS, LIVE_FPS, PHOTO_FPS = 15.0, 15.0, 10.0
FIRST_FRAME_S = 3.0
"""Default of the longest wait for a camera's first frame."""

ZJU_FPS = 50.0
"""Assumed frame rate of ZJU-MoCap, which its files do not state."""
MAX_LATENCY_MS = 6e4
"""Longest latency of a camera: one that is a minute late is not live."""


class SourceConfig(Settings, frozen=True, kw_only=True):
    """Keys of every kind. fps: not given, it is the recording's own, 15 for a world, 10 for photos. effects: name ->
    parameters, or null (see ``freshfield scenario keys effects``).
    """

    kind: str
    fps: Annotated[float, within(*FPS_RANGE, "captures per second")] | None = None
    codec: Literal["jpeg", "png", "zstd"] = DEFAULT_CODEC
    quality: Annotated[int, within(1, 100, "of JPEG; from 90 up, color is not subsampled")] = 92
    # Depth takes about as many bytes as its image: with 5 it is a sixth of all bytes, in 3 of 15 frames a second.
    depth_every: Annotated[int, within(0, 10**6, "one in this many frames of a depth camera has depth; 0: none")] = 5
    effects: dict[str, dict[str, Any] | None] = field(default_factory=dict)

    waits: ClassVar[bool] = False  # whether captures wait for hardware: in threads of their own, never in virtual time


class WorldConfig(SourceConfig, frozen=True, kw_only=True):
    """A synthetic world. motion_seed: draws path, sense, start and speed; not given: the scene's own motion. arm:
    images of its cameras are rendered from the simulated arm's true pose.
    """

    scene: Annotated[str, about("room, drawn_room, tile or tower")] = "room"
    width: Annotated[int | None, about("pixels")] = None
    height: Annotated[int | None, about("pixels")] = None
    horizontal_fov_deg: Annotated[float | None, about("of the cameras")] = None
    speed_m_per_s: Annotated[float | None, about("of the scene's motion")] = None
    motion_seed: Annotated[int | None, about("draws another motion of the scene")] = None
    params: Annotated[dict[str, Any], about("further parameters of the scene, by name")] = field(default_factory=dict)
    arm: Annotated[ArmConfig | None, about("carries the cameras that it lists")] = None
    carried: Annotated[tuple[str, ...], about("cameras that somebody carries through the room")] = ()

    def scene_parameters(self) -> dict[str, Any]:
        """Parameters of the scene by name: the fields above that were given, and ``params``."""
        names = ("width", "height", "horizontal_fov_deg", "speed_m_per_s", "motion_seed")
        given = {name: getattr(self, name) for name in names if getattr(self, name) is not None}
        return {**given, **self.params}


class TrajectoryConfig(Settings, frozen=True):
    """Poses from TUM files (``t tx ty tz qx qy qz qw``), one per camera, instead of the calibration's. With real
    cameras, a tracker writes the files, or named pipes, while they run; t is in seconds since 1970.

    max_gap_ms: a frame farther than this from its pose sample is not sent.
    hand_eye: output of ``camera-node calibrate hand-eye --out``: the camera's pose on the flange, whose poses the
    files then hold.
    """

    files: Annotated[dict[str, str], about("camera -> file")]
    pairing: Literal["nearest", "interpolated"] = "interpolated"
    max_gap_ms: Annotated[float, within(0, MAX_GAP_MS, "largest gap from frame to pose sample")] = 50.0
    start_s: Annotated[float, within(-MAX_STAMP_S, MAX_STAMP_S, "the trajectory's time at the clip's first frame")] = (
        0.0
    )
    hand_eye: str = ""


class RecordedConfig(SourceConfig, frozen=True, kw_only=True):
    """Keys of all recorded data sets. assignment: where the names differ."""

    data: Annotated[str, about("folder or file, absolute or below the data folder")] = ""
    scale: Annotated[float, within(1, math.inf, "image sizes are divided by it")] = 1.0
    assignment: Annotated[dict[str, str], about("scenario camera -> the data's")] = field(default_factory=dict)

    def __post_init__(self) -> None:
        if not self.data:
            raise ValueError("data: missing: the data set's folder or JSON file")
        if getattr(self, "background", None) == "keep" and self.codec != "png":
            raise ValueError(f"background 'keep' sends alpha, which codec {self.codec!r} cannot; use png")


class TransformsConfig(RecordedConfig, frozen=True, kw_only=True):
    """nerfstudio, instant-ngp, NeRF-synthetic. background: color behind RGBA images;
    ``keep`` sends alpha and needs the codec png."""

    background: Background = "white"


class VideoConfig(RecordedConfig, frozen=True, kw_only=True):
    """Video files with a calibration JSON. data: the JSON or its folder; or one camera's video, whose lens
    ``horizontal_fov_deg`` gives. files: not given, they are ``videos/<camera>.mp4`` or ``<camera>.mp4``.
    """

    files: Annotated[dict[str, str], about("camera -> video, relative to the JSON")] = field(default_factory=dict)
    horizontal_fov_deg: Annotated[float, within(5.0, 150.0, "of a video without a calibration")] | None = None
    trajectory: Annotated[TrajectoryConfig | None, about("poses from files")] = None


class LiveConfig(SourceConfig, frozen=True, kw_only=True):
    """Keys of all kinds with real cameras.

    devices: serial numbers; for kind ``camera`` a number, path or address (``camera-node devices``). Needed if there is
        more than one.
    calibration: relative to the scenario; not given: intrinsics are the device's, if it reports any, and poses come
    from ``arm`` or ``trajectory``, whose files are relative to the scenario, too.
    """

    devices: Annotated[dict[str, str | int], about("camera -> its device")] = field(default_factory=dict)
    width: Annotated[int, within(8, MAX_IMAGE_SIDE_PX, "requested pixels")] = 640
    height: Annotated[int, within(8, MAX_IMAGE_SIDE_PX, "requested pixels")] = 400
    exposure_us: Annotated[int, within(1, 10**6, "fixed exposure; not given: automatic")] | None = None
    calibration: Annotated[str | None, about("JSON of intrinsics and poses by camera, as for videos")] = None
    arm: Annotated[ArmConfig | None, about("an arm that carries the cameras it lists")] = None
    trajectory: Annotated[TrajectoryConfig | None, about("poses that a tracker writes to files")] = None
    first_frame_s: Annotated[float, within(0.1, 60, "time that a camera may take until its first frame")] = (
        FIRST_FRAME_S
    )

    waits: ClassVar[bool] = True


class CameraConfig(LiveConfig, frozen=True, kw_only=True):
    """Any camera or stream that OpenCV opens: a USB camera by number or path (/dev/v4l/by-id/...), a network
    camera by address (rtsp://...). It knows no intrinsics: ``calibration`` gives them. latency_ms: for drivers without
    time stamps.
    """

    latency_ms: Annotated[float, within(0, MAX_LATENCY_MS, "from exposure to arrival at the host")] = 0.0


class OakConfig(LiveConfig, frozen=True, kw_only=True):
    """Luxonis OAK cameras through depthai 3 (extra ``oak``). The device undistorts the image, and measures depth if it
    has a stereo pair.
    """

    socket: Annotated[str, about("which of the device's cameras")] = "CAM_A"
    iso: Annotated[int, within(100, 1600, "with exposure_us")] = 400


class RealsenseConfig(LiveConfig, frozen=True, kw_only=True):
    """Intel RealSense D400 cameras: color, and depth of the same size unless ``depth_every`` is 0 (extra
    ``realsense``)."""


class DynerfConfig(RecordedConfig, frozen=True, kw_only=True):
    """DyNeRF (Neural 3D Video). data: the folder with ``cam*.mp4`` and ``poses_bounds.npy``."""


class ZjuConfig(RecordedConfig, frozen=True, kw_only=True):
    """ZJU-MoCap. data: the folder with ``annots.npy`` and the cameras' folders of images. background: what goes
    behind the person."""

    recorded_fps: Annotated[float, within(*FPS_RANGE, "of the recording, whose files do not state it")] = ZJU_FPS
    masks: Annotated[str | None, about("a folder of masks (mask_cihp) that cut the person out")] = None
    background: Background = "black"


class EyefulConfig(RecordedConfig, frozen=True, kw_only=True):
    """Eyeful Tower. data: a scene's folder with ``cameras.json``. Cameras are named like their folders: list them
    in cameras.ids, or in assignment. images: not given, it is the smallest of ``images-jpeg-1k``, ``-2k``, ``-4k``,
    ``images-jpeg``.
    """

    images: Annotated[str | None, about("folder of images")] = None


class ColmapConfig(RecordedConfig, frozen=True, kw_only=True):
    """A COLMAP model, text or binary. data: the folder that holds it, itself or in ``sparse/0``. background: what
    goes under transparent images."""

    images: Annotated[str | None, about("folder of images; not given: images")] = None
    background: Background = "white"


class HandheldConfig(RecordedConfig, frozen=True, kw_only=True):
    """One moving camera with depth. data: the folder of a TUM RGB-D sequence (rgb.txt), of a 7-Scenes sequence
    (frame-*.pose.txt), of a Record3D export "EXR + JPG" (metadata.json), or of Polycam's raw data (keyframes)."""


class FoxgloveConfig(RecordedConfig, frozen=True, kw_only=True):
    """A recording in MCAP, by any tool, in Foxglove's protobuf messages (extra ``mcap``). data: the file."""


class RosbagConfig(RecordedConfig, frozen=True, kw_only=True):
    """A ROS bag, read without ROS (extra ``ros``). data: a ROS 2 bag's folder, its one .mcap or .db3 file, or a ROS 1
    .bag. Cameras are named like their frames (``frame_id``): list them in cameras.ids, or in assignment."""


class McapConfig(SourceConfig, frozen=True, kw_only=True):
    """A session that ``edge-server run --record`` wrote, replayed message by message: the same bytes and
    poses, with stamps shifted to now, once through, after which the node ends. fps, codec, quality and depth are
    the recording's."""

    file: Annotated[str, about("the recording")] = ""
    assignment: Annotated[dict[str, str], about("scenario camera -> the recording's")] = field(default_factory=dict)

    def __post_init__(self) -> None:
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
    "tum": HandheldConfig,
    "sevenscenes": HandheldConfig,
    "record3d": HandheldConfig,
    "polycam": HandheldConfig,
    "rosbag": RosbagConfig,
    "foxglove": FoxgloveConfig,
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
    if not isinstance(kind, str):
        raise ScenarioError(f"{where}.kind: expected one of {', '.join(MODELS)}, got {kind!r}")
    with errors_of(f"{where}.kind"):
        model = MODELS.get(kind) or own_class(kind)[1]
    config = read_settings(model, scenario.source, where)
    if isinstance(config, LiveConfig | VideoConfig):
        files = {} if config.trajectory is None else config.trajectory.files
        for key, named in (("devices", getattr(config, "devices", {})), ("trajectory.files", files)):
            if unknown := [camera for camera in named if camera not in scenario.cameras]:
                raise ScenarioError(f"{where}.{key}.{unknown[0]}: not a camera of this scenario")
    if scenario.phase != "locked" and not isinstance(config, WorldConfig):
        raise ScenarioError(
            f"{scenario.path}: cameras.phase: {scenario.phase} applies to source.kind world only, others capture at "
            "their own times: remove phase"
        )
    return config


def own_class(kind: str) -> tuple[type[Source], type[SourceConfig]]:
    """The class of a plug-in source (``freshfield.plugins``), and its keys. Raises PluginError."""
    from camera_node.sources.base import Source

    found: type[Source] = plugins.find("source", kind, MODELS)
    if not issubclass(found, Source):
        raise plugins.PluginError(f"{kind}: {found.__name__} does not derive from camera_node.sources.base.Source")
    keys, built_in = found.Config or SourceConfig, (WorldConfig, RecordedConfig, LiveConfig, McapConfig)
    if not (isinstance(keys, type) and issubclass(keys, SourceConfig)) or issubclass(keys, built_in):
        raise plugins.PluginError(f"{kind}: Config: expected a subclass of SourceConfig, and of no built-in kind's")
    return found, keys


def beside(scenario: Scenario, name: str) -> Path:
    """A file that the scenario names, relative to it."""
    return scenario.path.parent / Path(name).expanduser()


def find_data(name: str, scenario: Scenario, base: Path | None, key: str = "data") -> Path:
    """Locate the file or folder ``name`` that the scenario gives as ``source.key``.

    name: absolute, or relative to the scenario's folder, else to the data folder.
    base: the data folder (--data); None: $FRESHFIELD_DATA.
    Raises ScenarioError if there is no data folder, or nothing at the path.
    """
    where = f"{scenario.path}: source.{key}"
    path = Path(name).expanduser()
    if (near := beside(scenario, name)).exists():
        return near
    if not path.is_absolute():
        given = base or os.environ.get("FRESHFIELD_DATA")
        if given is None or not (Path(given) / path).exists():
            of_rig = scenario.source.get("kind") == "video" and path.suffix == ".json"
            rig = "; camera-node calibrate rig writes it" if of_rig else ""
            folder = f"the data folder ({given or 'none given'}: --data DIR or FRESHFIELD_DATA)"
            raise ScenarioError(f"{where}: {name}: neither beside {scenario.path.name} nor in {folder}{rig}")
        path = Path(given) / path
    if not path.exists():
        raise ScenarioError(f"{where}: {path} does not exist")
    return path
