"""Puts one edge server together: ingest, buffer, loop, scoring, page, and the files they leave.

Three sorts of threads: the event loop of gRPC (never blocked), the update loop with the field's workers (at
lower priority), and observers (scoring, page, metrics), which only read what was published.
"""

from __future__ import annotations

import asyncio
import json
import logging
import threading
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
from grpc_health.v1 import health, health_pb2, health_pb2_grpc
from grpc_reflection.v1alpha import reflection

from edge_server.config import EdgeConfig, embedding_for, open_embedder
from edge_server.fidelity.lpips_weights import open_lpips
from edge_server.fidelity.scorer import Scorer, open_listed_perceptual
from edge_server.fields import View, checkpoint
from edge_server.fields.common.kernels.thread_pool import SERVER_NICE
from edge_server.fields.registry import make_field
from edge_server.live.buffer import FrameBuffer
from edge_server.live.decision_log import Decisions
from edge_server.live.grpc_services import ClockService, EdgeService
from edge_server.live.ingest import Ingest, Recent
from edge_server.live.journal import Journal
from edge_server.live.loop import Loop, Updates, open_foreground, open_keyframes
from edge_server.live.scoring_thread import Scoring
from edge_server.live.state import CameraView, Comparison, Controls, EdgeState, Publication, Renderer
from edge_server.live.update_budget import Deadline, Fixed, Pacing, choose, read_points
from edge_server.scheduler import BANDIT, OFFERED, Policy, make_live_policy
from freshfield.clock import Clock, WallClock
from freshfield.ledger import Ledger
from freshfield.scenario import Scenario, ScenarioError
from freshfield.transport import Transport, TransportError
from freshfield.v1 import clock_pb2, clock_pb2_grpc, edge_pb2, edge_pb2_grpc, frames_pb2, frames_pb2_grpc

if TYPE_CHECKING:  # loaded only where a policy was learnt, or a run is recorded
    from edge_server.live.recorder import Recorder
    from edge_server.scheduler.online.online_trainer import OnlineTrainer

log = logging.getLogger(__name__)

# A person walking: what a scene that does not tell its speed is taken to move at.
_USUAL_SPEED_M_PER_S = 1.0

_STATUS_S = 0.5
_AGES_S = 0.2
_SNAPSHOT_S = 30.0


@dataclass(frozen=True)
class Options:
    """How one server process runs; the scenario says what it does."""

    listen: str
    out: Path
    transport: Transport = field(default_factory=Transport)
    page_host: str = "127.0.0.1"
    page_port: int | None = None
    metrics_port: int | None = None
    lpips_folder: Path | None = None
    resume: Path | None = None
    checkpoint_s: float | None = None
    record: Path | None = None


