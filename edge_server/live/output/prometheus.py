"""Prometheus metrics of a running edge server, read from its state when scraped."""

from __future__ import annotations

from collections.abc import Iterator

from prometheus_client import CollectorRegistry, make_wsgi_app
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric

from edge_server.fidelity.scorer import fidelity_title
from edge_server.live.ingest import Ingest, percentile
from edge_server.live.output.guarded_http import serve_guarded
from edge_server.live.state import EdgeState
from freshfield.transport import Transport, TransportError


class EdgeCollector:
    """Turns the state into samples when it is scraped; nothing runs in between."""

    def __init__(self, state: EdgeState, ingest: Ingest) -> None:
        self._state = state
        self._ingest = ingest

    def collect(self) -> Iterator[Metric]:
        age = GaugeMetricFamily("freshfield_camera_age_seconds", "age of the newest buffered frame", labels=["camera"])
        delivered = CounterMetricFamily("freshfield_frames_delivered", "frames accepted", labels=["camera"])
        for camera in self._state.cameras():
            if camera.age_ms is not None:
                age.add_metric([camera.camera], camera.age_ms / 1e3)
            delivered.add_metric([camera.camera], camera.delivered)
        rejected = CounterMetricFamily("freshfield_frames_rejected", "frames refused", labels=["reason"])
        for reason, count in dict(self._ingest.rejected).items():  # ingest adds reasons meanwhile
            rejected.add_metric([reason], count)
        if self._ingest.depth:  # no series of depth where no camera sends it
            yield from self._depth()
        shed = self._ingest.buffer.shed
        yield from (age, delivered, rejected)
        yield CounterMetricFamily("freshfield_frames_shed", "frames left out for lack of time", value=shed)
        check = GaugeMetricFamily("freshfield_check_seconds", "time to check and buffer a frame", labels=["quantile"])
        for percent in (50, 99):
            value = percentile(self._ingest.check_ms, percent)
            if value is not None:
                check.add_metric([str(percent / 100)], value / 1e3)
        yield check
        last, scored = self._state.newest(), self._state.newest(scored=True)
        if last is None:
            return
        yield CounterMetricFamily("freshfield_updates", "updates published", value=last.number + 1)
        yield GaugeMetricFamily("freshfield_update_seconds", "last update", value=last.update_ms / 1e3)
        yield GaugeMetricFamily("freshfield_aaoi_seconds", "mean age of selection", value=last.aaoi_ms / 1e3)
        yield GaugeMetricFamily("freshfield_selected_views", "views used last", value=len(last.selected))
        about = fidelity_title([scored.scored_on if scored else None])
        for name in ("psnr_db", "psnr_moving_db", "ssim", "lpips"):
            if (value := getattr(scored, name, None)) is not None:
                yield GaugeMetricFamily(f"freshfield_{name}", about, value=value)

    def _depth(self) -> Iterator[Metric]:
        frames = CounterMetricFamily("freshfield_depth_frames", "frames accepted with depth", labels=["camera"])
        size = CounterMetricFamily("freshfield_depth_bytes", "encoded depth in accepted frames", labels=["camera"])
        age = GaugeMetricFamily("freshfield_depth_age_seconds", "age of the newest depth", labels=["camera"])
        now_ns = self._state.now_ns()
        for camera, depth in self._ingest.depth.copy().items():
            frames.add_metric([camera], depth.frames)
            size.add_metric([camera], depth.bytes)
            age.add_metric([camera], (now_ns - depth.newest_ns) / 1e9)
        yield from (frames, size, age)


def serve_metrics(state: EdgeState, ingest: Ingest, host: str, port: int, transport: Transport | None = None) -> None:
    """Serve /metrics on a thread until the process ends. Raises TransportError if the port is not available,
    or if the metrics would be open to others (see ``Transport.guard``)."""
    registry = CollectorRegistry()
    registry.register(EdgeCollector(state, ingest))  # type: ignore[arg-type]
    try:
        serve_guarded(make_wsgi_app(registry), "metrics", host, port, transport)
    except OSError as error:
        raise TransportError(
            f"metrics: cannot listen on {host}:{port} ({error.strerror}); see --metrics-port"
        ) from None
