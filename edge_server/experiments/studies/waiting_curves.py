"""Threshold, wait and the number of images: figures 6.3 to 6.7."""

from __future__ import annotations

from typing import Any

from edge_server.experiments.common.seed_table import Row, SeedTable
from edge_server.experiments.studies.drawing import curves, instants
from edge_server.experiments.studies.study import Study, StudyRequest
from edge_server.experiments.studies.study_constants import PLATEAU_NEAR
from edge_server.experiments.studies.trial import Point, recording, run_points, scenes_here, sweep, usual_trial
from edge_server.experiments.studies.verdicts import Claim, better, interior, plateau, trend

OMEGAS = (15.0, 30.0, 45.0, 60.0, 75.0, 90.0, 105.0, 120.0, 160.0, 240.0)
QUICK_OMEGAS = (15.0, 45.0, 75.0, 120.0, 240.0)

# --- figures 6.3 and 6.4 -------------------------------------------------------------------------------------

# The thesis's two traffic states, and the high one as literally described in 6.4.2: every frame is transmitted at
# once.
CHANNELS: dict[str, Row] = {
    "high traffic": {"preset": "ch6-high"},
    "low traffic": {"preset": "ch6-low"},
    "high traffic, parallel": {"preset": "ch6-high", "discipline": "parallel"},
}
WAITS = ("wait", "wait-arrived", "wait-flush")
# Where the plateau of wait starts in the thesis (6.5.2): 62 ms in high traffic, 105 ms in low.
PLATEAU_MS = {"high traffic": 62.0, "low traffic": 105.0, "high traffic, parallel": 62.0}
FRESHNESS = ("f_w", "f_w_corrected")
SHOWN = (30.0, 60.0, 120.0)
BEST_OMEGA = {"best": "omega_ms"}


def _omega_cases(request: StudyRequest) -> list[Point]:
    omegas = dict.fromkeys(("threshold", *WAITS), QUICK_OMEGAS if request.quick else OMEGAS)
    found = []
    for scene in scenes_here(request, ("room", "kitchen")):
        ours = recording(scene) is None
        channels = list(request.channels(CHANNELS).items())
        some = channels if ours or not request.quick else channels[:1]
        conditions = [({"channel": name}, {"channel": channel, "every_ms": 2400.0}) for name, channel in some]
        found += sweep(request, scene, request.repeats(6 if ours else 3, 40), conditions, "omega_ms", omegas)
    return found


def _plateau(table: SeedTable, metric: str, labels: Row) -> Any:
    return plateau("omega_ms", PLATEAU_MS.get(labels["channel"], 62.0))(table, metric, labels)


OMEGA = Study(
    "omega",
    "Threshold and wait against omega, by traffic and queue (figures 6.3, 6.4)",
    _omega_cases,
    run_points,
    (*PLATEAU_NEAR, *FRESHNESS),
    (
        Claim(
            "there is an optimum between few and stale views (6.5.1: at 50 ms in high traffic, 72 in low).",
            interior("omega_ms"),
            bound=None,
            where={"policy": "threshold"},
        ),
        *(
            claim
            for policy in WAITS
            for claim in (
                Claim(
                    "waiting longer brings fidelity to a plateau, from 62 ms on in high traffic, 105 in low (6.5.2).",
                    _plateau,
                    {metric: -near for metric, near in PLATEAU_NEAR.items()},
                    {"policy": policy},
                    tuple(PLATEAU_NEAR),
                ),
                Claim(
                    "has an optimum inside once freshness counts (6.5.2).",
                    interior("omega_ms"),
                    None,
                    {"policy": policy},
                    FRESHNESS,
                ),
                Claim(
                    "better than threshold, each at its own best omega (6.5.2).",
                    better({"policy": policy, **BEST_OMEGA}, {"policy": "threshold", **BEST_OMEGA}),
                    where={"policy": policy},
                ),
            )
        ),
        Claim(
            "frames that arrive meanwhile (6.16) serve better than those generated meanwhile (6.5).",
            better({"policy": "wait-arrived", **BEST_OMEGA}, {"policy": "wait", **BEST_OMEGA}),
            where={"policy": "wait-arrived"},
        ),
    ),
    ("scene", "channel"),
    (
        curves(
            "omega",
            "omega_ms",
            "omega (ms)",
            (*PLATEAU_NEAR, *FRESHNESS, "aaoi_ms"),
            "policy",
            ("scene", "channel"),
            of="6.3",
        ),
        *(
            instants(
                f"omega-{policy}", ("room", "kitchen"), policy, SHOWN, {"preset": "ch6-high"}, of="6.4", every_ms=2400.0
            )
            for policy in ("threshold", "wait")
        ),
    ),
)

