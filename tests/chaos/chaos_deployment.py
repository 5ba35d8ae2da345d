"""A deployment in virtual time whose processes crash and stall; each writes its ledger.

A crash loses the state of the process. Node: captures and the waiting frame. Emulator: links and the frames
inside them. Edge: buffer, sessions, policy, decisions and what the field has learned since its last
checkpoint. Each event of a frame is written to the ledger of the process that would write it live, and
counted in ``really``, so that the ledgers' accounting can be compared with what really happened.
"""

from collections import Counter, deque
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

from camera_node.capture import Camera
from channel_emu.live.live_emulator_constants import CREDITS
from channel_emu.model.channel import Channel
from channel_emu.model.link import Event, EventKind
from channel_emu.model.nanoseconds import NEVER_NS
from channel_emu.model.settings import channel_from_mapping
from edge_server.experiments.virtual.run_settings import RunSettings
from edge_server.experiments.virtual.virtual_deployment import VirtualDeployment, WakeCondition
from edge_server.fields import checkpoint
from edge_server.fields.registry import make_field
from edge_server.live.field_updater import FieldUpdater, open_updater
from edge_server.live.ingest import FrameAdmission
from edge_server.scheduler import make_policy, parse_policy
from edge_server.settings import read_config
from freshfield.frame import Frame
from freshfield.ledger import Ledger
from freshfield.scenario import Scenario
from tests.chaos.fault_plan import ROLES, Fault

# Period of a node's clock exchanges; until the next one it does not know of a step of its clock.
_CLOCK_PERIOD_NS = 10**9


