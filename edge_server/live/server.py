"""One edge server: ingest, buffer, update loop, scoring, page, and the files they write.

It has three kinds of threads: the event loop of gRPC, which is never blocked; the update loop with the
field's workers, at lower priority; and observers (scoring, page, metrics), which only read what was
published.
"""

from __future__ import annotations

import contextlib
import logging
import threading
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import msgspec

from edge_server.fidelity.images import write_png
from edge_server.fidelity.lpips_weights import open_lpips
from edge_server.fidelity.scorer import Score, Scorer
from edge_server.fields import Field, View, checkpoint
from edge_server.fields.registry import make_field
from edge_server.live import live_constants as tuned
from edge_server.live.best_update_time import open_frontier
from edge_server.live.field_updater import open_updater
from edge_server.live.grpc_services import GrpcThread
from edge_server.live.ingest import Ingest, percentile
from edge_server.live.loop import UpdateLoop
from edge_server.live.output.journal import Journal
from edge_server.live.scoring.scoring_thread import ScoringThread
from edge_server.live.state import CameraView, Comparison, Controls, EdgeState, Publication, Snapshot
from edge_server.machine import run_facts
from edge_server.run_records import DepthCounts, DepthStatus, EdgeStatus, UpdateCounts
from edge_server.scheduler import LivePolicies, short_name
from edge_server.settings import EdgeConfig, cameras_move, described, embedding_for, read_config
from freshfield.clock import WallClock
from freshfield.files import read_status, write_json
from freshfield.ledger import Ledger, LedgerReader
from freshfield.scenario import Scenario, ScenarioError
from freshfield.transport import Transport, host_port
from freshfield.untrusted import stored_bytes

if TYPE_CHECKING:  # imported at run time only where a run is recorded, and where a policy is learned
    from edge_server.live.output.recorder import Recorder
    from edge_server.scheduler.learned.decision_record import DecisionWriter

log = logging.getLogger(__name__)


class OpenPage(Protocol):
    """A live page that is being served. url: its address on this machine."""

    url: str

    def stop(self) -> None:
        """Stop serving the page."""
        ...


@dataclass(frozen=True)
class ServerOptions:
    """How one server process runs; the scenario says what it does.

    listen: HOST:PORT for frames.
    out: folder of the run's files.
    transport: security of connections.
    page_host: address on which page and metrics listen.
    open_page: starts the live page of a state; None: no page. open_foxglove: likewise the server for Foxglove.
    metrics_port: port of Prometheus metrics; None: no metrics.
    lpips_folder: folder with LPIPS weights; None: that of $FRESHFIELD_LPIPS, if any.
    resume: checkpoint to start from. checkpoint_s: period of writing one, seconds; None: only at the end.
    record: MCAP file to write the session to; None: not recorded.
    emulator_out: folder with the emulator's status; None: ``out``.
    """

    listen: str
    out: Path
    transport: Transport = field(default_factory=Transport)
    page_host: str = "127.0.0.1"
    open_page: Callable[[EdgeState], OpenPage] | None = None
    open_foxglove: Callable[[EdgeState], OpenPage] | None = None
    metrics_port: int | None = None
    lpips_folder: Path | None = None
    resume: Path | None = None
    checkpoint_s: float | None = None
    record: Path | None = None
    emulator_out: Path | None = None


