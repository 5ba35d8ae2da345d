"""What the static field learns where cameras measure depth: their plates, virtual ones, and its first Gaussians."""

from __future__ import annotations

import logging
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import View
from edge_server.fields.common.camera_rows import camera_rows
from edge_server.fields.common.scene_box import SceneBox, scene_box
from edge_server.fields.common.threads.thread_pool import Pool, compile_kernels
from edge_server.fields.splat.layers import layer_constants as of_layers
from edge_server.fields.splat.layers.depth import layer_depth_constants as tuned
from edge_server.fields.splat.layers.depth.body_depth import body_depth, seen_through
from edge_server.fields.splat.layers.depth.depth_plate import DepthPlate, smooth
from edge_server.fields.splat.layers.depth.first_gaussians import first_gaussians
from edge_server.fields.splat.layers.depth.kernels.surfaces import Meshes
from edge_server.fields.splat.layers.depth.large_planes import continued, large_planes
from edge_server.fields.splat.layers.depth.overlaps import contradicting, exposures
from edge_server.fields.splat.layers.depth.plate_stereo import PlateStereo
from edge_server.fields.splat.layers.depth.registration import Correction, register, register_stereo
from edge_server.fields.splat.layers.depth.surfaces import Surface, SurfaceScene
from edge_server.fields.splat.layers.depth.virtual_plates import virtual_plates
from edge_server.fields.splat.layers.observations import FixedCamera, Observation
from edge_server.fields.splat.layers.plates import Plate
from edge_server.fields.splat.layers.static_layer import PlateImage
from edge_server.fields.splat.settings import SplatSettings
from freshfield.geometry import Pinhole

if TYPE_CHECKING:
    from edge_server.fields.splat.layers.depth.network_depth import NetworkDepth

log = logging.getLogger(__name__)

Arrays = dict[str, NDArray[Any]]


@dataclass(frozen=True)
class CameraPlates:
    """The plates of a camera as they were at one moment, for another thread.

    plate: at the resolution of ``depth``. learned: what the static field learns, maybe finer.
    depth: None of a camera that has measured none.
    reported: its pose, camera-to-world (4, 4), as its frames say it.
    """

    plate: PlateImage
    learned: PlateImage
    depth: DepthPlate | None
    reported: NDArray[np.float64]

    @property
    def name(self) -> str:
        """The camera."""
        return self.plate.view.camera

    def inverse(self, pool: Pool) -> NDArray[np.float32]:
        """See ``DepthPlate.medians``; all 0 where depth is noise or there is none."""
        nothing = np.zeros(self.plate.known.shape, np.float32)
        if self.depth is None:
            return nothing
        found = self.depth.medians(pool)
        return found if self.depth.is_steady(found) else nothing

    def surface(self, inverse: NDArray[np.float32], slope: NDArray[np.float32] | None = None) -> Surface:
        """slope: None: not known."""
        view, color, known = self.plate
        slope = np.zeros((*inverse.shape, 2), np.float32) if slope is None else slope
        return Surface(view.intrinsics, self.reported, color, known > 0, inverse, slope)


