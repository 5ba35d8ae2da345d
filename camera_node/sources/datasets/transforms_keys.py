"""The keys of a ``transforms.json`` that the tools of the field write: which are honored, which change nothing here,
and which are refused because they change the camera or what may be learned. docs/data.md has the table for users."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any

from camera_node.sources.datasets.records import DatasetError

CAMERA_NAMES = ("camera", "camera_label", "camera_name", "cam_name", "cam", "camera_id", "cam_id", "camera_index")
"""Keys of a frame that name the camera that took it; the first one counts."""

_HONORED = """
frames file_path transform_matrix fps time is_bad mask_path
camera_model is_fisheye fl_x fl_y cx cy w h camera_angle_x camera_angle_y x_fov y_fov k1 k2 k3 k4 p1 p2
distortion_params train_filenames test_filenames val_filenames test_frames
depth_file_path depth_path depth_unit_scale_factor integer_depth_scale
"""
HONORED = frozenset((*_HONORED.split(), *CAMERA_NAMES))

# Where the scene lies and how large it is, which is found from the cameras here; normals and points, which are not
# used; how it was made.
_HARMLESS = """
aabb_scale aabb scale offset render_aabb render_aabb_to_local up orientation_override auto_scale_poses_override
applied_transform applied_scale scene_box scene_scale scene_center avg_pos near far z_near z_far bounds
enable_depth_loading normal_path normal_file_path confidence_path ply_file_path sparse_pcd_path
rotation sharpness sharpen blur_score frame frame_id frame_index n_frames colmap_im_id colmap_id image_id id
timestamp timestamps timestamp_ns exposure exposure_time iso name version generator camera_make date
driver_parameters n_extra_learnable_dims has_mask
"""
HARMLESS = frozenset(_HARMLESS.split())

_STEPS = ("timestep", "timestep_index", "time_index", "frame_time")  # of a frame; beside its time they say nothing more
_PINHOLES = "cut them into images of a pinhole camera"
_UNDISTORT = "undistort the images and leave it out"
REFUSED: dict[str, str] = {
    **dict.fromkeys(("latlong", "equirectangular", "spherical"), f"the images are panoramas: {_PINHOLES}"),
    **dict.fromkeys([f"ftheta_p{k}" for k in range(5)], f"the lens is an f-theta lens: {_UNDISTORT}"),
    **dict.fromkeys(("k5", "k6"), f"these belong to a rational lens model: {_UNDISTORT}"),
    **dict.fromkeys(("b1", "b2", "skew"), f"the pixels are skewed: {_UNDISTORT}"),
    **dict.fromkeys([f"s{k}" for k in range(1, 5)], f"the lens has thin-prism terms: {_UNDISTORT}"),
    "xi": f"the lens is omnidirectional: {_UNDISTORT}",
    "fisheye_crop_radius": "pixels beyond it are no image: give each frame a mask_path that is black there",
    "rolling_shutter": "each row has a pose of its own: correct the images and leave it out",
    **dict.fromkeys(
        ("transform_matrix_start", "transform_matrix_end"),
        "the camera moved during the exposure: give the pose of its middle as transform_matrix",
    ),
    "enable_ray_loading": "rays come from files of their own: give a lens instead",
    **dict.fromkeys(_STEPS, "give the instant in seconds as time"),
    **dict.fromkeys(("from_mitsuba", "from_na"), "its axes are others: convert the poses to OpenGL's and leave it out"),
    **dict.fromkeys(
        ("white_transparent", "black_transparent", "mask_color"),
        "a color stands for transparent pixels: store images with alpha and leave it out",
    ),
}

# What a key that nobody here knows must not look like: words of lenses, projections and masks.
_SUSPECT = re.compile(
    r"fish|^dist(?!ance)|coef|radial|tangential|shutter|lens_?(model|type|dist|corr)|^lens$|fov|skew|mask|alpha|crop|"
    r"\broi\b|binning|(?<![a-z])projection|pano|equi|lat_?long|ortho|omni|shift|flip|mirror|rotate|orientation|"
    r"_to_(cam|world)|2(w|c)$|convention|coordinate|pose_?type|^(camera_)?model$|"
    r"^([kpsb]_?\d+|f[xy]|c[xy]|focal.*|intr.*|extr.*|camera_(type|intrinsics|matrix|angle.*)|K|D)$",
    re.IGNORECASE,
)


def check_keys(entry: Mapping[str, Any], where: str) -> set[str]:
    """The keys of ``entry`` that nobody here knows, and that look harmless. Raises DatasetError for one that says
    something and is refused, or looks as if it changed the camera or what may be learned."""
    unknown: set[str] = set()
    for key in entry.keys() - HONORED - HARMLESS:
        if not says_something(entry[key]):
            continue
        if key in _STEPS and "time" in entry:
            continue
        if key in REFUSED:
            raise DatasetError(f"{where}: {key}: {REFUSED[key]}")
        if _SUSPECT.search(key):
            raise DatasetError(
                f"{where}: {key} is not understood and may change the camera or what may be learned: undistort or mask "
                "the images accordingly, and leave it out"
            )
        unknown.add(key)
    return unknown


def unknown_note(unknown: Iterable[str]) -> str:
    """A sentence on keys that ``check_keys`` found unknown."""
    return f"keys that are not understood and not used: {', '.join(sorted(unknown))[:300]}"


def says_something(value: Any) -> bool:
    """Whether a value is other than null, zero, false and empty, or a list of such."""
    if isinstance(value, list | tuple):
        return any(says_something(each) for each in value)
    return bool(value)