# --- figures 6.5 and 6.6 -------------------------------------------------------------------------------------

COUNTS = (2, 3, 4, 6, 8, 10, 12, 14, 16, 18)
QUICK_COUNTS = (3, 6, 10, 14, 18)
# The thesis's representations: of cameras that look in (6.5) and that look out (6.6).
IMAGE_METRICS = ("lpips", "psnr_db", "psnr_moving_db", "aaoi_ms")
IMAGE_FIELDS = {"room": "nerfacto", "tower": "splat"}
IMAGE_FIGURES = {"room": "6.5", "tower": "6.6"}


def _image_cases(request: StudyRequest) -> list[Point]:
    found = []
    for scene in scenes_here(request, tuple(IMAGE_FIELDS)):
        of = {"field": "splat" if request.quick else IMAGE_FIELDS.get(scene, "splat")}
        conditions = [
            ({**of, "channel": name}, {"channel": channel, **of})
            for name, channel in request.channels({"ch5": {"preset": "ch5"}}).items()
        ]
        cameras = len(usual_trial(request, scene, seed=0, **conditions[0][1]).scenario().training)
        counts = [float(c) for c in (QUICK_COUNTS if request.quick else COUNTS) if c <= cameras]
        values = {"freshest-k": counts}
        found += sweep(request, scene, request.repeats(6, 40), conditions, "images", values, [(of, of)])
    return found


IMAGES = Study(
    "images",
    "Perceptual distance and age against the number of images (figures 6.5, 6.6)",
    _image_cases,
    run_points,
    IMAGE_METRICS,
    (
        Claim(
            "more images are better (thesis: LPIPS .323 to .101 looking in, .472 to .214 looking out).",
            trend("images"),
            where={"policy": "freshest-k"},
            metrics=("lpips", "psnr_db", "psnr_moving_db"),
        ),
        Claim(
            "more images are older (thesis: mean age 16 to 82 ms looking in, 37 to 146 ms looking out).",
            trend("images", rises=True),
            where={"policy": "freshest-k"},
            metrics=("aaoi_ms",),
        ),
    ),
    ("scene", "field", "channel"),
    (curves("images", "images", "images, the freshest", (*IMAGE_METRICS, "ssim"), "policy", of=IMAGE_FIGURES),),
)

# --- figure 6.7 ----------------------------------------------------------------------------------------------

# Steps of one update, such that it takes about as long as one of splat on two cores.
FIELDS = {"splat": 400, "ngp": 250, "nerfacto": 150, "tensorf": 150}
FIELD_METRICS = ("psnr_db", "psnr_moving_db", "lpips", "f_w")
QUICK_FIELDS = {"splat": 150, "ngp": 80}


def _field_cases(request: StudyRequest) -> list[Point]:
    fields = (QUICK_FIELDS if request.quick else FIELDS).items()
    ideals = [({"field": f}, {"field": f, "steps": steps, "every_ms": 2400.0}) for f, steps in fields]
    (channel,) = request.channels({"high traffic": CHANNELS["high traffic"]}).values()
    traffic = [(labels, {**settings, "channel": channel}) for labels, settings in ideals]
    omegas = dict.fromkeys(("threshold", "wait"), (30.0, 75.0, 120.0, 240.0) if request.quick else OMEGAS)
    seeds = request.repeats(4, 20)
    scenes = scenes_here(request, ("room",))
    return [p for s in scenes for p in sweep(request, s, seeds, traffic, "omega_ms", omegas, ideals)]


REPRESENTATIONS = Study(
    "representations",
    "Threshold and wait, by representation (figure 6.7)",
    _field_cases,
    run_points,
    FIELD_METRICS,
    tuple(
        Claim(
            f"the trade shows: {policy} has an optimum inside (6.5.2: with every representation).",
            interior("omega_ms"),
            None,
            {"policy": policy},
        )
        for policy in ("threshold", "wait")
    ),
    ("scene", "field"),
    (curves("representations", "omega_ms", "omega (ms)", FIELD_METRICS, "field", ("scene", "policy")),),
)
