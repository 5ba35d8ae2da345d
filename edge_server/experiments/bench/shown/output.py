"""Tables and figure of ``bench shown``."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from edge_server.experiments.bench.shown.rows import ROWS
from edge_server.experiments.bench.shown.runs import FIRST_VARIANT, SHOWN_EVERY_MS, VARIANTS
from edge_server.experiments.common.statistics import interval
from edge_server.experiments.common.tables import markdown_table, mean_or_none, number
from edge_server.experiments.virtual.shown_truth import PARTS

Figures = Mapping[str, Any]
_SHARES = ("the field's own error", "prediction", "network", "computing")
_AGES = ("network", "waiting", "computing", "display")

_SHOWN_TEXT = (
    f"Virtual time, last third of each run, a seeded random instant in every {SHOWN_EVERY_MS:g} ms. "
    "*layers*: `splat` with `layers: true` on arrivals, as `room` ships it; *before*: `splat` without "
    "layers in cycles of 250 ms. Layers are charged the processor time of one core that an update and each "
    "view took in the scene's own run where nothing is late, without the training and the renderings of the "
    "static field, which another core does; *before* is charged 70 ms an update and 3 ms a step, as "
    "[studies](../studies.md#where-there-is-a-trade-off-at-all). PSNR in dB, mean and 95 % interval over "
    "seeds. Content lag: the tau, up to 600 ms, at which truth(t - tau) matches the moving pixels shown "
    "best. Age: of the cameras' newest views that the picture rests on, when it was looked at; display: "
    "since it was published. The page adds what the browser takes."
)
_SLOWER_TEXT = (
    "Slower processors: the same scenes, first seed, where an update and a frame are charged twice and four "
    "times as much. *A perfect field that stands still*: the true picture at the mean capture time of the "
    "newest views that the same run showed."
)
_CEILINGS_TEXT = (
    "Ceilings, whole / moving, first seed. *Nothing late*: the same field, ideal network, computing free: "
    "its own error. *Computing free*: the scene's network alone. *Perfect field*: the true scene carried "
    "on to the instant from what the same run knew: each rigid part keeps the linear and angular velocity "
    "that it had at the capture of the newest view (an upper bound: one view does not tell all), or at the "
    "mean capture of all cameras' newest views. A field below the latter has not even used its mean "
    "evidence; above it, fresh views correct what late ones say.\n\n"
    "Shares of the moving pixels' squared error. With E a run's error and P that of the perfect field at "
    "the newest view of the same run: own E(nothing late); prediction P(shown) - P(nothing late), what "
    "nobody knows who assumes constant velocity; network E(computing free) - E(nothing late) and computing "
    "E(shown) - E(computing free), both beyond their part of the prediction. A few negative per cent are "
    "the luck of a run."
)


def table(figures: Figures) -> str:
    """All figures as Markdown, with explanations."""
    meaning = []
    for name in list(figures)[:1]:
        lags = [_mean(figures[name].get(v, {}).values(), "lag_ms", "p50") for v in ("shown", "before")]
        if "-" not in lags and (shares := _shares(figures, name)):
            meaning = [
                f"So `{name}` shows what moves as it was {lags[0]} ms ago; before, {lags[1]}. Of the squared "
                f"error that is left where it moves, {100 * max(shares):.0f} % is "
                f"{_SHARES[shares.index(max(shares))]}."
            ]
    return "\n\n".join(
        [
            _SHOWN_TEXT,
            *meaning,
            _shown_table(figures),
            *_slower_table(figures),
            *_trends(figures),
            _CEILINGS_TEXT,
            _ceilings_table(figures),
        ]
    )


def _trends(figures: Figures) -> list[str]:
    """Table of long runs minute by minute, with a heading; empty without such runs."""
    runs = {name: run for name in figures if (run := _first(figures, name, "shown")) and "by_minute" in run}
    if not runs:
        return []
    minutes = [part["minute"] for part in next(iter(runs.values()))["by_minute"]]
    rows = []
    for name, run in runs.items():
        parts, scene = run["by_minute"], f"{name} ({run['left_out']} frames left out)"
        rows.append((f"{scene}: mean age, ms", *(number(part["age_ms"], 0) for part in parts)))
        rows.append((f"{scene}: moving, dB", *(number(part["psnr_moving_db"], 1) for part in parts)))
    return ["Long runs, minute by minute:", markdown_table(["scene", *map(str, minutes)], rows)]


def _slower_table(figures: Figures) -> list[str]:
    """Table of rows on slower processors and the same rows on this one, with a heading; empty without such
    runs."""
    slower = {row.name: row for row in ROWS if row.slower > 1.0 and row.name in figures and not row.minutes}
    if not slower:
        return []
    rows = []
    for of in dict.fromkeys(row.charged_as for row in slower.values()):
        for name, speed in ((of, 1.0), *((n, 1 / r.slower) for n, r in slower.items() if r.charged_as == of)):
            if (run := _first(figures, name, "shown")) is None or "frozen" not in run["perfect"]:
                continue
            rows.append(
                (
                    of,
                    f"{speed:g}",
                    *(number(run["psnr_db"][part], 1) for part in PARTS),
                    number(run["perfect"]["frozen"]["psnr_db"]["moving"], 1),
                    number(run["age_ms"]["mean"], 0),
                    number(run["updates"] / run["seconds"], 0),
                    f"{run['left_out'] / run['arrivals']:.0%}",
                )
            )
    head = (
        "scene|speed|whole|moving|still|a perfect field that stands still|mean age, ms|updates a second|frames left out"
    )
    return [_SLOWER_TEXT, markdown_table(head.split("|"), rows)]


def _shown_table(figures: Figures) -> str:
    head = (
        "scene|mode|runs|whole|moving|still|content lag p50 / p95, ms|newest view, ms|"
        "mean age = network + waiting + computing + display, ms"
    )
    rows = []
    for name in _own(figures):
        for mode, variant in (("layers", "shown"), ("before", "before")):
            if not (runs := list(figures[name].get(variant, {}).values())):
                continue
            psnr = [str(interval([run["psnr_db"][part] for run in runs])) for part in PARTS]
            lags = " / ".join(_mean(runs, "lag_ms", p) for p in ("p50", "p95"))
            ages = f"{_mean(runs, 'age_ms', 'mean')} = {' + '.join(_mean(runs, 'age_ms', age) for age in _AGES)}"
            rows.append((name, mode, len(runs), *psnr, lags, _mean(runs, "age_ms", "newest"), ages))
    return markdown_table(head.split("|"), rows)


def _ceilings_table(figures: Figures) -> str:
    head = (
        "scene|shown|computing free|nothing late|perfect field, newest view|perfect field, mean age|"
        f"error of moving pixels, %: {' + '.join(_SHARES)}|charged, ms"
    )
    rows = []
    for name in _own(figures):
        if (shown := _first(figures, name, "shown")) is None:
            continue
        of = (shown, *(_first(figures, name, v) for v in ("computing free", FIRST_VARIANT)))
        perfect = [shown["perfect"][known] for known in ("newest", "mean")]
        shares = " + ".join(f"{100 * share:.0f}" for share in _shares(figures, name)) or "-"
        charged = "{ms_per_update:.1f} an update, {ms_per_view:.2f} a view".format(**shown["charged"])
        rows.append((name, *map(_pair, (*of, *perfect)), shares, charged))
    return markdown_table(head.split("|"), rows)


def _own(figures: Figures) -> list[str]:
    """The scenes with their own costs."""
    others = {row.name for row in ROWS if row.charged_as}
    return [name for name in figures if name not in others]


def _first(figures: Figures, name: str, variant: str) -> dict[str, Any] | None:
    """The run with the first seed of a row's variant; None if there is none."""
    return next(iter(figures[name].get(variant, {}).values()), None)


