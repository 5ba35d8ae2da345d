"""Figures 6.5 and 6.6: LPIPS and age against the number of images, with cameras looking inward and
outward."""

from __future__ import annotations

from edge_server.experiments.common.statistics import interval, negated, optimum, paired
from edge_server.experiments.studies.drawing import draw_metrics
from edge_server.experiments.studies.study import (
    METRICS,
    Curve,
    Point,
    SceneStudy,
    StudyRequest,
    Table,
    Verdict,
    number,
)

COUNTS = (2, 3, 4, 6, 8, 10, 12, 14, 16, 18)
QUICK_COUNTS = (3, 6, 10, 14, 18)
# Scene -> the thesis's representation, its figure, and its result from few to many images.
SCENES = {
    "room": ("nerfacto", "looking in (6.5)", "LPIPS .323 to .101, mean age 16 to 82 ms"),
    "tower": ("splat", "looking out (6.6)", "LPIPS .472 to .214, mean age 37 to 146 ms"),
}
_METRICS = ("lpips", "psnr_db", "psnr_moving_db", "ssim", "aaoi_ms")


class Images(SceneStudy):
    name = "images"
    title = "Perceptual distance and age against the number of images (figures 6.5, 6.6)"

    scenes = tuple(SCENES)

    def of_scene(self, request: StudyRequest, scene: str) -> list[Point]:
        of = {"field": SCENES[scene][0] if scene in SCENES and not request.quick else "splat"}
        settings = {"channel": {"preset": "ch5"}, **of}
        cameras = len(request.trial(scene, seed=0, **settings).scenario().training)
        counts = [float(c) for c in (QUICK_COUNTS if request.quick else COUNTS) if c <= cameras]
        seeds, freshest = request.repeats(6, 40), {"freshest-k": counts}
        return request.sweep(scene, seeds, [(of, settings)], "images", freshest, [(of, of)])

    def judge(self, request: StudyRequest, table: Table, scene: str) -> list[Verdict]:
        verdicts = []
        field = table.where(scene=scene)[0]["field"]
        _, way, thesis = SCENES.get(scene, ("", "", "the same"))
        draw_metrics(
            request.out / f"images-{scene}.png",
            table,
            "images",
            "images, the freshest",
            _METRICS,
            [(field, {"scene": scene})],
            f"{scene}, cameras {way}",
        )
        for metric in ("lpips", "psnr_db", "psnr_moving_db", "aaoi_ms"):
            curve = table.curve("images", metric, scene=scene)
            if not curve:
                continue
            name, _, digits, _ = METRICS[metric]
            xs, rises = list(curve), metric != "lpips"
            change = paired(curve[xs[-1]], curve[xs[0]])
            first, last = (number(interval(curve[x].values()).mean, digits) for x in (xs[0], xs[-1]))
            claim = f"more images: {'higher' if rises else 'lower'} (thesis: {thesis})."
            text = (
                f"from {xs[0]:g} to {xs[-1]:g} images {first} to {last}, "
                f"change {change.text(digits)}; {table.no_delay_gain(metric, scene=scene)}."
            )
            answer = change.above(0.0) if rises else negated(change.above(0.0))
            verdicts.append(Verdict(f"{scene}, {name}", claim, text, answer, change))
            if metric != "aaoi_ms":
                verdicts.append(_best_count(f"{scene}, {name}", metric, curve))
        return verdicts


def _best_count(about: str, metric: str, curve: Curve) -> Verdict:
    """The verdict whether fewer images than all are best."""
    _, lower, digits, least = METRICS[metric]
    best = optimum(curve, lower)
    better = f", {best.over_last.text(digits)} better than all of them" if best.x < max(curve) else ""
    claim = "some fewer, the freshest, are better than all (not in the thesis)."
    found = f"best with {best.x:g} images{best.spread}{better}."
    return Verdict(about, claim, found, best.interior(least), best.over_last)
