"""A camera node: captures with one or several cameras, each of which sends on its own stream."""

from __future__ import annotations

import asyncio
import contextlib
import logging
import os
import secrets
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import grpc.aio

from camera_node import node_constants as tuned
from camera_node.capture import Camera, prepare
from camera_node.clock_offset import ClockSync
from camera_node.clocks import NodeClock
from camera_node.outbox import Outbox
from camera_node.sender import TAKEN, Sender
from camera_node.sources.base import Shot
from freshfield.clock import WallClock
from freshfield.files import write_json
from freshfield.frame import Frame
from freshfield.ledger import Ledger
from freshfield.scenario import Scenario
from freshfield.transport import Transport

log = logging.getLogger("camera-node")


@dataclass(frozen=True)
class NodeOptions:
    """How a node runs.

    to: HOST:PORT of the next hop.
    transport: TLS and tokens of the connection.
    out: folder for the ledger and the status file; None writes neither.
    seconds: duration of capture; None: until stopped.
    response_timeout_s: see ``Sender``.
    """

    to: str
    transport: Transport
    out: Path | None = None
    seconds: float | None = None
    response_timeout_s: float = tuned.ANSWER_TIMEOUT_S


class Node:
    """The cameras of one process, from capture to the stream. ``await run()`` returns once ``stop`` was
    called, the options' duration is over, or all recordings have ended.

    cameras: opened, at least one.
    """

    def __init__(self, scenario: Scenario, cameras: Sequence[Camera], options: NodeOptions) -> None:
        self.name = node_name([c.name for c in cameras])
        self.session = f"{os.getpid()}-{secrets.token_hex(6)}"
        self.phase = "starting"
        self.outboxes: dict[str, Outbox] = {}
        self.senders: dict[str, Sender] = {}
        self._scenario = scenario
        self._cameras = cameras
        self._options = options
        self._clock = WallClock()  # true time: a camera with a wrong clock only stamps with it
        self._clocks: dict[str, NodeClock] = {c.name: c.clock(self._clock) for c in cameras}
        self._trouble: dict[str, Counter[str]] = {c.name: Counter() for c in cameras}
        self._syncs: dict[str, ClockSync] = {}
        self._stopping = asyncio.Event()
        # Cameras that compute share a thread; each that waits for hardware has its own, so a dead one blocks no other.
        self._pool = ThreadPoolExecutor(1, thread_name_prefix="capture")
        self._own_pools = {
            c.name: ThreadPoolExecutor(1, thread_name_prefix=f"capture {c.name}") for c in cameras if c.waits
        }

    def stop(self) -> None:
        """Ask ``run`` to end. May be called from the loop's signal handlers, and more than once."""
        self._stopping.set()

    async def run(self) -> None:
        """Connect, prepare, capture and send until stopped. Raises what a camera's task raised, OSError if
        the ledger cannot be created, and TransportError."""
        ledger = None
        if self._options.out is not None:
            ledger = Ledger(self._options.out, "node", self.name, self._clock.now_ns())
        channel = self._options.transport.aio_channel(self._options.to)
        metadata = self._options.transport.metadata()
        troubles: dict[str, str] = {}
        for camera in self._cameras:
            outbox = Outbox(camera.name, self.session, ledger, self._clock)
            self.outboxes[camera.name] = outbox
            self._syncs[camera.name] = self._sync_of(camera.name, channel, metadata)
            self.senders[camera.name] = Sender(
                outbox,
                channel,
                metadata,
                self._syncs[camera.name].offset,
                self._scenario.rng("backoff", camera.name),
                troubles,
                self._options.response_timeout_s,
            )
        try:
            await self._work()
        finally:
            self._stopping.set()  # the pool's work checks this
            for pool in (self._pool, *self._own_pools.values()):
                pool.shutdown(wait=False, cancel_futures=True)
            await channel.close()
            self._enter("stopped")
            for outbox in self.outboxes.values():
                outbox.close()
            if ledger is not None:
                ledger.close(self._clock.now_ns())

    def _sync_of(self, camera: str, channel: grpc.aio.Channel, metadata: tuple[tuple[str, str], ...]) -> ClockSync:
        """The offset estimate of a camera: shared by cameras on the exact clock; a wrong clock has its
        own."""
        clock = self._clocks[camera]
        if not clock.exact:
            return ClockSync(channel, metadata, clock)
        shared = [self._syncs[c] for c in self._syncs if self._clocks[c].exact]
        return shared[0] if shared else ClockSync(channel, metadata, clock)

    async def _work(self) -> None:
        background = [asyncio.ensure_future(sync.run()) for sync in set(self._syncs.values())]
        background += [asyncio.ensure_future(s.run()) for s in self.senders.values()]
        background += [asyncio.ensure_future(self._report())]
        stop = asyncio.ensure_future(self._stopping.wait())
        capture = asyncio.ensure_future(self._capture_all())
        try:
            await asyncio.wait({stop, capture, *background}, return_when=asyncio.FIRST_COMPLETED)
            capture.cancel()
            await self._last_answers()
        finally:
            tasks = [stop, capture, *background]
            for task in tasks:
                task.cancel()
            results = await asyncio.gather(*tasks, return_exceptions=True)
        for result in results:
            if isinstance(result, Exception):
                raise result

    async def _capture_all(self) -> None:
        self._enter("preparing")
        world = self._scenario.source.get("kind") == "world"
        log.info("preparing frames%s", "; a synthetic world is rendered first, once" if world else "")
        loop = asyncio.get_running_loop()
        await loop.run_in_executor(self._pool, prepare, self._cameras, self._stopping.is_set)
        if any(camera.source.schedule(0).lossless for camera in self._cameras):
            # Wait for the connection: a recording that started earlier would lose its beginning.
            self._enter("connecting")
            while not all(sender.ready for sender in self.senders.values()):
                await asyncio.sleep(tuned.READY_POLL_S)
        self._enter("streaming")
        log.info("streaming %s", ", ".join(camera.name for camera in self._cameras))
        start_ns = self._clock.now_ns()
        tasks = [asyncio.ensure_future(self._capture(c, start_ns)) for c in self._cameras]
        try:
            await asyncio.wait(tasks, timeout=self._options.seconds or None, return_when=asyncio.FIRST_EXCEPTION)
        finally:
            for task in tasks:
                task.cancel()
        for result in await asyncio.gather(*tasks, return_exceptions=True):
            if isinstance(result, Exception):
                raise result

    async def _capture(self, camera: Camera, start_ns: int) -> None:
        """Capture with one camera, each time its schedule is due in true time."""
        loop = asyncio.get_running_loop()
        outbox, trouble = self.outboxes[camera.name], self._trouble[camera.name]
        pool = self._own_pools.get(camera.name, self._pool)
        schedule = camera.source.schedule(start_ns)
        tick: int | None = schedule.first(self._clock.now_ns())
        sequence = 0
        while tick is not None:
            due_ns = schedule.due_ns(tick)
            await asyncio.sleep((due_ns - self._clock.now_ns()) * 1e-9)
            try:
                shot = camera.cached(tick)
                if shot is None:
                    shot = await loop.run_in_executor(pool, camera.capture, tick)
            except (ValueError, OSError) as error:  # OSError: a photo that is gone
                self._failed(camera.name, error)
            else:
                # A rendered or read image shows the instant at which the tick was due, however late the loop
                # woke up; a real camera reports when it exposed.
                shown_ns = due_ns if shot.captured_ns is None else shot.captured_ns
                generated_ns = self._clocks[camera.name].stamp_ns(shown_ns)
                if schedule.lossless:
                    await outbox.wait_empty()
                outbox.put(self._frame(camera, shot, sequence, generated_ns))
                sequence += 1
            tick, missed = schedule.next(tick, self._clock.now_ns())
            trouble["missed"] += missed

    def _frame(self, camera: Camera, shot: Shot, sequence: int, generated_ns: int) -> Frame:
        return Frame(
            camera=camera.name,
            session=self.session,
            sequence=sequence,
            generated_ns=generated_ns,
            pose=shot.pose,
            intrinsics=shot.intrinsics,
            codec=camera.codec,
            payload=shot.payload,
            held_out=camera.name in self._scenario.held_out,
            pose_gap_ns=shot.pose_gap_ns,
            depth=shot.encoded_depth,
        )

    def _failed(self, camera: str, error: Exception) -> None:
        """Count a capture that could not be made; log the first."""
        if not self._trouble[camera]["failed"]:
            log.warning("%s: no frame: %s (further ones are only counted)", camera, error)
        self._trouble[camera]["failed"] += 1

    async def _last_answers(self) -> None:
        try:
            async with asyncio.timeout(tuned.LAST_ANSWERS_S):
                while any(s.busy or (s.connected and s.outbox.waiting) for s in self.senders.values()):
                    await asyncio.sleep(tuned.LAST_ANSWERS_POLL_S)
        except TimeoutError:
            pass  # those frames are recorded as broken

    def failure(self) -> str | None:
        """After ``run``: why the peer took no frame; None if it took one, or there was no time for any."""
        counts = sum((outbox.counts for outbox in self.outboxes.values()), Counter())
        failed = sum(trouble["failed"] for trouble in self._trouble.values())
        if failed and not counts["captured"]:
            return f"no frame could be captured ({failed} tries)"
        why = next((sender.trouble for sender in self.senders.values() if sender.trouble), "")
        if (why or counts["captured"]) and not any(sender.connections for sender in self.senders.values()):
            return f"{self._options.to} was never reached: {why or 'no connection in time'}"
        if any(counts[outcome] for outcome in TAKEN):
            return None
        refused = {name: n for name, n in counts.items() if name.startswith("rejected:")}
        if refused:
            return f"all frames were refused: {', '.join(f'{name[9:]} {n}' for name, n in refused.items())}"
        return f"{self._options.to} answered no frame: {why}" if why else None

    def _enter(self, phase: str) -> None:
        self.phase = phase
        self._write_status()

    async def _report(self) -> None:
        while True:
            self._write_status()
            await asyncio.sleep(tuned.STATUS_PERIOD_S)

    def _write_status(self) -> None:
        if self._options.out is not None:
            with contextlib.suppress(OSError):  # a full disk must not end the node
                write_json(self._options.out / f"node-{self.name}.json", self.status())

    def status(self) -> dict[str, Any]:
        """Contents of the status file ``OUT/node-<name>.json``, which is replaced about once a second.

        Keys: name, pid, session, phase (starting, preparing, connecting, streaming, stopped), to, t_ns (on
        the node's true clock), and cameras.

        Keys of each camera: fps, held_out, connected, connections, trouble (text or null), clock_offset_ms
        and clock_uncertainty_ms (peer minus camera; null before the first exchange), the numbers of frames
        waiting, captured, replaced, sent and broken, outcomes {accepted, dropped_busy, superseded,
        "rejected:<reason>"}, missed (ticks for which the machine was too slow), failed (shots that could not
        be made), depth_failed (shots sent without depth because it failed; a repeating shot counts once),
        poses_refused (lines of a tracker's file that are not poses).
        """
        return {
            "name": self.name,
            "pid": os.getpid(),
            "session": self.session,
            "phase": self.phase,
            "to": self._options.to,
            "t_ns": self._clock.now_ns(),
            "cameras": {c.name: self._camera_status(c) for c in self._cameras},
        }

    def _camera_status(self, camera: Camera) -> dict[str, Any]:
        outbox, sender = self.outboxes[camera.name], self.senders[camera.name]
        counts = dict(outbox.counts)
        offset = self._syncs[camera.name].offset()
        frames = {k: counts.pop(k, 0) for k in ("captured", "replaced", "sent", "broken")}
        return {
            "fps": float(camera.fps),
            "held_out": camera.name in self._scenario.held_out,
            "connected": sender.connected,
            "connections": sender.connections,
            "trouble": sender.trouble or None,
            "clock_offset_ms": None if offset is None else offset.offset_ns / 1e6,
            "clock_uncertainty_ms": None if offset is None else offset.uncertainty_ns / 1e6,
            "waiting": outbox.waiting,
            **frames,
            "outcomes": counts,
            "missed": self._trouble[camera.name]["missed"],
            "failed": self._trouble[camera.name]["failed"],
            "depth_failed": camera.depth_failed,
            "poses_refused": camera.source.poses_refused,
        }


def node_name(cameras: Sequence[str]) -> str:
    """Name of a node in file names: its camera, or the first one and the number of the others (cam00+3)."""
    return cameras[0] if len(cameras) == 1 else f"{cameras[0]}+{len(cameras) - 1}"