class DepthSupervision:
    """Prepares what the static field learns. One thread at a time may call it.

    wrong: cameras whose depth contradicts the others', and is not used.
    corrections: camera -> its pose and the scale of its depth, where registration has found them.
    scene: the surfaces as they were last learned; None before that, or where none can be used.
    stereo: of the plates; None where it was not needed. stereo_cameras: up to so many, it finds what has no depth.
    """

    def __init__(self, settings: SplatSettings, pool: Pool, network: NetworkDepth | None = None) -> None:
        """network: fills what neither sensors nor stereo find."""
        self.settings, self.pool, self.network = settings, pool, network
        self.wrong: tuple[str, ...] = ()
        self.corrections: dict[str, Correction] = {}
        self.scene: SurfaceScene | None = None
        self.stereo: PlateStereo | None = None
        self.stereo_cameras = of_layers.STEREO_CAMERAS
        self._learned: dict[str, NDArray[np.float32]] = {}  # camera -> inverse depths as learned

    def forget_camera(self, camera: str) -> None:
        """Forget what was learned of a camera that stands somewhere else now."""
        self._learned.pop(camera, None)
        self.corrections = {name: found for name, found in self.corrections.items() if name != camera}

    @property
    def displaced(self) -> dict[str, Correction]:
        """Cameras that stand elsewhere than their frames say, or whose depth is of another scale."""
        return {name: found for name, found in self.corrections.items() if found.is_large}

    @property
    def troubles(self) -> tuple[str, ...]:
        """What is wrong with poses and depth, for people."""
        against = [f"the depth of {name} contradicts the other cameras' and is not used" for name in self.wrong]
        refused = {} if self.network is None else self.network.refused
        unused = [f"the depth network is not used for {name}: {why}" for name, why in refused.items()]
        return (*against, *(f"{name} {found}" for name, found in self.displaced.items()), *unused)

    def exposures(self, cameras: Sequence[CameraPlates]) -> Mapping[str, NDArray[np.float64]]:
        """Camera -> log of its exposure over the mean of all, (3,)."""
        surfaces = [camera.surface(camera.inverse(self.pool)) for camera in cameras]
        for k in contradicting(surfaces):
            surfaces[k] = replace(surfaces[k], inverse=np.zeros_like(surfaces[k].inverse))
        logs = exposures(surfaces)
        return {camera.name: found for camera, found in zip(cameras, logs)}

    def has_changed(self, cameras: Sequence[CameraPlates]) -> bool:
        """Whether depths are known that were not when they were last learned, or differ from those. May sweep a camera
        whose plate has changed."""
        if self.stereo is not None and self._sweep(self.stereo, cameras):
            return True
        changed = 0
        for camera in cameras:
            now = camera.inverse(self.pool)
            before = self._learned.get(camera.name, np.zeros_like(now))
            changed += int(np.count_nonzero((now > 0) & (np.abs(now - before) > tuned.STEADY)))
        return changed > tuned.CHANGED_SHARE * sum(camera.plate.known.size for camera in cameras)

    def plates(self, cameras: Sequence[CameraPlates], anew: bool) -> tuple[list[PlateImage], list[Surface]]:
        """What to learn: the cameras' plates, and virtual ones; and the surfaces that these show. anew: whether to find
        ``corrections`` first, as for a camera that has joined or stands somewhere else."""
        inverse = {camera.name: camera.inverse(self.pool) for camera in cameras}
        self._learned = inverse
        rough = [camera.surface(inverse[camera.name]) for camera in cameras]
        wrong = tuple(cameras[k].name for k in contradicting(rough))
        if wrong != self.wrong:
            log.warning("depth that contradicts the other cameras' is not used: %s", ", ".join(wrong) or "now none")
            self.wrong = wrong
        used = [camera for camera in cameras if camera.name not in wrong and inverse[camera.name].any()]
        measured = {c.name: c.surface(*smooth(inverse[c.name], c.plate.color, self.pool)) for c in used}
        if measured and (anew or not self.corrections.keys() >= measured.keys()):
            self._take_corrections(list(measured), register(list(measured.values())))
        surfaces = [self._corrected(c, measured.get(c.name)) for c in cameras]
        whole = _are_whole(cameras, surfaces)
        if not whole and len(cameras) <= self.stereo_cameras:
            surfaces, whole = self._filled(cameras, surfaces, anew)
        poses = [surface.pose for surface in surfaces]
        surfaces = [surface for surface in surfaces if surface.inverse.any()]
        plates = [
            camera.learned._replace(view=replace(camera.learned.view, camera_to_world=pose))
            for camera, pose in zip(cameras, poses)
        ]
        self.scene = SurfaceScene.of(surfaces) if surfaces else None
        if self.scene is not None:
            plates += virtual_plates(self.scene, surfaces, poses, whole, self.pool)
        return plates, surfaces

    def _sweep(self, stereo: PlateStereo, cameras: Sequence[CameraPlates], every: bool = False) -> bool:
        plates = {camera.name: self._corrected(camera, None) for camera in cameras}
        return stereo.sweep(plates, _distance_m(cameras), every)

    def _filled(
        self, cameras: Sequence[CameraPlates], surfaces: list[Surface], every: bool
    ) -> tuple[list[Surface], bool]:
        """The surfaces with depth by stereo and network where they have none. Whether what still has none is seen by no
        other camera. every: see ``PlateStereo.sweep``."""
        whole, measured = False, [surface.inverse > 0 for surface in surfaces]
        if len(cameras) >= of_layers.LEAST_CAMERAS:
            self.stereo = self.stereo or PlateStereo(self.pool)
            self._sweep(self.stereo, cameras, every)
            filled = self.stereo.fill({camera.name: surface for camera, surface in zip(cameras, surfaces)})
            if filled is not None:
                surfaces, whole = filled, True
                if not any(there.any() for there in measured):
                    surfaces = self._of_stereo_alone(cameras, filled, every)
        if self.network is not None:
            surfaces = self.network.fill([camera.name for camera in cameras], surfaces, measured, self.pool)
            whole = whole or _are_whole(cameras, surfaces)
        return surfaces, whole

    def _of_stereo_alone(self, cameras: Sequence[CameraPlates], surfaces: list[Surface], anew: bool) -> list[Surface]:
        """The surfaces that stereo has found, at corrected poses, with large planes continued where no network will say
        what is there. anew: see ``plates``."""
        names = [camera.name for camera in cameras]
        if anew or not self.corrections.keys() >= set(names):
            reported = [camera.reported for camera in cameras]
            self._take_corrections(names, register_stereo(surfaces, reported, _distance_m(cameras)))
            surfaces = [replace(s, pose=self.corrections[name].pose) for name, s in zip(names, surfaces)]
        if self.network is not None:
            return surfaces
        planes = large_planes(surfaces, np.random.default_rng([self.settings.seed, 8]))
        return [continued(surface, planes) for surface in surfaces]

    def _corrected(self, camera: CameraPlates, measured: Surface | None) -> Surface:
        """What a camera sees, where it stands. measured: None: without depth."""
        if measured is None:
            measured = camera.surface(np.zeros(camera.plate.known.shape, np.float32))
        found = self.corrections.get(camera.name)
        return measured if found is None else found.applied(measured)

    def _take_corrections(self, names: Sequence[str], found: Sequence[Correction]) -> None:
        before = self.displaced
        self.corrections = dict(zip(names, found)) if len(names) > 1 else {}
        for name, off in self.displaced.items():
            if name not in before:
                log.warning("%s %s", name, off)

    def first_gaussians(self, surfaces: Sequence[Surface], box: SceneBox) -> NDArray[np.float32] | None:
        """Parameters of the static field's first Gaussians; None: it has to find them itself."""
        if not surfaces:
            return None
        return first_gaussians(surfaces, box, self.settings, np.random.default_rng([self.settings.seed, 7]))

    # --- state --------------------------------------------------------------------------------

    def state(self) -> Arrays:
        """Everything needed to continue bit for bit."""
        mine: Arrays = {"wrong": np.array(self.wrong, dtype=np.str_)}
        mine |= {f"learned.{camera}": inverse for camera, inverse in self._learned.items()}
        for camera, found in self.corrections.items():
            mine[f"correction.{camera}"] = np.concatenate(
                [found.pose.ravel(), [found.scale, found.turn_deg, found.shift_m]]
            )
        if self.scene is not None:
            mine |= {"center": self.scene.center, **{f"meshes.{n}": a for n, a in self.scene.meshes._asdict().items()}}
        if self.stereo is not None:
            mine |= {f"stereo.{name}": array for name, array in self.stereo.state().items()}
        return {name: np.array(array) for name, array in mine.items()}

    def load_state(self, state: Arrays) -> None:
        """Continue from ``state``. KeyError: it lacks something."""
        self.wrong = tuple(str(camera) for camera in state["wrong"])
        self._learned = {n.removeprefix("learned."): np.array(a) for n, a in state.items() if n.startswith("learned.")}
        self.corrections, self.scene, self.stereo = {}, None, None
        stereo = {n.removeprefix("stereo."): array for n, array in state.items() if n.startswith("stereo.")}
        if stereo:
            self.stereo = PlateStereo(self.pool)
            self.stereo.load_state(stereo)
        for name, numbers in state.items():
            if name.startswith("correction."):
                pose, rest = np.array(numbers[:16]).reshape(4, 4), map(float, numbers[16:])
                self.corrections[name.removeprefix("correction.")] = Correction(pose, *rest)
        if "center" in state:
            meshes = Meshes(*(np.array(state[f"meshes.{name}"]) for name in Meshes._fields))
            self.scene = SurfaceScene(np.array(state["center"]), meshes)


