"""Limits of frames, streams, connections and files, for every process, with unit and reason.

A frame, a scenario or a stream that exceeds one of these is refused where it arrives, and the refusal is
counted by its reason. Bounds of settings (in the sections of a scenario) are defined with the settings; what one
program alone accepts (visitors of its page, ONNX models, policies) is bounded in the constants of its folder.
"""

from __future__ import annotations

# --- messages and images ----------------------------------------------------------------------

MAX_PAYLOAD_BYTES = 8 * 2**20
"""Size of an encoded image, with its depth: four bits per pixel of the largest one, more than a high-quality JPEG
needs."""

MAX_MESSAGE_BYTES = MAX_PAYLOAD_BYTES + 4096
"""Size of a gRPC message: the largest payload, and space for the header."""

MAX_IMAGE_SIDE_PX = 4096
"""Width and height of a decoded image: 50 MB of RGB, which bounds the cost of a decompression bomb."""

METERS_PER_COUNT = (1e-6, 1.0)
"""Scale of 16-bit depth: the smallest gives a range of 6.5 cm, less than any sensor's, the largest 65 km."""

USUAL_DEPTH_M = (0.02, 200.0)
"""Bounds of an image's median depth; outside them, its unit is wrong: 1 m read as millimeters is 1 km or 1 mm."""

MAX_DEPTH_GAP_NS = 10**10
"""Time between an image and its depth: some 100 ms between a camera's streams, seconds in replays of a slow sensor."""

MAX_PNG_CHUNKS = 10_000
"""Chunks of a PNG, because a decoder reads them all. Encoders write 8 kB or more per chunk: 1000 in 8 MB."""

MAX_JPEG_SEGMENTS = 1000
"""Segments and fill bytes before a JPEG's first scan. A camera writes some ten; a 16 MB profile takes 250."""

MAX_JPEG_SCANS = 16
"""Scans of a JPEG: a baseline one has 1 to 3, a progressive one some 10. Each visits every block."""

MAX_ID_CHARS = 64
"""Length of a camera or session id, which becomes part of file names and ledger lines."""

MAX_PEER_TEXT_CHARS = 200
"""Length of a peer's text in a log line."""

MAX_REASONS = 32
"""Number of a peer's refusal reasons that are counted separately: a broken peer may invent reasons."""

# --- files ------------------------------------------------------------------------------------

MAX_YAML_CHARS = 2**17
"""Length of a scenario or other YAML file: a thousand cameras with the longest ids need half of it, and
reading as many characters takes 2 s."""

MIN_YAML_VALUES, MAX_YAML_DEPTH = 100_000, 50
"""Number of values allowed in any YAML file, however short: anchors may well repeat cameras and lenses. Depth of nested
collections; the parser's work for every token grows with it."""

MAX_FILE_BYTES = 2**30
"""Size of any file that is read whole, unless a reader says otherwise."""

MAX_ERROR_CHARS = 1000
"""Length of a quotation from a file in an error message."""

# --- streams and cameras ----------------------------------------------------------------------

MAX_CAMERAS = 1000
"""Number of cameras of a scenario, each with a stream, so that one connection serves them all."""

MAX_STREAMS_PER_CAMERA = 4
"""Number of open streams at a process, per camera: one is in use, others may be closing after a restart. Beyond that,
a new stream ends the least used one."""

TLS_HANDSHAKE_TIMEOUT_S = 5.0
"""How long a connection to the page or to gRPC may last without a completed handshake."""

MAX_GRPC_CONNECTIONS = 512
"""Number of connections to one address, including those in their handshake; further ones are closed at once.
A process may usually have 1,024 open files, and a run needs some itself. A node has one connection for all
its cameras."""

GRPC_IDLE_S = 60.0
"""How long a connection to gRPC may last without a call; then it ends. Clients connect again."""

MAX_CONCURRENT_STREAMS = 1024
"""Streams of a gRPC connection: one for each camera of the largest scenario, and some further calls."""

MAX_CALLS = 3 * MAX_CAMERAS
"""Open calls of a server, on all its connections, unless it says how many it needs: three for each camera of the
largest scenario. A new call ends one that carried no message."""

MAX_PENDING_CALLS = 1000
"""Calls waiting to be handled: all cameras of the largest scenario may connect at once. Above this number some further
calls are refused, above 1.5 times as many all of them."""

FIRST_MESSAGE_TIMEOUT_S = 10.0
"""How long a call of a unary-request method may stay open before its message arrives."""

MAX_SESSIONS_PER_CAMERA = 64
"""Number of sessions remembered for a camera: many, because a forgotten session could be replayed."""

SESSION_IDLE_NS = 2 * 10**9
"""Time without a frame after which another stream may continue a session: a node whose stream ended without
notice opens another one."""

# --- time -------------------------------------------------------------------------------------

MAX_CAPTURE_AHEAD_NS = 250_000_000
"""How far a capture may be ahead of the edge's clock, beyond the uncertainty of the node's offset."""

MAX_CAPTURE_AGE_NS = 3600 * 10**9
"""How far a capture may be behind the edge's clock: an hour means a broken clock, not a slow link."""

MAX_CLOCK_UNCERTAINTY_NS = 10**9
"""Largest uncertainty of an offset that is tolerated. A node that has not measured its offset reports an
hour, which must not make a frame from the future the newest one until that time has come."""

# --- poses and lenses -------------------------------------------------------------------------

MAX_TRANSLATION_M = 1e6
"""Distance from the origin along each axis: more is a wrong unit (a kilometer in millimeters) or garbage."""

MAX_QUATERNION_ERROR = 1e-3
"""Error of a quaternion's length, or of a rotation's orthonormality. Real calibrations are better."""

MIN_FOCAL_PER_SIDE = 1 / 16
"""Focal length over the longer image side: 1/16 is a 166 degree lens, beyond what a pinhole can describe."""

MAX_FOCAL_PX = 1e6
"""Focal length; with a larger one, the rays are parallel."""

MAX_DISTORTION = 100.0
"""Absolute value of each distortion coefficient: more than any lens has."""

MAX_CENTER_OUTSIDE_SIDES = 1.0
"""How far the principal point may be outside the image, in image sides: only a crop puts it outside."""

MAX_LENS_ERROR_PX = 1.0
"""Distance of a pixel from itself after undistortion and projection; a lens with more cannot be inverted."""
