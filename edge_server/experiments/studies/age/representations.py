"""Figure 6.7: whether the trade-off is the same for every representation."""

from __future__ import annotations

from edge_server.experiments.common.statistics import all_of, optimum
from edge_server.experiments.studies.drawing import draw_metrics
from edge_server.experiments.studies.study import METRICS, Point, SceneStudy, StudyRequest, Table, Verdict, number

OMEGAS = (15.0, 30.0, 45.0, 60.0, 75.0, 90.0, 105.0, 120.0, 160.0, 240.0)
QUICK_OMEGAS = (30.0, 75.0, 120.0, 240.0)
# Steps of one update, such that it takes about as long as one of splat on two cores.
FIELDS = {"splat": 400, "ngp": 250, "nerfacto": 150, "tensorf": 150}
QUICK_FIELDS = {"splat": 150, "ngp": 80}
POLICIES = ("threshold", "wait")
_METRICS = ("psnr_db", "psnr_moving_db", "lpips", "f_w")


class Representations(SceneStudy):
    name = "representations"
    title = "Threshold and wait, by representation (figure 6.7)"

    def of_scene(self, request: StudyRequest, scene: str) -> list[Point]:
        fields = (QUICK_FIELDS if request.quick else FIELDS).items()
        ideals = [({"field": f}, {"field": f, "steps": steps, "every_ms": 2400.0}) for f, steps in fields]
        traffic = [(labels, {**settings, "channel": {"preset": "ch6-high"}}) for labels, settings in ideals]
        omegas = dict.fromkeys(POLICIES, QUICK_OMEGAS if request.quick else OMEGAS)
        return request.sweep(scene, request.repeats(4, 20), traffic, "omega_ms", omegas, ideals)

    def judge(self, request: StudyRequest, table: Table, scene: str) -> list[Verdict]:
        verdicts = []
        fields = table.distinct("field")
        for policy in POLICIES:
            draw_metrics(
                request.out / f"representations-{scene}-{policy}.png",
                table,
                "omega_ms",
                "omega (ms)",
                _METRICS,
                [(f, {"scene": scene, "field": f, "policy": policy}) for f in fields],
                f"{scene}, {policy}: from scratch",
            )
            for metric in _METRICS:
                verdicts += self._judge(table, scene, policy, metric)
        return verdicts

    def _judge(self, table: Table, scene: str, policy: str, metric: str) -> list[Verdict]:
        name, lower, _, least = METRICS[metric]
        answers, text = [], []
        for field in table.distinct("field"):
            curve = table.curve("omega_ms", metric, scene=scene, field=field, policy=policy)
            if curve:
                best = optimum(curve, lower)
                answers.append(best.interior(least))
                text.append(
                    f"{field} {number(best.x, 0)} ms{best.spread} ("
                    f"{table.no_delay_gain(metric, scene=scene, field=field)})"
                )
        if not text:
            return []
        inside = f"an optimum inside for {sum(a is True for a in answers)} of {len(answers)}."
        about, claim = f"{scene}, {policy}, {name}", "the trade shows with every representation (6.5.2)."
        found = f"best omega: {', '.join(text)}; {inside}"
        return [Verdict(about, claim, found, all_of(answers))]
