"""report.html: one self-contained page with the figures inside."""

from __future__ import annotations

import base64
from html import escape
from pathlib import Path
from typing import Any

from edge_server.fidelity.scorer import SELECTED
from freshfield.scenario import NOTHING_HELD_OUT

Report = dict[str, Any]

_STYLE = """
:root { --ink: #222; --soft: #666; --line: #e2e2e2; --blue: #0072B2; --bad: #D55E00; }
* { box-sizing: border-box; }
body { font: 16px/1.5 system-ui, "Segoe UI", Roboto, sans-serif; color: var(--ink); background: #fafafa;
  margin: 0; }
main { max-width: 58rem; margin: 0 auto; padding: 2rem 1.2rem 4rem; }
h1 { font-size: 1.7rem; margin: 0; }
h2 { font-size: 1.15rem; margin: 2.4rem 0 .6rem; }
p { margin: .4rem 0; } .soft { color: var(--soft); }
.tiles { display: grid; grid-template-columns: repeat(auto-fit, minmax(9.5rem, 1fr)); gap: .7rem;
  margin: 1.4rem 0; }
.tile { background: #fff; border: 1px solid var(--line); border-radius: .5rem; padding: .7rem .9rem; }
.tile b { display: block; font-size: 1.45rem; font-weight: 650; }
.tile span { color: var(--soft); font-size: .82rem; display: block; line-height: 1.3; }
figure { margin: .8rem 0; background: #fff; border: 1px solid var(--line); border-radius: .5rem;
  padding: .8rem; }
figure img { width: 100%; height: auto; display: block; }
table { border-collapse: collapse; background: #fff; font-size: .92rem; }
th, td { padding: .3rem .8rem; border-bottom: 1px solid var(--line); text-align: right; }
th { font-weight: 600; background: #f3f3f3; } th:first-child, td:first-child { text-align: left; }
.wide { overflow-x: auto; } .ok { color: #00785a; } .bad { color: var(--bad); font-weight: 600; }
code { font-size: .88em; } ul { padding-left: 1.2rem; } details { margin: .8rem 0; }
summary { cursor: pointer; color: var(--blue); }
"""


def render_html(report: Report, figures: dict[str, Path]) -> str:
    """The page. figures: PNGs by name, as ``figures.draw_all`` returns them."""
    sections = [
        _head(report),
        _tiles(report),
        _section(f"Rendering of {_views(report)}", _figure(figures, "comparison"), _fidelity_table(report)),
        _section("Fidelity over time", _figure(figures, "fidelity")),
        _section("Mesh", _mesh_table(report)),
        _section("Age", _figure(figures, "ages"), _details("By camera", _age_table(report))),
        _section("Updates", _figure(figures, "updates"), _updates_line(report), _cut_line(report)),
        _section("What accuracy costs in time", _figure(figures, "frontier")),
        _section("Frames", _frames_table(report), _details("By camera", _frames_by_camera(report))),
        _section("Channel", _figure(figures, "channel"), _channel_table(report)),
        _section("Machine", _figure(figures, "processes"), _machine_table(report)),
        _notes(report),
    ]
    title = escape(str(report["scenario"] or "run"))
    return (
        '<!doctype html>\n<html lang="en"><head><meta charset="utf-8">'
        '<meta name="viewport" content="width=device-width, initial-scale=1">'
        f"<title>{title}: report</title><style>{_STYLE}</style></head>"
        f"<body><main>{''.join(sections)}</main></body></html>\n"
    )


def _views(report: Report) -> str:
    """The views on which all fidelities of the report were measured."""
    return NOTHING_HELD_OUT if SELECTED in report["fidelity"]["scored_on"] else "a held-out view"


def _head(report: Report) -> str:
    policy = report["policy"]
    value = "" if policy["value"] is None else f" {policy['value']:g}"
    facts = [
        f"{report['seconds']:.0f} s" if report["seconds"] else None,
        f"seed {report['seed']}" if report["seed"] is not None else None,
        f"field {report['field']}" if report["field"] else None,
        f"policy {policy['name']}{value}" if policy["name"] else None,
    ]
    if report["kind"] == "fit" and report["data"]:
        data = report["data"]
        held_out = len(data["held_out"])
        facts += [f"{data['training']} views", f"{held_out} held out" if held_out else None, data["instant"]]
    line = " · ".join(escape(f) for f in facts if f)
    return f"<h1>{escape(str(report['scenario'] or 'A run'))}</h1><p class=soft>{line}</p>"


