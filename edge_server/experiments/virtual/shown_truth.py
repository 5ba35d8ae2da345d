"""Compares images shown at random instants with those of a perfect field that has views of the same ages.

The synthetic world is known at any instant, so for each image shown two things can be computed:

* the content lag of its moving pixels: the tau at which truth(t - tau) matches them best;
* the image of a perfect field that knows the scene up to some instant and extrapolates it: since then every
  rigid part has kept its linear and angular velocity (``carried_on``).
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, field
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from camera_node.config import WorldConfig, source_config
from camera_node.synthetic.placement import MovingBody
from camera_node.synthetic.render import CameraRenderer
from edge_server.experiments.virtual.from_scenario import exact_scene
from edge_server.fidelity.images import to_unit
from edge_server.fidelity.moving_pixels import LAGS_MS, moving_mask
from edge_server.live.state import Publication
from freshfield.geometry import Array, Pinhole, so3_exp, so3_log
from freshfield.scenario import Scenario, ScenarioError

# Instants are multiples of this, so that a periodic scene is rendered once for all runs. Every lag of the
# moving pixels and every scene's period is a multiple of it.
GRID_NS = 5_000_000
LONGEST_LAG_MS, EARLIEST_LAG_MS = 600.0, -100.0
_IMAGES_KEPT = 4096
_MOMENT_S = 1e-3  # time difference for velocities
PARTS = ("whole", "moving", "still")
PERFECT = ("newest", "mean", "frozen")


def carried_on(body: MovingBody, known_s: float) -> MovingBody:
    """The body extrapolated from the instant ``known_s``: each part keeps the velocities that it had then."""
    then, before = body.matrices(known_s), body.matrices(known_s - _MOMENT_S)
    shift = (then[:, :3, 3] - before[:, :3, 3]) / _MOMENT_S
    turn = np.stack([so3_log(_rotation(a) @ _rotation(b).T) for a, b in zip(then, before)]) / _MOMENT_S

    def matrices(t_s: float) -> Array:
        out, ahead_s = then.copy(), t_s - known_s
        out[:, :3, 3] += shift * ahead_s
        out[:, :3, :3] = np.stack([so3_exp(w * ahead_s) for w in turn]) @ then[:, :3, :3]
        return out

    return dataclasses.replace(body, matrices=matrices)


def _rotation(matrix: Array) -> Array:
    linear: Array = matrix[:3, :3]  # with scales
    return linear / np.linalg.norm(linear, axis=0)


class KnownWorld:
    """The synthetic world of a scenario, seen by its first held-out camera at multiples of GRID_NS.

    Raises ScenarioError if no camera is held out, or the source is not a world.
    """

    def __init__(self, scenario: Scenario) -> None:
        source = source_config(scenario)
        if not isinstance(source, WorldConfig) or not scenario.held_out:
            raise ScenarioError(f"{scenario.path}: expected a source of kind world and a held-out camera")
        scene, effects = exact_scene(scenario, source)
        self.camera = scenario.held_out[0]
        lens, self.pose = scene.cameras[self.camera]
        self.lens: Pinhole = effects.reported_lens(lens)
        self._world, self._expose = scene.world, effects.with_exposure
        self._renderer: CameraRenderer = scene.renderer(self.camera)
        self._period = round(scene.period_s * 1e9 / GRID_NS)
        self._at_index = lru_cache(_IMAGES_KEPT)(self._render)

    def image(self, index: int) -> NDArray[np.uint8]:
        """The truth (H, W, 3) at ``index`` times GRID_NS."""
        return self._at_index(index % self._period)

    def _render(self, index: int) -> NDArray[np.uint8]:
        return self._expose(self._renderer).image(index * GRID_NS / 1e9)

    def carried(self, known_ns: float, present_ns: int) -> NDArray[np.uint8]:
        """Image of the scene known at ``known_ns`` and extrapolated to ``present_ns``, uint8 (H, W, 3)."""
        bodies = tuple(carried_on(body, known_ns / 1e9) for body in self._world.moving_bodies)
        world = dataclasses.replace(self._world, moving_bodies=bodies)
        return self._expose(self._renderer.for_world(world)).image(present_ns / 1e9)

    def lag_ms(self, shown: NDArray, index: int, pixels: NDArray[np.bool_]) -> float | None:
        """The lag at which the earlier truth matches ``pixels`` (H, W) of the image ``shown`` best, by a
        parabola between grid instants; None without such pixels.

        index: the instant of ``shown``, in multiples of GRID_NS.
        """
        if not pixels.any():
            return None
        steps = range(int(EARLIEST_LAG_MS * 1e6) // GRID_NS, int(LONGEST_LAG_MS * 1e6) // GRID_NS + 1)
        seen = 255.0 * to_unit(shown, "shown")[pixels]
        errors = np.array([((self.image(index - k)[pixels] - seen) ** 2).mean() for k in steps])
        best = int(errors.argmin())
        offset = 0.0
        if 0 < best < len(errors) - 1:
            a, b, c = errors[best - 1 : best + 2]
            offset = 0.5 * (a - c) / (a - 2 * b + c) if a + c > 2 * b else 0.0
        return float((steps[best] + offset) * GRID_NS / 1e6)


@dataclass
class ShownTruth:
    """A ``Truth`` of a deployment that keeps more than scores of what is shown: ``instants``.

    from_ns: earlier images are ignored.
    instants: one mapping for each image shown: its instant, its mean squared errors (by ``PARTS``; None if
        nothing moves), those of a perfect field that knows the scene up to the capture of the newest view
        (``newest``) and up to the mean capture of all cameras' newest views (``mean``), those of the scene as
        it was at the latter (``frozen``), content lag and ages.
    """

    world: KnownWorld
    from_ns: int = 0
    instants: list[dict[str, Any]] = field(default_factory=list)
    _publication: Publication | None = None

    def published(self, publication: Publication) -> None:
        """Call this with each publication of the deployment."""
        self._publication = publication

    def nearest_ns(self, present_ns: int) -> int:
        return round(present_ns / GRID_NS) * GRID_NS

    def view(self, camera: str, present_ns: int) -> tuple[NDArray[np.uint8], Pinhole, Array]:
        return self.world.image(round(present_ns / GRID_NS)), self.world.lens, self.world.pose

    def score(self, field: Any, present_ns: int) -> None:
        """Add to ``instants``; returns no score."""
        publication, world = self._publication, self.world
        if present_ns < self.from_ns or publication is None:
            return
        index = round(present_ns / GRID_NS)
        truth = world.image(index)
        earlier = [world.image(index - round(lag * 1e6) // GRID_NS) for lag in LAGS_MS]
        shown, moving = field.render(world.pose, world.lens).color, moving_mask(truth, earlier)
        display_ms = (present_ns - publication.published_ns) / 1e6
        ages_ms = {"newest": min(publication.ages_ms) + display_ms, "mean": publication.aaoi_ms + display_ms}
        waiting_ms = publication.aaoi_ms - (publication.network_ms or 0.0) - publication.update_ms
        self.instants.append(
            {
                "t_s": present_ns / 1e9,
                "shown": squared_errors(shown, truth, moving),
                **{
                    known: squared_errors(world.carried(present_ns - 1e6 * age_ms, present_ns), truth, moving)
                    for known, age_ms in ages_ms.items()
                },
                "frozen": squared_errors(world.image(index - round(1e6 * ages_ms["mean"] / GRID_NS)), truth, moving),
                "lag_ms": world.lag_ms(shown, index, moving),
                "age_ms": {
                    **ages_ms,
                    "network": publication.network_ms,
                    "waiting": waiting_ms,
                    "computing": publication.update_ms,
                    "display": display_ms,
                },
            }
        )


def squared_errors(shown: NDArray, truth: NDArray, moving: NDArray[np.bool_]) -> dict[str, float | None]:
    """Mean squared error of the whole image, of the pixels that move and of the others."""
    error = ((to_unit(shown, "shown") - to_unit(truth, "truth")) ** 2).mean(axis=2)
    pixels = {"whole": error, "moving": error[moving], "still": error[~moving]}
    return {part: float(of.mean()) if of.size else None for part, of in pixels.items()}