def _are_whole(cameras: Sequence[CameraPlates], surfaces: Sequence[Surface]) -> bool:
    """Whether nearly all of what the plates show has depth."""
    known = sum(int(np.count_nonzero(camera.plate.known)) for camera in cameras)
    return sum(int(np.count_nonzero(s.depth())) for s in surfaces) >= (1.0 - tuned.MOST_HOLES) * known


def _distance_m(cameras: Sequence[CameraPlates]) -> float:
    """Of the cameras to the scene, by the poses that their frames say: corrections must not have stereo begin anew."""
    views = [replace(camera.plate.view, camera_to_world=camera.reported) for camera in cameras]
    return scene_box(views).distance_m


def warm_up() -> float:
    """Compile every kernel of depth, or load it from numba's cache; returns the seconds taken."""
    return compile_kernels(_run_kernels)


def _run_kernels(pool: Pool) -> None:
    """Run every kernel once, on a small wall."""
    lens, shape = Pinhole.from_fov(16, 16, 60.0), (16, 16)
    view = View("warm-up", np.zeros((*shape, 3), np.uint8), np.eye(4), lens)
    plate = PlateImage(view, np.zeros((*shape, 3), np.float32), np.ones(shape, bool))
    depth = DepthPlate.empty(*shape)
    for _ in range(tuned.LEAST):
        depth.take(np.ones(shape, np.float32), np.zeros(shape, bool))
    DepthSupervision(SplatSettings(), pool).plates([CameraPlates(plate, plate, depth, np.eye(4))], anew=True)
    box = scene_box([view])
    camera = FixedCamera(view, Plate(*shape), row=camera_rows([np.eye(4)], [lens], box), depth=depth)
    frame = Observation(0.0, "warm-up", replace(view, depth=depth.samples[..., 0].copy()), np.ones(shape, bool))
    frame.body_m = body_depth(frame, camera)
    seen_through([np.zeros((1, 3), np.float32)], [frame], {"warm-up": camera}, box)
    aside = np.eye(4)
    aside[0, 3] = 0.5
    nothing = np.zeros(shape, np.float32)
    walls = {
        str(k): CameraPlates(plate, plate, None, pose).surface(nothing) for k, pose in enumerate((np.eye(4), aside))
    }
    PlateStereo(pool).sweep(walls, 1.0)
