"""Does it help to look at the pictures where something important moves in one part of the view, and does it
cost nothing where nothing does?"""

from __future__ import annotations

import dataclasses
from typing import Any

from edge_server.offline.study.base import Ask, Point, Table, Verdict, by_bool
from edge_server.offline.study.engine import StudyError
from edge_server.offline.study.learning import (
    School,
    better,
    embeddings_missing,
    named_runs,
    no_worse,
    room,
    runs_of,
)
from edge_server.offline.study.sight import Sees, Sight, telling
from edge_server.offline.study.statistics import interval
from edge_server.offline.train_scheduler import OMEGAS_MS, layout_of
from edge_server.offline.training.contest import RIVALS, Contest, rivals, rows, write_rows
from edge_server.offline.training.setting import Setting, seeds
from edge_server.offline.training.trainer import Course
from edge_server.scheduler.learned.spec import Spec

EPISODES = {True: 300, False: 1200}
PARTS = ("semantics", "age", "pose")
# scene -> (speed, PSNR of what). Cameras look outward; a person walks on one side or a cart drives on the
# other, which of both there is nobody knows without looking. Or what is there stands still.
SCENES = {"somebody moves": (1.0, "moving"), "nothing moves": (0.0, "whole")}
# One camera for each side, of those that reward and of those that judge.
REWARDING, JUDGING = ("cam00", "cam11"), ("cam13", "cam08")
# Of the reward, a view: with views for nothing there is nothing to choose, since no view ever harms.
PRICE = 0.002
# An update a second: what has moved since the last one is worth a view.
STEPS, REFRESH_MS = 40, 900.0
# So many cameras are used by those that know which of them see what moves.
KNOWING = (1, 2, 3, 4)


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
                setting = workshop(speed)
                reward = dataclasses.replace(school.reward("set", on), views=-PRICE)
                mine: dict[str, Any] = {}
                for name, layout in (
                    ("with", layout_of(setting, PARTS)),
                    ("without", layout_of(setting, PARTS[1:])),
                ):
                    course = Course(Spec("select", layout), reward, EPISODES[ask.quick])
                    lesson = f"{self.name}-{scene.replace(' ', '-')}-{name}"
                    mine |= named_runs(name, school.teach_all(lesson, setting, course))
                everybody: dict[str, Any] = {
                    **rivals(OMEGAS_MS["threshold"], ["threshold"], RIVALS), **mine
                }  # fmt: skip
                count = len(ask.repeats(10, 100))
                sight = Sight(setting)
                if speed:
                    everybody |= {f"sees:{k}": Sees(sight, k) for k in KNOWING}
                contest = school.contest(setting, everybody, reward, count)
                written += rows(contest, scene=scene)
                found += judge(scene, contest, on == "moving")
                if speed:
                    moments = [m for e in school.crew.draw(setting, seeds(0, "test", count)) for m in e]
                    found += why(scene, contest, telling(sight, moments))
        write_rows(ask.out / f"{self.name}.csv", written)
        return found


def workshop(speed_m_per_s: float) -> Setting:
    """The scene and how it is updated."""
    setting = room(
        "ch5", scene="tower", speed_m_per_s=speed_m_per_s, held_out=REWARDING, report=JUDGING, parts=PARTS,
        steps=STEPS, refresh_ms=REFRESH_MS,
    )  # fmt: skip
    scenario = setting.scenario
    params = {**scenario.source.get("params", {}), "movers": "one"}
    source = {**scenario.source, "params": params}
    return dataclasses.replace(setting, scenario=dataclasses.replace(scenario, source=source))


def judge(scene: str, contest: Contest, moves: bool) -> list[Verdict]:
    """Whether who looks at the pictures does better than who does not; or, where nothing moves, no worse.
    And whether either is better than the best of what does not learn."""
    about, seeing, blind = f"tower, ch5, {scene}", runs_of(contest, "with"), runs_of(contest, "without")
    views = {name: contest.term(f"{name}-0", "views").mean for name in ("with", "without")}
    told = f"{views['with']:.1f} views with, {views['without']:.1f} without; "
    if moves:
        claim = "semantics help where something important moves."
        found = [better(about, claim, seeing, blind, told)]
    else:
        claim = "semantics cost no more than 1 % where nothing moves."
        found = [no_worse(about, claim, seeing, blind)]
    fixed = [n for n in contest.outcomes if not n.startswith(("with", "random", "sees"))]
    best = max(fixed, key=lambda n: interval(list(contest.rewards(n).values())).mean)
    return found + [
        better(f"{about}, {name} semantics", "better than the best of all that does not learn.", runs,
               contest.rewards(best), f"{best}, known from the very seeds; ")
        for name, runs in (("with", seeing), ("without", blind))
    ]  # fmt: skip


def why(scene: str, contest: Contest, told: tuple[float, float]) -> list[Verdict]:
    """Whether the embedding tells what is to be known, and whether who knows it could use it. told: as
    ``telling`` has it."""
    about, (embedding, camera) = f"tower, ch5, {scene}", told
    knowing = [n for n in contest.outcomes if n.startswith("sees")]
    best = max(knowing, key=lambda n: interval(list(contest.rewards(n).values())).mean)
    return [
        Verdict(about, "the embedding tells which cameras see what moves (better than which camera it is).",
                f"area under the curve {embedding:.2f}, by a linear rule on episodes that it was not fitted "
                f"to; {camera:.2f} from which camera it is.", by_bool(embedding > camera)),
        better(about, "who knows which cameras see what moves does better than what is learnt blindly.",
               contest.rewards(best), runs_of(contest, "without"),
               f"{best}, the best number of them known from the very seeds; "),
    ]  # fmt: skip
