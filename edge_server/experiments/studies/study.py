"""A study is data: cases to measure, metrics, and claims; ``verdicts`` judges them by the measured rows."""

from __future__ import annotations

import shlex
import sys
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cache
from pathlib import Path
from typing import Any

from edge_server.experiments.common.folders import Folders
from edge_server.experiments.common.seed_table import Row, SeedTable
from edge_server.experiments.common.tables import markdown_table
from edge_server.experiments.engine import Engine
from edge_server.experiments.experiment_constants import FALSE_DISCOVERY_RATE
from edge_server.experiments.studies.verdicts import DOES_NOT_HOLD, HOLDS, UNDECIDED, Claim, Verdict, judge
from edge_server.machine import commit
from edge_server.progress import ProgressLine
from freshfield.files import write_csv, write_text


class StudyError(RuntimeError):
    """A study that cannot be run as asked; the message says what to change."""


@dataclass(frozen=True)
class StudyRequest:
    """The options of the command; None or no case selects the study's default.

    quick: a small pass.
    out: folder of tables and figures.
    seeds: number of repetitions of a point.
    scenes: names or files of scenarios.
    channel: section of a channel, used in place of the study's own. channel_name: what it is called. channel_given: as
        the command names it.
    jobs, ray: as in ``Engine``.
    cases: words in the names of the selected cases, for studies that consist of cases.
    episodes: episodes of one training, for studies that train.
    figures: names of the figures that the study has drawn, and what each is called; see ``figure``.
    """

    quick: bool
    out: Path
    folders: Folders
    seeds: int | None = None
    scenes: tuple[str, ...] | None = None
    channel: Mapping[str, Any] | None = None
    channel_name: str = ""
    channel_given: str = ""
    jobs: int = 1
    ray: str | None = None
    cases: tuple[str, ...] = ()
    episodes: int | None = None
    figures: dict[str, str] = field(default_factory=dict)

    def figure(self, name: str, title: str = "") -> Path:
        """Where to draw a figure, which the study's page shows. title: which of the thesis's it is, if the study has
        several."""
        self.figures[name] = title
        return self.out / name

    def chosen(self, cases: Sequence[str], quick: Sequence[str]) -> list[str]:
        """The selected cases: by default all, or ``quick`` in a quick pass. StudyError for an unknown one."""
        if not self.cases:
            return list(quick if self.quick else cases)
        if unknown := [word for word in self.cases if not any(word in case for case in cases)]:
            raise StudyError(
                f"--case: none has {', '.join(map(repr, unknown))} in its name; there are: {'; '.join(cases)}"
            )
        return [case for case in cases if any(word in case for word in self.cases)]

    def repeats(self, quick: int, full: int) -> range:
        """Seeds of a point: the requested number, else that of a quick or full pass."""
        return range(self.seeds or (quick if self.quick else full))

    def channels(self, own: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
        """The study's channels by name, or the one that was asked for."""
        given = own if self.channel is None else {self.channel_name: self.channel}
        return {name: dict(channel) for name, channel in given.items()}

    def command(self, study: str) -> str:
        """The command that repeats this request, without folders and processes, which change nothing."""
        words = ["edge-server study", study, *(["--quick"] if self.quick else [])]
        words += [f"--seeds {self.seeds}"] if self.seeds else []
        words += [f"--scene {shlex.quote(','.join(self.scenes))}"] if self.scenes else []
        words += [f"--channel {shlex.quote(self.channel_given)}"] if self.channel is not None else []
        words += [f"--case {shlex.quote(case)}" for case in self.cases]
        words += [f"--episodes {self.episodes}"] if self.episodes else []
        return " ".join(words)


Cases = Callable[[StudyRequest], Sequence[Any]]
Measure = Callable[[Sequence[Any], StudyRequest], list[Row]]


@dataclass(frozen=True)
class Study:
    """One study.

    name: of the command. title: one line for people, which ends with the thesis's figure.
    cases: what is measured, for a request.
    measure: the rows of the cases, one for each seed.
    panels: labels that tell verdicts apart; a claim is judged once for each of their combinations and metric.
    draw: each draws figures into the request's folder.
    tables: Markdown below the verdicts.
    """

    name: str
    title: str
    cases: Cases
    measure: Measure
    metrics: tuple[str, ...]
    claims: tuple[Claim, ...]
    panels: tuple[str, ...] = ("scene",)
    draw: tuple[Callable[[StudyRequest, SeedTable], None], ...] = ()
    tables: Callable[[SeedTable], str] | None = None


def run_study(study: Study, request: StudyRequest) -> list[Verdict]:
    """Measure the cases without stored results, write OUT/NAME.csv, .md and figures, and return the verdicts.
    Raises StudyError."""
    request = replace(request, figures={})
    request.out.mkdir(parents=True, exist_ok=True)
    rows = study.measure(study.cases(request), request)
    write_csv(request.out / f"{study.name}.csv", rows)
    table = SeedTable(rows)
    with ProgressLine(sys.stderr).running("figures" if study.draw else None):
        for draw in study.draw:
            draw(request, table)
    verdicts = judge(study.claims, study.metrics, study.panels, table)
    write_text(request.out / f"{study.name}.md", markdown(study, request, table, verdicts))
    return verdicts


def markdown(study: Study, request: StudyRequest, table: SeedTable, verdicts: Sequence[Verdict]) -> str:
    """The study as a page: how it was run, how often each claim holds, and folded, where."""
    of_claim = {v.claim: [w for w in verdicts if w.claim == v.claim] for v in verdicts}
    counted = [
        [claim, *(sum(v.verdict == said for v in of) or "" for said in (HOLDS, DOES_NOT_HOLD, UNDECIDED))]
        for claim, of in of_claim.items()
    ]
    each = [[v.claim, v.about, v.verdict, v.found] for of in of_claim.values() for v in of]
    seeds = len({row["seed"] for row in table.rows})
    at = f", commit {found}" if (found := commit()) else ""
    parts = [
        f"# {study.title}",
        f"`{request.command(study.name)}`: {'quick pass' if request.quick else 'full run'}, {seeds} seeds a point{at}. "
        f"[Rows]({study.name}.csv).",
        f"Intervals are 95 %. Of the {len(verdicts)} verdicts, those that are decided are corrected for their number "
        f"(Benjamini-Hochberg, false discovery rate {100 * FALSE_DISCOVERY_RATE:g} %).",
        markdown_table(["claim", HOLDS, DOES_NOT_HOLD, UNDECIDED], counted),
        "<details><summary>Where, and what was found</summary>",
        markdown_table(["claim", "where", "verdict", "found"], each),
        "</details>",
        *([study.tables(table)] if study.tables is not None else []),
        *(f"![{title or study.title}]({name})" for name, title in sorted(request.figures.items())),
    ]
    return "\n\n".join(parts) + "\n"


@cache
def print_once(line: str) -> None:
    """Print a line of a study that several of its parts have to say."""
    print(f"  {line}", flush=True)


def open_engine(request: StudyRequest, name: str, threads: int | None = None) -> Engine:
    """The engine of a study's cases, with results in OUT/results/NAME.jsonl."""
    return Engine(request.out / "results" / f"{name}.jsonl", request.jobs, request.ray, threads)