def _tiles(report: Report) -> str:
    final, age, frames = report["fidelity"]["final"], report["age_ms"], report["frames"]
    network = report["fidelity"]["lpips_network"]
    similarity = [(_n(final["ssim"], 3), "SSIM"), (_n(final["lpips"], 3), f"LPIPS-{network}" if network else "LPIPS")]
    if final["perceptual"] is not None:
        similarity.append((_n(final["perceptual"], 3), "perceptual (not LPIPS)"))
    if report["kind"] == "fit":
        what = f"PSNR at the end, of {_views(report)}"
        return _tile_row([(_n(final["psnr_db"], 1, " dB"), what), *similarity])
    shown = report["fidelity"]["shown"]
    tiles = [(shown, "PSNR of what was shown")] if shown["psnr_db"] is not None else []
    return _tile_row(
        [
            *(
                (_n(found[key], 1, " dB"), f"{what}{where}, last fifth of the run")
                for found, what in [*tiles, (final, f"PSNR at publication, of {_views(report)}")]
                for key, where in (("psnr_db", ""), ("psnr_moving_db", " where the scene moves"))
            ),
            *similarity,
            (_n(age["mean"], 0, " ms"), f"mean age (95 %: {_n(age['p95'], 0)} ms)"),
            (_n(report["updates"]["ms_p50"], 0, " ms"), f"median of {report['updates']['count']} updates"),
            (f"{frames['delivered']:,}", f"frames delivered of {frames['captured']:,} captured"),
        ]
    )


def _tile_row(tiles: list[tuple[str, str]]) -> str:
    cells = "".join(f"<div class=tile><b>{b}</b><span>{escape(s)}</span></div>" for b, s in tiles)
    return f"<div class=tiles>{cells}</div>"


def _fidelity_table(report: Report) -> str:
    found = report["fidelity"]
    network = f"LPIPS-{found['lpips_network']}" if found["lpips_network"] else "LPIPS"
    metrics = {"psnr_db": 2, "psnr_moving_db": 2, "ssim": 4, "lpips": 4}
    rows = [["", "PSNR (dB)", "PSNR, moving (dB)", "SSIM", network]]
    if found["mean"]["perceptual"] is not None:
        metrics["perceptual"] = 4
        rows[0].append("perceptual (not LPIPS)")
    fit = report["kind"] == "fit"
    for name, label in (("final", "at the end" if fit else "last fifth of the run"), ("mean", "whole run")):
        if fit and name == "mean":
            continue  # the mean of a learning curve is no result
        rows.append([label, *(_n(found[name][metric], digits) for metric, digits in metrics.items())])
    if not fit and found["shown"]["psnr_db"] is not None:
        shown = [_n(found["shown"].get(metric), digits) for metric, digits in metrics.items()]
        rows.insert(1, ["shown, last fifth of the run", *shown])
    for name, label in (("nearest_view_db", "nearest training view"), ("mean_colour_db", "mean color")):
        rows.append([label, _n(found["baseline"][name], 2), *[""] * (len(metrics) - 1)])
    remarks = []
    if SELECTED in found["scored_on"]:
        remarks.append("No camera is held out: scored on the selected views themselves (6.21-6.22).")
    elif found["scored_on"]:
        remarks.append(f"Held out: {', '.join(found['scored_on'])}.")
    if found["series"] and not fit:
        remarks.append(f"{found['scored']} of {report['updates']['count']} publications were scored.")
    if found["lpips_missing"]:
        remarks.append(f"LPIPS: {found['lpips_missing']}.")
    return _table(rows) + f"<p class=soft>{escape(' '.join(remarks))}</p>"


