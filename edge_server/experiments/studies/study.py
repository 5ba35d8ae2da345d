"""Parts of a study: points (labels and a trial), a results table, and verdicts."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

from edge_server.experiments.common.folders import Folders
from edge_server.experiments.common.statistics import Interval, interval, paired
from edge_server.experiments.common.tables import number
from edge_server.experiments.studies.engine import Engine, StudyError
from edge_server.experiments.studies.trial import Row, Trial, recording
from edge_server.report.machine import commit
from edge_server.scheduler.learned.rewards import W_S, f_w
from freshfield.files import write_csv, write_json, write_text

HOLDS, DOES_NOT_HOLD, UNDECIDED = "holds", "does not hold", "undecided"


class Metric(NamedTuple):
    """A measured quantity.

    label: text of the axis. lower: whether lower is better. digits: decimals in texts.
    least: smallest difference that supports a claim.
    """

    label: str
    lower: bool
    digits: int
    least: float


LEAST_DB = 0.1
METRICS = {
    "psnr_db": Metric("PSNR (dB)", False, 2, LEAST_DB),
    "psnr_moving_db": Metric("PSNR, moving pixels (dB)", False, 2, LEAST_DB),
    "shown_psnr_db": Metric("PSNR as shown (dB)", False, 2, LEAST_DB),
    "shown_psnr_moving_db": Metric("PSNR as shown, moving pixels (dB)", False, 2, LEAST_DB),
    "ssim": Metric("SSIM", False, 3, 0.002),
    "lpips": Metric("LPIPS", True, 3, 0.002),
    "aaoi_ms": Metric("mean age of used views (ms)", True, 1, 0.0),
    "f_w": Metric("F_w (6.37)", True, 3, 0.01),
    "f_w_corrected": Metric(f"F_w with w_s = {-W_S:g}", True, 3, 0.01),
}

Curve = dict[float, dict[int, float | None]]


@dataclass(frozen=True)
class StudyRequest:
    """The options of the command; None or no case selects the study's default.

    quick: a small pass.
    out: folder of tables and figures.
    seeds: number of repetitions of a point.
    field: representation of the trials that do not name one themselves.
    scenes: names of the scenes.
    jobs: number of processes.
    cases: words in the names of the selected cases, for studies that consist of cases.
    episodes: episodes of one training, for studies that train.
    """

    quick: bool
    out: Path
    folders: Folders
    seeds: int | None = None
    scenes: tuple[str, ...] | None = None
    jobs: int = 1
    cases: tuple[str, ...] = ()
    episodes: int | None = None
    field: str = "splat"

    def chosen(self, cases: Sequence[str], quick: Sequence[str]) -> list[str]:
        """The selected cases: by default all, or ``quick`` in a quick pass. StudyError for an unknown one."""
        if not self.cases:
            return list(quick if self.quick else cases)
        if unknown := [word for word in self.cases if not any(word in case for case in cases)]:
            raise StudyError(
                f"--case: none has {', '.join(map(repr, unknown))} in its name; there are: {'; '.join(cases)}"
            )
        return [case for case in cases if any(word in case for word in self.cases)]

    def command(self, study: str) -> str:
        """The command that repeats this request, without folders and processes, which change nothing."""
        words = ["edge-server study", study, *(["--quick"] if self.quick else [])]
        words += [f"--seeds {self.seeds}"] if self.seeds else []
        words += [f"--scene {','.join(self.scenes)}"] if self.scenes else []
        words += [f"--case {case!r}" for case in self.cases]
        words += [f"--episodes {self.episodes}"] if self.episodes else []
        words += [f"--field {self.field}"] if self.field != "splat" else []
        return " ".join(words)

    def repeats(self, quick: int, full: int) -> range:
        """Seeds of a point: the requested number, else that of a quick or full pass."""
        return range(self.seeds or (quick if self.quick else full))

    def scenes_here(self, default: Sequence[str]) -> list[str]:
        """The requested scenes, else ``default``, without recorded ones that are not in the data folder."""
        wanted, data = list(self.scenes or default), self.folders.data
        found = []
        for scene in wanted:
            file = recording(scene)
            if file is None or (data is not None and (data / file).exists()):
                found.append(scene)
            else:
                print(f"  {scene} is left out: {file} is not below the data folder (--data or FRESHFIELD_DATA)")
        if not found:
            raise StudyError(f"none of the scenes asked for is here: {', '.join(wanted)}")
        return found

    def trial(self, scene: str, **more: Any) -> Trial:
        """The usual trial of a scene, with the image size and the steps of a quick or full pass. more:
        further arguments of ``Trial``."""
        sized: Row = {"size": 64, "steps": 150} if self.quick else {"size": 128, "steps": 400}
        if recording(scene) is not None:
            scale = 2.0 if self.quick else 1.0
            sized = {"scale": scale, "steps": sized["steps"], "speed_m_per_s": None}
        return Trial(scene=scene, **{"field": self.field, **sized, **more})

    def sweep(
        self,
        scene: str,
        seeds: Iterable[int],
        conditions: Sequence[tuple[Row, Row]],
        x: str,
        values: Mapping[str, Sequence[float]],
        ideals: Sequence[tuple[Row, Row]] = (({}, {}),),
    ) -> list[Point]:
        """Points of every seed: in each condition use-all and each value of each policy; and without delay.

        conditions, ideals: (labels in the table, settings of the trial) of each.
        x: label that holds the value.
        values: policy -> its values.
        """
        found = []
        for seed in seeds:
            for labels, settings in conditions:
                base, labels = self.trial(scene, seed=seed, **settings), {"scene": scene, **labels}
                found.append(Point({**labels, "policy": "all"}, base))
                found += [
                    Point({**labels, "policy": policy, x: value}, replace(base, policy=policy, value=value))
                    for policy, some in values.items()
                    for value in some
                ]
            for labels, settings in ideals:
                ideal = self.trial(scene, seed=seed, channel={"preset": "ideal"}, **settings)
                found.append(Point({"scene": scene, **labels, "policy": "no delay"}, ideal))
        return found


@dataclass(frozen=True)
class Verdict:
    """The thesis's claim, the result here, and whether the claim holds.

    about: scene and setting.
    holds: None where it is undecided.
    interval: of the difference that the claim is about; None where it is about several, or a single value.
    """

    about: str
    claim: str
    found: str
    holds: bool | None
    interval: Interval | None = None

    @property
    def verdict(self) -> str:
        return UNDECIDED if self.holds is None else HOLDS if self.holds else DOES_NOT_HOLD

    def mapping(self) -> Row:
        """As JSON values; the interval as [mean, low, high]."""
        interval = None if self.interval is None else self.interval.rounded(4)
        texts = {name: getattr(self, name) for name in ("about", "claim", "found", "verdict")}
        return {**texts, "interval": interval}

    def line(self) -> str:
        return f"[{self.verdict}] {self.about}: {self.claim} Found: {self.found}"


@dataclass(frozen=True)
class Point:
    """A trial and its labels in the table."""

    labels: Row
    trial: Trial


@dataclass
class Table:
    """Points with their results, in the order of the points."""

    points: list[Point]
    results: list[Row]
    rows: list[Row] = field(init=False)

    def __post_init__(self) -> None:
        self.rows = [
            {**p.labels, "seed": p.trial.seed, **r, "f_w": f_w(r), "f_w_corrected": f_w(r, -W_S)}
            for p, r in zip(self.points, self.results)
        ]

    def where(self, **labels: Any) -> list[Row]:
        """Rows that carry all the given labels."""
        return [row for row in self.rows if all(row.get(k) == v for k, v in labels.items())]

    def values(self, metric: str, **labels: Any) -> dict[int, float | None]:
        """seed -> value of the point with these labels."""
        return {row["seed"]: row[metric] for row in self.where(**labels)}

    def curve(self, x: str, metric: str, **labels: Any) -> Curve:
        """x -> seed -> value, for the points that have an x and at least one value."""
        found: Curve = {}
        for row in self.where(**labels):
            if row.get(x) is not None:
                found.setdefault(float(row[x]), {})[row["seed"]] = row[metric]
        return {k: v for k, v in sorted(found.items()) if any(y is not None for y in v.values())}

    def distinct(self, label: str) -> list[Any]:
        """The label's values in order of appearance."""
        return list(dict.fromkeys(row[label] for row in self.rows if row.get(label) is not None))

    def means(self) -> list[Row]:
        """The labels of each point, and [mean, low, high] over its seeds of everything measured."""
        groups: dict[str, list[Row]] = {}
        for point, row in zip(self.points, self.rows):
            groups.setdefault(repr(point.labels), []).append(row)
        labels = {repr(p.labels): p.labels for p in self.points}
        measured = [n for n in (self.results[0] if self.results else {}) if n != "decisions"]
        return [
            {**labels[key], **{n: interval(row[n] for row in rows).rounded(4) for n in measured}}
            for key, rows in groups.items()
        ]

    def no_delay_gain(self, metric: str, **labels: Any) -> str:
        """Describe how much better no delay is than using all views: the limit of any scheduler's gain."""
        kept = {k: v for k, v in labels.items() if k in ("scene", "field")}
        use_all = self.values(metric, policy="all", **labels)
        limit = self.values(metric, policy="no delay", **kept)
        _, lower, digits, least = METRICS[metric]
        gap = paired(use_all, limit) if lower else paired(limit, use_all)
        if metric == "aaoi_ms":
            return f"with no delay it is {number(interval(limit.values()).mean, digits)}"
        nothing = " (nothing to win)" if gap.above(least) is False else ""
        return f"no delay at all is {gap.text(digits)} better than use-all{nothing}"


