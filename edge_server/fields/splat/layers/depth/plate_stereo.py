"""Depth of plates by stereo, where no sensor measures it: see ``stereo``."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from edge_server.fields.common.threads.thread_pool import Pool
from edge_server.fields.field_constants import SAME_POSE
from edge_server.fields.splat.kernels.semi_global import UNKNOWN
from edge_server.fields.splat.layers.depth import layer_depth_constants as tuned
from edge_server.fields.splat.layers.depth.depth_plate import smooth
from edge_server.fields.splat.layers.depth.surfaces import Surface
from edge_server.fields.splat.layers.layer_constants import CHANGED
from edge_server.fields.splat.stereo import match_depths
from freshfield.geometry import Pinhole, seen_from

Image = NDArray[np.float32]

_KEPT = ("images", "poses", "found")  # of a state, by camera


class PlateStereo:
    """Depth of plates from one another, kept: a camera is swept again once its own plate or pose, or that of a camera
    that it is compared with, differs enough from what was swept.

    Matching uses the plates as they were when they last differed, so what it finds does not change between sweeps.
    """

    def __init__(self, pool: Pool) -> None:
        self.pool = pool
        self._distance_m = 0.0
        self._images: dict[str, Image] = {}  # camera -> its plate as it is matched
        self._poses: dict[str, NDArray[np.float64]] = {}
        self._found: dict[str, Image] = {}  # camera -> inverse depths, before others confirm them
        self._due: list[str] = []  # cameras to be swept

    def sweep(self, plates: Mapping[str, Surface], distance_m: float, every: bool = False) -> bool:
        """Sweep every camera that never was, or else at most one of those that are due: an update that needs many is
        not held up. Returns whether that was the last one.

        plates: of all cameras; what they know of depth is not used. Those of more than ``SWEEP_PIXELS`` are matched
            smaller.
        distance_m: of the cameras to the scene.
        every: whether to sweep all that are due, as for a field that begins anew.
        """
        lenses = {name: _lens(s) for name, s in plates.items()}
        self._take(plates, lenses, distance_m)
        now = self._due if every else [name for name in self._due if name not in self._found] or self._due[:1]
        for name in now:
            self._found[name] = self._match(name, lenses)
        self._due = [name for name in self._due if name not in now]
        return bool(now) and not self._due

    def inverses(self, plates: Mapping[str, Surface]) -> list[Image]:
        """Inverse depth of each plate that was swept, float32 (H, W), 1 / m along the optical axis; 0 where the plate
        is unknown, where no depth fits best, or where no other plate's depth confirms it."""
        lenses, poses = [_lens(s) for s in plates.values()], [self._poses[name] for name in plates]
        found = [self._found[name] for name in plates]
        out = []
        for k, surface in enumerate(plates.values()):
            size = surface.known.shape[::-1]
            inverse = cv2.resize(_confirmed(k, lenses, poses, found), size, interpolation=cv2.INTER_NEAREST)
            out.append(np.where(surface.known, inverse, 0.0).astype(np.float32))
        return out

    def fill(self, plates: Mapping[str, Surface]) -> list[Surface] | None:
        """The plates that were swept, with the depth that stereo finds where they have none; None where it cannot be
        believed: it finds little, or sensors measured something else at too many of its pixels."""
        swept, surfaces = self.inverses(plates), list(plates.values())
        if sum(map(np.count_nonzero, swept)) < tuned.SWEEP_LEAST * sum(np.count_nonzero(s.known) for s in surfaces):
            return None
        pairs = [np.stack([s.inverse, found])[:, (s.inverse > 0) & (found > 0)] for s, found in zip(surfaces, swept)]
        measured, ours = np.concatenate(pairs, axis=1)
        agree = np.count_nonzero(np.abs(np.log(ours / measured)) < tuned.SWEEP_AGREE)
        if agree < tuned.SWEEP_TRUSTED * len(ours):
            return None
        out, noise = [], tuned.SWEEP_NOISE / (tuned.SWEEP_STEPS * tuned.SWEEP_NEAR * self._distance_m)
        for surface, found in zip(surfaces, swept):
            inverse, slope = smooth(found, surface.color, self.pool, noise)
            known = surface.inverse > 0
            inverse = np.where(known, surface.inverse, inverse)
            out.append(replace(surface, inverse=inverse, slope=np.where(known[..., None], surface.slope, slope)))
        return out

    def _take(self, plates: Mapping[str, Surface], lenses: Mapping[str, Pinhole], distance_m: float) -> None:
        """Take over the plates that differ from those kept, and note which cameras are to be swept again."""
        if distance_m != self._distance_m:  # another camera: depths are looked for in another range
            self._distance_m, self._due = distance_m, []
            self._images, self._poses, self._found = {}, {}, {}
        changed = [name for name in self._images if name not in plates]
        for name in changed:
            del self._images[name], self._poses[name]
            self._found.pop(name, None)
        for name, surface in plates.items():
            image = _prepare(surface, lenses[name])
            moved = np.abs(self._poses[name] - surface.pose).max() if name in self._poses else np.inf
            if moved > tuned.SWEEP_ELSEWHERE:
                self._found.pop(name, None)
            if moved > SAME_POSE or _differ(self._images[name], image):
                self._images[name], self._poses[name] = image, surface.pose.copy()
                changed.append(name)
        if changed:
            near = {name: self._compared(name, lenses) for name in plates}
            gone = any(name not in plates for name in changed)
            due = [name for name in plates if gone or name in changed or set(near[name]) & set(changed)]
            self._due = [name for name in self._due if name in plates and name not in due] + due

    def _compared(self, name: str, lenses: Mapping[str, Pinhole]) -> list[str]:
        """The cameras whose plates tell the depth of a camera's plate."""
        here, nearest_m = self._poses[name], tuned.SWEEP_NEAR * self._distance_m
        parallax_px = {other: _parallax_px(self._poses[other], here, lens) for other, lens in lenses.items()}
        return [other for other, px in parallax_px.items() if px / nearest_m >= tuned.SWEEP_LEAST_PX]

    def _match(self, name: str, lenses: Mapping[str, Pinhole]) -> Image:
        """Sweep a camera: inverse depth, float32 (H, W), 1 / m, 0 where none fits best."""
        image, lens, others = self._images[name], lenses[name], self._compared(name, lenses)
        if not others:
            return np.zeros(image.shape[1:], np.float32)
        flat = np.zeros((len(others), 3, max(self._images[other][0].size for other in others)), np.float32)
        for row, other in zip(flat, others):
            row[:, : self._images[other][0].size] = self._images[other].reshape(3, -1)
        cameras = [(self._poses[other], lenses[other]) for other in others]
        steps = np.linspace(0.0, 1.0 / (tuned.SWEEP_NEAR * self._distance_m), tuned.SWEEP_STEPS).astype(np.float32)
        return match_depths(image, self._poses[name], lens, flat, cameras, steps, self.pool)

    # --- state --------------------------------------------------------------------------------

    def state(self) -> dict[str, NDArray[Any]]:
        """Everything needed to continue bit for bit."""
        mine: dict[str, NDArray[Any]] = {"due": np.array(self._due, np.str_), "distance_m": np.array(self._distance_m)}
        for name in _KEPT:
            mine |= {f"{name}.{camera}": array for camera, array in getattr(self, f"_{name}").items()}
        return mine

    def load_state(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Continue from ``state``. KeyError: it lacks something."""
        self._due, self._distance_m = [str(camera) for camera in state["due"]], float(state["distance_m"])
        for name in _KEPT:
            arrays = {
                key.removeprefix(f"{name}."): np.array(a) for key, a in state.items() if key.startswith(f"{name}.")
            }
            setattr(self, f"_{name}", arrays)


def _differ(before: Image, now: Image) -> bool:
    """Whether two plates, see ``_prepare``, differ enough to change what stereo finds."""
    differ = np.abs(before - now).max(axis=0) > np.float32(CHANGED / 255.0)  # also where one of them is UNKNOWN
    return bool(np.count_nonzero(differ) > tuned.CHANGED_SHARE * differ.size)


def _lens(surface: Surface) -> Pinhole:
    """The plate's lens, at the resolution at which it is matched."""
    factor = np.sqrt(tuned.SWEEP_PIXELS / surface.known.size)
    return surface.lens.scaled(factor) if factor < 1.0 else surface.lens


def _prepare(surface: Surface, lens: Pinhole) -> Image:
    """The plate's colors in [0, 1], or UNKNOWN, float32 (3, H, W), blurred as interpolation will blur the others'."""
    known = surface.known & np.isfinite(surface.color).all(axis=2)
    rgba = np.dstack([np.where(known[..., None], np.clip(surface.color / 255.0, 0.0, 1.0), 0.0), known])
    small = cv2.resize(rgba.astype(np.float32), (lens.width, lens.height), interpolation=cv2.INTER_AREA)
    color = np.clip(cv2.GaussianBlur(small[..., :3], (0, 0), tuned.SWEEP_BLUR_PX), 0.0, 1.0)
    color[cv2.blur(small[..., 3], (3, 3)) < 1.0 - 1e-3] = UNKNOWN
    return np.ascontiguousarray(color.transpose(2, 0, 1), dtype=np.float32)


def _parallax_px(a: NDArray[np.float64], b: NDArray[np.float64], lens: Pinhole) -> float:
    """Parallax of a point 1 m away from cameras at poses a and b; 0 for images of one row or column."""
    wide = min(lens.width, lens.height) > 1
    return float(np.linalg.norm(a[:3, 3] - b[:3, 3])) * lens.fx if wide else 0.0


def _confirmed(k: int, lenses: Sequence[Pinhole], poses: Sequence[NDArray], inverses: Sequence[Image]) -> Image:
    """Inverse depth k where another camera's depth agrees within ``SWEEP_AGREE``, else 0. One so near to camera k that
    it would see no difference cannot."""
    there, rays = inverses[k] > 0, lenses[k].rays()
    depth = np.where(there, 1.0 / np.where(there, inverses[k], 1.0), 0.0)
    points = (rays * (depth / rays[..., 2])[..., None]) @ poses[k][:3, :3].T + poses[k][:3, 3]
    points, depth, agree = points.reshape(-1, 3), depth.ravel(), np.zeros(depth.size, bool)
    for j, (lens, pose) in enumerate(zip(lenses, poses)):
        if j == k:
            continue
        local, at, inside = seen_from(lens, pose, points)
        inside &= there.ravel()
        column, row = np.where(inside[:, None], at, 0.0).astype(np.int64).T
        ratio = np.where(inside, local[:, 2], 1.0) * inverses[j][row, column]
        near = np.abs(np.log(np.maximum(ratio, 1e-9))) < tuned.SWEEP_AGREE
        agree |= inside & near & (depth <= _parallax_px(poses[k], pose, lens) / tuned.SWEEP_FAR_PX)
    return np.where(agree.reshape(there.shape), inverses[k], np.float32(0.0))