def _mesh_table(report: Report) -> str:
    """Empty where the scenario asks for no mesh."""
    mesh = report.get("mesh")
    if not mesh:
        return ""
    found = mesh.get("measured")
    rows = [["", "", "target"], ["triangles", f"{mesh['triangles']:,}", ""]]
    if found:
        within = f"surface within {found['within_mm']:g} mm of it"
        rows += [
            ["chamfer distance", _n(found["chamfer_mm"], 2, " mm"), _n(found["target_chamfer_mm"], 1, " mm")],
            [within, _n(100 * found["complete"], 1, " %"), _n(100 * found["target_complete"], 0, " %")],
            ["distance from the surface, median", _n(found["accuracy_median_mm"], 2, " mm"), ""],
        ]
    rows += [[f"{name}, seconds", _n(spent, 1), ""] for name, spent in mesh["stages_s"].items()]
    return _table(rows) + f"<p class=soft>{escape(str(mesh['file']))}</p>"


def _age_table(report: Report) -> str:
    if report["age_ms"] is None:
        return ""
    rows = [["camera", "mean (ms)", "median (ms)", "95 % (ms)"]]
    for camera, s in report["age_ms"]["by_camera"].items():
        cells = [_n(s[k], 0) for k in ("mean", "p50", "p95")] if s else ["never reported", "", ""]
        rows.append([camera, *cells])
    return _table(rows) if len(rows) > 1 else ""


def _updates_line(report: Report) -> str:
    u = report["updates"]
    if report["kind"] == "fit":
        return ""
    if not u["count"]:
        return "<p>The field was never updated.</p>"
    first = None if u["first_ms"] is None else u["first_ms"] / 1e3
    idle = f"; without time for a step: {u['without_step']}" if u.get("without_step") else ""
    damaged = f"; frames that could not be decoded: {u['undecodable']}" if u["undecodable"] else ""
    shed = f"; frames left out for lack of time: {u['shed']}" if u.get("shed") else ""
    return (
        f"<p>{u['count']} updates, median {_n(u['ms_p50'], 0)} ms, 95 % within {_n(u['ms_p95'], 0)} ms; "
        f"the first {_n(first, 1)} s after the edge started{idle}{damaged}{shed}.</p>"
    )


def _cut_line(report: Report) -> str:
    """How many images the foreground was cut out of, and how many passed whole."""
    cut = report.get("foreground")
    if not cut:
        return ""
    from edge_server.foreground import WHY  # only where a run cuts objects out

    whole = [f"{cut[name]} ({why})" for name, why in WHY.items() if cut.get(name)]
    spent = _n(cut.get("ms_per_image"), 0, " ms")
    return (
        f"<p>The object was cut out of {_n(cut.get('masked'), 0)} images, {spent} each; "
        f"used whole: {', '.join(whole) or 'none'}.</p>"
    )


def _frames_table(report: Report) -> str:
    f = report["frames"]
    if f is None:
        return ""
    if not f["ledgers"]:
        return "<p>No ledgers: no frame passed a network in this run.</p>"
    rejected = sum(f["rejected"].values())
    ends = [
        ("skipped", "never sampled by the arrival process"),
        ("dropped_busy", "discarded: the link was busy"),
        ("superseded", "a newer frame took its place in the link"),
        ("lost", "lost by the channel"),
        ("broken", "its stream ended on the way"),
        ("delivered", "in the edge's buffer, or the held-out truth"),
        ("in_flight", "inside the link when the emulator ended"),
        ("cut_off", "sent; held by a process that was killed or still runs"),
    ]
    rows = [["frames", "", ""]]
    rows += [
        ["captured", f"{f['captured']:,}", "= replaced + waiting + sent"],
        ["replaced", f"{f['replaced']:,}", "a newer frame came before the stream was free"],
        ["waiting", f"{f['waiting']:,}", "still at the node when it ended"],
        ["sent", f"{f['sent']:,}", "handed to the stream"],
        ["duplicated", f"{f['duplicated']:,}", "further copies; sent + duplicated = all below"],
    ]
    rows += [[name.replace("_", " "), f"{f[name]:,}", text] for name, text in ends]
    rows.append(["rejected", f"{rejected:,}", ", ".join(f"{k} {v:,}" for k, v in f["rejected"].items())])
    result = (
        "<p class=ok>Every frame is accounted for."
        if f["closes"]
        else f"<p class=bad>Not every frame is accounted for: {escape('; '.join(f['doubts']))}."
    )
    if count := f["contradiction_count"]:
        result += f" <span class=bad>The ledgers contradict each other on {count} frames:</span></p><ul>"
        result += "".join(f"<li><code>{escape(c)}</code></li>" for c in f["contradictions"]) + "</ul>"
    else:
        result += f" {f['ledgers']} ledgers joined, no contradictions.</p>"
    if strangers := f["strangers"]["count"]:
        reasons = ", ".join(f"{escape(k)} {v:,}" for k, v in f["strangers"]["reasons"].items())
        result += f"<p>Refused frames of unknown origin, not counted below: {strangers:,} ({reasons}).</p>"
    return result + _table(rows, left=(0, 2))


