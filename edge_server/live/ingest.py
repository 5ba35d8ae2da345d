"""Ingest of frames: checks against earlier frames, the buffer, the ledger, the response.

Ingest never waits for the field and never decodes: it answers as soon as checksum, headers and limits are
checked and the frame is buffered.
"""

from __future__ import annotations

import logging
import time
from collections import Counter, OrderedDict, deque
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass

import grpc
import grpc.aio
import numpy as np

from edge_server.live import live_constants as tuned
from edge_server.live.buffer import FrameBuffer
from freshfield import limits
from freshfield.clock import Clock
from freshfield.depth import EncodedDepth
from freshfield.frame import Frame, FrameRejected, counted_ids, from_request, parse
from freshfield.ledger import Ledger
from freshfield.limits import MAX_IMAGE_SIDE_PX
from freshfield.streams import OpenStreams, ServedCall, SessionStreams
from freshfield.v1 import frames_pb2 as pb

log = logging.getLogger(__name__)

_SERVICE = pb.DESCRIPTOR.services_by_name["FrameStreamService"].full_name


@dataclass
class _Session:
    """The last admitted frame of a session. A camera that restarts opens a new session while frames of the
    old one may still be on their way."""

    sequence: int = -1
    generated_ns: int = -(2**63)
    began_ns: int = 0
    """Capture time of its first frame that this process admitted, on the edge's clock; 0: none yet."""
    newest_ns: int = 0
    """Capture time of its last admitted frame, on the edge's clock."""


@dataclass
class DepthArrivals:
    """Depth received with one camera's frames. bytes: encoded. newest_ns: when the newest was measured, edge clock."""

    frames: int = 0
    bytes: int = 0
    newest_ns: int = -(2**63)

    def add(self, frame: Frame, depth: EncodedDepth) -> None:
        self.frames += 1
        self.bytes += len(depth.payload)
        self.newest_ns = max(self.newest_ns, frame.generated_edge_ns + depth.after_image_ns)


LastFrames = Mapping[str, Mapping[str, tuple[int, int]]]


