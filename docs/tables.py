"""Writes the tables of docs/ that come from measured files.

    python docs/tables.py            after `make bench`, `make figures` or `edge-server frontier --shipped`

A table stands between the lines ``<!-- table NAME -->`` and ``<!-- end -->``; what stands between them is
replaced. tests/deploy/test_docs.py fails while a page says something else than the files.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from statistics import median
from typing import Any

DOCS = Path(__file__).parent
VERDICT_WORDS = ("holds", "does not hold", "undecided")
FIELDS = {
    "splat": "3D Gaussians",
    "ngp": "hash grid, small network (default)",
    "nerfacto": "hash grid, proposal sampling",
    "tensorf": "vector-matrix factors",
}
# Rows of docs/results/gpu/field.json, and what they are called.
GPU_ROWS = {
    "splat": "`splat`, 8 threads",
    "splat, threads=16": "`splat`, 16 threads",
    "splat, threads=2": "`splat`, 2 threads",
    "splat, device=cuda": "`splat`, GPU (gsplat)",
    "ngp": "`ngp`, 8 threads",
    "ngp, threads=16": "`ngp`, 16 threads",
    "ngp, threads=2": "`ngp`, 2 threads",
    "ngp, device=cuda": "`ngp`, GPU (torch)",
}
# title, option as `bench options --only` knows it, and the cases (field, scene) with and without a need of it
OPTIONS: tuple[tuple[str, tuple[tuple[str, str], ...], tuple[tuple[str, str], ...]], ...] = (
    ("contraction", (("ngp", "room"), ("splat", "room")), (("ngp", "tile"), ("splat", "tile"))),
    ("exposure", (("ngp", "room, gains"),), (("ngp", "room"),)),
    ("pose refinement", (("ngp", "room, poses"),), (("ngp", "room"),)),
    ("distortion loss", (("ngp", "room"),), (("ngp", "tile"),)),
    (
        "depth guide",
        (("ngp", "tile"), ("ngp", "tile, six"), ("ngp", "kitchen, six"), ("ngp", "lego")),
        (("ngp", "room"),),
    ),
    ("appearance", (("nerfacto", "room, gains"),), (("nerfacto", "room"),)),
    (
        "view-dependent color",
        (("ngp", "lego"), ("ngp", "kitchen"), ("splat", "lego"), ("splat", "kitchen")),
        (("ngp", "tile"), ("ngp", "room"), ("splat", "tile"), ("splat", "room")),
    ),
    ("random background", (("ngp", "lego"), ("splat", "lego")), (("ngp", "tile"), ("splat", "tile"))),
    ("no density seen by few", (), (("ngp", "tile"), ("ngp", "room"), ("splat", "tile"), ("splat", "room"))),
    ("smoothness", (), (("ngp", "tile"), ("ngp", "room"))),
)
UPDATE_OPTIONS = (
    ("changed pixels first", "room, moving"),
    ("changed pixels first", "kitchen, moving"),
    ("stale pixels masked", "room, late"),
    ("stale pixels masked", "room, moving"),
    ("weighed by age", "room, late"),
    ("weighed by age", "room, moving"),
    ("movement followed", "room, late"),
    ("movement followed", "room, moving"),
    ("wrong views refused", "room, moving"),
    ("wrong views refused", "kitchen, moving"),
)

FROM_NOTHING = "room, ch5, whole, one viewpoint, from nothing"  # the thesis's case of figure 5.9
# The rows of docs/studies.md: study, scene and setting of the verdict, and a word of its claim.
VERDICTS = (
    ("mat", "room, drop-new, PSNR (dB)", ""),
    ("mat", "room, drop-new, PSNR, moving pixels (dB)", ""),
    ("mat", "room, parallel, PSNR, moving pixels (dB)", ""),
    ("mat", "room, drop-new, PSNR as shown, moving pixels (dB)", ""),
    ("mat", "room, parallel, PSNR as shown, moving pixels (dB)", ""),
    ("mat", "kitchen, drop-new, PSNR, moving pixels (dB)", ""),
    ("mat-delay", "room, PSNR (dB)", ""),
    ("mat-delay", "room, PSNR, moving pixels (dB)", ""),
    ("lambda", "room, threshold, whole image, ages of all cameras (5.8)", ""),
    ("lambda", "room, threshold, whole image, ages of used views (6.35)", ""),
    ("omega", "room, high traffic, threshold, PSNR (dB)", ""),
    ("omega", "room, high traffic, threshold, PSNR, moving pixels (dB)", ""),
    ("omega", "room, low traffic, threshold, PSNR, moving pixels (dB)", ""),
    ("omega", "room, high traffic, wait, PSNR (dB)", "longer"),
    ("omega", "room, high traffic, wait, PSNR (dB)", "threshold"),
    ("omega", "room, high traffic, wait-flush, PSNR (dB)", "threshold"),
    ("omega", "room, low traffic, wait, PSNR (dB)", "threshold"),
    ("omega", "room, high traffic, threshold, PSNR as shown, moving pixels (dB)", ""),
    ("omega", "room, high traffic, wait, PSNR as shown, moving pixels (dB)", "threshold"),
    ("omega", "room, high traffic, parallel, threshold, PSNR, moving pixels (dB)", ""),
    ("omega", "room, high traffic, parallel, wait, PSNR, moving pixels (dB)", "threshold"),
    ("omega", "room, high traffic, wait, F_w (6.37)", "inside"),
    ("omega", "room, high traffic, wait, F_w with w_s = -0.2", "inside"),
    ("omega", "room, high traffic, wait-arrived, PSNR (dB)", "arrive meanwhile"),
    ("omega", "room, high traffic, wait-arrived, F_w (6.37)", "arrive meanwhile"),
    ("images", "room, LPIPS", "more images"),
    ("images", "room, mean age of used views (ms)", ""),
    ("images", "room, PSNR, moving pixels (dB)", "better than all"),
    ("images", "tower, LPIPS", "more images"),
    ("images", "tower, mean age of used views (ms)", ""),
    ("representations", "room, threshold, PSNR (dB)", ""),
    ("representations", "room, threshold, PSNR, moving pixels (dB)", ""),
    ("ppo-select", f"{FROM_NOTHING}, judged from the cameras that rewarded", ""),
    ("ppo-select", FROM_NOTHING, "better than random"),
    ("ppo-select", FROM_NOTHING, "fixed threshold"),
    ("ppo-select", FROM_NOTHING, "better than all"),
    ("ppo-wait", "room, ch6, age -0.015/ms, wait", "best fixed"),
    ("ppo-wait", "room, ch6, age -0.015/ms, threshold", "best fixed"),
    ("ppo-wait", "room, ch6, age -0.015/ms", ""),
    ("ppo-wait", "room, ch6, age -0.015/ms, threshold", "the ages tell"),
    ("viewpoints", "tile, FisherRF", ""),
    ("viewpoints", "tile, FisherRF, 8 views", ""),
    ("viewpoints", "tile, FisherRF, 8 views, path", ""),
    ("preferences", "tile, policy, object, 8 views", ""),
    ("preferences", "tile, policy, object, 8 views, path", ""),
    ("metrics", "LPIPS", ""),
    ("metrics", "SSIM", "lowest"),
)


def measured(name: str) -> Any:
    """A file of figures, by its path from the repository's root."""
    return json.loads((DOCS.parent / name).read_text())


