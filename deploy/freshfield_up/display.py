"""The state of a run as a line of text; the page and the report show more."""

from __future__ import annotations

from freshfield.scenario import NOTHING_HELD_OUT
from freshfield_up.status import RunStatus, Status, fmt, number


def status_line(status: RunStatus) -> str:
    """Cameras, field and channel in one line."""
    ages = sorted(age for camera in status.cameras if (age := number(camera, "age_ms")) is not None)
    median = f", age {ages[len(ages) // 2]:.0f} ms (median)" if ages else ""
    cameras = f"{len(ages)}/{len(status.cameras)} cameras{median}"
    return f"{cameras}; {_edge_line(status.edge)}; {_channel_line(status.channel)}"


def _channel_line(channel: Status) -> str:
    if not channel:
        return "no channel yet"
    parts = [str(channel.get("preset") or "custom")]
    state = channel.get("state")
    share = number(channel, "state_share", str(state))
    if state:
        parts.append(f"state {state}" + (f" ({share:.0%} of the time)" if share is not None else ""))
    parts.append(f"forwarded {fmt(number(channel, 'counts', 'forwarded'), '.0f')}")
    for fate in ("dropped_busy", "superseded", "skipped", "lost", "broken"):
        if count := number(channel, "counts", fate):
            parts.append(f"{fate.replace('_', ' ')} {count:.0f}")
    parts.append(f"delay error p99 {fmt(number(channel, 'delay_error_ms', 'p99'), '.2f')} ms")
    return ", ".join(parts)


def _edge_line(edge: Status) -> str:
    updates = number(edge, "updates", "count")
    if not updates:
        return str(edge.get("doing") or "no update yet")
    views = f" on {NOTHING_HELD_OUT}" if (edge.get("scores") or {}).get("on") == "selected" else ""
    parts = [
        f"{updates:.0f} updates",
        f"{fmt(number(edge, 'updates', 'ms_p50'), '.0f')} ms each",
        f"PSNR {fmt(number(edge, 'scores', 'psnr_db'), '.2f')} dB{views}",
        f"moving {fmt(number(edge, 'scores', 'psnr_moving_db'), '.2f')} dB",
        f"aAoI {fmt(number(edge, 'last', 'aaoi_ms'), '.0f')} ms",
        f"policy {edge.get('policy', '-')}",
    ]
    return ", ".join(parts) + (" (paused)" if edge.get("paused") else "")
