"""The ports of the simulated controller: what the client library (ur_rtde) connects to, and the truth.

    30004  Real-Time Data Exchange: state out, registers in
    29999  dashboard: a line in, a line out; the library asks for version, serial number and remote control
    30003  programs in (nothing is streamed out)
    30010  not on a real controller: a line with an instant (ns) in, a line of JSON out with the instant and
           the true joint angles (rad), from which simulated cameras render

Clients have fixed port numbers, so every simulated arm needs an address of its own. 127.0.0.2, 127.0.0.3, ...
are this machine too.
"""

from __future__ import annotations

import asyncio
import json
import logging
import struct
from collections.abc import Awaitable, Callable

from camera_node.robot.simulated_controller import TRUTH_PORT
from camera_node.robot.simulated_controller import rtde_protocol as rtde
from camera_node.robot.simulated_controller import simulated_controller_constants as tuned
from camera_node.robot.simulated_controller.controller import Controller
from camera_node.robot.simulated_controller.joint_motion import STEP_S
from freshfield.clock import Clock

log = logging.getLogger("camera-node.arm")

Handler = Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None]]

RTDE_PORT, DASHBOARD_PORT, SCRIPT_PORT = 30004, 29999, 30003
VERSION = (5, 12, 0, 0)
_DASHBOARD = {
    "PolyscopeVersion": "URSoftware 5.12.0.0 (simulated)",
    "get serial number": "20230000001",
    "is in remote control": "true",
}


def _guarded(handler: Handler) -> Handler:
    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        try:
            await handler(reader, writer)
        except (OSError, asyncio.IncompleteReadError) as error:
            log.debug("a client disconnected: %s", error)
        except (asyncio.LimitOverrunError, ValueError) as error:
            log.warning("simulated arm: disconnecting a client whose message is invalid: %s", error)
        finally:
            writer.close()

    return serve


class ControllerServer:
    """Serves ``controller`` at ``host``, in the time of ``clock``, while ``run`` runs."""

    def __init__(self, controller: Controller, host: str, clock: Clock) -> None:
        self.controller, self.host, self.clock = controller, host, clock
        self.clients: set[_Client] = set()

    async def run(self, started: Callable[[], None]) -> None:
        """Open every port, call ``started``, and serve until cancelled; the loop's end closes all connections. Raises
        OSError if a port is taken."""
        handlers: dict[int, Handler] = {
            RTDE_PORT: self._serve_rtde,
            DASHBOARD_PORT: self._serve_dashboard,
            TRUTH_PORT: self._serve_truth,
            SCRIPT_PORT: self._serve_script,
        }
        for port, handler in handlers.items():
            await asyncio.start_server(_guarded(handler), self.host, port)
        started()
        while True:
            self.controller.advance_to(self.clock.now_ns(), self._publish)
            # Wake up as often as the fastest client needs. Each time, all steps that are due are executed.
            fastest = min((client.every_steps for client in self.clients), default=tuned.IDLE_STEPS)
            await asyncio.sleep(STEP_S * min(fastest, tuned.IDLE_STEPS))

    def _publish(self) -> None:
        due = [client for client in self.clients if client.due(self.controller.steps)]
        if due:
            values = self.controller.values()
            for client in due:
                client.send(values)

    async def _serve_rtde(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        client = _Client(writer)
        self.clients.add(client)
        try:
            while True:
                size, kind = rtde.HEADER.unpack(await reader.readexactly(rtde.HEADER.size))
                if not rtde.HEADER.size <= size <= rtde.MAX_PACKET:
                    raise ValueError(f"a packet of {size} bytes")
                payload = await reader.readexactly(size - rtde.HEADER.size)
                try:
                    given = client.handle(kind, payload)
                except struct.error as error:
                    if kind != rtde.DATA:
                        raise ValueError(str(error)) from None
                    # Some of the library's calls send packets that do not match their recipes.
                    self.controller.fault(f"registers that are not of the recipe ({error})")
                    continue
                if given:
                    self.controller.advance_to(self.clock.now_ns(), self._publish)
                    self.controller.write_inputs(given)
        finally:
            self.clients.discard(client)

    async def _serve_dashboard(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(b"Connected: Universal Robots Dashboard Server\n")
        while line := await reader.readline():
            request = line.decode(errors="replace").strip()
            if request == "stop":  # as at the pendant
                self.controller.stop_program()
            answer = "Stopped" if request == "stop" else _DASHBOARD.get(request, f"could not understand: '{request}'")
            writer.write(f"{answer}\n".encode())

    async def _serve_script(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        # The program is not interpreted: the client library's program only executes register commands.
        while await reader.read(tuned.READ_BYTES):
            self.controller.start_program()

    async def _serve_truth(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while line := await reader.readline():
            t_ns = int(line)
            self.controller.advance_to(self.clock.now_ns(), self._publish)
            known_ns, joints = self.controller.true_joints(t_ns)
            writer.write(json.dumps({"t_ns": known_ns, "q": joints.tolist()}).encode() + b"\n")


class _Client:
    """One connection of the data exchange, with its recipes."""

    def __init__(self, writer: asyncio.StreamWriter) -> None:
        self._writer = writer
        self._output: rtde.Recipe | None = None
        self.every_steps = 1
        self._inputs: dict[int, rtde.Recipe] = {}
        self._started = False

    def due(self, step: int) -> bool:
        return self._started and self._output is not None and step % self.every_steps == 0

    def send(self, values: dict) -> None:
        assert self._output is not None
        # A client that does not read loses samples, so that it cannot fill this machine's memory. To one that is gone
        # asyncio would log each.
        waiting = self._writer.transport.get_write_buffer_size()
        if waiting < tuned.MAX_WAITING_BYTES and not self._writer.is_closing():
            self._reply(rtde.DATA, self._output.pack(values))

    def handle(self, kind: int, payload: bytes) -> dict | None:
        """Answer one packet. Returns input registers for the controller, if there are any."""
        if kind == rtde.REQUEST_VERSION:
            self._reply(kind, bytes([struct.unpack(">H", payload)[0] == 2]))
        elif kind == rtde.CONTROLLER_VERSION:
            self._reply(kind, struct.pack(">4I", *VERSION))
        elif kind == rtde.SETUP_OUTPUTS:
            (frequency_hz,) = struct.unpack(">d", payload[:8])
            recipe = rtde.Recipe.of(1, _names(payload[8:]))
            if recipe.valid:
                self._output = recipe
                self.every_steps = max(1, round(1.0 / (STEP_S * max(frequency_hz, 1.0))))
            self._reply(kind, bytes([recipe.valid]) + ",".join(recipe.types).encode())
        elif kind == rtde.SETUP_INPUTS:
            recipe = rtde.Recipe.of(len(self._inputs) + 1, _names(payload))
            if recipe.valid:
                self._inputs[recipe.number] = recipe
            number = recipe.number if recipe.valid else 0
            self._reply(kind, bytes([number]) + ",".join(recipe.types).encode())
        elif kind in (rtde.START, rtde.PAUSE):
            self._started = kind == rtde.START and self._output is not None
            self._reply(kind, bytes([kind == rtde.PAUSE or self._started]))
        elif kind == rtde.DATA and payload and payload[0] in self._inputs:
            return self._inputs[payload[0]].unpack(payload[1:])
        return None

    def _reply(self, kind: int, payload: bytes) -> None:
        self._writer.write(rtde.packet(kind, payload))


def _names(payload: bytes) -> list[str]:
    return [name for name in payload.decode("ascii").split(",") if name]
