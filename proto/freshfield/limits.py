"""Every bound on what a process accepts from outside, with its unit and the reason for its value.

A frame, a scenario or a stream beyond one of these is refused where it arrives, and the refusal is counted by
its reason. Bounds of settings (what a scenario's sections may say) stand with the settings.
"""

from __future__ import annotations

# --- messages and images ----------------------------------------------------------------------

MAX_PAYLOAD_BYTES = 8 * 2**20
"""Of one encoded image: four bits a pixel of the largest one, more than a JPEG of high quality takes."""

MAX_MESSAGE_BYTES = MAX_PAYLOAD_BYTES + 4096
"""Of one gRPC message: the header's room beside the largest payload."""

MAX_IMAGE_SIDE_PX = 4096
"""Of a decoded image: 50 MB of RGB, which bounds what a decompression bomb can cost."""

MAX_PNG_CHUNKS = 10_000
"""Of one PNG, all of which a decoder looks at. Encoders write 8 kB or more into a chunk: 1000 in 8 MB."""

MAX_JPEG_SEGMENTS = 1000
"""Before a JPEG's first scan, fill bytes included. A camera writes some ten; a 16 MB profile takes 250."""

MAX_JPEG_SCANS = 16
"""Of one JPEG: a baseline one has 1 to 3, a progressive one some 10. A decoder visits every block in each."""

MAX_ID_CHARS = 64
"""Of a camera or session id: it becomes part of file names and of ledger lines."""

MAX_POLICY_CHARS = 1024
"""Of a policy's name: it may hold a file's path."""

MAX_PEER_TEXT_CHARS = 200
"""Of a peer's words in a log line."""

MAX_REASONS = 32
"""Different reasons of a peer's refusals that are counted apart: a broken peer may make them up."""

# --- files ------------------------------------------------------------------------------------

MAX_YAML_CHARS = 2**17
"""Of one scenario or other YAML file: a thousand cameras with the longest ids take half of it, and its reader
takes 2 s for as many characters."""

MAX_ERROR_CHARS = 1000
"""Of what an error quotes from a file."""

MAX_CHUNK_BYTES = 16 * 2**20
"""Of a recording's compressed chunk, unpacked: writers end one at 1 MB, but for the largest image."""

MAX_UNPACKED_PER_BYTE = 20
"""Of all compressed chunks of a recording together: most of it is images, which do not compress."""

MAX_MODEL_BYTES = 4 * 2**30
"""Of memory for all ONNX models of a process together: four times what the largest YOLO11 takes for a batch.
An allocation beyond it fails, whatever sizes the file states."""

# --- streams and cameras ----------------------------------------------------------------------

MAX_CAMERAS = 1000
"""Of one scenario: a stream each, so that one connection serves them all."""

MAX_STREAMS_PER_CAMERA = 4
"""Streams open at once at a process, for each of its cameras: one is in use, others may be closing after a
restart. Beyond that a new stream ends the one of least use."""

MAX_WATCHERS = 32
"""Of decisions, at once. Each takes a look at the state twenty times a second."""

MAX_SNAPSHOTS = 20
"""In the folder of one run: whoever asks for more is told to move some away."""

MAX_SCRAPES = 8
"""Connections open at once to the metrics, or to the preference page: a new one ends the oldest."""

SCRAPE_TIMEOUT_S = 5.0
"""How long one of them may say nothing."""

MAX_VISITORS = 32
"""Of the page, at once. One who does not read costs what the page sends at first, some megabytes."""

VISITOR_TIMEOUT_S = 30.0
"""How long a visitor may leave unread what was sent: a slow line takes the first megabytes in that time."""

MAX_VISITOR_MESSAGE_BYTES = 2**16
"""Of what a visitor sends: viewpoints, clicks and values of controls take less than a kilobyte."""

MAX_CLICKS_HZ = 50.0
"""Of one visitor, on controls and cameras, and as many at once: a number's arrow, held down, makes 40."""

MAX_VIEW_SIDE_PX = 16384
"""Of a visitor's window: wider than any screen."""

MAX_PAGE_CONNECTIONS = 128
"""To the page, visitors and requests, at once: a browser opens six. A new one ends the oldest request.
Over TLS as many more may be in their handshake, of which a new one ends the oldest."""

TLS_HANDSHAKE_TIMEOUT_S = 5.0
"""Of a connection to the page or to gRPC: without a handshake it ends."""

MAX_GRPC_CONNECTIONS = 512
"""To one address, those in their handshake included; more are closed at once. A process may usually have
1,024 files open, and a run needs some for itself. A node has one for all its cameras."""

GRPC_IDLE_S = 60.0
"""Of a connection to gRPC: without a call it ends, and its place is free. Clients connect again."""

MAX_QUEUED_BYTES = 256 * 2**20
"""Of all frames inside the emulator's links: 2.5 s of a thousand cameras of 100 kB a second."""

MAX_CONCURRENT_STREAMS = 1024
"""Of one gRPC connection: a stream for each camera of the largest scenario, and some calls beside them."""

MAX_SESSIONS_PER_CAMERA = 64
"""Sessions remembered for a camera. A forgotten session could be replayed, so many are remembered."""

SESSION_IDLE_NS = 2 * 10**9
"""After as long without a frame, another stream may go on with a session: a node whose stream is gone without
a word opens another one."""

# --- time -------------------------------------------------------------------------------------

LONGEST_MS = 3_600_000.0
"""Of a wait, a period, a deadline or an update: in an hour every scene has changed."""

MAX_STAMP_S = 4.6e9
"""Of a stamp in a file, either way: the difference of two fits 64 bits in nanoseconds. Since 1970 it is the
year 2115; larger ones are in another unit."""

MAX_CAPTURE_AHEAD_NS = 250_000_000
"""How far a capture may lie ahead of the edge's clock, beyond the uncertainty of the node's offset."""

MAX_CAPTURE_AGE_NS = 3600 * 10**9
"""How far behind it: an hour-old frame comes from a broken clock, not over a slow link."""

MAX_CLOCK_UNCERTAINTY_NS = 10**9
"""What an offset's uncertainty may excuse. A node that has not measured its offset announces an hour, which
must not make a frame from the future the newest one until that future has come."""

# --- poses and lenses -------------------------------------------------------------------------

MAX_TRANSLATION_M = 1e6
"""From the origin, by axis: more is a wrong unit (a kilometer in millimeters) or garbage."""

MAX_QUATERNION_ERROR = 1e-3
"""Of a quaternion's length from 1; also of a rotation matrix from orthonormal. Real calibrations are
better."""

MIN_FOCAL_PER_SIDE = 1 / 16
"""Focal length over the longer image side: 1/16 is a 166 degree lens, beyond what a pinhole can describe."""

MAX_FOCAL_PX = 1e6
"""Focal length: more is parallel light."""

MAX_DISTORTION = 100.0
"""Of each distortion coefficient: more than any lens has."""

MAX_CENTER_OUTSIDE_SIDES = 1.0
"""How far the principal point may lie outside the image, in image sides: only a crop puts it outside at
all."""

MAX_LENS_ERROR_PX = 1.0
"""Between a pixel and itself after undistortion and projection: more, and the lens cannot be inverted."""
