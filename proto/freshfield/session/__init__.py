"""A session in one MCAP file: exactly what arrived at the edge, and what was decided.

Topics, CAMERA being a camera's id:

    /CAMERA/header       freshfield.v1.FrameHeader    the frame's header as received
    /CAMERA/depth        freshfield.v1.Depth          its depth as received, if any; before the image
    /CAMERA/image        foxglove.CompressedImage     its payload; jpeg, png, or zstd, which viewers lack
    /CAMERA/pose         foxglove.PoseInFrame         camera-to-world; frame ``world``
    /CAMERA/calibration  foxglove.CameraCalibration   when it changes; OpenCV's pixel origin
    /tf                  foxglove.FrameTransform      the same pose: ``world`` -> CAMERA, axes as OpenCV's
    /decisions           freshfield.Decision          JSON: an update of the field, when published
    /scores              freshfield.Decision          JSON: the same with its fidelity, when that is known

A message's log time is its arrival at the edge, its publish time the capture, both on the edge's clock.
Header, depth and image hold everything that was sent; the other topics repeat it in formats that viewers know.
Chunks are not compressed: payloads already are, and a truncated file stays readable up to the cut.

Needs the packages mcap, mcap-protobuf-support and foxglove-schemas-protobuf (extra ``mcap``), which only
``writer`` and ``reader`` import.
"""

from __future__ import annotations

WORLD = "world"
HEADER, DEPTH, IMAGE, POSE, CALIBRATION = "header", "depth", "image", "pose", "calibration"
TRANSFORMS, DECISIONS, SCORES = "/tf", "/decisions", "/scores"
INSTALL = "recordings need MCAP: pip install 'freshfield[mcap]'"
INSTALL_ROS = "ROS bags need rosbags: pip install 'freshfield[ros]'"


class SessionError(ValueError):
    """A recording that cannot be written or read; the message says why and what to do."""


def topic_of(camera: str, kind: str) -> str:
    """Topic of a camera's messages of a kind."""
    return f"/{camera}/{kind}"
