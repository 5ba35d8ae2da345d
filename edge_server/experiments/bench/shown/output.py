"""Tables and the picture of what is shown."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from edge_server.experiments.bench.shown.runs import FIRST_VARIANT, SHOWN_EVERY_MS
from edge_server.experiments.common.statistics import interval
from edge_server.experiments.common.tables import markdown_table, mean_or_none, number
from edge_server.experiments.virtual.shown_truth import PARTS

Figures = Mapping[str, Any]
_SHARES = ("the field's own error", "prediction", "network", "computing")
_AGES = ("network", "waiting", "computing", "display")


def table(figures: Figures) -> str:
    """All figures as Markdown, and what they mean."""
    texts = [_shown_text(figures), _shown_table(figures), _CEILINGS_TEXT, _ceilings_table(figures)]
    if shares := list(_shares(figures)):
        name, first = shares[0]
        most = max(first, key=lambda part: first[part])
        texts.append(f"{_SHARES_TEXT} In `{name}` most of it, {100 * first[most]:.0f} %, is {most}.")
        cells = [(name, *(f"{100 * s:.0f} %" for s in of.values())) for name, of in shares]
        texts.append(markdown_table(("scene", *_SHARES), cells))
    return "\n\n".join(texts)


def _runs(figures: Figures, row: str, variant: str) -> list[dict[str, Any]]:
    """A row's runs of one variant, the first seed first."""
    return list(figures[row].get(variant, {}).values())


def _shown_text(figures: Figures) -> str:
    text = (
        f"Virtual time, last third of each run, a seeded random instant in every {SHOWN_EVERY_MS:g} ms. "
        "*layers*: `splat` with `layers: true` on arrivals, as `room` ships it; *before*: `splat` without "
        "layers in cycles of 250 ms. Layers are charged the processor time of one core that an update and "
        "each view took in the scene's own run where nothing is late, without the training of the static "
        "field, which another core does; *before* is charged 70 ms an update and 3 ms a step, as "
        "[studies](../studies.md#where-there-is-a-trade-off-at-all). PSNR in dB, mean and 95 % interval over "
        "seeds. Content lag: the tau, up to 600 ms, at which truth(t - tau) matches the moving pixels shown "
        "best. Age: of the cameras' newest views that the picture rests on, when it was looked at; display: "
        "since it was published. The page adds what the browser takes."
    )
    for name in figures:
        ours, before = (_runs(figures, name, variant) for variant in ("shown", "before"))
        if ours and before and None not in (lags := [runs[0]["lag_ms"]["p50"] for runs in (ours, before)]):
            return (
                f"{text} So `{name}` shows what moves as it was {lags[0]:.0f} ms ago; before, {lags[1]:.0f}."
            )
    return text


_CEILINGS_TEXT = (
    "Ceilings, whole / moving. *Nothing late*: the same field, ideal network, computing free: its own error. "
    "*Computing free*: the scene's network alone. *Perfect field*: the true scene carried on to the instant "
    "from what the same run knew: each rigid part keeps the linear and angular velocity that it had at the "
    "capture of the newest view (an upper bound: one view does not tell all), or at the mean capture of all "
    "cameras' newest views. Below the latter, a field has not even used its mean evidence; above, it uses "
    "fresh views to correct what late ones say. First seed of each scene."
)
_SHARES_TEXT = (
    "Where the squared error of moving pixels goes, in shares of what is shown (first seed). With E a run's "
    "error and P that of the perfect field at the newest view of the same run: own E(nothing late); "
    "prediction P(shown) - P(nothing late), what nobody can know who assumes constant velocity; network "
    "E(computing free) - E(nothing late) and computing E(shown) - E(computing free), both beyond their part "
    "of the prediction. They add up; a few negative per cent are the luck of one run."
)


def _shown_table(figures: Figures) -> str:
    head = (
        "scene|mode|runs|whole|moving|still|content lag p50 / p95, ms|newest view, ms|"
        "mean age = network + waiting + computing + display, ms"
    )
    rows = []
    for name in figures:
        for mode, variant in (("layers", "shown"), ("before", "before")):
            if not (runs := _runs(figures, name, variant)):
                continue
            psnr = [str(interval([run["psnr_db"][part] for run in runs])) for part in PARTS]
            lags = " / ".join(
                number(mean_or_none([run["lag_ms"][p] for run in runs]), 0) for p in ("p50", "p95")
            )
            ages = {
                age: mean_or_none([run["age_ms"][age] for run in runs]) for age in ("mean", "newest", *_AGES)
            }
            split = " + ".join(number(ages[age], 0) for age in _AGES)
            rows.append(
                (
                    name,
                    mode,
                    len(runs),
                    *psnr,
                    lags,
                    number(ages["newest"], 0),
                    f"{number(ages['mean'], 0)} = {split}",
                )
            )
    return markdown_table(head.split("|"), rows)


