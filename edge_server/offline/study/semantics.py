"""Does it help to look at the pictures where something important moves in one part of the view, and does it
cost nothing where nothing does?"""

from __future__ import annotations

from typing import Any

from edge_server.offline.study.base import Ask, Point, Table, Verdict
from edge_server.offline.study.engine import StudyError
from edge_server.offline.study.learning import (
    FOUR_VIEWPOINTS,
    School,
    better,
    embeddings_missing,
    named_runs,
    no_worse,
    room,
    runs_of,
)
from edge_server.offline.train_scheduler import OMEGAS_MS, layout_of
from edge_server.offline.training.contest import Contest, rivals, rows, write_rows
from edge_server.offline.training.trainer import Course
from edge_server.scheduler.learned.spec import Spec

EPISODES = {True: 100, False: 1200}
PARTS = ("semantics", "age", "pose")
# scene -> (speed, PSNR of what): a person walks about, whom some cameras see and others do not; and nobody.
SCENES = {"somebody moves": (2.0, "moving"), "nothing moves": (0.0, "whole")}


class Semantics:
    name = "semantics"
    title = "Where semantics help, and whether they cost anything where they do not (6.31-6.33)"

    def points(self, ask: Ask) -> list[Point]:
        return []

    def report(self, ask: Ask, table: Table) -> list[Verdict]:
        del table
        if missing := embeddings_missing():
            raise StudyError(f"{self.name}: {missing}")
        found: list[Verdict] = []
        written: list[dict[str, Any]] = []
        with School(ask) as school:
            for scene, (speed, on) in SCENES.items():
                setting = room("ch5", speed_m_per_s=speed, held_out=FOUR_VIEWPOINTS, parts=PARTS)
                reward = school.reward("set", on)
                mine: dict[str, Any] = {}
                for name, layout in (
                    ("with", layout_of(setting, PARTS)),
                    ("without", layout_of(setting, PARTS[1:])),
                ):
                    course = Course(Spec("select", layout), reward, EPISODES[ask.quick])
                    lesson = f"{self.name}-{scene.replace(' ', '-')}-{name}"
                    mine |= named_runs(name, school.teach_all(lesson, setting, course))
                everybody: dict[str, Any] = {
                    **rivals(OMEGAS_MS["threshold"], ["threshold"], ("random", "all")), **mine
                }  # fmt: skip
                contest = school.contest(setting, everybody, reward, len(ask.repeats(10, 100)))
                written += rows(contest, scene=scene)
                found.append(judge(scene, contest, on == "moving"))
        write_rows(ask.out / f"{self.name}.csv", written)
        return found


def judge(scene: str, contest: Contest, moves: bool) -> Verdict:
    """Whether who looks at the pictures does better than who does not; or, where nothing moves, no worse."""
    about, seeing, blind = f"room, ch5, {scene}", runs_of(contest, "with"), runs_of(contest, "without")
    if moves:
        return better(about, "semantics help where something important moves.", seeing, blind)
    return no_worse(about, "semantics cost no more than 1 % where nothing moves.", seeing, blind)