class EdgeServer:
    """One edge server. ``run`` blocks until ``stop`` is called or the update loop fails."""

    def __init__(
        self, scenario: Scenario, config: EdgeConfig, options: Options, clock: Clock | None = None
    ) -> None:
        self.scenario = scenario
        self.config = config
        self.options = options
        self.clock = clock or WallClock()
        self.start_ns = self.clock.now_ns()
        self._stopping = threading.Event()
        self._update_ms = Recent(4096)
        self._first_ms: float | None = None
        options.out.mkdir(parents=True, exist_ok=True)

        self.pacing, field_options = _pacing(scenario, config)
        aside = {"nice": SERVER_NICE, **field_options}
        self.field = make_field(config.field, aside, seed=scenario.seed)
        updates = 0
        if options.resume is not None:
            state, about = checkpoint.load(options.resume)
            self.field.load_state(state)
            # Numbers go on, so that a snapshot does not take the name of an earlier one.
            updates = max(0, int(about.get("updates", 0)))
        self.buffer = FrameBuffer(scenario.training)
        self.ledger = Ledger(options.out, "edge", "edge", self.start_ns)
        lpips, self.lpips_missing = (
            (None, "turned off by the scenario (edge.lpips: none)")
            if config.lpips == "none"
            else open_lpips(options.lpips_folder, config.lpips)  # type: ignore[arg-type]
        )
        scorer = Scorer(lpips, config.noisy_truth, perceptual=open_listed_perceptual(config.metrics))
        self.scoring = Scoring(scenario.held_out, scorer, self._scored)
        try:
            policy = self._policy(config.policy.name, config.policy.value)
            self.lessons = self._lessons(policy)
            if self.lessons is not None:
                policy = self.lessons.policy
            self._embedding = embedding_for(config, policy)
            embedder = open_embedder(self._embedding)
            keyframes = open_keyframes(config.keyframes, resumed=options.resume is not None)
            foreground = open_foreground(config.foreground, scenario)
            self.updates = Updates(
                self.buffer, policy, self.field, self.start_ns, embedder, keyframes, foreground
            )
        except ValueError as error:
            raise ScenarioError(f"{scenario.path}: edge.policy: {error}") from None
        self.recorder: Recorder | None = None
        if options.record is not None:
            from edge_server.live.recorder import Recorder  # MCAP is loaded only where something is recorded

            self.recorder = Recorder(options.record, scenario.name)
            log.info("recording to %s", self.recorder.file)
        self.ingest = Ingest(
            self.clock, self.buffer, scenario.held_out, self.ledger, self.scoring.held_out_frame,
            None if self.recorder is None else self.recorder.frame,
        )  # fmt: skip
        self._decisions = Decisions(options.out, self._embedding)
        self.updates.number = updates
        self.loop = Loop(
            self.updates,
            self.clock,
            self.pacing,
            config.grace_ms,
            self._published,
            self._say,
            self._checkpoint,
        )
        self.state = EdgeState(
            scenario=scenario.name,
            # Of what was learnt, only what the server was started with: nobody outside names files to open.
            policies=OFFERED if policy.name in OFFERED else (policy.name, *OFFERED),
            controls=Controls(policy.name, policy.value),
            cameras=self._cameras,
            now_s=lambda: (self.clock.now_ns() - self.start_ns) / 1e9,
            set_policy=self._set_policy,
            save_snapshot=self._save_snapshot,
            channel=_JsonFile(options.out / "channel.json"),
            field_name=config.field,
            decision=lambda: self.updates.policy.last_decision,
            embed=None if embedder is None else embedder.embed,
            learning=self._learning,
        )
        self.journal = Journal(options.out, self.status)

    # --- running ----------------------------------------------------------------------------------

    def run(self) -> None:
        """Serve until stopped, then write everything down. Raises what ended the update loop, if it did."""
        grpc_ready = threading.Event()
        problem: list[BaseException] = []
        grpc_thread = threading.Thread(
            target=self._serve, args=(grpc_ready, problem), name="grpc", daemon=True
        )
        grpc_thread.start()
        grpc_ready.wait()
        if problem:
            raise problem[0]
        page = None
        try:
            if self.options.page_port is not None:
                # The viewer is loaded only where there is a page.
                from edge_server.page import PageError, start_page

                try:
                    page = start_page(self.state, self.options.page_host, self.options.page_port)
                except PageError as error:
                    raise TransportError(f"page: {error}") from None
                log.info("page: %s", page.url)
            if self.options.metrics_port is not None:
                from edge_server.live.prometheus import serve_metrics

                serve_metrics(self.state, self.ingest, self.options.page_host, self.options.metrics_port)
            self.scoring.start()
            if self.lessons is not None:
                self.lessons.start()
            self.loop.start()
            self._watch()
        finally:
            self._stopping.set()
            self.loop.stop()
            self.scoring.stop()
            if self.lessons is not None:
                self.lessons.stop()
            if page is not None:
                page.stop()
            grpc_thread.join(5.0)
            self._write_final()
        if self.loop.failure is not None:
            raise self.loop.failure

    def stop(self) -> None:
        """Ask ``run`` to end; safe from signal handlers and other threads."""
        self._stopping.set()

    def _watch(self) -> None:
        """Write status and ages, carry the operator's wishes to the loop, notice its death."""
        ticks, every = 0, round(_STATUS_S / _AGES_S)
        saved_ns = self.clock.now_ns()
        while not self._stopping.wait(_AGES_S) and self.loop.alive:
            now_ns = self.clock.now_ns()
            self.journal.ages((now_ns - self.start_ns) / 1e9, self.buffer.ages_ms(now_ns))
            if ticks % every == 0:
                self.journal.write_status()
            ticks += 1
            controls = self.state.controls
            self.loop.paused = controls.paused
            if controls.reset_requested:
                controls.reset_requested = False
                self.loop.request_reset()
            every_s = self.options.checkpoint_s
            if every_s is not None and now_ns - saved_ns > every_s * 1e9:
                saved_ns = now_ns
                self.loop.request_checkpoint(self.options.out / "field.npz")

    def _serve(self, ready: threading.Event, problem: list[BaseException]) -> None:
        try:
            asyncio.run(self._serve_until_stopped(ready))
        except BaseException as error:
            problem.append(error)
            self._stopping.set()
            ready.set()

    async def _serve_until_stopped(self, ready: threading.Event) -> None:
        server = self.options.transport.aio_server()
        frames_pb2_grpc.add_FrameStreamServiceServicer_to_server(self.ingest, server)
        clock_pb2_grpc.add_ClockServiceServicer_to_server(ClockService(self.clock), server)
        edge_pb2_grpc.add_EdgeServiceServicer_to_server(EdgeService(self.state), server)
        checker = health.aio.HealthServicer()
        health_pb2_grpc.add_HealthServicer_to_server(checker, server)
        names = [
            module.DESCRIPTOR.services_by_name[name].full_name
            for module, name in (
                (frames_pb2, "FrameStreamService"),
                (clock_pb2, "ClockService"),
                (edge_pb2, "EdgeService"),
            )
        ]
        reflection.enable_server_reflection([*names, health.SERVICE_NAME, reflection.SERVICE_NAME], server)
        port = self.options.transport.bind(server, self.options.listen)
        await server.start()
        for name in ("", *names):
            await checker.set(name, health_pb2.HealthCheckResponse.SERVING)
        log.info("listening on port %d", port)
        ready.set()
        await asyncio.to_thread(self._stopping.wait)
        await checker.enter_graceful_shutdown()
        await server.stop(0.5)

    # --- what others call -------------------------------------------------------------------------

    def _published(self, publication: Publication, renderer: Renderer, views: list[View]) -> None:
        if self._first_ms is None:
            self._first_ms = publication.t_s * 1e3
        self._update_ms.add(publication.update_ms)
        if self.state.bounds is None:
            self.state.bounds = getattr(self.field, "bounds", None)
        self.state.publish(publication, renderer)
        self.journal.published(publication)
        self._decisions.keep(self.updates.policy, publication.number)
        self.journal.poses(views)
        if self.recorder is not None:
            self.recorder.published(publication)
        self.scoring.published(publication, renderer, views)

    def _scored(self, publication: Publication, comparison: Comparison | None, final: bool) -> None:
        self.state.scored(publication, comparison)
        self.journal.scored(publication, final)
        if self.lessons is not None and final:
            self.lessons.add_score(publication.number, publication)
        if final and self.recorder is not None:
            self.recorder.scored(publication, self.clock.now_ns())

    def _say(self, line: str) -> None:
        self.state.last_decision = line

    def _policy(self, name: str, value: float | None):
        return make_live_policy(name, value, self.scenario.rng("policy", name))

    def _lessons(self, policy: Policy) -> OnlineTrainer | None:
        """What lets ``policy`` go on learning, where that was asked for. ValueError where it cannot."""
        learn = self.config.learn
        if learn is None:
            return None
        if not policy.name.startswith(BANDIT):
            raise ValueError(f"{policy.name} cannot learn: only bandit:FILE can (--policy, edge.policy)")
        if not self.scenario.held_out:
            raise ValueError("nothing is held out (cameras.held_out), so that there is no reward to learn by")
        from edge_server.scheduler.online.online_trainer import open_online_trainer

        lessons = open_online_trainer(
            Path(policy.name.removeprefix(BANDIT)), learn.reward, learn.fallback,
            self.scenario.rng("lessons"), self.lpips_missing, self.options.out,
        )  # fmt: skip
        by = lessons.reward
        if by.distance and by.distance_is == "perceptual" and "perceptual" not in self.config.metrics:
            raise ValueError("the policy was trained by the stand-in distance, which nothing measures here: "
                             "list it in the scenario, edge.metrics: [perceptual]")  # fmt: skip
        return lessons

    def _learning(self) -> str:
        """How learning goes, for people; empty where nobody learns, or another policy was chosen."""
        if self.lessons is None or self.state.controls.policy != self.lessons.policy.name:
            return ""
        return self.lessons.policy.summary()

    def _set_policy(self, name: str, value: float | None) -> None:
        if name.startswith(BANDIT) and name not in self.state.policies:
            raise ValueError(f"policy {name!r}: what was learnt is chosen at the start (--policy {name})")
        policy = self._policy(name, value)
        if self.lessons is not None and policy.name == self.lessons.policy.name:
            policy = self.lessons.policy  # the one that learns goes on
        self.updates.check(policy)
        self.state.controls.policy, self.state.controls.value = policy.name, policy.value
        self.loop.use_policy(policy)

    def _save_snapshot(self) -> Path:
        if not self.state.started:
            raise RuntimeError("the field has not been trained yet")
        path = self.options.out / f"snapshot-{self.updates.number:06d}.npz"
        try:
            return self.loop.request_checkpoint(path).result(_SNAPSHOT_S)
        except TimeoutError:
            raise RuntimeError(f"the update in progress took over {_SNAPSHOT_S:g} s") from None

    def _checkpoint(self, path: Path) -> None:
        checkpoint.save(path, self.field.state(), self._about())

    def _cameras(self) -> list[CameraView]:
        now_ns = self.clock.now_ns()
        newest = self.buffer.newest()
        rejected = self.ingest.rejected_by_camera
        views = []
        for camera in self.scenario.cameras:
            held_out = camera in self.scenario.held_out
            if held_out:
                frame = self.ingest.newest_held_out.get(camera)
                age = (now_ns - frame.generated_edge_ns) / 1e6 if frame else None
            else:
                item = newest.get(camera)
                frame, age = (item.frame, item.age_ms(now_ns)) if item else (None, None)
            views.append(
                CameraView(camera, held_out, frame, age, self.ingest.delivered[camera], rejected[camera])
            )
        return views

    def status(self) -> dict[str, Any]:
        """Contents of edge.json."""
        publications = self.state.publications()
        last = publications[-1] if publications else None
        scored = next((p for p in reversed(publications) if p.psnr_db is not None), None)
        baselines = self.scoring.baselines

        def mean(name: str) -> float | None:
            values = [v for b in list(baselines) if (v := getattr(b, name)) is not None]
            return float(np.mean(values)) if values else None

        recorded = {} if self.recorder is None else {"recording": self.recorder.status()}
        return {
            **recorded,
            "scenario": self.scenario.name,
            "seed": self.scenario.seed,
            "started_ns": self.start_ns,
            "uptime_s": self.state.now_s(),
            "field": self.config.field,
            "policy": self.state.controls.policy,
            "value": self.state.controls.value,
            "paused": self.state.controls.paused,
            "doing": self.state.last_decision,
            "cameras": [
                {
                    "camera": c.camera,
                    "held_out": c.held_out,
                    "age_ms": c.age_ms,
                    "delivered": c.delivered,
                    "rejected": c.rejected,
                }
                for c in self._cameras()
            ],
            "rejected": dict(self.ingest.rejected),
            "lines_lost": self.journal.lines_lost + self.ledger.lines_lost,
            "decisions_lost": self._decisions.lost,
            "stale_on_arrival": self.buffer.stale_on_arrival,
            "check_ms": {f"p{p}": self.ingest.check_ms.percentile(p) for p in (50, 99)},
            "updates": {
                "count": self.updates.number,
                "ms_p50": self._update_ms.percentile(50),
                "ms_p95": self._update_ms.percentile(95),
                "first_ms": self._first_ms,
                "deadline_ms": self.config.deadline_ms,
                "undecodable": self.updates.decoder.undecodable + self.scoring.undecodable,
            },
            "treatment": {
                "views": self.updates.treatment_cost.views,
                "ms_per_view": self.updates.treatment_cost.ms_per_view,
            },
            "foreground": None if (cut := self.updates.decoder.foreground) is None else cut.status(),
            "baseline": {
                "mean_colour_db": mean("mean_colour_db"),
                "nearest_view_db": mean("nearest_view_db"),
            },
            "learning": None if self.lessons is None else self.lessons.policy.status(),
            "lpips_missing": self.lpips_missing,
            "lpips_network": None if self.lpips_missing else self.config.lpips,
            "held_out": list(self.scenario.held_out),
            "last": None if last is None else {"t_s": last.t_s, "aaoi_ms": last.aaoi_ms,
                                               "update_ms": last.update_ms, "selected": len(last.selected),
                                               "omega_ms": last.omega_ms, "steps": last.steps},
            "scores": None if scored is None else {"psnr_db": scored.psnr_db, "ssim": scored.ssim,
                                                   "psnr_moving_db": scored.psnr_moving_db,
                                                   "lpips": scored.lpips,
                                                   "perceptual": scored.perceptual, "on": scored.scored_on},
        }  # fmt: skip

    def _write_final(self) -> None:
        try:
            comparison = self.state.comparison
            if comparison is not None:
                pair = {"truth": comparison.truth, "rendered": comparison.rendered}
                for name, image in pair.items():
                    cv2.imwrite(str(self.options.out / f"{name}.png"), cv2.cvtColor(image, cv2.COLOR_RGB2BGR))
            if self.state.started and not self.loop.alive:
                self._checkpoint(self.options.out / "field.npz")
            if self.lessons is not None:
                self.lessons.close()
        except OSError as error:
            log.error("not everything was written at the end: %s", error)
        finally:
            # Whatever failed: every frame's account is complete, and the status is the last one.
            try:
                self.ledger.close(self.clock.now_ns())
            finally:
                if self.recorder is not None:
                    self.recorder.close()
                self.journal.close()

    def _about(self) -> dict[str, Any]:
        return {
            "field": self.config.field,
            "options": self.config.field_options,
            "scenario": self.scenario.name,
            "seed": self.scenario.seed,
            "updates": self.updates.number,
        }