def _mean(runs: Iterable[Figures], kind: str, key: str) -> str:
    """Mean of a figure in ms, without decimals."""
    mean = mean_or_none([run[kind][key] for run in runs])
    return number(None if mean is None else round(mean), 0)


def _pair(run: Figures | None) -> str:
    """PSNR whole / moving."""
    return " / ".join(number(run["psnr_db"][part] if run else None, 1) for part in ("whole", "moving"))


def _shares(figures: Figures, name: str) -> list[float]:
    """``_SHARES`` of the squared error of a row's moving pixels; empty if they cannot be separated."""
    runs = [_first(figures, name, v) for v in (FIRST_VARIANT, "computing free", "shown")]
    known = [run for run in runs if run and run["squared_error"]["moving"]]
    if len(known) < len(runs):
        return []
    error = [run["squared_error"]["moving"] for run in known]
    perfect = [run["perfect"]["newest"]["squared_error"]["moving"] for run in known]
    beyond = [e - p for e, p in zip(error, perfect)]
    parts = (error[0], perfect[2] - perfect[0], beyond[1] - beyond[0], beyond[2] - beyond[1])
    return [part / error[2] for part in parts]


def draw(figures: Figures, path: Path) -> None:
    """Draw the moving PSNR of each variant and of the perfect field, and the shares of the error, one line
    per scene, to ``path`` (PNG)."""
    from edge_server.report.style import CYCLE, figure

    names = [name for name in _own(figures) if _first(figures, name, "shown")]
    if not names:
        return
    lines: dict[str, list[Figures | None]] = {v: [_first(figures, n, v) for n in names] for v in VARIANTS}
    lines["perfect field, same ages"] = [run and run["perfect"]["newest"] for run in lines["shown"]]
    with figure(path, 1, 2, 1.0 + 0.3 * len(names), sharey=True) as (_, ((left, right),)):
        for (label, runs), color, mark in zip(lines.items(), CYCLE, "^ovxd"):
            psnr = [run and run["psnr_db"]["moving"] for run in runs]
            left.plot(
                [float("nan") if db is None else db for db in psnr],
                range(len(names)),
                mark,
                color=color,
                label=label,
                markersize=6,
            )
        begun = [0.0] * len(names)
        for k, part in enumerate(_SHARES):
            widths = [max(100 * (_shares(figures, name) or [0.0] * 4)[k], 0.0) for name in names]
            right.barh(range(len(names)), widths, left=begun, color=CYCLE[k], label=part, height=0.6)
            begun = [a + b for a, b in zip(begun, widths)]
        left.set(xlabel="PSNR of moving pixels (dB)", yticks=range(len(names)))
        left.set_yticklabels([name.partition(":")[0] for name in names])
        left.invert_yaxis()
        right.set(xlabel="share of their squared error (%)")
        for ax in (left, right):
            ax.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2)