class FrameAdmission:
    """Checks the order and the time of frames, by camera and session, and their size.

    training, held_out: ids of the cameras in each role.
    max_side_px: longest side of an image, pixels; see ``Scenario.max_side_px``.
    known: ``last_frames`` of an earlier process, so that no frame is taken again after a restart.
    codec: of the images, as the scenario says; None: any.
    """

    def __init__(
        self,
        training: Collection[str],
        held_out: Collection[str],
        max_side_px: int = MAX_IMAGE_SIDE_PX,
        known: LastFrames | None = None,
        codec: str | None = None,
    ) -> None:
        self._max_side_px, self._codec = max_side_px, codec
        self._roles = {c: False for c in training} | {c: True for c in held_out}
        self.cameras: Collection[str] = self._roles.keys()
        self.doubled: Counter[str] = Counter()
        """Frames admitted while another node sent as the same camera, by camera."""
        self._sessions: dict[str, OrderedDict[str, _Session]] = {c: OrderedDict() for c in self._roles}
        for camera in self._roles.keys() & (known or {}).keys():
            sessions = (known or {})[camera].items()
            self._sessions[camera] = OrderedDict((name, _Session(*last)) for name, last in sessions)

    def last_frames(self) -> LastFrames:
        """Sequence and capture time (on the node's clock) of the last frame of each camera's sessions."""
        return {
            camera: {name: (last.sequence, last.generated_ns) for name, last in sessions.copy().items()}
            for camera, sessions in self._sessions.items()
        }

    def admit(self, frame: Frame, now_ns: int) -> None:
        """Raises FrameRejected with reason unknown_camera, wrong_role, unknown_codec, too_large, depth_too_large,
        replayed_sequence, time_reversed, from_future or too_old. now_ns: on the edge's clock."""
        if frame.camera not in self._roles:
            raise FrameRejected("unknown_camera", f"camera {frame.camera!r} is not part of this scenario")
        if frame.held_out != self._roles[frame.camera]:
            raise FrameRejected("wrong_role", f"{frame.camera} is held out at only one of node and edge")
        if self._codec is not None and frame.codec != self._codec:
            raise FrameRejected(
                "unknown_codec", f"a {frame.codec}, where the scenario (source.codec) has {self._codec}: the same file?"
            )
        k, depth = frame.intrinsics, frame.depth
        if max(k.width, k.height) > self._max_side_px:
            raise FrameRejected(
                "too_large",
                f"{k.width} x {k.height}: the scenario (source.width, source.height) has images of at most "
                f"{self._max_side_px} pixels a side",
            )
        most_px = max(self._max_side_px, tuned.DEPTH_SIDE_PX)
        if depth is not None and max(depth.width, depth.height) > most_px:
            raise FrameRejected("depth_too_large", f"depth of {depth.width} x {depth.height}: {most_px} a side at most")
        sessions = self._sessions[frame.camera]
        session = sessions.get(frame.session, _Session())
        if frame.sequence <= session.sequence:
            raise FrameRejected("replayed_sequence", f"{frame.sequence} after {session.sequence}")
        if frame.generated_ns <= session.generated_ns:
            raise FrameRejected("time_reversed", "captured before the frame that came before it")
        ahead = frame.generated_edge_ns - now_ns - min(frame.clock_uncertainty_ns, limits.MAX_CLOCK_UNCERTAINTY_NS)
        if ahead > limits.MAX_CAPTURE_AHEAD_NS:
            raise FrameRejected("from_future", f"captured {ahead / 1e6:.0f} ms from now: clock offset unknown?")
        if -ahead > limits.MAX_CAPTURE_AGE_NS:
            raise FrameRejected("too_old", f"captured {-ahead / 6e10:.0f} minutes ago: a wrong clock?")
        # Only an admitted frame changes the session: a refused one does not affect the next.
        session.sequence, session.generated_ns = frame.sequence, frame.generated_ns
        sessions[frame.session] = session
        session.began_ns = session.began_ns or frame.generated_edge_ns
        session.newest_ns = frame.generated_edge_ns
        self._look_for_two_nodes(frame, sessions)
        sessions.move_to_end(frame.session)
        while len(sessions) > limits.MAX_SESSIONS_PER_CAMERA:
            sessions.popitem(last=False)

    def _look_for_two_nodes(self, frame: Frame, sessions: OrderedDict[str, _Session]) -> None:
        """Count ``frame`` if two nodes send as its camera. A node that restarts ends its old session, whereas
        two nodes keep two sessions going side by side."""
        now_ns, mine = frame.generated_edge_ns, sessions[frame.session]
        other = max(sessions.values(), key=lambda session: session.began_ns)
        goes_on = now_ns - other.newest_ns < tuned.SILENT_SESSION_NS
        if goes_on and mine.began_ns < other.began_ns < now_ns - limits.MAX_CLOCK_UNCERTAINTY_NS:
            if frame.camera not in self.doubled:
                log.warning(
                    "%s: two nodes send as this camera, each in a session of its own: give one another id "
                    "(cameras.ids)",
                    frame.camera,
                )
            self.doubled[frame.camera] += 1


