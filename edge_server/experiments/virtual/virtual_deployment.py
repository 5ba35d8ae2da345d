"""A whole deployment in virtual time: cameras -> links -> gate -> buffer -> updates -> publications.

It uses the live parts with a virtual clock. With one seed a run repeats bit for bit, faults included.
``ComputeConfig`` sets the cost of an update; an update is published when that cost has elapsed. A frame is
captured and encoded only when an update uses it, a fault damages it, or a fault of its link depends on its
size, which does not change results, because nothing reads a frame earlier.
"""

from __future__ import annotations

import dataclasses
import heapq
import itertools
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Sequence
from typing import Any, NamedTuple

import numpy as np

from camera_node.capture import Camera
from channel_emu.model.channel import Channel
from channel_emu.model.link import Event, EventKind, Link
from channel_emu.model.nanoseconds import NEVER_NS
from channel_emu.model.settings import ChannelConfig
from edge_server.experiments.virtual.run_settings import RunSettings
from edge_server.experiments.virtual.truth import Truth
from edge_server.fidelity.scorer import Score
from edge_server.fields import Budget, Snapshot
from edge_server.live.field_updater import FieldUpdater
from edge_server.live.ingest import FrameAdmission
from edge_server.live.state import Publication
from edge_server.scheduler.policy import Policy
from freshfield.clock import VirtualClock
from freshfield.frame import Frame, FrameRejected, from_request, to_request
from freshfield.geometry import Pose
from freshfield.scenario import seed_sequence

SESSION = "virtual"
# The pose comes with the capture; nothing reads it before the frame is used.
_NO_POSE = Pose((1.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0))


class WakeCondition(NamedTuple):
    """When the edge's loop continues: at an instant, or at the next arrival if that is earlier."""

    at_ns: int = NEVER_NS
    on_arrival: bool = False


_AT_ARRIVAL = WakeCondition(on_arrival=True)


