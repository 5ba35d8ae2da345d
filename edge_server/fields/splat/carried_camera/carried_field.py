"""The Gaussian field of hand-held cameras, live: a scan with sequential views.

``fit`` takes the newest view of each camera. Some become keyframes: a keyframe starts with the correction and the
exposure of its predecessor, and seeds Gaussians where the field lacks surfaces that its depth measures. Steps are
shared between the newest keyframes and all of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from edge_server.fields import SEPARATOR, View
from edge_server.fields.common.supervision import CameraMemory, check_view
from edge_server.fields.common.view_store import Arrays
from edge_server.fields.splat.carried_camera import carried_camera_constants as tuned
from edge_server.fields.splat.carried_camera import keyframe_choice
from edge_server.fields.splat.carried_camera.frame_stereo import sweep_depth
from edge_server.fields.splat.carried_camera.plausibility import agreeing, flat, moved_in, troubles, unturned
from edge_server.fields.splat.carried_camera.pose_alignment import Alignment, Rendered, align, gray
from edge_server.fields.splat.carried_camera.reported_poses import OwnMotion, guessed_poses, search
from edge_server.fields.splat.carried_camera.scan_field import ScanField, Shown, aim_of
from edge_server.fields.splat.carried_camera.seeds_on_depth import usable_depth
from edge_server.fields.splat.densification import opacity

# State of cameras and frames that a restarted field without measured depth keeps.
_OF_CAMERAS = ("_pixels", "_taken", "_blind", "_bare", "_seen", "_seen_m")
_COUNTS = ("_taken", "_blind", "_bare", "_took_at", "_due_before", "_pixels", "_measured")  # that a state keeps

_NO_DEPTH = "its frames tell no depth (it only turns, or sees plain walls): distances are guessed, move it sideways"


class CarriedField(ScanField):
    """See ``ScanField``. It asks for every frame, because only one in five may have depth."""

    frame_s = 0.0
    full_steps = np.inf

    def _forget_parameters(self) -> None:
        super()._forget_parameters()
        self._clear_views()
        self._pixels, self._taken = 0, 0  # of the largest image, and keyframes, so far
        self._blind = 0  # keyframes before the first ones that gave depth
        self._bare = True  # whether no keyframe so far shows anything
        self._took_at = 0  # step of the newest keyframe
        self._due_before = 0  # keyframes that were due before the restart, which resets the step count
        self._own = OwnMotion(self._poses)
        self._moving: dict[str, float] = {}  # share of a camera's newest keyframe where something moves
        self._depths: dict[str, View] = {}  # the newest keyframe of each camera that had depth
        self._measured = False  # whether any keyframe had depth
        self._seen: dict[str, View] = {}  # the last view of each camera that became a keyframe, as given

    def _ingest(self, views: Sequence[View]) -> None:
        for view in views:
            check_view(view)
        news = [view for view in views if self._is_new(view)]
        if news and (not self._views or (self._bare and not all(_is_bare(view) for view in news))):
            self.view_store.forget_scene()
            self._begin(news)
        due = self._due_before + keyframe_choice.due(self.step, len(self._seen), self._taken)
        for view in keyframe_choice.next_keyframes(news, self._seen, due):
            self._take(view)
        self._snapshot = None

    def _is_new(self, view: View) -> bool:
        known = self._seen.get(view.camera)
        return known is None or not (
            known.generated_ns == view.generated_ns and np.array_equal(known.image, view.image)
        )

    def _begin(self, views: Sequence[View]) -> None:
        """Find the scene's box: if depth is measured, its median is the distance of the scene."""
        self._data = self.view_store.add(views).data  # the first Gaussians may need its weights: none
        self.view_store.keep_box()
        box, depths = self.view_store.box, [usable_depth(view.depth) for view in views]
        assert box is not None
        measured = [(view, float(np.median(z[z > 0]))) for view, z in zip(views, depths) if z is not None]
        if measured and self.settings.center_m is None:
            distance_m = float(np.median([z for _, z in measured]))
            ahead = [v.camera_to_world[:3, 3] + v.camera_to_world[:3, 2] * distance_m for v, _ in measured]
            x, y, z = map(float, np.mean(ahead, axis=0))
            lens = measured[0][0].intrinsics
            box = replace(
                box, center_m=(x, y, z), radius_m=distance_m, distance_m=distance_m, pixel_m=distance_m / lens.fx
            )
            self.view_store.box = box
        self.view_store.forget_views()
        self._forget_parameters()

    def _clear_views(self) -> None:
        """Begin without keyframes."""
        self._views = ()
        self._aims: list[tuple[NDArray[np.float64], float]] = []

    def _take(self, reported: View) -> None:
        """Make a view a keyframe."""
        given = self._poses.taken_back(reported, reported.camera)
        view = replace(given, camera=f"{given.camera}{SEPARATOR}{self._taken}", depth=usable_depth(given.depth))
        last = self._seen.get(given.camera)
        if last is not None and not self._measured:
            self._own.of(given.camera).compare_turns(unturned(last, given))
        self._seen[given.camera] = given
        self._follow(view)
        shown = self._look(view)
        unseen = self._leaps_out_of_sight(reported, shown)
        reports = self._own.of(reported.camera)
        agrees = agreeing(view, shown, *self._exposures.of(view.camera))
        if self._rigid is not None and len(self.cloud) and (unseen or reports.doubted or agrees < tuned.SURE):
            placed = self._placed(view, shown, unseen)
            if placed is None and self._founded:
                self._leave_out(view)
                return
            view = placed or view
            self._seen[given.camera] = replace(given, camera_to_world=view.camera_to_world)
            shown = self._look(view)
        else:
            reports.trust()
        self._taken += 1
        self._bare &= _is_bare(view)
        self._pixels = max(self._pixels, view.image.shape[0] * view.image.shape[1])
        view = self._without_what_moves(view)
        if self._rigid is not None and len(self.cloud):
            self._expose(view, shown)
        self._measured |= view.depth is not None
        if not self._measured and len(self.cloud):
            view = replace(view, depth=self._sweep(view))
            if not self._founded and view.depth is not None and self._taken - self._blind > tuned.BEGINS[-1]:
                self._blind = self._taken - tuned.BEGINS[0]
        if view.depth is not None:
            seeds = self._seeds_of(view, shown, nearer=self._measured)
            self._make_room(len(seeds))
            self._add(seeds)
        self._append(view, self._aim(view, shown))
        if not self._measured and self._taken - self._blind in tuned.BEGINS:
            self._begin_anew()
        self._took_at = self.step
        h, w = view.image.shape[:2]
        while len(self._views) > keyframe_choice.most_kept(h * w):
            self._drop(keyframe_choice.least_needed([v.camera_to_world for v in self._views], self._distance_m()))

    @property
    def _founded(self) -> bool:
        """Whether any depth was measured or found by stereo. A camera that only turns gives none, nor does a bare wall,
        which matches at any depth: the field is then a guess, with which frames need not agree."""
        return self._measured or (self._seen_m > 0.0 and not self._bare)

    def _sweep(self, view: View) -> NDArray[np.float32] | None:
        """Depth of a view from neighboring keyframes, at the estimated poses."""
        posed = [replace(other, camera_to_world=self._pose_of(other)) for other in (view, *self._views)]
        return usable_depth(sweep_depth(posed[0], posed[1:], self._seen_m or self._distance_m(), self.pool))

    def _distance_m(self) -> float:
        assert self.view_store.box is not None
        return self.view_store.box.distance_m

    def _follow(self, view: View) -> None:
        """Start with the correction and the exposure of the previous keyframe."""
        if self._rigid is None:
            return
        track = _carrier(view)
        before = self._poses.neighbors_in_time(view, track)
        self._poses.begin(view, track)
        if before:
            self._exposures.known[view.camera] = self._exposures.between(before)

    def _track(self, view: View, prior: float | None = None) -> Alignment:
        """Correct the pose of a view by image alignment. prior: see ``align``."""
        frame = gray(view.image)
        for _ in range(tuned.ALIGNMENTS):
            found = align(self._rendered(view, self._pose_of(view)), frame, view.camera_to_world, prior=prior)
            self._poses.set_pose(view, found.pose)
        return found

    def _leaps_out_of_sight(self, view: View, shown: Shown) -> bool:
        """Whether the reported pose of a view is far from the one before, where the field shows hardly anything."""
        seen = (shown.opacity >= tuned.ALIGNED_OPACITY).mean()
        leaps = self._own.leaps(view, view.camera) and seen < tuned.LEAST_OVERLAP and self._founded
        if leaps and self._measured:
            self._own.of(view.camera).doubts += 1
        return leaps

    def _placed(self, view: View, shown: Shown, unseen: bool) -> View | None:
        """A view at its estimated pose: near the reported one, else near the view before. None: its image is not
        consistent with the field there. unseen: see ``_leaps_out_of_sight``."""
        camera = _carrier(view)
        reports = self._own.of(camera)
        if reports.astray:
            if reports.fit_again(not flat(view, shown) and self._track(view).fits):
                return view
            found = self._search(view)
            if found is not None:
                return self._own.located(view, camera, *found)
            return self._own.lost(view, camera, self._has_depth_of(view) is not None)
        if flat(view, shown):
            return None
        begun = self._pose_of(view)
        tracked = self._track(view)
        after_leap = self._own.after_leap(view, camera)
        if after_leap is not None:
            known = self._poses.known[view.camera]
            self._poses.begin(after_leap, camera)
            fits = not tracked.fits and self._fits_after_leap(after_leap)
            if self._own.try_leap(camera, tracked.fits, fits):
                return after_leap
            if fits:
                return None
            self._poses.known[view.camera] = known
        leapt, least = False, tuned.DOUBTFUL if self._measured else tuned.LOCATED
        doubtful = tracked.overlap >= tuned.LEAST_OVERLAP and tracked.agreeing < least
        if unseen or (doubtful and self._founded):
            found = self._search(view)
            if found is not None and found[1] != 1.0:
                if self._measured and tracked.agreeing >= tuned.LEAST_AGREEING and not unseen:
                    reports.doubts += 1
                if reports.astray:
                    return self._own.located(view, camera, *found)
                if not tracked.fits:
                    again = self._search(view, goes_on=tuned.FOLLOWED) or found
                    leapt = self._own.suggest_leap(view, camera, begun, again[0])
            elif found is not None and not unseen:
                reports.trust()
        if unseen and self._measured:
            return None
        return view if self._plausible(view, tracked, leapt) else None

    def _fits_after_leap(self, view: View) -> bool:
        """Whether a view fits at the pose after a leap: to the field, or to the previous keyframe, since a camera that
        moved on sees places that the field does not contain yet."""
        there = self._track(view, tuned.GUESSED_ERROR)
        if there.fits:
            return True
        found = self._search(view, [there.pose])
        if found is None or not self._poses.within(there.pose, found[0], 1.0):
            return False
        self._poses.set_pose(view, found[0])
        return True

    def _has_depth_of(self, view: View) -> View | None:
        """The newest keyframe with depth of a view's camera, if it was taken not long before."""
        last, before = self._depths.get(_carrier(view)), self._own.before(view, _carrier(view))
        recent = last is not None and bool(before) and last.generated_ns >= before[0].at_ns
        return last if recent else None

    def _search(
        self, view: View, guesses: Sequence[NDArray[np.float64]] = (), goes_on: float = 0.0
    ) -> tuple[NDArray[np.float64], float] | None:
        """See ``reported_poses.search``. guesses: none: see ``guessed_poses``."""
        last, before = self._has_depth_of(view), self._own.before(view, _carrier(view))
        if last is not None and (z := last.depth) is not None:
            kept = Rendered(self._pose_of(last), last.intrinsics, gray(last.image), z, np.ones_like(z))
        elif before and (newest := [each for each in self._views if _carrier(each) == _carrier(view)]):
            kept = self._rendered(newest[-1], self._pose_of(newest[-1]))._replace(gray=gray(newest[-1].image))
        else:
            return None
        guesses = guesses or guessed_poses(view, before)
        return search(view, kept, before, guesses, self._poses, lambda pose: self._rendered(view, pose), goes_on)

    def _rendered(self, view: View, pose: NDArray[np.float64]) -> Rendered:
        shown, lens = self._look(view, tuned.RENDERED_HALVINGS, pose), view.intrinsics.halved(tuned.RENDERED_HALVINGS)
        return Rendered(pose, lens, gray(shown.color), shown.depth, shown.opacity)

    def _plausible(self, view: View, found: Alignment, leapt: bool) -> bool:
        """Whether a view is consistent with the field, or is accepted because too many in a row were not."""
        reports = self._own.of(_carrier(view))
        fits = found.overlap < tuned.LEAST_OVERLAP or found.agreeing >= tuned.LEAST_AGREEING
        taken = (fits and not leapt) or reports.left_out_in_a_row >= tuned.PATIENCE
        reports.left_out_in_a_row = 0 if taken else reports.left_out_in_a_row + 1
        reports.suggested = None if taken else reports.suggested
        return taken

    def _leave_out(self, view: View) -> None:
        self._own.of(_carrier(view)).left_out += 1
        self._poses.forget(view.camera)
        self._exposures.known.pop(view.camera, None)

    def _without_what_moves(self, view: View) -> View:
        """The view, with weight 0 where an object has appeared since the last keyframe with depth."""
        camera = _carrier(view)
        before, self._moving[camera] = self._depths.get(camera), 0.0
        if view.depth is None:
            return view
        self._depths[camera] = view
        if before is None:
            return view
        moved = moved_in(view, self._pose_of(view), before, self._pose_of(before))
        share = float(moved.mean())
        if share < tuned.MOVED_LEAST:
            return view
        self._moving[camera] = share
        return replace(view, weight=(~moved).astype(np.float32))

    @property
    def troubles(self) -> tuple[str, ...]:
        """Problems of the cameras' frames and poses, in words."""
        with self._lock:
            left_out = [
                f"{camera}: {known.left_out} frames left out: they show something else than their poses say"
                for camera, known in self._own.cameras.items()
                if known.left_out
            ]
            moving = [
                f"{camera}: something moves in {100 * share:.0f} % of its picture: left out of learning"
                for camera, share in self._moving.items()
                if share > 0.0
            ]
            located = self._own.troubles()
            poses = troubles(self._poses) if self._rigid is not None else []
            guessed = self._taken > tuned.BEGINS[-1] and not self._founded
            blind = [camera for camera in self._seen if guessed and not self._own.of(camera).have_no_rotation]
            unknown = [f"{camera}: {_NO_DEPTH}" for camera in blind]
        return (*left_out, *located, *moving, *poses, *unknown)

    def _begin_anew(self) -> None:
        """Restart with Gaussians seeded from all keyframes so far: without depth, the first few hold little information
        and later ones do not repair a field fitted to them. The depth found also updates the box and the poses: steps
        that overestimate the scene's distance overshoot. If none is found, the box stays."""
        swept = {view.camera: view for view in self._sweep_views()}
        self._learn_distance(list(swept.values()))
        views, kept = [swept.get(v.camera, v) for v in self._views], {name: getattr(self, name) for name in _OF_CAMERAS}
        due = self._due_before + self.step // tuned.STEPS_A_KEYFRAME
        cameras, leaps = self._own.cameras.items(), self._poses.leaps
        self._begin(views)
        self._own.cameras, self._poses.leaps = {camera: known.begun_anew() for camera, known in cameras}, leaps
        for name, value in kept.items():
            setattr(self, name, value)
        self._due_before = due
        for view in views:
            self._follow(view)
            self._append(view, self._aim(view, None))
        if swept:
            self._seed_on([view for view in views if view.camera in swept], nearer=False)
        else:
            self._seen_m = 0.0  # the distance found by an earlier start does not apply to this one's guesses
            self._seed()

    def _append(self, view: View, aim: tuple[NDArray[np.float64], float]) -> None:
        """Add a view to the training views. Its depth is no longer needed."""
        view = replace(view, depth=None)
        self._views = (*self._views, view)
        moved = None if view.weight is None else view.weight == 0.0
        self.view_store.memory[view.camera] = CameraMemory(view, moved)
        self._aims.append(aim)

    def _aim(self, view: View, shown: Shown | None) -> tuple[NDArray[np.float64], float]:
        """The input of ``PoseCorrections.descend`` for a view."""
        if view.depth is None and shown is not None:
            view = replace(view, depth=np.where(shown.opacity >= tuned.COVERED, shown.depth, np.float32(0.0)))
        return aim_of(view, self._distance_m())

    def _expose(self, view: View, shown: Shown) -> None:
        """Find the exposure of a view at its first rendering, from consistent pixels."""
        gain, bias = self._exposures.of(view.camera)
        image = view.image[::2, ::2, :3].reshape(-1, 3) / 255.0
        rendered = shown.color[::2, ::2].reshape(-1, 3).astype(np.float64)
        error = np.abs(rendered * gain + bias - image).mean(axis=1)
        usual = (shown.opacity[::2, ::2].reshape(-1) > tuned.EXPOSED_OPACITY) & (error < tuned.EXPOSED_ERROR)
        if usual.mean() < tuned.EXPOSED_SHARE:
            return
        r, t = rendered[usual], (image[usual] - bias) / gain
        sums = np.stack([np.ones_like(r), r, r * r, t, r * t]).sum(axis=1).T
        self._exposures.learn(view.camera, sums, whole=True)

    def _drop(self, k: int) -> None:
        """Remove a keyframe from training. Its correction stays, for held-out and late frames of its time."""
        gone = self._views[k]
        self._views = (*self._views[:k], *self._views[k + 1 :])
        del self.view_store.memory[gone.camera], self._aims[k]
        for name in list(self._poses.known)[: -tuned.KEPT_CORRECTIONS]:
            if name not in self.view_store.memory:
                self._poses.forget(name)
                self._exposures.known.pop(name, None)

    # --- what the field asks for --------------------------------------------------------------

    def _next_view(self) -> int:
        return keyframe_choice.next_view(self._rng(7), len(self._views), len(self._seen), self.step - self._took_at)

    def _pixels_of(self, view: int) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        one = self._views[view]
        weight = np.zeros((0, 0), np.float32) if one.weight is None else one.weight
        return np.ascontiguousarray(one.image), np.ascontiguousarray(weight)

    def _most(self) -> int:
        return min(super()._most(), max(int(tuned.PER_PIXEL * self._pixels), tuned.LEAST))

    def _grow(self) -> None:
        if len(self.cloud) < tuned.GROWN_UPTO * self._most():
            super()._grow()

    def _make_room(self, count: int) -> None:
        """Remove the least visible Gaussians (faint and small), until ``count`` more may be added."""
        surplus = len(self.cloud) + min(count, self._most()) - self._most()
        if surplus > 0:
            shows = opacity(self.cloud.params) * np.maximum(self.cloud.reach, np.float32(1e-9))
            kept = np.ones(len(shows), np.bool_)
            kept[np.argsort(shows, kind="stable")[:surplus]] = False
            self.cloud.keep(kept)

    def _counters(self) -> dict[str, Any]:
        counts = {name[1:]: getattr(self, name) for name in _COUNTS}
        depths = {camera: view.camera for camera, view in self._kept_depths()}
        return {**super()._counters(), **counts, "own_motion": self._own.meta(), "depths": depths}

    def _kept_depths(self) -> list[tuple[str, View]]:
        return [(camera, view) for camera, view in self._depths.items() if view.camera in self.view_store.memory]

    def _arrays(self) -> Arrays:
        aims = [np.append(normal, pixel_m) for normal, pixel_m in self._aims]
        depths = {f"depth_{k}": np.asarray(view.depth) for k, (_, view) in enumerate(self._kept_depths())}
        return {**super()._arrays(), **depths, "aims": np.stack(aims) if aims else np.zeros((0, 37))}

    def _load(self, meta: dict[str, Any], state: Arrays) -> None:
        super()._load(meta, state)
        for name in _COUNTS:
            setattr(self, name, type(getattr(self, name))(meta[name[1:]]))
        self._own.load(meta["own_motion"])
        self._clear_views()
        views, aims = self.view_store.views, np.asarray(state["aims"], np.float64)
        if aims.shape != (len(views), 37) or not np.isfinite(aims).all():
            raise ValueError(f"the state's aims must be (V, 37) of {len(views)} keyframes, not {aims.shape}")
        for view, aim in zip(views, aims):
            moved = self.view_store.memory[view.camera].moved
            view = view if moved is None else replace(view, weight=(~moved).astype(np.float32))
            self._append(view, (aim[:36].reshape(6, 6), float(aim[36])))
            self._seen[_carrier(view)] = view
        for k, (camera, name) in enumerate(meta["depths"].items()):
            view = self.view_store.memory[name].view
            depth = np.array(state[f"depth_{k}"], np.float32)
            if depth.shape != view.image.shape[:2]:
                raise ValueError(f"the state's depth_{k} must be {view.image.shape[:2]}, not {depth.shape}")
            self._depths[camera] = replace(view, depth=depth, weight=None)


def _carrier(view: View) -> str:
    """The camera that took a keyframe."""
    return view.camera.rpartition(SEPARATOR)[0]


def _is_bare(view: View) -> bool:
    """Whether a view shows nothing: a bare wall, a hand or a cap on the lens. Alone, it determines neither place nor
    size of the scene."""
    return bool(gray(view.image).std() < tuned.BARE)


make = CarriedField
