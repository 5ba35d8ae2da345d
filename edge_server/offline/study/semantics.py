"""Does it help to look at the pictures where something important moves in one part of the view, and does it
cost nothing where nothing does?"""

from __future__ import annotations

from typing import Any

from edge_server.offline.study.base import Ask, Point, Table, Verdict
from edge_server.offline.study.engine import StudyError
from edge_server.offline.study.learning import (
    FOUR_VIEWPOINTS,
    Lesson,
    School,
    better,
    embeddings_missing,
    no_worse,
    room,
)
from edge_server.offline.train_scheduler import OMEGAS_MS, layout_of
from edge_server.offline.training.contest import rivals, rows, write_rows
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
                reward, mine = school.reward("set", on), {}
                for name, layout in (
                    ("with", layout_of(setting, PARTS)),
                    ("without", layout_of(setting, PARTS[1:])),
                ):
                    lesson = Lesson(f"{self.name}-{scene.replace(' ', '-')}-{name}", setting,
                                    Course(Spec("select", layout), reward, EPISODES[ask.quick]))  # fmt: skip
                    mine[name] = school.teach(lesson).actor
                everybody: dict[str, Any] = {
                    **rivals(OMEGAS_MS["threshold"], ["threshold"], ("random", "all")), **mine
                }  # fmt: skip
                contest = school.contest(setting, everybody, reward, len(ask.repeats(10, 100)))
                written += rows(contest, scene=scene)
                seeing, blind = contest.rewards("with"), contest.rewards("without")
                about = f"room, ch5, {scene}"
                if on == "moving":
                    found.append(
                        better(about, "semantics help where something important moves.", seeing, blind)
                    )
                else:
                    claim = "semantics cost no more than 1 % where nothing moves."
                    found.append(no_worse(about, claim, seeing, blind))
        write_rows(ask.out / f"{self.name}.csv", written)
        return found