class VirtualDeployment:
    """Runs ``updates`` on the frames that ``cameras`` send over the channel. ``run`` may be called
    repeatedly.

    cameras: the training cameras, as a node would host them, in the order of the buffer's cameras.
    channel: configuration of the emulated channel.
    updates: the edge: buffer, policy and field.
    settings: how it runs; may be replaced, which takes effect at the next decision.
    seed: of the channel and the random instants.
    truth: reference images for scores; None scores nothing.
    on_published: called with each publication.
    Raises ValueError if the cameras are not the buffer's.
    """

    def __init__(
        self,
        cameras: Sequence[Camera],
        channel: ChannelConfig,
        updates: FieldUpdater,
        settings: RunSettings,
        seed: int,
        truth: Truth | None = None,
        on_published: Callable[[Publication], None] | None = None,
    ) -> None:
        self.clock = VirtualClock(updates.start_ns)
        self.updates = updates
        updates.materialize = self.with_images
        self.settings = settings
        self.truth = truth
        self.publications: list[Publication] = []
        self.shown: list[Score] = []
        """Scores of the image shown at random instants: the newest publication, extrapolated to the
        instant."""
        self.captured: Counter[str] = Counter()
        self.delivered: Counter[str] = Counter()
        self.rejected: Counter[str] = Counter()
        self.failed: Counter[str] = Counter()
        """Number of captures that a source could not make, by camera; noticed when a decision uses them."""
        self.next_policy: Policy | None = None
        """Replaces the policy at the next decision, as live."""
        self.session = SESSION
        """Session id of the frames captured from now on."""
        self._on_published = on_published
        self._origin_ns = updates.start_ns  # of the cameras' ticks
        self._channel_origin_ns = updates.start_ns
        self._cameras = {camera.name: camera for camera in cameras}
        if tuple(self._cameras) != updates.buffer.cameras:
            raise ValueError("the cameras and the buffer's are not the same, or in another order")
        self._channel = Channel(channel, seed)
        self._links: dict[str, Link] = {name: self._channel.link(name) for name in self._cameras}
        self._by_size = any(link.by_size for link in self._links.values())
        self._admission = FrameAdmission(updates.buffer.cameras, ())
        self._node_clocks = {name: camera.clock(self.clock) for name, camera in self._cameras.items()}
        self._tick = dict.fromkeys(self._cameras, 0)
        self._due = {name: camera.source.rate_schedule().due_ns for name, camera in self._cameras.items()}
        self._used: dict[str, tuple[Frame, ...]] = {}
        """The last two frames of each camera that have images."""
        self._scored_ns: int | None = None
        self._shown: Snapshot | None = None  # the newest publication
        self._instants = self._shown_instants(seed)
        self._show_ns = next(self._instants)
        self.decided_ns = updates.start_ns
        """Instant of the current or last decision."""
        self._agenda: list[tuple[int, int, Callable[[], None]]] = []
        self._order = itertools.count()
        self._edge = self._run_edge()
        self._wake = next(self._edge)

    def at(self, at_ns: int, action: Callable[[], None]) -> None:
        """Call ``action`` at an instant of the clock, before other events of that instant."""
        heapq.heappush(self._agenda, (at_ns, next(self._order), action))

    def run(self, seconds: float) -> list[Publication]:
        """Continue for ``seconds`` of virtual time. Returns the publications of that time."""
        end_ns = self.clock.now_ns() + round(seconds * 1e9)
        known = len(self.publications)
        while True:
            due_ns, wake_ns = self._link_event_ns(), self._wake_ns()
            capture_ns = min(self._due_ns(name) for name in self._cameras)
            action_ns = self._agenda[0][0] if self._agenda else NEVER_NS
            now_ns = min(action_ns, due_ns, capture_ns, wake_ns, self._show_ns)
            if now_ns > end_ns:
                break
            self.clock.advance_to(now_ns)
            # At one instant links complete first, which makes room for captures; a decision sees both.
            if action_ns == now_ns:
                heapq.heappop(self._agenda)[2]()
            elif due_ns == now_ns:
                self._advance_links(now_ns)
            elif capture_ns == now_ns:
                for name in self._cameras:
                    if self._due_ns(name) == now_ns:
                        self._capture(name, now_ns)
            elif wake_ns == now_ns:
                self._wake = next(self._edge)
            else:
                self._score_shown(now_ns)
        self.clock.advance_to(end_ns)
        return self.publications[known:]

    def flush(self) -> None:
        """Abort transmissions now (thesis 6.5: nothing is considered to be in transit)."""
        for link in self._links.values():
            self._take(link.flush(self.clock.now_ns() - self._channel_origin_ns))

    def shown_now(self) -> Snapshot | None:
        """What a visitor sees: the newest publication, carried on to the clock's instant. None before the first, and if
        nothing shown is scored."""
        return None if self._shown is None else self._shown.at(self.clock.now_ns())

    @property
    def capture_period_ns(self) -> int:
        """Capture period of the fastest camera."""
        return round(1e9 / max(float(camera.fps) for camera in self._cameras.values()))

    def with_images(self, items: Sequence[Frame]) -> tuple[Frame, ...]:
        """Frames of the buffer with their images and poses, which are made now; frames that a source cannot
        make are left out. A frame that is used again stays the same object and is decoded once. Public for
        code that decides instead of this deployment's edge."""
        made = []
        for item in items:
            camera, sequence = item.camera, item.sequence
            known = self._used.get(camera, ())
            used = next((frame for frame in known if frame.sequence == sequence), None)
            if used is None:
                try:
                    used = self._with_image(item)
                except ValueError:
                    self.failed[camera] += 1
                    continue
                self._used[camera] = (used, *known)[:2]
            made.append(used)
        return tuple(made)

    def frames(self) -> dict[str, Any]:
        """Frame counts with the names of report.json; here every captured frame is offered at once."""
        sent = sum(self.captured.values())
        ends = {
            kind.value: sum(link.counts[kind] for link in self._links.values())
            for kind in (
                EventKind.SKIPPED,
                EventKind.DROPPED_BUSY,
                EventKind.SUPERSEDED,
                EventKind.LOST,
                EventKind.BROKEN,
                EventKind.DUPLICATED,
            )
        }
        return {
            "captured": sent,
            "replaced": 0,
            "waiting": 0,
            "sent": sent,
            **ends,
            "delivered": sum(self.delivered.values()),
            "rejected": dict(self.rejected),
            "in_flight": sum(link.in_flight for link in self._links.values()),
        }

    # --- cameras and channel --------------------------------------------------------------------------

    def _link_event_ns(self) -> int:
        """Instant of the next event of a link."""
        return self._channel_origin_ns + min((k.next_event_ns for k in self._links.values()), default=NEVER_NS)

    def _wake_ns(self) -> int:
        """Instant at which the edge's loop continues, if nothing arrives before."""
        return self._wake.at_ns

    def _due_ns(self, name: str) -> int:
        """Instant of a camera's next capture."""
        return self._origin_ns + self._due[name](self._tick[name])

    def _capture(self, name: str, now_ns: int) -> None:
        camera, tick = self._cameras[name], self._tick[name]
        self._tick[name] = tick + 1
        stamped_ns, offset_ns = self._stamp(name, now_ns)
        frame = Frame(
            camera=name,
            session=self.session,
            sequence=tick,
            generated_ns=stamped_ns,
            pose=_NO_POSE,
            intrinsics=camera.source.intrinsics,
            codec=camera.codec,
            payload=b"",
            clock_offset_ns=offset_ns,
        )
        if self._by_size:
            try:
                frame = self._with_image(frame)
            except ValueError:
                self.failed[name] += 1
                return
        self.captured[name] += 1
        self._send(frame, now_ns)

    def _stamp(self, name: str, now_ns: int) -> tuple[int, int]:
        """What a camera's clock shows, and the node's estimate of the edge's clock minus that one, which is
        exact because clock exchanges take no time here."""
        stamped_ns = self._node_clocks[name].stamp_ns(now_ns)
        return stamped_ns, now_ns - stamped_ns

    def _send(self, frame: Frame, now_ns: int) -> None:
        """Offer a frame to its link."""
        size = to_request(frame).ByteSize() if self._by_size else 0
        self._take(self._links[frame.camera].offer(now_ns - self._channel_origin_ns, frame, size)[1])

    def _advance_links(self, now_ns: int) -> None:
        for link in self._links.values():
            self._take(link.advance(now_ns - self._channel_origin_ns))

    def _take(self, events: Sequence[Event]) -> None:
        for event in events:
            if event.kind in (EventKind.DELIVERED, EventKind.DUPLICATED):
                self._deliver(event.transit.item, event.transit.flips)

    def _deliver(self, frame: Frame, flips: tuple[tuple[float, int], ...]) -> str | None:
        """Deliver a frame to the edge. Returns the reason if it is refused, else None."""
        now_ns = self.clock.now_ns()
        try:
            if flips:
                from channel_emu.model.faults.corruption import damage_frame  # only where a scenario lists it

                request = to_request(self._with_image(frame))
                damage_frame(request, flips)
                frame = from_request(request)
            self._admission.admit(frame, now_ns)
        except FrameRejected as error:
            self.rejected[error.reason] += 1
            return error.reason
        self.delivered[frame.camera] += 1
        self.updates.buffer.put(frame, now_ns)
        if self._wake.on_arrival:
            self._wake = WakeCondition(now_ns)
        return None

    def _with_image(self, frame: Frame) -> Frame:
        """The frame with its image and pose, made now unless it came with them."""
        if frame.payload:
            return frame
        shot = self._cameras[frame.camera].capture(frame.sequence)
        return dataclasses.replace(
            frame,
            pose=shot.pose,
            intrinsics=shot.intrinsics,
            payload=shot.payload,
            pose_gap_ns=shot.pose_gap_ns,
            depth=shot.encoded_depth,
        )

    # --- the edge -------------------------------------------------------------------------------------

    def _run_edge(self) -> Generator[WakeCondition, None, None]:
        """The edge's loop; it yields the condition on which it continues."""
        updates, settings = self.updates, self.settings
        if settings.first_ms is None:
            yield from self._await_cameras()
        else:  # with the cameras that have reported by then: the instants are given
            yield WakeCondition(self._origin_ns + round(settings.first_ms * 1e6))
        while True:
            settings = self.settings
            # The first update takes in all frames that have arrived; later ones are limited.
            most_new = settings.most_new if self.publications else None
            if self.next_policy is not None:
                updates.policy, self.next_policy = self.next_policy, None
            decided_ns = self.decided_ns = self.clock.now_ns()
            plan = updates.plan(decided_ns)
            if plan.flush:
                self.flush()
            while (selection := updates.select(plan, self.clock.now_ns(), most_new=most_new)) is None:
                waits = plan.wait_until_ns > self.clock.now_ns()
                yield WakeCondition(plan.wait_until_ns) if waits else _AT_ARRIVAL
            if settings.scratch:
                updates.field.reset()
            others, items = self.with_images(selection.others), self.with_images(selection.items)
            pictured = dataclasses.replace(selection, others=others, items=items)
            fitted = updates.fit(pictured, Budget(steps=settings.steps))
            if fitted is None:
                yield _AT_ARRIVAL  # every selected frame is damaged: newer ones will come
                continue
            views, report = fitted
            charged_ns = settings.compute.charge_ns(report.steps, selection.arrivals)
            yield WakeCondition(self.clock.now_ns() + charged_ns)
            published_ns = self.clock.now_ns()
            self._publish(updates.publication(selection, views, report, published_ns))
            next_ns = settings.next_ns(decided_ns, published_ns, self._origin_ns)
            if next_ns > published_ns:
                yield WakeCondition(next_ns)
            elif published_ns == decided_ns:
                yield _AT_ARRIVAL  # free updates without epochs: once for every arrival, not for ever

    def _await_cameras(self) -> Iterator[WakeCondition]:
        """Give every camera a chance to report, as the live loop does."""
        buffer = self.updates.buffer
        while not buffer.newest():
            yield _AT_ARRIVAL
        until_ns = self.clock.now_ns() + round(self.settings.grace_ms * 1e6)
        while len(buffer.newest()) < len(self._cameras) and self.clock.now_ns() < until_ns:
            yield WakeCondition(until_ns, on_arrival=True)

    def _publish(self, publication: Publication) -> None:
        publication = self._with_score(publication)
        self.publications.append(publication)
        if self._show_ns != NEVER_NS:
            self._shown = self.updates.field.snapshot(publication.published_ns)
        if self._on_published is not None:
            self._on_published(publication)

    def _with_score(self, publication: Publication) -> Publication:
        every_ms, present_ns = self.settings.score_every_ms, publication.published_ns
        if self.truth is None or every_ms is None:
            return publication
        if self._scored_ns is not None and present_ns - self._scored_ns < every_ms * 1e6:
            return publication
        self._scored_ns = present_ns
        return publication.scored(self.truth.score(self.updates.field.snapshot(present_ns), present_ns))

    def _shown_instants(self, seed: int) -> Iterator[int]:
        """Seeded random instants, independent of the cameras' phase."""
        every_ms, truth = self.settings.shown_every_ms, self.truth
        if every_ms is None or truth is None:
            while True:
                yield NEVER_NS
        rng = np.random.default_rng(seed_sequence(seed, "shown"))
        at_ns = self._origin_ns
        for period in itertools.count():
            random_ns = self._origin_ns + round((period + rng.random()) * every_ms * 1e6)
            at_ns = max(truth.nearest_ns(random_ns), at_ns)
            yield at_ns

    def _score_shown(self, now_ns: int) -> None:
        self._show_ns = next(self._instants)
        shown = self.shown_now()
        if shown is not None:
            assert self.truth is not None
            self.shown.append(self.truth.score(shown, now_ns))