class EdgeServer:
    """One edge server. ``run`` blocks until ``stop`` is called or the update loop fails."""

    def __init__(self, scenario: Scenario, config: EdgeConfig, options: ServerOptions) -> None:
        self.scenario = scenario
        self.options = options
        self.clock = WallClock()
        self.start_ns = self.clock.now_ns()
        self._run_facts = run_facts()
        self._stopping = threading.Event()
        self._update_ms: deque[float] = deque(maxlen=tuned.UPDATE_TIMES)
        self._counts = UpdateCounts()
        self._snapshot_lock = threading.Lock()
        options.out.mkdir(parents=True, exist_ok=True)

        state, about = None, dict[str, Any]()
        if options.resume is not None:
            state, about = checkpoint.load(options.resume, most_bytes=stored_bytes(options.resume))
        # The camera that moves: none yet, or the one that the earlier run found.
        self._moving = str(about.get("moving") or ("a camera" if cameras_move(scenario) else ""))
        config_if_moving = msgspec.structs.replace(read_config(scenario, moving=True), policy=config.policy)
        self.config, first = (config_if_moving if about.get("moving") else config), config
        config = self.config
        try:
            self.frontier = open_frontier(scenario, config)
        except ValueError:  # see ``_camera_moves``
            self.frontier = open_frontier(scenario, first)
        field = self._make_field(config)
        if state is not None:
            field.load_state(state)
        lpips, self.lpips_missing = (
            (None, "turned off by the scenario (edge.lpips: none)")
            if config.lpips == "none"
            else open_lpips(options.lpips_folder)
        )
        scorer = Scorer(lpips, config.background)
        self.scoring = ScoringThread(
            scenario.held_out, scorer, self._scored, self._shown, scenario.seed, config.noisy_truth
        )
        try:
            self.policies = LivePolicies(config.policy.name, config.policy.value, partial(scenario.rng, "policy"))
        except ValueError as error:
            raise ScenarioError(f"{scenario.path}: edge.policy: {error}") from None
        policy = self.policies.first
        self.updater = open_updater(scenario, config, policy, field, self.start_ns, resumed=options.resume is not None)
        self.updater.forgiving = True
        # Numbers continue, so that a snapshot does not take the name of an earlier one.
        self.updater.number = max(0, int(about.get("updates", 0)))
        if not self._moving:
            self.updater.watch_cameras(config_if_moving, self._make_field, self._camera_moves)
        self.buffer = self.updater.buffer
        self.recorder: Recorder | None = None
        if options.record is not None:
            from edge_server.live.output.recorder import Recorder  # MCAP is imported only for recordings

            self.recorder = Recorder(options.record, scenario.name)
            log.info("recording to %s", self.recorder.file)
        self.ledger = Ledger(options.out, "edge", "edge", self.start_ns)  # once nothing above can fail any more
        earlier = _earlier(options.out / "edge.json")
        counted = earlier.updates or UpdateCounts()  # continued over the whole run, like its ledgers
        self._earlier_undecodable, self._earlier_shed = counted.undecodable or 0, counted.shed or 0
        self._counts.refused = dict(counted.refused)
        # If the field restarts, or resumes from a checkpoint older than a kill, so do numbers and counts.
        short = max(0, int(about.get("without_step", 0)))
        self._earlier_updates = max(0, counted.count - self.updater.number)
        self._earlier_short = max(0, (counted.without_step or 0) - short)
        self.ingest = Ingest(
            self.clock,
            self.buffer,
            scenario.held_out,
            self.ledger,
            self.scoring.held_out_frame,
            None if self.recorder is None else self.recorder.frame,
            scenario.max_side_px,
            earlier.last_frames,
            scenario.codec,
        )
        self._decisions: DecisionWriter | None = None
        controls = Controls(policy.name, policy.value)
        self.loop = UpdateLoop(
            self.updater,
            self.clock,
            controls,
            config.update_ms,
            config.grace_ms,
            self._published,
            self._set_status_line,
            self._write_checkpoint,
            lambda what: self.state.note(what),
        )
        self.loop.without_step = short
        self.state = EdgeState(
            scenario=scenario.name,
            policies=self.policies.offered,
            controls=controls,
            cameras=self._cameras,
            start_ns=self.start_ns,
            now_ns=self.clock.now_ns,
            set_policy=self._set_policy,
            save_snapshot=self._save_snapshot,
            channel=partial(read_status, (options.emulator_out or options.out) / "channel.json"),
            frontier=self.frontier,
            field_name=config.field,
            chosen=described(scenario, config, self._moving),
            troubles=lambda: self.updater.troubles,
            flat_db=lambda: self.scoring.baselines.mean.mean_color_db,
            so_far=lambda: self.scoring.so_far,
        )
        ended_s = earlier.uptime_s or 0.0
        self.state.events.extend((round(event.t_s - ended_s, 3), event.what) for event in earlier.events)
        log.info("%s", self.state.chosen)
        self.journal = Journal(options.out, self.status)

    # --- running ----------------------------------------------------------------------------------

    def run(self) -> None:
        """Serve until stopped, then write everything to disk. Raises the update loop's error, if it failed;
        TransportError if a port would be open to others."""
        grpc = GrpcThread(
            self.options.transport, self.options.listen, self.ingest, self.clock, self.state, self._stopping
        )
        try:
            self.state.warnings = self._warnings()
            self.scoring.load()  # before frames arrive: they would wait for it
            grpc.start()
        except BaseException:
            self._leave_no_trace()
            raise
        opened: list[OpenPage] = []
        served = False
        try:
            for name, start in (("page", self.options.open_page), ("Foxglove", self.options.open_foxglove)):
                if start is not None:
                    opened.append(start(self.state))
                    log.info("%s: %s", name, opened[-1].url)
            if self.options.metrics_port is not None:
                from edge_server.live.output.prometheus import serve_metrics

                serve_metrics(
                    self.state, self.ingest, self.options.page_host, self.options.metrics_port, self.options.transport
                )
            write_json(self.options.out / "frontier.json", msgspec.to_builtins(self.frontier))
            self.journal.begin()
            served = True
            self.scoring.start()
            self.loop.start()
            self._watch()
        finally:
            self._stopping.set()
            self.loop.stop()
            self._write_field()  # first: whoever stopped the server does not wait for ever
            self.scoring.stop(tuned.LAST_SCORES_S)
            grpc.join(tuned.GRPC_END_S)
            self._write_final() if served else self._leave_no_trace()
            for page in opened:
                page.stop()
        if self.loop.failure is not None:
            raise self.loop.failure

    def _warnings(self) -> list[str]:
        """Security warnings for the page, one for each port that needs one."""
        options = self.options
        ports = [(host_port(options.listen)[0], "gRPC", False)]
        ports += [(options.page_host, "page", True)] if options.open_page is not None else []
        ports += [(options.page_host, "metrics", True)] if options.metrics_port is not None else []
        words = [options.transport.guard(host, what, http) for host, what, http in ports]
        return [each for each in words if each]

    def stop(self) -> None:
        """Ask ``run`` to end; safe from signal handlers and other threads."""
        self._stopping.set()

    def _watch(self) -> None:
        """Write status and ages, and notice if the loop ends."""
        ticks, every = 0, round(tuned.STATUS_PERIOD_S / tuned.AGES_PERIOD_S)
        saved_ns, saving = self.clock.now_ns(), None
        while not self._stopping.wait(tuned.AGES_PERIOD_S) and self.loop.alive:
            now_ns = self.clock.now_ns()
            ages = self.buffer.ages_ms(now_ns), self.ingest.depth_ages_ms(now_ns)
            self.journal.ages((now_ns - self.start_ns) / 1e9, *ages)
            if ticks % every == 0:
                self.journal.write_status()
            ticks += 1
            every_s = self.options.checkpoint_s
            # At most one is pending: if cameras come only after hours, those due until then would be written in a row.
            due = every_s is not None and now_ns - saved_ns > every_s * 1e9
            if due and (saving is None or saving.done()):
                saved_ns = now_ns
                saving = self.loop.request_checkpoint(self.options.out / "field.npz")

    # --- callbacks -------------------------------------------------------------------------

    def _published(self, publication: Publication, renderer: Snapshot, views: list[View]) -> None:
        counts = self._counts
        if counts.first_ms is None:
            counts.first_ms = publication.t_s * 1e3
        self._update_ms.append(publication.update_ms)
        for camera in publication.refused:
            counts.refused[camera] = counts.refused.get(camera, 0) + 1
        self.state.publish(publication, renderer)
        self.journal.published(publication)
        self._record_decision(publication.number)
        if self.recorder is not None:
            self.recorder.published(publication)
        self.scoring.published(publication, renderer, views)

    def _record_decision(self, number: int) -> None:
        """Keep what a learned policy decided, for ``edge-server explain``."""
        policy = self.updater.policy
        if policy.last_decision is None:
            return
        if self._decisions is None:
            from edge_server.scheduler.learned.decision_record import DecisionWriter

            self._decisions = DecisionWriter(self.options.out, embedding_for(self.config, policy))
        self._decisions.record(policy, number)

    def _scored(self, publication: Publication, comparison: Comparison | None, final: bool) -> None:
        self.state.scored(publication, comparison)
        self.journal.scored(publication, final)
        if final and self.recorder is not None:
            self.recorder.scored(publication, self.clock.now_ns())

    def _shown(self, score: Score, publication: Publication) -> None:
        self.state.add_shown(score)
        t_s = (score.published_ns - self.start_ns) / 1e9
        self.journal.shown(t_s, score, publication, self.scoring.so_far)

    def _set_status_line(self, line: str) -> None:
        self.state.status_line = line

    def _set_policy(self, name: str, value: float | None) -> None:
        policy = self.policies.make(name, value)
        self.updater.check(policy)
        controls = self.state.controls
        controls.policy, controls.value, controls.chosen = policy.name, policy.value, policy

    def _make_field(self, config: EdgeConfig) -> Field:
        return make_field(config.field, {"nice": tuned.FIELD_NICE, **config.field_options}, seed=self.scenario.seed)

    def _camera_moves(self, config: EdgeConfig, camera: str) -> None:
        """Follow the updater, which has restarted because ``camera`` moves."""
        self.config, self._moving = config, camera
        self.loop.update_ms = config.update_ms
        self.state.chosen = described(self.scenario, config, camera)
        log.info("%s", self.state.chosen)
        self.state.note(f"the field was restarted: {camera} moves")
        with contextlib.suppress(ValueError):  # a scenario's frontier may cover the first choice only
            self.frontier = self.state.frontier = open_frontier(self.scenario, config)
            write_json(self.options.out / "frontier.json", msgspec.to_builtins(self.frontier))

    def _save_snapshot(self) -> Path:
        if not self.state.started:
            raise RuntimeError("the field has not been trained yet")
        if len(list(self.options.out.glob("snapshot-*.npz"))) >= tuned.MAX_SNAPSHOTS:
            raise RuntimeError(f"{self.options.out} holds {tuned.MAX_SNAPSHOTS} already: move some away")
        if not self._snapshot_lock.acquire(blocking=False):
            raise RuntimeError("another one is being written")
        try:
            path = self.options.out / f"snapshot-{self._earlier_updates + self.updater.number:06d}.npz"
            return self.loop.request_checkpoint(path).result(tuned.SNAPSHOT_TIMEOUT_S)
        except TimeoutError:
            raise RuntimeError(f"the update in progress took over {tuned.SNAPSHOT_TIMEOUT_S:g} s") from None
        finally:
            self._snapshot_lock.release()

    def _write_checkpoint(self, path: Path) -> None:
        about = {
            "field": self.config.field,
            "options": self.config.field_options,
            "moving": self._moving,
            "scenario": self.scenario.name,
            "seed": self.scenario.seed,
            "updates": self.updater.number,
            "without_step": self.loop.without_step,
        }
        checkpoint.save(path, self.updater.field.state(), about)

    def _cameras(self) -> list[CameraView]:
        now_ns, ingest = self.clock.now_ns(), self.ingest
        frames = ingest.newest_held_out | self.buffer.newest()
        views = []
        for camera in self.scenario.cameras:
            frame = frames.get(camera)
            age_ms = None if frame is None else (now_ns - frame.generated_edge_ns) / 1e6
            counts = ingest.delivered[camera], ingest.rejected_by_camera[camera]
            depth = camera in self.ingest.depth
            views.append(CameraView(camera, camera in self.scenario.held_out, frame, age_ms, *counts, depth))
        return views

    def status(self) -> dict[str, Any]:
        """Contents of edge.json."""
        last, scored = self.state.newest(), self.state.newest(scored=True)
        depth = {c: DepthCounts(d.frames, d.bytes) for c, d in self.ingest.depth.copy().items()}
        depth_status = DepthStatus(depth, self.updater.decoder.undecodable_depth)
        return {
            **({} if self.recorder is None else {"recording": self.recorder.status()}),
            **({"depth": msgspec.to_builtins(depth_status)} if depth else {}),
            "scenario": self.scenario.name,
            "seed": self.scenario.seed,
            "started_ns": self.start_ns,
            "run": self._run_facts,
            "events": [{"t_s": t_s, "what": what} for t_s, what in self.state.events.copy()],
            "uptime_s": self.state.now_s(),
            "field": self.config.field,
            "chosen": self.state.chosen,
            "troubles": list(self.state.troubles()),
            "policy": short_name(self.state.controls.policy),
            "value": self.state.controls.value,
            "paused": self.state.controls.paused,
            "doing": self.state.status_line,
            "cameras": [_values(c, "camera", "held_out", "age_ms", "delivered", "rejected") for c in self._cameras()],
            "rejected": dict(self.ingest.rejected),
            "streams_ended": self.ingest.streams.ended,
            "two_nodes": dict(self.ingest.admission.doubled),
            "lines_lost": self.journal.lines_lost + self.ledger.lines_lost,
            "decisions_lost": self._decisions.lost if self._decisions else 0,
            "last_frames": self.ingest.admission.last_frames(),
            "stale_on_arrival": self.buffer.stale_on_arrival,
            "check_ms": {f"p{p}": percentile(self.ingest.check_ms, p) for p in (50, 99)},
            "updates": msgspec.to_builtins(
                msgspec.structs.replace(
                    self._counts,
                    count=self._earlier_updates + self.updater.number,
                    ms_p50=percentile(self._update_ms, 50),
                    ms_p95=percentile(self._update_ms, 95),
                    without_step=self._earlier_short + self.loop.without_step,
                    undecodable=self._earlier_undecodable + self.updater.decoder.undecodable + self.scoring.undecodable,
                    shed=self._earlier_shed + self.buffer.shed,
                )
            ),
            "foreground": None if (cut := self.updater.decoder.foreground) is None else cut.status(),
            "baseline": msgspec.to_builtins(self.scoring.baselines.mean),
            "so_far": msgspec.to_builtins(self.scoring.so_far),
            "lpips_missing": self.lpips_missing,
            "lpips_network": None if self.lpips_missing else self.config.lpips,
            "held_out": list(self.scenario.held_out),
            "last": None
            if last is None
            else {**_values(last, "t_s", "aaoi_ms", "update_ms", "omega_ms", "steps"), "selected": len(last.selected)},
            "scores": None
            if scored is None
            else {**_values(scored, "psnr_db", "ssim", "psnr_moving_db", "lpips"), "on": scored.scored_on},
        }

    def _write_field(self) -> None:
        path = self.options.out / "field.npz"
        if self.loop.alive:
            log.error("%s: not written: the last update did not end within %g s", path, tuned.STOP_S)
        elif self.state.started:
            try:
                self._write_checkpoint(path)
            except OSError as error:
                log.error("%s: not written: %s", path, error)

    def _write_final(self) -> None:
        try:
            if (comparison := self.state.comparison) is not None:
                for name, image in _values(comparison, "truth", "rendered").items():
                    write_png(self.options.out / f"{name}.png", image)
        except OSError as error:
            log.error("not everything was written at the end: %s", error)
        finally:
            # Whatever failed, the ledger is complete and the last status is written.
            try:
                self._close_records()
            finally:
                self.journal.close()

    def _leave_no_trace(self) -> None:
        """Close the files of a start that failed: edge.json and frontier.json, and with them the report, stay those of
        an earlier run. A ledger without frames is deleted; one with frames (say, received before the page's port was
        refused) is renamed so that it does not count as a start of the run."""
        try:
            self._close_records()
            path = self.ledger.path
            if all(each.event == "closed" for each in LedgerReader(path)):
                path.unlink()
            else:
                path.rename(path.with_name(f"ledger-edge-unserved-{self.start_ns}.tsv"))
        finally:
            self.journal.close(with_status=False)

    def _close_records(self) -> None:
        try:
            self.ledger.close(self.clock.now_ns())
        finally:
            if self.recorder is not None:
                self.recorder.close()


def _earlier(path: Path) -> EdgeStatus:
    """The status of an earlier process."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=EdgeStatus)
    except (OSError, ValueError, RecursionError):
        return EdgeStatus()


def _values(of: Any, *names: str) -> dict[str, Any]:
    return {name: getattr(of, name) for name in names}