def _pacing(scenario: Scenario, config: EdgeConfig) -> tuple[Pacing, dict[str, Any]]:
    """How long updates may be, and the field's options: the scenario's own, over those of the measured point
    that a deadline leads to. ValueError where the frontier cannot be read."""
    if config.deadline_ms is None:
        return Fixed(config.update_ms), config.field_options
    path = None if config.frontier is None else scenario.path.parent / config.frontier
    points = read_points(path, config.field)
    speed = scenario.source.get("speed_m_per_s", _USUAL_SPEED_M_PER_S)
    point = choose(points, config.deadline_ms, float(speed))
    log.info(
        "deadline of %g ms: %s effort, updates of %.0f ms (measured at %g m/s: %.1f dB, %.1f where it moves)",
        config.deadline_ms, point.effort, point.update_ms, point.speed_m_per_s, point.psnr_db,
        point.psnr_moving_db,
    )  # fmt: skip
    if point.update_ms > config.deadline_ms:
        log.warning("no measured update is as short as that: what fits is done")
    return Deadline(config.deadline_ms, point.update_ms), {**point.options, **config.field_options}


class _JsonFile:
    """A JSON file that another process replaces now and then; read again only when it has changed."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._stamp = -1
        self._data: dict | None = None

    def __call__(self) -> dict | None:
        try:
            stamp = self._path.stat().st_mtime_ns
            if stamp != self._stamp:
                self._data, self._stamp = json.loads(self._path.read_text()), stamp
        except (OSError, ValueError):
            return self._data
        return self._data
