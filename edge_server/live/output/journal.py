"""The files of a run, written as it goes: edge.json, series.jsonl, shown.jsonl, ages.jsonl.

edge.json is replaced about twice a second (live tables read it). series.jsonl gets a line for each
publication once its scores are final; publications without scores get at most one line per LINE_EVERY_S.
shown.jsonl gets a line for each instant at which what was shown is scored. ages.jsonl samples every camera's
age at a fixed rate, so that its mean is a time average.
"""

from __future__ import annotations

import dataclasses
import json
import logging
import threading
from collections import OrderedDict
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import msgspec
from msgspec.structs import asdict

from edge_server.fidelity.scorer import SHOWN, Score
from edge_server.live import live_constants as tuned
from edge_server.live.state import Publication
from edge_server.run_records import AgeParts, AgesRow, ShownRow, SoFarScores
from freshfield.files import Lines, write_json

log = logging.getLogger(__name__)


class Journal:
    """Writes the files of one run. Thread-safe.

    out: the run's folder. Lines are appended to those of an earlier process: an edge may be restarted.
    status: gives the contents of edge.json.
    A full disk costs lines (counted in ``lines_lost``) and statuses, and never ends the edge.
    """

    def __init__(self, out: Path, status: Callable[[], dict[str, Any]]) -> None:
        out.mkdir(parents=True, exist_ok=True)
        self._out = out
        self._status = status
        self._open: OrderedDict[int, Publication] = OrderedDict()
        self._lock = threading.Lock()
        self._files = {name: Lines(out / f"{name}.jsonl") for name in ("series", "shown", "ages")}
        self._last_s: float | None = None  # instant of the last publication
        self._usual_s: float | None = None  # usual time from one publication to the next
        self._without_line = 0  # publications since the last line of the series
        self._status_failed = False

    @property
    def lines_lost(self) -> int:
        """Number of lines that could not be written so far."""
        return sum(file.lost for file in self._files.values())

    def begin(self) -> None:
        """Mark in each file with lines of an earlier process, which may have published nothing, that a new one begins:
        by an empty line at 0 s."""
        if (self._out / "ages.jsonl").stat().st_size:
            for file in self._files.values():
                file.write('{"t_s": 0.0, "age_ms": {}}')

    def published(self, publication: Publication) -> None:
        with self._lock:
            self._open[publication.number] = publication
            while len(self._open) > tuned.FINAL_AFTER:
                self._write_oldest()

    def scored(self, publication: Publication, final: bool) -> None:
        """Take a publication that now has scores. final: the scores of all held-out cameras are in."""
        with self._lock:
            if publication.number not in self._open:
                return
            self._open[publication.number] = publication
            # Lines keep the order of publication: a final one waits for those before it.
            if final and next(iter(self._open)) == publication.number:
                self._write_oldest()

    def shown(self, t_s: float, score: Score, publication: Publication, so_far: SoFarScores | None = None) -> None:
        """Write ``shown_line``."""
        self._files["shown"].write(shown_line(t_s, score, publication, so_far))

    def ages(
        self, t_s: float, ages_ms: Mapping[str, float | None], depth_ages_ms: Mapping[str, float] | None = None
    ) -> None:
        """Write a line of ages. depth_ages_ms: of the newest depth of cameras that send it."""
        ages = {c: a if a is None else round(a, 3) for c, a in ages_ms.items()}
        line = AgesRow(round(t_s, 4), ages, {c: round(a, 3) for c, a in (depth_ages_ms or {}).items()})
        self._files["ages"].write(msgspec.json.encode(line).decode())

    def write_status(self) -> None:
        """Replace edge.json; if that fails, the old one stays."""
        status = self._status()
        try:
            write_json(self._out / "edge.json", status)
        except OSError as error:
            if not self._status_failed:
                log.warning("%s: cannot be written (%s)", self._out / "edge.json", error.strerror or error)
            self._status_failed = True

    def close(self, with_status: bool = True) -> None:
        """Write pending lines, and a last status unless that of another run is to stay."""
        with self._lock:
            while self._open:
                self._write_oldest()
            for file in self._files.values():
                file.close()
        if with_status:
            self.write_status()

    def _write_oldest(self) -> None:
        """Write a line for the oldest publication, unless it has no scores and lines would be too frequent.
        That is judged by the number of publications since the last line: by the time, publications at the end
        of a long gap would get a line more often than others."""
        _, publication = self._open.popitem(last=False)
        many = False
        if self._last_s is not None:
            interval_s = publication.t_s - self._last_s
            usual_s = interval_s if self._usual_s is None else self._usual_s
            many = (self._without_line + 1) * usual_s < tuned.LINE_EVERY_S
            self._usual_s = usual_s + tuned.INTERVAL_SHARE * (interval_s - usual_s)
        self._last_s = publication.t_s
        if publication.psnr_db is None and many:
            self._without_line += 1
            return
        self._without_line = 0
        self._files["series"].write(json.dumps(dataclasses.asdict(publication), allow_nan=False))


def shown_line(t_s: float, score: Score, publication: Publication, so_far: SoFarScores | None = None) -> str:
    """A line of shown.jsonl with ``score``, the score of what was shown at ``t_s``: ``publication``, extrapolated to
    ``t_s``. The age of its views is the sum of network, waiting, computing and display. so_far: see ``ShownRow``."""
    waiting_ms = publication.aaoi_ms - publication.update_ms - (publication.network_ms or 0.0)
    line = ShownRow(
        t_s=round(t_s, 4),
        number=publication.number,
        **{name: getattr(score, name) for name in SHOWN},
        age_ms=AgeParts(
            network=publication.network_ms,
            waiting=waiting_ms,
            computing=publication.update_ms,
            display=1e3 * (t_s - publication.t_s),
        ),
        so_far=so_far,
    )
    return json.dumps(line, default=asdict, allow_nan=False)