def _ceilings_table(figures: Figures) -> str:
    head = (
        "scene|shown|computing free|nothing late|perfect field, newest view|perfect field, mean age|"
        "charged, ms"
    )
    rows = []
    for name in figures:
        firsts = [
            next(iter(_runs(figures, name, v)), None) for v in ("shown", "computing free", FIRST_VARIANT)
        ]
        if (shown := firsts[0]) is None:
            continue
        perfect = [_pair(shown["perfect"][known]) for known in ("newest", "mean")]
        cost = shown["charged"]
        charged = f"{cost['ms_per_update']:.1f} an update, {cost['ms_per_view']:.2f} a view"
        rows.append((name, *map(_pair, firsts), *perfect, charged))
    return markdown_table(head.split("|"), rows)


def _pair(run: Figures | None) -> str:
    """PSNR whole / moving."""
    if run is None:
        return "-"
    return " / ".join(number(run["psnr_db"][part], 1) for part in ("whole", "moving"))


def _shares(figures: Figures) -> Iterable[tuple[str, dict[str, float]]]:
    """Of each row that tells network and computing apart, the shares of its moving pixels' squared error."""
    for name in figures:
        runs = [_runs(figures, name, v) for v in (FIRST_VARIANT, "computing free", "shown")]
        if not all(runs):
            continue
        error = [first[0]["squared_error"]["moving"] for first in runs]
        perfect = [first[0]["perfect"]["newest"]["squared_error"]["moving"] for first in runs]
        if None in error or not error[-1]:
            continue
        beyond = [e - p for e, p in zip(error, perfect)]
        parts = (error[0], perfect[2] - perfect[0], beyond[1] - beyond[0], beyond[2] - beyond[1])
        yield name, dict(zip(_SHARES, [part / error[-1] for part in parts]))


def draw(figures: Figures, path: Path) -> None:
    """Moving PSNR shown, before and at each ceiling, and the shares of the error, a line a scene, to ``path``
    (PNG)."""
    from edge_server.report.style import BLUE, CYCLE, GREEN, GREY, ORANGE, VERMILION, figure

    names = [name for name in figures if _runs(figures, name, "shown")]
    if not names:
        return
    shares = dict(_shares(figures))
    with figure(path, 1, 2, 1.0 + 0.3 * len(names), sharey=True) as (_, ((left, right),)):
        for variant, color, mark in (
            ("before", GREY, "x"), ("shown", BLUE, "o"), ("computing free", ORANGE, "v"),
            (FIRST_VARIANT, GREEN, "^"),
        ):  # fmt: skip
            at = [(_first_moving(_runs(figures, name, variant)), k) for k, name in enumerate(names)]
            _dots(left, at, color, mark, variant)
        perfect = [(_first_moving([run["perfect"]["newest"] for run in _runs(figures, n, "shown")]), k)
                   for k, n in enumerate(names)]  # fmt: skip
        _dots(left, perfect, VERMILION, "d", "perfect field, same ages")
        begun = [0.0] * len(names)
        for part, color in zip(_SHARES, CYCLE):
            widths = [100 * max(shares.get(name, {}).get(part, 0.0), 0.0) for name in names]
            right.barh(range(len(names)), widths, left=begun, color=color, label=part, height=0.6)
            begun = [a + b for a, b in zip(begun, widths)]
        left.set(
            xlabel="PSNR of moving pixels (dB)",
            yticks=range(len(names)),
            yticklabels=[name.partition(":")[0] for name in names],
        )
        left.invert_yaxis()
        right.set(xlabel="share of the squared error (%)")
        for ax in (left, right):
            ax.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2)


def _first_moving(runs: Sequence[Figures]) -> float | None:
    value: float | None = runs[0]["psnr_db"]["moving"] if runs else None
    return value


def _dots(ax: Any, at: Sequence[tuple[float | None, int]], color: str, mark: str, label: str) -> None:
    known = [(x, y) for x, y in at if x is not None]
    if known:
        ax.plot(*zip(*known), mark, color=color, label=label, markersize=6)
