"""The conclusion of a report: what was shown, at what age, and what limited it, in three sentences."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from edge_server.fidelity.scorer import SELECTED
from edge_server.report.report_constants import FINAL_PART, LITTLE_DB, TOO_SHORT, WORTH_SAYING
from freshfield.scenario import NOTHING_HELD_OUT

Report = Mapping[str, Any]


def conclusion(report: Report) -> list[str]:
    """At most three sentences, from the contents of report.json. A sentence says only what was measured."""
    if report["kind"] == "fit":
        return [sentence for sentence in (_shown(report), _fitted(report)) if sentence]
    if not report["updates"]["count"]:
        if report["scenario"] is None:  # ledgers of several machines, joined in a folder of their own
            return ["What was shown is not known: the edge's files are not in this folder.", *_delivery(report)]
        return ["Nothing was shown: the field was never updated.", *_delivery(report)]
    return [sentence for sentence in (_shown(report), _age(report), _limit(report)) if sentence]


def _shown(report: Report) -> str:
    fidelity = report["fidelity"]
    shown, final, so_far = fidelity["shown"], fidelity["final"], fidelity["so_far"]
    found = shown if shown["psnr_db"] is not None else final
    db = found["psnr_db"]
    if so_far is not None:
        db = so_far["now_psnr_db"]
        text = (
            f"The newest held-out frame read {db:.1f} dB, all {so_far['frames']} so far {so_far['all_psnr_db']:.1f} dB"
        )
    elif db is None:
        text = f"The fidelity is not known: nothing was scored in the {FINAL_PART} of the run"
        newest = next((row for row in reversed(fidelity["series"]) if row["psnr_db"] is not None), None)
        earlier = f"; the newest score, {newest['psnr_db']:.1f} dB, is of second {newest['t_s']:.0f}" if newest else ""
        return f"{text}{earlier}."
    elif report["kind"] == "fit":
        text = f"After {report['seconds']:.0f} s of fitting, {_views(report)} read {db:.1f} dB"
        if final["psnr_refined_db"] is not None:
            text += f", {final['psnr_refined_db']:.1f} dB at refined poses and exposures"
    else:
        text = (
            f"In the {FINAL_PART} of the run, {'what was shown' if found is shown else 'publications'} read {db:.1f} dB"
        )
        text += f" on {NOTHING_HELD_OUT}" if SELECTED in fidelity["scored_on"] else ""
        if found["psnr_moving_db"] is not None:
            text += f", {found['psnr_moving_db']:.1f} dB where the scene moves"
    flat = fidelity["baseline"]["mean_color_db"]
    if flat is None:
        return f"{text}."
    if db < flat:
        return f"{text}: worse than an image of one mean color, which reads {flat:.1f} dB."
    return f"{text}; an image of one mean color reads {flat:.1f} dB."


def _views(report: Report) -> str:
    count = len((report["data"] or {}).get("held_out", ()))
    if not count or SELECTED in report["fidelity"]["scored_on"]:
        return NOTHING_HELD_OUT
    return "the held-out view" if count == 1 else f"{count} held-out views"


def _fitted(report: Report) -> str:
    data, rows = report["data"], report["fidelity"]["series"]
    if not data or not rows:
        return ""
    least = next((r for r in rows if r["psnr_db"] is not None and r["psnr_db"] >= rows[-1]["psnr_db"] - 1.0), None)
    text = f"It learned from {data['training']} views"
    return f"{text}, and was within 1 dB of its end after {least['t_s']:.0f} s." if least else f"{text}."


def _age(report: Report) -> str:
    parts = {name: ms for name, ms in report["fidelity"]["shown"]["age_ms"].items() if ms is not None}
    still, moving = (report["fidelity"]["shown"][f"psnr_{what}_db"] for what in ("still", "moving"))
    if parts:
        each = ", ".join(f"{ms:.0f} ms {name}" for name, ms in parts.items())
        text = f"The views behind it were {sum(parts.values()):.0f} ms old on average ({each})"
    elif report["age_ms"] and report["age_ms"]["mean"] is not None:
        text = f"The newest frame of a camera was {report['age_ms']['mean']:.0f} ms old on average"
    else:
        return ""
    if still is not None and moving is not None:
        text += (
            f"; what stands still, which age does not hurt, reads {still:.1f} dB, {still - moving:.1f} above what moves"
        )
    return f"{text}."


def _limit(report: Report) -> str:
    """What limited the picture: the cameras where even what stands still is a blur, else the largest part of age."""
    fidelity = report["fidelity"]
    shown, flat, so_far = fidelity["shown"], fidelity["baseline"]["mean_color_db"], fidelity["so_far"]
    # Where held-out cameras move, `shown` is scored at given poses, which may be wrong where the picture is not.
    still = shown["psnr_still_db"] if so_far is None else so_far["all_psnr_db"]
    what, few = "What stands still", f"too few cameras, poses that do not fit, or {TOO_SHORT}"
    if still is None and SELECTED in fidelity["scored_on"]:
        what, still = "What is shown", fidelity["final"]["psnr_db"]
        # Few cameras do not blur the views that were learned from.
        few = f"poses that do not fit, or {TOO_SHORT}"
    lost = "; ".join(_delivery(report)).rstrip(".")
    if still is not None and flat is not None and still < flat + LITTLE_DB:
        better = "little better" if still > flat else "no better"
        return f"{what} is {better} than one mean color: {few}{f'; {lost}' if lost else ''}."
    age = {name: ms or 0.0 for name, ms in shown["age_ms"].items()}
    if not any(age.values()):
        return f"{lost[:1].upper()}{lost[1:]}." if lost else ""
    parts = {
        "The network was the limit: it takes": age["network"],
        "Waiting for an update and computing it were the limit: they take": age["waiting"] + age["computing"],
        "Showing each image until the next was the limit: it takes": age["display"],
    }
    text = f"{max(parts, key=lambda name: parts[name])} the largest part of that age"
    return f"{text}{f'; {lost}' if lost else ''}."


def _delivery(report: Report) -> list[str]:
    """The shares of frames that the network and the edge left out, and of updates without training, in one sentence;
    empty if all are negligible."""
    frames, updates = report["frames"] or {}, report["updates"]
    sent, delivered = frames.get("sent") or 0, frames.get("delivered") or 0
    undelivered = sum(frames.get(name) or 0 for name in ("dropped_busy", "superseded", "lost", "skipped", "broken"))
    shares = (
        (undelivered, sent, "of the frames sent did not pass the network"),
        (updates["shed"] or 0, delivered, "of those delivered were left out for lack of time"),
        (
            updates["without_step"],
            updates["count"],
            "of the updates had no time for a step of training (smaller pictures, source.scale or width and height, or "
            "longer updates, edge.update_ms, give them some)",
        ),
    )
    said = [f"{part / whole:.0%} {what}" for part, whole, what in shares if whole and part >= WORTH_SAYING * whole]
    return [", ".join(said) + "."] if said else []