def table(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """A Markdown table; numbers of a row are shown with one decimal."""
    lines = [header, ["---"] * len(header), *rows]
    return "\n".join(
        "| " + " | ".join(f"{c:.1f}" if isinstance(c, float) else str(c) for c in line) + " |" for line in lines
    )


def from_scratch(scene: str, seconds: Sequence[float]) -> str:
    """PSNR after so many seconds of fitting, a row a representation."""
    found = measured("docs/results/field.json")["field"][scene]
    head = ["representation", *(f"{s:g} s" for s in seconds)]
    return table(head, ([f"`{f}`", *(found[f]["series"][f"{s:g}_s"]["psnr_db"] for s in seconds)] for f in FIELDS))


def gpu() -> str:
    """From scratch on a GPU and on the cores beside it: dB after so many seconds, and steps a second."""
    found = measured("docs/results/gpu/field.json")["field"]
    rows = []
    for name, words in GPU_ROWS.items():
        room, lego = (found[scene].get(name, {}) for scene in ("room", "lego"))
        cells = [
            of.get("series", {}).get(f"{s:g}_s", {}).get("psnr_db", "-")
            for of, seconds in ((room, (0.5, 1, 2.5, 8)), (lego, (2, 5)))
            for s in seconds
        ]
        rate = f"{room['steps_per_s']:.0f}" if "steps_per_s" in room else "-"
        rows.append([words, *cells, rate])
    head = ["", *(f"`room`, {s:g} s" for s in (0.5, 1, 2.5, 8)), *(f"`lego`, {s} s" for s in (2, 5))]
    return table([*head, "steps a second, `room`"], rows)


def threads() -> str:
    """Steps a second and milliseconds of an update of ``room``, by threads, on a machine of 16 cores."""
    found = measured("docs/results/gpu/threads.json")
    of, updates = found["steps_per_s"], found["threads"]
    names = [name for name in of["1"] if name != "empty_job_us"]
    rows = [[f"steps a second, {name}", *(row[name] for row in of.values())] for name in names]
    rows.append(["a kernel that does nothing, us", *(row["empty_job_us"] for row in of.values())])
    took = [f"{updates[n]['median_ms']:.0f}" if n in updates else "-" for n in of]
    return table(["threads", *of], [*rows, ["an update of the scenario `room`, ms", *took]])


def representations() -> str:
    """What each representation is, and what it takes: rendering, compiling, memory."""
    found = measured("docs/results/field.json")["field"]
    rows = []
    for name, what in FIELDS.items():
        start, tile = found["start"][name], found["tile"][name]
        rows.append(
            [
                f"`{name}`",
                what,
                tile["render_128_ms"],
                tile["render_256_ms"],
                start["jit_cold_s"],
                f"{start['jit_cached_s']:.2f}",
                math.floor(start["peak_rss_mb"] + 0.5),
            ]
        )
    return table(
        ["`field:`", "what it is", "render 128², ms", "render 256², ms", "compile, s", "from cache, s", "peak MB"], rows
    )


def baselines() -> str:
    """How far held-out cameras stand off, and what doing without a field would score."""
    found = measured("docs/results/field.json")["field"]
    rows = []
    for scene in ("tile", "room", "kitchen", "lego", "fox"):
        part = found[scene]
        known = part["baseline"]
        rows.append([part["scene"], part["angle_deg"], known["mean_colour_db"], known["nearest_view_db"]])
    return table(["scene", "held-out view to nearest other, degrees", "mean color, dB", "nearest view, dB"], rows)


def best_updates() -> str:
    """The best time of an update, by what is scored; `splat` at each effort, the others at one."""
    rows = []
    for (speed, field, effort, by), times in _updates().items():
        if field.startswith("`splat`") or effort == "medium":
            best = [max(times, key=lambda s, part=part: times[s][part]) for part in (0, 1)]
            at = [f"{times[s][part]:.1f} at {s:g} s" for part, s in enumerate(best)]
            rows.append([speed, field, by, *at, "{:.1f} / {:.1f} at {:g} s".format(*times[max(times)], max(times))])
    head = ("person, m/s", "representation, effort", "by what was", "best dB, whole image", "best dB, moving pixels")
    return table((*head, "longest, whole / moving"), rows)


def all_updates() -> str:
    """Every point of the shipped frontier: whole image / moving pixels."""
    found = _updates()
    seconds = sorted({s for times in found.values() for s in times})
    rows = [
        [speed, field, by, *("{:.1f} / {:.1f}".format(*times[s]) if s in times else "-" for s in seconds)]
        for (speed, field, _, by), times in found.items()
    ]
    head = ("person, m/s", "representation, effort", "by what was")
    return table((*head, *(f"{s:g} s" for s in seconds)), rows)


def _updates() -> dict[tuple[str, str, str, str], dict[float, tuple[float, float]]]:
    """(speed, representation with effort, effort, shown or published) -> seconds planned for an update ->
    PSNR of the whole image and of moving pixels."""
    found: dict[Any, Any] = {}
    order = list(FIELDS)
    points = measured("edge_server/frontier.json")["updates"]
    for p in sorted(points, key=lambda p: (p["speed_m_per_s"], order.index(p["field"]))):
        by = "shown" if "shown_psnr_db" in p else "published"
        prefix = "shown_" if by == "shown" else ""
        key = f"{p['speed_m_per_s']:g}", f"`{p['field']}`, {p['effort']}", p["effort"], by
        psnr = p[f"{prefix}psnr_db"], p[f"{prefix}psnr_moving_db"]
        found.setdefault(key, {})[p["planned_update_s"]] = psnr
    return found


def options() -> str:
    """Gain of each optional part after four seconds (and step for step), where it is called for or not."""
    found = {(r["option"], r["field"], r["scene"]): r["gain_psnr_db"] for r in _option_rows()}

    def cell(name: str, cases: Sequence[tuple[str, str]]) -> str:
        parts = []
        for field, scene in cases:
            gain = found[name, field, scene]
            parts.append(f"`{field}`, {scene}: {signed(gain['4_s'])} ({signed(gain['400_steps'])})")
        return "<br>".join(parts) or "none of ours"

    return table(
        ["option", "scenes that call for it, gain dB", "scenes that do not, gain dB"],
        ([name, cell(name, yes), cell(name, no)] for name, yes, no in OPTIONS),
    )


def update_options() -> str:
    """The same for updates of a quarter of a second while the scene moves: whole image, moving pixels."""
    found = {(r["option"], r["field"], r["scene"]): r for r in _option_rows()}
    rows = []
    for name, scene in UPDATE_OPTIONS:
        cells = []
        for field in ("ngp", "splat"):
            row = found.get((name, field, scene))
            cells.append(
                f"{signed(row['gain_psnr_db']['0.25_s'])} / {signed(row['gain_psnr_moving_db']['0.25_s'])}"
                if row
                else "has none"
            )
        rows.append([name, scene, *cells])
    return table(["option", "scene", "`ngp`, whole / moving, dB", "`splat`, whole / moving, dB"], rows)


def _option_rows() -> list[Any]:
    rows: list[Any] = measured("docs/results/field.json")["options"]["rows"]
    return rows


def signed(value: float) -> str:
    """With its sign and one decimal; 0 has none."""
    text = f"{value:+.1f}"
    return "0" if float(text) == 0 else text


def limits() -> str:
    """What the machine's own limits explain of each kernel's time."""
    rows = [row for row in _rows("limits", r"\w+ on ") if row[4] not in ("-", "")]
    return table(
        ["field, scene", "kernel", "share of a step", "explained by the machine's limits"],
        ([row[0], f"`{row[1]}`", row[3], row[4]] for row in rows),
    )


def following(part: str) -> str:
    """Tables of track and drift: how far updates stay behind a fresh fit."""
    found = [row for row in _rows(part, "(room|kitchen) ") if row[1] in FIELDS]
    found.sort(key=lambda row: (("room", "kitchen").index(row[0]), list(FIELDS).index(row[1])))
    last = 10 if part == "drift" else 9
    rows = [[r[0], f"`{r[1]}`", r[2], *map(_one_decimal, r[4:last])] for r in found]
    head = ["scene", "`field:`", "update", "updated, dB", "fresh fit, dB", "never updated, dB"]
    head += ["within 0.5 dB of fresh", "median gap, dB", "gap in first, last tenth, dB"]
    return table(head[: len(rows[0])], rows)


def card() -> str:
    """What policies show in the scenario card, and the learnt one against all."""
    found = measured("deploy/scenarios/card/scores.json")
    rows = [
        [name, *(f"{row['own_seed'][m]:.2f}" for m in ("psnr_db", "psnr_moving_db")), f"{row['own_seed']['views']:.1f}"]
        for name, row in found["policies"].items()
    ]
    learnt = found["policies"]["learnt"]
    whole, moving = (_interval(learnt[f"{m}_over_all"]) for m in ("psnr_db", "psnr_moving_db"))
    omegas = ", ".join(f"{state} {_interval(ms, 0)} ms" for state, ms in learnt["omega_ms"].items())
    return (
        table(("policy", "shown, dB", "moving", "views an update"), rows)
        + f"\n\nSeed {found['seed']}, {found['seconds']:g} s after {found['lead_s']:g}. The learnt policy "
        f"minus `all`, paired over {found['seeds']} other seeds and motions: {whole} dB, moving {moving}. "
        f"Its mean threshold by the channel's state: {omegas}."
    )


def compared(file: str) -> str:
    """What policies without learning show in a scenario, and minus the first of them, over seeds."""
    found = measured(f"docs/results/learning/{file}.json")
    first = next(iter(found["policies"]))
    columns = [
        c
        for m in ("psnr_db", "psnr_moving_db")
        for c in (m, f"{m}_over_{first}", f"{m}_over_fixed")
        if any(c in row for row in found["policies"].values())
    ]
    rows = [
        [
            f"`{name}`",
            *("" if c not in row or (name == first and "over" in c) else _interval(row[c]) for c in columns),
            f"{row['views'][0]:.1f}",
            f"{row['aaoi_ms'][0]:.0f}",
        ]
        for name, row in found["policies"].items()
    ]
    words = {"psnr_db": "shown, dB", "psnr_moving_db": "moving, dB"}
    less = [words.get(c) or f"minus {'the best fixed' if c.endswith('fixed') else f'`{first}`'}" for c in columns]
    head = ("policy", *less, "views an update", "their mean age, ms")
    of_each = "channel and motion" if found.get("motions", True) else "channel"
    best = " Best fixed: on the other half of the seeds." if any(c.endswith("fixed") for c in columns) else ""
    charged = ""
    if costs := found.get("compute"):
        step, update, view = (f"{costs[f'ms_per_{part}']:.2g}" for part in ("step", "update", "view"))
        charged = f" Computing: {step} ms a step, {update} an update, {view} a frame."
    return table(head, rows) + (
        f"\n\n{found['seeds']} seeds, each with a {of_each} of its own; {found['seconds']:g} s after "
        f"{found['lead_s']:g}; commit {found['commit']}. Differences are paired over seeds.{best}{charged}"
    )


def studies() -> list[Any]:
    """The files of the thesis's figures, in the order of their numbers."""
    found = [json.loads(path.read_text()) for path in (DOCS / "results" / "thesis").glob("*.json")]
    return sorted(found, key=lambda s: [int(n) for n in re.findall(r"\d+", _figure(s))] or [99])


def _figure(study: Any) -> str:
    """The figures, tables or equations that a study makes anew; they end its title."""
    number = re.search(r"\(([^()]*\d)\)$", study["title"])
    return number[1] if number else ""


def verdicts() -> str:
    """The verdicts of ``VERDICTS``, as far as they were measured."""
    rows: list[list[str]] = []
    by_name, said = {study["study"]: study for study in studies()}, ("", "")
    for name, about, word in VERDICTS:
        for v in by_name[name]["verdicts"] if name in by_name else ():
            if v["about"] == about and word in v["claim"]:
                figure = f"{re.sub('^figures? ', '', _figure(by_name[name]))} (`{name}`)"
                rows.append([figure if figure != said[0] else "", v["claim"] if v["claim"] != said[1] else ""])
                rows[-1] += [about, v["found"], v["verdict"]]
                said = figure, v["claim"]
    return table(["figure", "claim", "where", "found here", "verdict"], rows)


def taught() -> str:
    """What policies taught by preferences gain over others, the lowest and the highest of them, by scene."""
    verdicts = measured("docs/results/thesis/preferences.json")["verdicts"]
    found: dict[str, dict[str, list[tuple[float, str]]]] = {}
    for v in verdicts:
        scene, kind, *_ = v["about"].split(", ")
        if kind == "policy":
            of = re.sub(r" \(.*", "", v["claim"])
            found.setdefault(scene, {}).setdefault(of, []).append((v["interval"][0], v["verdict"]))
    columns = {
        "better than random": "dB over random views",
        "better than FisherRF": "dB over FisherRF",
        "shorter than random's": "path, m shorter than random views'",
    }

    def cell(of: list[tuple[float, str]]) -> str:
        values, won = [mean for mean, _ in of], sum(verdict == "holds" for _, verdict in of)
        shown = {0: "none", len(of): "all"}.get(won, str(won))
        return f"{min(values):.1f} to {max(values):.1f}; shown for {shown}"

    rows = [[f"`{scene}`", *(cell(of[name]) for name in columns)] for scene, of in found.items()]
    return table(["8 views of", *columns.values()], rows)


def figures() -> str:
    """A section for each study: how it was run, how often each claim holds, and folded, where."""
    names = [study["study"] for study in studies()]
    parts = []
    for study in studies():
        name = study["study"]
        seeds = f", {study['seeds']} seeds a point" if study["seeds"] else ""
        field = ", ".join(f"`{f}`" for f in study["field"])
        claims: dict[str, list[list[str]]] = {}
        for v in study["verdicts"]:
            known = v["interval"] and v["interval"][0] is not None
            row = [v["about"], v["verdict"], _short_interval(v["interval"]) if known else ""]
            claims.setdefault(v["claim"], []).append(row)
        names_of = {claim: f"{claim[0].upper()}{claim[1:].rstrip('.')}" for claim in claims}
        rows = [
            [names_of[claim] if k == 0 else "", *row] for claim, found in claims.items() for k, row in enumerate(found)
        ]
        counts = [
            [names_of[claim], *(sum(row[1] == word for row in found) or "" for word in VERDICT_WORDS)]
            for claim, found in claims.items()
        ]
        longer = tuple(n for n in names if n != name and n.startswith(name))
        drawn = [
            p.name
            for p in (DOCS / "results" / "thesis").glob(f"{name}*.png")
            if not (longer and p.name.startswith(longer))
        ]
        # The usual scene first, and of it the curves.
        drawn.sort(key=lambda p: (not re.search("room|tile", p), bool(re.search("-(pictures|images|paths)", p)), p))
        more = "".join(f", [{p.removesuffix('.png')}]({p})" for p in drawn[1:])
        if (DOCS / "results" / "thesis" / f"{name}-tables.md").exists():
            more = f", [tables]({name}-tables.md){more}"
        parts += [
            f"## {study['title']}\n",
            f"`{study['command']}`: {'quick pass' if study['quick'] else 'full run'}{seeds}"
            f"{', ' if field else ''}{field}, commit {study['commit']}. "
            f"[Rows]({name}.csv), [verdicts and means]({name}.json){more}.\n",
            table(["claim", *VERDICT_WORDS], counts),
            "\n<details><summary>Where, with differences and intervals</summary>\n",
            table(["claim", "where", "verdict", "difference"], rows),
            "\n</details>",
            *(f"\n![{study['title']}]({p})" for p in drawn[:1]),
            "",
        ]
    return "\n".join(parts).rstrip()


def _short_interval(values: Sequence[float | None]) -> str:
    """Mean and interval with the decimals that they call for; 0 where all are 0. One seed has no interval."""
    mean, low, high = values
    if mean is None or low is None or high is None:
        return "" if mean is None else f"{mean:.2f}"
    if not any(values):
        return "0"
    scale = max(high - low, abs(mean) / 10, 1e-3)
    digits = max(0, min(3, 1 - math.floor(math.log10(scale))))
    return _interval([round(v, digits) + 0.0 for v in (mean, low, high)], digits)  # + 0.0: no -0.00


def _interval(values: Sequence[float | None], digits: int = 2) -> str:
    mean, low, high = ("-" if v is None else f"{v:.{digits}f}" for v in values)
    return f"{mean} [{low}, {high}]"


def _one_decimal(text: str) -> str:
    return re.sub(r"-?\d+\.\d+", lambda number: re.sub(r"^-(?=0\.0$)", "", f"{float(number[0]):.1f}"), text)


def _rows(part: str, begins: str) -> list[list[str]]:
    """Rows of field.md's tables of a part, those whose first cell begins so, as cells."""
    text = (DOCS / "results" / "field.md").read_text().partition(f"## {part}\n")[2].partition("\n## ")[0]
    lines = [line for line in text.splitlines() if re.match(rf"\| {begins}", line)]
    return [[cell.strip() for cell in line.strip().strip("|").split("|")] for line in lines]


def peers() -> str:
    """Seconds to two qualities beside other programs, medians; and how many times the fastest of ours."""
    rows = []
    for scene in ("lego", "kitchen"):
        found = {n: r for n, r in measured("docs/results/peers.json")["peer"][scene].items() if n != "about"}

        def reached(name: str, target: str, found: dict[str, Any] = found) -> float:
            seconds = [run["seconds_to"][target] or math.inf for run in found[name].values()]
            return median(seconds)

        for name, runs in found.items():
            cells = []
            for target in ("20", "25"):
                ours, this = min(reached(n, target) for n in ("splat", "ngp")), reached(name, target)
                cell = "not reached" if this == math.inf else f"{this:.{2 if this < 1 else 0}f}"
                cells.append(cell + (f" ({this / ours:.0f} times)" if math.inf > this > 2.0 * ours else ""))
            best, spent = (max(r[what] for r in runs.values()) for what in ("best_db", "within_s"))
            rows.append([scene, name, len(runs), *cells, f"{best:.1f} in {spent:.0f} s"])
    return table(["scene", "contestant", "runs", "s to 20 dB", "s to 25 dB", "best, dB"], rows)


def soak(name: str) -> str:
    """Recoveries by fault, memory and account of a run of ``freshfield_up.soak``."""
    run = measured(f"docs/results/{name}.json")
    rows = []
    for kind, target in dict.fromkeys((f["kind"], f["target"]) for f in run["faults"]):
        same = [f for f in run["faults"] if (f["kind"], f["target"]) == (kind, target)]
        known = [f["recovery_s"] for f in same if f["recovery_s"] is not None]
        starts = [f["start_s"] for f in same if f["start_s"] is not None]
        rows.append(
            [f"{kind}, {target}", len(same), len(same) - len(known)]
            + [f"{of(v):.2f}" if v else "" for v in (known, starts) for of in (median, max)]
        )
    memory = ", ".join(
        f"{who} {use['early_mb']:.0f} to {use['late_mb']:.0f} MB in {use['minutes']:.0f} min"
        for who, use in run["memory"].items()
        if use["minutes"] >= 5.0
    )
    frames = run["frames"]
    account = "all accounted for" if frames["closes"] else f"not accounted for: {'; '.join(frames['doubts'])}"
    head = [
        "fault",
        "times",
        "no recovery before the next",
        "recovery, s: median",
        "worst",
        "start, s: median",
        "worst",
    ]
    return (
        f"Load average {run['load_average']:.0f}, {run['cores']} cores, a fault each {run['every_s']:.0f} s. "
        + (f"Memory of each last process: {memory}. " if memory else "")
        + f"Frames: {frames['captured']:,} captured, {account}.\n\n"
        + table(head, rows)
    )


def attacks() -> str:
    """Refusals, neighbors and memory of a run of tests/chaos/attacks.py."""
    run = measured("docs/results/attacks.json")

    def ms(found: dict[str, float] | None) -> str:
        return "" if found is None else " / ".join(f"{found[q]:.1f}" for q in ("p50", "p99"))

    rows = [
        [
            r["sent"],
            r["at"],
            r["answer"],
            ms(r["refused_ms"]),
            ms(r["neighbors"]["emulator" if r["at"] == "emulator" else "edge"]["ms"]),
            " / ".join(map(str, r["memory_mb"])),
            f"`{r['test']}`" if r["test"] else "",
        ]
        for r in run["attacks"]
    ]
    head = [
        "attack",
        "on",
        "answers",
        "after, ms: p50 / p99",
        "neighbor's answers, ms: p50 / p99",
        "MB before / most / after",
        "test",
    ]
    return f"Load average {run['load_average']:.0f}, {run['cores']} cores.\n\n" + table(head, rows)


def masks() -> str:
    """How well the shipped detector of the tile finds it and cuts it out, on what it was not trained on."""
    log = measured("edge_server/foreground/models/tile.json")
    where = {
        "unseen worlds": "other worlds, near and far",
        "own rig of tile": "`tile`, its own 19 cameras",
        "own rig of cell": "`cell`, as the hand sees it",
        "own rig of scan": "`scan`, as the hand sees it",
        "own rig of scan, from its rig": "the bench of `scan`, from the cameras of `tile`",
    }
    rows = []
    for key, words in where.items():
        boxes = log["quality"]["tile_int8"][key]
        ours, cut = (log["masks"][name][key] for name in ("tile_int8", "tile_int8, grabcut"))
        alarms = ours["false_alarms"]
        shares = [f"{x:.2f}" for x in (ours["iou"], ours["iou_p10"], cut["iou"])]
        rows.append(
            [
                words,
                ours["images"],
                f"{boxes['map50']:.2f}",
                f"{boxes['map50_95']:.2f}",
                f"{100 * ours['found']:.0f} %",
                *shares,
                "" if alarms is None else f"{100 * alarms:.0f} % of {ours['empty_images']}",
            ]
        )
    head = [
        "pictures",
        "that show it",
        "AP at IoU .5",
        "AP, .5 to .95",
        "found",
        "mask IoU, mean",
        "one in ten below",
        "by GrabCut in the same boxes",
        "false alarms without it",
    ]
    return table(head, rows)


def cell_meshes() -> str:
    """Meshes from the viewpoints of ``cell`` (``edge-server bench surface --only cell``)."""
    rows = [
        [
            f"{size} x {size}",
            f"{c['chamfer_mm']:.2f}",
            f"{100 * c['complete']:.0f} %",
            f"{100 * c['precise']:.0f} %",
            f"{c['median_mm']:.2f}",
            f"{c['exact_chamfer_mm']:.2f} mm, {100 * c['exact_complete']:.0f} %",
            f"{c['seconds']:.0f}",
        ]
        for size, c in measured("docs/results/surface.json")["surface"]["cell"].items()
    ]
    head = [
        "images",
        "chamfer, mm (aim 1.5)",
        "surface within 3 mm (aim 95 %)",
        "mesh within 3 mm",
        "median depth error, mm",
        "with exact depth",
        "seconds",
    ]
    return table(head, rows)


def scanned() -> str:
    """Meshes of the tile on its bench, by what its images were cut with (``edge-server bench scanned``)."""
    run = measured("docs/results/scanned.json")["scanned"]
    names = {
        "whole images": "nothing: whole images",
        "whole images, mesh cut to a box by hand": "a box in space by hand",
        "box": "the detector's boxes",
        "grabcut": "GrabCut in its boxes",
        "detector": "the detector's masks",
        "true masks": "true masks",
    }
    rows = []
    for key, words in names.items():
        row = run["rows"][key]
        if "failed" in row:
            rows.append([words, "", row["failed"], "", "", "", ""])
            continue
        rows.append(
            [
                words,
                f"{row['iou']:.2f}" if "iou" in row else "",
                f"{row['chamfer_mm']:.1f}",
                f"{row['accuracy_mm']:.1f}",
                f"{row['completeness_mm']:.1f}",
                f"{100 * row['complete']:.0f} %",
                f"{100 * row['precise']:.0f} %",
            ]
        )
    head = [
        "cut with",
        "mask IoU",
        "chamfer, mm",
        "mesh to tile, mm",
        "tile to mesh, mm",
        "tile within 3 mm",
        "mesh within 3 mm",
    ]
    size = run["size"]
    about = f"{run['views']} images of {size} x {size}, `{run['field']}`, {run['steps']} steps, one seed."
    return f"{about}\n\n{table(head, rows)}"


TABLES: dict[str, Callable[[], str]] = {
    "attacks": attacks,
    "soak": lambda: soak("soak"),
    "kills": lambda: soak("kills"),
    "peers": peers,
    "representations": representations,
    "tile": lambda: from_scratch("tile", (0.25, 0.5, 0.8, 1, 2.5, 15)),
    "room": lambda: from_scratch("room", (0.25, 0.5, 1, 2.5, 4, 15)),
    "kitchen": lambda: from_scratch("kitchen", (2, 5, 15, 60)),
    "lego": lambda: from_scratch("lego", (2, 5, 15, 60)),
    "fox": lambda: from_scratch("fox", (2, 5, 15, 60)),
    "baselines": baselines,
    "gpu": gpu,
    "threads": threads,
    "best-updates": best_updates,
    "all-updates": all_updates,
    "options": options,
    "update-options": update_options,
    "track": lambda: following("track"),
    "drift": lambda: following("drift"),
    "limits": limits,
    "card": card,
    "compared": lambda: compared("policies"),
    "hindsight": lambda: compared("hindsight"),
    "hindsight-kitchen": lambda: compared("hindsight-kitchen"),
    "hindsight-overload": lambda: compared("hindsight-overload"),
    "figures": figures,
    "verdicts": verdicts,
    "taught": taught,
    "masks": masks,
    "scanned": scanned,
    "cell-meshes": cell_meshes,
}


def renewed(text: str) -> str:
    """A page with its tables made anew. KeyError: a page names a table that there is not."""
    return re.sub(
        r"<!-- table ([\w-]+) -->\n.*?<!-- end -->",
        lambda found: f"<!-- table {found[1]} -->\n{TABLES[found[1]]()}\n<!-- end -->",
        text,
        flags=re.S,
    )


def main() -> None:
    for page in sorted(DOCS.rglob("*.md")):
        text = page.read_text()
        if (new := renewed(text)) != text:
            page.write_text(new)
            print(page.relative_to(DOCS.parent))


if __name__ == "__main__":
    main()
