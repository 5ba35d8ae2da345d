"""Of carried cameras in virtual time: scores of the newest held-out frame and of all so far, as live.

A held-out camera that moves shows another view each time, so a mean over the run says little (``fidelity.so_far``).
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import numpy as np
from msgspec.structs import asdict

from camera_node.capture import Camera
from edge_server.experiments.experiment_constants import RESCORED_EVERY_S, RESCORES_COUNT_FROM_S
from edge_server.experiments.virtual.virtual_deployment import VirtualDeployment
from edge_server.fidelity.images import Color, opaque
from edge_server.fidelity.scorer import Scorer
from edge_server.fidelity.so_far import score_frame, so_far
from edge_server.fields import View
from edge_server.run_records import SoFarScores
from freshfield import payload


class NowAndAll:
    """Watches a deployment before it runs. rows: seconds since the run began, and the scores then.

    cameras: the held-out cameras, opened. seconds: how long it will run. background: behind transparent images.
    """

    def __init__(
        self, deployment: VirtualDeployment, cameras: Sequence[Camera], seconds: float, background: Color
    ) -> None:
        self.rows: list[tuple[float, SoFarScores]] = []
        self._deployment, self._scorer = deployment, Scorer(background=background)
        self._frames: list[View] = []
        for camera in cameras:
            schedule, tick = camera.source.rate_schedule(), 0
            while schedule.due_ns(tick) < 1e9 * seconds:
                deployment.at(schedule.due_ns(tick), partial(self._take, camera, tick))
                tick += 1
        for number in range(1, int(seconds / RESCORED_EVERY_S) + 1):
            deployment.at(round(1e9 * number * RESCORED_EVERY_S), partial(self._mark, number * RESCORED_EVERY_S))

    def means(self) -> dict[str, float]:
        """Means of the scores in dB and of SSIM from RESCORES_COUNT_FROM_S on; empty before."""
        late = [asdict(scores) for t_s, scores in self.rows if t_s >= RESCORES_COUNT_FROM_S]
        names = [name for name in (late[0] if late else ()) if name.endswith(("_db", "_ssim"))]
        return {name: float(np.mean([row[name] for row in late])) for name in names if late[0][name] is not None}

    def at(self, t_s: float) -> SoFarScores | None:
        """The scores as known at an instant; None before the first."""
        return next((scores for since_s, scores in reversed(self.rows) if since_s <= t_s), None)

    def _take(self, camera: Camera, tick: int) -> None:
        shot = camera.capture(tick)
        lens = shot.intrinsics
        image = payload.decode(shot.payload, camera.codec, lens.width, lens.height)
        image = opaque(image, self._scorer.background)
        self._frames.append(View(camera.name, image, shot.pose.matrix(), lens, self._deployment.clock.now_ns()))

    def _mark(self, t_s: float) -> None:
        shown = self._deployment.shown_now()
        if shown is not None and self._frames:
            scores = [score_frame(shown, frame, self._scorer) for frame in self._frames]
            self.rows.append((t_s, so_far(scores, scores[-1])))
