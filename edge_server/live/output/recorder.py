"""Records arriving frames and decisions to a session file or ROS bag, on a separate thread.

Callers never wait: messages that do not fit the bounded queue are dropped and counted.
"""

from __future__ import annotations

import dataclasses
import logging
import shutil
import threading
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import msgspec

from edge_server.live import live_constants as tuned
from edge_server.live.state import Publication
from freshfield.session import DECISIONS, SCORES
from freshfield.v1 import frames_pb2 as pb

if TYPE_CHECKING:
    from freshfield.session.bag_writer import BagWriter
    from freshfield.session.writer import SessionWriter

log = logging.getLogger(__name__)


class Recorder:
    """Records one session. Thread-safe.

    file: ``path``, or a numbered name beside it if that exists: MCAP by its suffix, else the folder of a ROS 2 bag.
    written, dropped: number of messages in the file, and of those that did not fit the queue.
    Raises OSError, and SessionError if the extra ``mcap`` or ``ros`` is missing.
    """

    def __init__(self, path: Path, scenario: str) -> None:
        path.parent.mkdir(parents=True, exist_ok=True)
        self.file = _free_name(path)
        self.dropped = 0
        self._writer = _writer_class(path)(self.file, {"scenario": scenario})
        self._queue: deque[tuple[int, Callable[[], None]]] = deque()
        self._queue_bytes = 0
        self._closing = False
        self._failed = False
        self._changed = threading.Condition()
        self._schema = msgspec.json.schema_components([Publication])[1][Publication.__name__]
        self._thread = threading.Thread(target=self._main, name="recorder", daemon=True)
        self._thread.start()

    @property
    def written(self) -> int:
        return self._writer.messages

    def frame(self, request: pb.PushRequest, arrived_ns: int) -> None:
        """Record an accepted frame. The request must not be changed afterwards."""
        size = len(request.payload) + len(request.depth.payload) + tuned.MESSAGE_BYTES
        self._put(size, lambda: self._writer.frame(request, arrived_ns))

    def published(self, publication: Publication) -> None:
        """Record an update of the field."""
        self._decision(DECISIONS, publication)

    def scored(self, publication: Publication, t_ns: int) -> None:
        """Record the fidelity of an update, known since ``t_ns``."""
        self._decision(SCORES, publication, t_ns)

    def status(self) -> dict[str, Any]:
        """For edge.json."""
        return {"file": self.file.name, "written": self.written, "dropped": self.dropped, "failed": self._failed}

    def close(self) -> None:
        """Write queued messages and the index. An empty recording is removed: the next start takes its name."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._thread.join()
        if not self.written and not self._failed:
            shutil.rmtree(self.file) if self.file.is_dir() else self.file.unlink(missing_ok=True)

    def _decision(self, topic: str, publication: Publication, t_ns: int | None = None) -> None:
        at = publication.published_ns if t_ns is None else t_ns
        values = dataclasses.asdict(publication)
        self._put(
            tuned.MESSAGE_BYTES, lambda: self._writer.data(topic, "freshfield.Decision", self._schema, values, at)
        )

    def _put(self, size: int, write: Callable[[], None]) -> None:
        with self._changed:
            full = len(self._queue) >= tuned.MOST_QUEUED or self._queue_bytes + size > tuned.MOST_QUEUED_BYTES
            if full or self._closing or self._failed:
                self.dropped += 1
                return
            self._queue.append((size, write))
            self._queue_bytes += size

    def _main(self) -> None:
        try:
            while True:
                with self._changed:
                    if not self._queue:
                        if self._closing:
                            break
                        # Callers do not wake this thread: that would cost them more than everything else here.
                        self._changed.wait(tuned.RECORD_EVERY_S)
                        continue
                    size, write = self._queue.popleft()
                    self._queue_bytes -= size
                    more = bool(self._queue)
                try:
                    write()
                except ValueError as error:  # the format cannot hold it
                    self.dropped += 1
                    log.warning("%s: a message is left out: %s", self.file, error)
                if not more:
                    self._writer.flush()
            self._writer.close({"messages": self.written, "dropped": self.dropped})
        except OSError as error:  # a full disk must end the recording, not the server
            with self._changed:
                self._failed = True
                self.dropped += len(self._queue) + 1
                self._queue.clear()
            self._writer.abandon()
            log.error("%s: recording ended: %s", self.file, error)


def _writer_class(path: Path) -> type[SessionWriter] | type[BagWriter]:
    if path.suffix.lower() == ".mcap":
        from freshfield.session.writer import SessionWriter

        return SessionWriter
    from freshfield.session.bag_writer import BagWriter

    return BagWriter


def _free_name(path: Path) -> Path:
    """``path``, or a free name beside it: a server that restarts keeps its earlier recordings."""
    number = 2
    free = path
    while free.exists():
        free = path.with_name(f"{path.stem}-{number}{path.suffix}")
        number += 1
    return free