class Ingest:
    """FrameStreamService of the edge.

    max_side_px, known, codec: see ``FrameAdmission``.
    on_held_out(frame), on_accepted(request, now_ns): called on the event loop for held-out frames and for
    every accepted one; they must not block.
    Counts are plain numbers; readers see them without a lock.
    """

    def __init__(
        self,
        clock: Clock,
        buffer: FrameBuffer,
        held_out: Collection[str],
        ledger: Ledger,
        on_held_out: Callable[[Frame], None],
        on_accepted: Callable[[pb.PushRequest, int], None] | None = None,
        max_side_px: int = MAX_IMAGE_SIDE_PX,
        known: LastFrames | None = None,
        codec: str | None = None,
    ) -> None:
        self._clock = clock
        self.buffer = buffer
        self.admission = FrameAdmission(buffer.cameras, held_out, max_side_px, known, codec)
        self._ledger = ledger
        self._on_held_out = on_held_out
        self._on_accepted = on_accepted
        self.delivered: Counter[str] = Counter()
        self.rejected: Counter[str] = Counter()
        self.rejected_by_camera: Counter[str] = Counter()
        self.newest_held_out: dict[str, Frame] = {}
        self.depth: dict[str, DepthArrivals] = {}
        """Of the cameras that have sent depth."""
        self.check_ms: deque[float] = deque(maxlen=tuned.CHECK_TIMES)
        cameras = self.admission.cameras
        self.streams = OpenStreams(limits.MAX_STREAMS_PER_CAMERA * len(cameras))
        self._sessions = SessionStreams(cameras)

    def add_to_server(self, server: grpc.aio.Server) -> None:
        """Register the service. Messages are parsed in ``take``: gRPC would end the stream at the first one
        that cannot be parsed."""
        push = grpc.stream_stream_rpc_method_handler(self._push, None, pb.PushResponse.SerializeToString)
        server.add_generic_rpc_handlers((grpc.method_handlers_generic_handler(_SERVICE, {"Push": push}),))

    def depth_ages_ms(self, now_ns: int) -> dict[str, float]:
        """Age of the newest depth of each camera that has sent any."""
        return {camera: (now_ns - depth.newest_ns) / 1e6 for camera, depth in self.depth.copy().items()}

    async def _push(self, _: object, context: grpc.aio.ServicerContext) -> None:
        async with self.streams.open(context) as stream:
            while (message := await context.read()) is not grpc.aio.EOF:
                await stream.write(self.take(message, stream))

    def take(self, message: bytes | pb.PushRequest, stream: ServedCall | None = None) -> pb.PushResponse:
        """Check one frame, buffer it and enter it in the ledger; the response gives the outcome.

        stream: the call that carried it, which claims the frame's session; None: nothing claims it.
        """
        start_s = time.perf_counter()
        now_ns = self._clock.now_ns()
        header = pb.FrameHeader()
        try:
            request = parse(message) if isinstance(message, bytes) else message
            header = request.header
            frame = from_request(request)
            if stream is not None and frame.camera in self.admission.cameras:
                self._sessions.claim(frame.camera, frame.session, stream, now_ns)
            self.admission.admit(frame, now_ns)
        except FrameRejected as error:
            self.rejected[error.reason] += 1
            camera, session = counted_ids(header, self.admission.cameras)
            self.rejected_by_camera[camera] += 1
            self._ledger.write(now_ns, camera, session, header.sequence, "rejected", error.reason)
            return pb.PushResponse(
                sequence=header.sequence, outcome=pb.OUTCOME_REJECTED, reason=error.reason, detail=str(error)
            )
        if stream is not None:
            stream.use()
        if frame.held_out:
            self.newest_held_out[frame.camera] = frame
            self._on_held_out(frame)
        else:
            self.buffer.put(frame, now_ns)
        if frame.depth is not None:
            self.depth.setdefault(frame.camera, DepthArrivals()).add(frame, frame.depth)
        self.delivered[frame.camera] += 1
        self._ledger.write(now_ns, frame.camera, frame.session, frame.sequence, "delivered")
        if self._on_accepted is not None:
            self._on_accepted(request, now_ns)
        self.check_ms.append((time.perf_counter() - start_s) * 1e3)
        return pb.PushResponse(sequence=frame.sequence, outcome=pb.OUTCOME_ACCEPTED)


def percentile(values: deque[float], percent: float) -> float | None:
    """The value that ``percent`` of ``values`` do not exceed; None if empty. Another thread may add values."""
    known = values.copy()
    return float(np.percentile(known, percent, method="inverted_cdf")) if known else None
