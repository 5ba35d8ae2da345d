"""A stylus on the network: a driver of a 3D Systems Touch, a VR controller or a script sends its samples.

Each message is a UDP datagram of JSON, of at most 2048 bytes. ``camera-node teleop --help`` describes it; the
axes of ``p`` are the arm's base's after a rotation by ``yaw_deg``, so z is up.

Only the first sender counts, until it has been silent for a second. Datagrams are neither authenticated nor
encrypted, so the default address is reachable from this machine alone.
"""

from __future__ import annotations

import json
import logging
import socket

from camera_node.robot.teleop import TeleopError
from camera_node.robot.teleop.stylus import StylusSample

log = logging.getLogger("camera-node.teleop")

MAX_BYTES = 2048
_MAX_MESSAGES = 64  # per poll, so that a flood does not delay the arm
_OWNED_NS = 1_000_000_000


class NetworkStylus:
    """Listens at ``host``:``port``; port 0 takes a free one, which ``port`` then tells. Raises
    TeleopError."""

    ended = False

    def __init__(self, host: str, port: int) -> None:
        self._owner: tuple[str, int] | None = None
        self._heard_ns = 0
        try:
            kind = socket.AF_INET6 if ":" in host else socket.AF_INET
            self._socket = socket.socket(kind, socket.SOCK_DGRAM)
            self._socket.bind((host, port))
        except OSError as error:
            raise TeleopError(
                f"--stylus network: cannot listen at {host}:{port}: {error.strerror}; name another port"
            ) from None
        self._socket.setblocking(False)
        self.port: int = self._socket.getsockname()[1]

    def poll(self, now_ns: int) -> list[StylusSample]:
        """See ``Stylus``."""
        found = []
        for _ in range(_MAX_MESSAGES):
            try:
                data, sender = self._socket.recvfrom(MAX_BYTES + 1)
            except OSError:
                break  # nothing there
            if self._owner is not None and sender[:2] != self._owner and now_ns - self._heard_ns < _OWNED_NS:
                continue
            sample = parse(data)
            if sample is None:
                continue
            if self._owner != sender[:2]:
                log.info("stylus: messages come from %s:%d", *sender[:2])
            self._owner, self._heard_ns = sender[:2], now_ns
            found.append(sample)
        return found

    def close(self) -> None:
        self._socket.close()


def parse(data: bytes) -> StylusSample | None:
    """Parse a message; None if it is malformed. Its numbers are checked later (``StylusSample.is_valid``)."""
    if len(data) > MAX_BYTES:
        return None
    try:
        message = json.loads(data)
        t_ns, clutch = message["t_ns"], message["clutch"]
        position = tuple(float(v) for v in message["p"])
        quaternion = tuple(float(v) for v in message["q"])
    except (ValueError, TypeError, KeyError, OverflowError, RecursionError):
        return None
    whole = isinstance(t_ns, int) and not isinstance(t_ns, bool) and isinstance(clutch, bool)
    if not whole or len(position) != 3 or len(quaternion) != 4:
        return None
    return StylusSample(t_ns, position, quaternion, clutch)


def encode(sample: StylusSample) -> bytes:
    """The datagram of a sample, for senders in Python."""
    message = {"t_ns": sample.t_ns, "p": sample.position_m, "q": sample.quaternion, "clutch": sample.clutch}
    return json.dumps(message).encode()