class Study:
    """One study. name: of the command. title: one line for people."""

    name: str
    title: str

    def points(self, request: StudyRequest) -> list[Point]:
        """Independent trials; none of a study that makes its own."""
        return []

    def report(self, request: StudyRequest, table: Table) -> list[Verdict]:
        """Draw the figures into ``request.out`` and judge the claims."""
        raise NotImplementedError


class SceneStudy(Study):
    """A study that has the same points in each scene, and judges one scene after the other.

    scenes: the default scenes.
    """

    scenes: tuple[str, ...] = ("room",)

    def points(self, request: StudyRequest) -> list[Point]:
        return [p for scene in request.scenes_here(self.scenes) for p in self.of_scene(request, scene)]

    def report(self, request: StudyRequest, table: Table) -> list[Verdict]:
        return [v for scene in table.distinct("scene") for v in self.judge(request, table, scene)]

    def of_scene(self, request: StudyRequest, scene: str) -> list[Point]:
        raise NotImplementedError

    def judge(self, request: StudyRequest, table: Table, scene: str) -> list[Verdict]:
        raise NotImplementedError


def run_study(study: Study, request: StudyRequest, engine: Engine) -> list[Verdict]:
    """Run the trials without stored results, write OUT/NAME.csv, .json, .md and figures, and return the
    verdicts. Raises StudyError."""
    request.out.mkdir(parents=True, exist_ok=True)
    points = study.points(request)
    table = Table(points, engine.run([p.trial for p in points], study.name))
    if table.rows:
        write_csv(request.out / f"{study.name}.csv", table.rows)
    verdicts = study.report(request, table)
    text = "\n".join(["# " + study.title, "", *(f"- {v.line()}" for v in verdicts), ""])
    write_text(request.out / f"{study.name}.md", text)
    found = {
        "study": study.name,
        "title": study.title,
        "command": request.command(study.name),
        "quick": request.quick,
        "seeds": len({p.trial.seed for p in points}) or request.seeds,
        "field": list(dict.fromkeys(p.trial.field for p in points)),
        "commit": commit(),
        "verdicts": [v.mapping() for v in verdicts],
        "rows": table.means(),
    }
    write_json(request.out / f"{study.name}.json", found)
    return verdicts
