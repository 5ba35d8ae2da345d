"""Writes what arrives and what is decided to a session file, on a thread of its own.

Whoever hands something over never waits: what does not fit the bounded queue is dropped and counted.
"""

from __future__ import annotations

import dataclasses
import logging
import threading
import types
import typing
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Any

from edge_server.live.state import Publication
from freshfield.session import DECISIONS, SCORES
from freshfield.v1 import frames_pb2 as pb

log = logging.getLogger(__name__)

# A disk that stalls for seconds costs nothing yet; a node's frames are some tens of kilobytes.
_MOST_BYTES = 64 * 2**20
_MOST_WAITING = 4096
_LOOK_S = 0.05
# What a message of no payload counts as.
_SMALL_BYTES = 1024


class Recorder:
    """A session being recorded. file: ``path``, or with a number where that exists already. Thread-safe.

    written: messages in the file. dropped: of what was handed over, what found no room. Raises OSError, and
    SessionError where the extra is missing.
    """

    def __init__(self, path: Path, scenario: str) -> None:
        from freshfield.session.writer import SessionWriter

        path.parent.mkdir(parents=True, exist_ok=True)
        self.file = _free(path)
        self.dropped = 0
        self._writer = SessionWriter(self.file, {"scenario": scenario})
        self._waiting: deque[tuple[int, Callable[[], None]]] = deque()
        self._bytes = 0
        self._closing = False
        self._failed = False
        self._changed = threading.Condition()
        self._schema = schema_of(Publication)
        self._thread = threading.Thread(target=self._main, name="recorder", daemon=True)
        self._thread.start()

    @property
    def written(self) -> int:
        return self._writer.messages

    def frame(self, request: pb.PushRequest, arrived_ns: int) -> None:
        """A frame was accepted; the request must not be changed any more."""
        self._put(len(request.payload) + _SMALL_BYTES, lambda: self._writer.frame(request, arrived_ns))

    def published(self, publication: Publication) -> None:
        """The field was updated."""
        self._decision(DECISIONS, publication)

    def scored(self, publication: Publication, t_ns: int) -> None:
        """An update's fidelity is known, since ``t_ns``."""
        self._decision(SCORES, publication, t_ns)

    def status(self) -> dict[str, Any]:
        """For edge.json."""
        return {
            "file": self.file.name,
            "written": self.written,
            "dropped": self.dropped,
            "failed": self._failed,
        }

    def close(self) -> None:
        """Write what waits, and the index."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._thread.join()

    def _decision(self, topic: str, publication: Publication, t_ns: int | None = None) -> None:
        at = publication.published_ns if t_ns is None else t_ns
        values = dataclasses.asdict(publication)
        self._put(
            _SMALL_BYTES, lambda: self._writer.data(topic, "freshfield.Decision", self._schema, values, at)
        )

    def _put(self, size: int, write: Callable[[], None]) -> None:
        with self._changed:
            full = len(self._waiting) >= _MOST_WAITING or self._bytes + size > _MOST_BYTES
            if full or self._closing or self._failed:
                self.dropped += 1
                return
            self._waiting.append((size, write))
            self._bytes += size

    def _main(self) -> None:
        try:
            while True:
                with self._changed:
                    if not self._waiting:
                        if self._closing:
                            break
                        # Nobody who hands over wakes this thread: that alone would cost more than the rest.
                        self._changed.wait(_LOOK_S)
                        continue
                    size, write = self._waiting.popleft()
                    self._bytes -= size
                    more = bool(self._waiting)
                try:
                    write()
                except ValueError as error:  # one that the format cannot hold
                    self.dropped += 1
                    log.warning("%s: a message is left out: %s", self.file, error)
                if not more:
                    self._writer.flush()
            self._writer.close({"messages": self.written, "dropped": self.dropped})
        except OSError as error:  # a full disk must end the recording, not the server
            with self._changed:
                self._failed = True
                self.dropped += len(self._waiting) + 1
                self._waiting.clear()
            self._writer.abandon()
            log.error("%s: recording ended: %s", self.file, error)


def _free(path: Path) -> Path:
    """``path``, or a name beside it that is free: a server that starts again keeps its first recording."""
    number = 2
    free = path
    while free.exists():
        free = path.with_name(f"{path.stem}-{number}{path.suffix}")
        number += 1
    return free


_KINDS = {int: "integer", float: "number", str: "string", bool: "boolean", type(None): "null"}


def schema_of(model: type) -> dict[str, Any]:
    """JSON schema of a dataclass of numbers, text and tuples of them."""
    hints = typing.get_type_hints(model)
    return {"type": "object", "properties": {name: _kind(hint) for name, hint in hints.items()}}


def _kind(hint: Any) -> dict[str, Any]:
    if typing.get_origin(hint) is tuple:
        return {"type": "array", "items": _kind(typing.get_args(hint)[0])}
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        return {"type": [_KINDS[part] for part in typing.get_args(hint)]}
    return {"type": _KINDS[hint]}