def _frames_by_camera(report: Report) -> str:
    names = (
        "captured",
        "replaced",
        "sent",
        "skipped",
        "dropped_busy",
        "superseded",
        "lost",
        "broken",
        "delivered",
        "in_flight",
        "cut_off",
    )
    rows = [["camera", *(n.replace("_", " ") for n in names), "rejected"]]
    by_camera = report["frames"]["by_camera"] if report["frames"] is not None else {}
    for camera, f in by_camera.items():
        rows.append([camera, *(f"{f[n]:,}" for n in names), f"{sum(f['rejected'].values()):,}"])
    return _table(rows) if len(rows) > 1 else ""


def _channel_table(report: Report) -> str:
    rows = [["", "mean", "50 %", "95 %", "99 %", "largest"]]
    channel = report["channel"] or {}
    for name, label in (("drawn_delay_ms", "drawn delay (ms)"), ("delay_error_ms", "delay error (ms)")):
        found = channel.get(name)
        if isinstance(found, dict) and any(found.get(k) is not None for k in ("mean", "p50", "p99")):
            rows.append([label, *(_n(found.get(k), 2) for k in ("mean", "p50", "p95", "p99", "max"))])
    return _table(rows) if len(rows) > 1 else ""


def _machine_table(report: Report) -> str:
    m, load = report["machine"], report["outside_load"]
    versions = ", ".join(f"{k} {v}" for k, v in report["versions"].items() if v)
    outside = "unknown" if load["cores"] is None else f"{load['cores']:g} cores ({load['method']})"
    if load["ours"] is not None:
        outside += f"; this run's own processes used {load['ours']:g}"
    rows = [
        ["processor", f"{m['cpu'] or 'unknown'}, {m['cores']} cores usable"],
        ["memory", "unknown" if m["memory_gb"] is None else f"{m['memory_gb']} GB"],
        ["system", f"{m['system']} {m['kernel']}"],
        ["outside load", outside],
        ["versions", versions],
    ]
    return _table([["", ""], *rows], left=(0, 1), head=False)


def _notes(report: Report) -> str:
    if not report["notes"]:
        return ""
    items = "".join(f"<li>{escape(str(note))}</li>" for note in report["notes"])
    return f"<h2>Missing or damaged files</h2><ul class=soft>{items}</ul>"


def _section(title: str, *parts: str) -> str:
    body = "".join(parts)
    return f"<h2>{escape(title)}</h2>{body}" if body else ""


def _details(title: str, body: str) -> str:
    return f"<details><summary>{escape(title)}</summary>{body}</details>" if body else ""


def _figure(figures: dict[str, Path], name: str) -> str:
    if name not in figures:
        return ""
    data = base64.b64encode(figures[name].read_bytes()).decode()
    return f'<figure><img alt="{escape(name)}" src="data:image/png;base64,{data}"></figure>'


def _table(rows: list[list[str]], left: tuple[int, ...] = (0,), head: bool = True) -> str:
    def cell(tag: str, column: int, text: str) -> str:
        align = ' style="text-align:left"' if column in left else ""
        return f"<{tag}{align}>{escape(text)}</{tag}>"

    lines = []
    for i, row in enumerate(rows):
        if i == 0 and not head:
            continue
        tag = "th" if i == 0 else "td"
        lines.append("<tr>" + "".join(cell(tag, c, text) for c, text in enumerate(row)) + "</tr>")
    return f"<div class=wide><table>{''.join(lines)}</table></div>"


def _n(value: float | None, digits: int, unit: str = "") -> str:
    """A number for people; an en dash where there is none."""
    return "–" if value is None else f"{value:,.{digits}f}{unit}"
