"""A workshop where images can help a policy: a person walks on one of four sides, only images show which one,
and each view has a cost."""

from __future__ import annotations

import dataclasses

from edge_server.experiments.studies.learning.setup import StudyTrainer, room
from edge_server.experiments.training.scheduler.setting import Setting
from edge_server.scheduler.learned.rewards import Reward

PARTS = ("semantics", "age", "pose")
# The cameras look outward: one per side for the reward and one per side for the evaluation.
REWARDING, JUDGING = ("cam00", "cam08", "cam15", "cam16"), ("cam14", "cam11", "cam06", "cam07")
# Cost of a view in the reward; with free views there is nothing to choose, because no view ever harms.
PRICE = 0.002
# One update per second, so that a view of the motion since the last one is worth its cost.
STEPS, REFRESH_MS = 40, 900.0


def priced(trainer: StudyTrainer, on: str) -> Reward:
    """The reward with a cost per view. With ``moving`` pixels only the PSNR counts, because SSIM and distance
    are of the whole image, in which a person in a corner hardly matters."""
    reward = dataclasses.replace(trainer.reward("set", on), views=-PRICE)
    return dataclasses.replace(reward, ssim=0.0, distance=0.0) if on == "moving" else reward


def workshop(speed_m_per_s: float) -> Setting:
    """The setting of the workshop."""
    setting = room(
        "ch5",
        scene="tower",
        speed_m_per_s=speed_m_per_s,
        held_out=REWARDING,
        report=JUDGING,
        parts=PARTS,
        steps=STEPS,
        refresh_ms=REFRESH_MS,
    )
    scenario = setting.scenario
    params = {**scenario.source.get("params", {}), "movers": "person"}
    source = {**scenario.source, "params": params}
    return dataclasses.replace(setting, scenario=dataclasses.replace(scenario, source=source))