class ChaosDeployment(VirtualDeployment):
    """Call ``run``, then ``end``.

    faults: carried out at their instants. out: folder of the ledgers and the checkpoint.

    Attributes:
    really: numbers of frames and copies by their outcome, with the names of ``FrameCounts``; refusals as
        ``rejected:reason``.
    arrivals: instants of deliveries, by camera.
    damaged_admitted: number of frames admitted although the network had damaged them.
    most_inside: largest number of frames inside a link.
    """

    def __init__(
        self, scenario: Scenario, cameras: list[Camera], settings: RunSettings, faults: Sequence[Fault], out: Path
    ) -> None:
        self.scenario = scenario
        self.really: Counter[str] = Counter()
        self.arrivals: dict[str, list[int]] = {camera.name: [] for camera in cameras}
        self.most_inside = self.damaged_admitted = 0
        self._out, self._checkpoint = out, out / "field.npz"
        self._down: set[str] = set()
        self._stalled: dict[str, int] = {}
        """Until when, by role."""
        self._away: Counter[str] = Counter()
        self._steps: dict[str, list[tuple[int, int]]] = {camera.name: [] for camera in cameras}
        self._synced_ns = 0  # when the node last asked for the edge's time for other reasons than its period
        self._waiting: dict[str, Frame] = {}  # at the node, while the emulator takes none
        self._upstream: deque[Event] = deque()  # sent to an edge that does not answer
        self._ledgers: dict[str, Ledger] = {}
        config = channel_from_mapping(scenario.channel, f"{scenario.path}: channel", scenario.path.parent)
        self._config = config
        self.shared = config.server.shared
        super().__init__(cameras, config, self._new_updater(0), settings, scenario.seed)
        for role in ROLES:
            self._open_ledger(role)
        for fault in faults:
            self.at(round(fault.at_ms * 1e6), partial(getattr(self, f"_do_{fault.kind}"), fault))

    def end(self) -> None:
        """End all processes cleanly, the node first."""
        now_ns = self.clock.now_ns()
        for frame in self._waiting.values():
            self._count("waiting", "node", frame)
        if "emulator" not in self._down:
            for link in self._links.values():
                for transit in link.pending():
                    self._count("in_flight", "emulator", transit.item)
            self._break_upstream()
        for ledger in self._ledgers.values():
            ledger.close(now_ns)

    def _do_crash(self, fault: Fault) -> None:
        """Kill -9 of a process, which is started again ``for_ms`` later."""
        role = fault.target
        if role in self._down:
            return
        self._down.add(role)
        self._stalled.pop(role, None)
        self._ledgers.pop(role)._lines.close()  # without the line ``closed``
        if role == "node":
            self.really["waiting"] += len(self._waiting)
            self._waiting.clear()
        elif role == "emulator":
            self.really["cut_off"] += sum(link.in_flight for link in self._links.values()) + len(self._upstream)
            self._links.clear()
            self._upstream.clear()
        else:
            self._break_upstream()
            self._edge.close()
            self._wake = WakeCondition()
        self._after(fault, lambda: self._restart(role, bool(fault.value)))

    def _restart(self, role: str, resume: bool) -> None:
        now_ns = self.clock.now_ns()
        self._down.discard(role)
        self._open_ledger(role)
        if role == "node":
            self.session = f"restart-{now_ns}"
            self._synced_ns = now_ns
        elif role == "emulator":
            self._channel_origin_ns = now_ns
            channel = Channel(self._config, self.scenario.seed)
            self._links.update({name: channel.link(name) for name in self._cameras})
            self._send_waiting()
        else:
            self.updates = self._new_updater(now_ns, resume)
            self.updates.materialize = self.with_images
            self._admission = FrameAdmission(self.updates.buffer.cameras, ())
            self._used.clear()
            self._edge = self._run_edge()
            self._wake = next(self._edge)

    def _do_stall(self, fault: Fault) -> None:
        """SIGSTOP of a process, and SIGCONT ``for_ms`` later."""
        role, until_ns = fault.target, self.clock.now_ns() + round(fault.for_ms * 1e6)
        if role not in self._down:
            self._stalled[role] = max(self._stalled.get(role, 0), until_ns)
            self.at(until_ns, lambda: self._go_on(role))

    def _go_on(self, role: str) -> None:
        if self.clock.now_ns() < self._stalled.get(role, NEVER_NS):
            return  # killed meanwhile, or it stands for longer
        del self._stalled[role]
        if role == "emulator":
            self._advance_links(self.clock.now_ns())
        self._send_waiting()
        while role == "edge" and self._upstream and role not in self._stalled:
            self._arrive(self._upstream.popleft())

    def _do_away(self, fault: Fault) -> None:
        """A camera is unplugged for a while."""
        self._away[fault.target] += 1
        self._after(fault, lambda: self._away.subtract([fault.target]))

    def _do_clock_step(self, fault: Fault) -> None:
        """A camera's clock jumps by ``value`` ms."""
        self._steps[fault.target].append((self.clock.now_ns(), round(fault.value * 1e6)))

    def _do_policy(self, fault: Fault) -> None:
        name, value = parse_policy(fault.target)
        self.next_policy = make_policy(name, value, self.scenario.rng("policy", name))

    def _do_checkpoint(self, fault: Fault) -> None:
        if self._runs("edge"):
            checkpoint.save(self._checkpoint, self.updates.field.state(), durable=False)

    def _capture(self, name: str, now_ns: int) -> None:
        if not self._runs("node") or self._away[name] > 0:
            self._tick[name] += 1
            return
        super()._capture(name, now_ns)

    def _stamp(self, name: str, now_ns: int) -> tuple[int, int]:
        stamped_ns, offset_ns = super()._stamp(name, now_ns)
        steps = self._steps[name]
        known = [by for at, by in steps if at + _CLOCK_PERIOD_NS <= now_ns or at <= self._synced_ns]
        return stamped_ns + sum(by for _, by in steps), offset_ns - sum(known)

    def _send(self, frame: Frame, now_ns: int) -> None:
        self._count("captured", "node", frame)
        if self._runs("emulator"):
            self._offer(frame, now_ns)
            return
        if frame.camera in self._waiting:
            self._count("replaced", "node", self._waiting[frame.camera])
        self._waiting[frame.camera] = frame

    def _send_waiting(self) -> None:
        """Send the frames that wait at the node, if both the node and the emulator run."""
        while self._waiting and self._runs("node", "emulator"):
            self._offer(self._waiting.pop(next(iter(self._waiting))), self.clock.now_ns())

    def _offer(self, frame: Frame, now_ns: int) -> None:
        self._count("sent", "node", frame)
        self._write("emulator", "received", frame.camera, frame.session, frame.sequence)
        super()._send(frame, now_ns)
        self.most_inside = max(self.most_inside, self._links[frame.camera].in_flight)

    def _take(self, events: Sequence[Event]) -> None:
        for event in events:
            frame = event.transit.item
            if event.kind in (EventKind.DELIVERED, EventKind.DUPLICATED):
                if event.kind is EventKind.DUPLICATED:
                    self._count("duplicated", "emulator", frame)
                self._forward(event)
            elif event.kind is not EventKind.STARTED:
                self._count(str(event.kind), "emulator", frame)

    def _forward(self, event: Event) -> None:
        frame = event.transit.item
        if "edge" in self._down or len(self._upstream) >= CREDITS:
            self._count("broken", "emulator", frame)
            return
        self._write("emulator", "forwarded", frame.camera, frame.session, frame.sequence)
        if "edge" in self._stalled:
            self._upstream.append(event)
        else:
            self._arrive(event)

    def _arrive(self, event: Event) -> None:
        frame = event.transit.item
        reason = self._deliver(frame, event.transit.flips)
        self._count(f"rejected:{reason}" if reason else "delivered", "edge", frame)
        self.damaged_admitted += bool(event.transit.flips and not reason)
        if not reason:
            self.arrivals[frame.camera].append(self.clock.now_ns())

    def _break_upstream(self) -> None:
        while self._upstream:
            self._count("broken", "emulator", self._upstream.popleft().transit.item)

    def _link_event_ns(self) -> int:
        return NEVER_NS if "emulator" in self._stalled else super()._link_event_ns()

    def _wake_ns(self) -> int:
        return max(self._wake.at_ns, self.clock.now_ns()) if self._runs("edge") else NEVER_NS

    def _runs(self, *roles: str) -> bool:
        return not (self._down | self._stalled.keys()) & {*roles}

    def _new_updater(self, now_ns: int, resume: bool = False) -> FieldUpdater:
        """The updater of an edge that was just started. resume: load the last checkpoint, if there is one."""
        scenario, config = self.scenario, read_config(self.scenario)
        field = make_field(config.field, config.field_options, scenario.seed)
        if resume and self._checkpoint.exists():
            field.load_state(checkpoint.load(self._checkpoint)[0])
        name, value = config.policy.name, config.policy.value
        policy = make_policy(name, value, scenario.rng("policy", name))
        return open_updater(scenario, config, policy, field, now_ns, resume)

    def _open_ledger(self, role: str) -> None:
        self._ledgers[role] = Ledger(self._out, role, "chaos", self.clock.now_ns())

    def _count(self, what: str, role: str, frame: Frame) -> None:
        """Count an event of a frame, and write it to the ledger of ``role``."""
        self.really[what] += 1
        event, _, detail = what.partition(":")
        self._write(role, event, frame.camera, frame.session, frame.sequence, detail)

    def _write(self, role: str, event: str, camera: str, session: str, sequence: int, detail: str = "") -> None:
        self._ledgers[role].write(self.clock.now_ns(), camera, session, sequence, event, detail)

    def _after(self, fault: Fault, action: Callable[[], None]) -> None:
        self.at(self.clock.now_ns() + round(fault.for_ms * 1e6), action)
