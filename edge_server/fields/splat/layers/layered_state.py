"""The state of a ``LayeredField`` as plain arrays: its parts, its cameras, the frames of the last second."""

from __future__ import annotations

import json
from collections import deque
from dataclasses import asdict, replace
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from edge_server.fields import View
from edge_server.fields.common.field_state import unpack_meta
from edge_server.fields.common.supervision import check_view
from edge_server.fields.splat.field import StillField
from edge_server.fields.splat.layers.layer_constants import FRAMES_KNOWN
from edge_server.fields.splat.layers.motion import ViewRow
from edge_server.fields.splat.layers.observations import FixedCamera, Observation, Observations
from edge_server.fields.splat.layers.plates import FinePlate, Plate
from edge_server.fields.splat.layers.static_layer import StaticLayer
from edge_server.fields.splat.layers.static_supervision import StaticSupervision
from freshfield.geometry import Pinhole

Arrays = dict[str, NDArray[Any]]

NAME = "splat in layers"
VERSION = 13
COUNTERS = ("layered", "origin_ns")  # of the field
# Of its supervision.
SUPERVISED = ("plates_s", "fine_s", "fine", "exposure_rounds", "anew", "with_depth", "early", "plain", "layers_shown")
TRACKED = ("anchors_s", "seeded_s", "fits")  # of its tracker
OF_CAMERA = ("newest_s", "rendered_step", "moves", "anew", "depth_scale", "looked_ns", "began_ns")
ARRAYS_OF_CAMERA = ("away", "depth_m", "reported", "bumped")  # or None


def pack(field: Any) -> Arrays:
    """The state in one dictionary of copies, without derived data: renderings from a frame's alignment are used only
    until the next one, within a call."""
    state: Arrays = {}
    cameras, observations = [], []
    for k, camera in enumerate(field.cameras.values()):
        view = camera.view
        lens, taken = asdict(view.intrinsics), list(camera.taken)
        cameras.append({**_facts(view), **_numbers(camera, OF_CAMERA), "taken": taken, "lens": lens})
        arrays = {"image": view.image, "pose": view.camera_to_world, **_prefixed("plate.", camera.plate.state())}
        if camera.fine is not None:
            arrays |= _prefixed("fine.", camera.fine.state())
        if camera.depth is not None:
            arrays |= _prefixed("depth.", camera.depth.state())
        arrays["turns"] = np.reshape(camera.turns, (-1, 3, 3))
        arrays |= {name: array for name in ARRAYS_OF_CAMERA if (array := getattr(camera, name)) is not None}
        state |= _prefixed(f"camera_{k}.", arrays)
    for k, o in enumerate(field.observations):
        observations.append({**_facts(o.view), "instant_s": o.instant_s, "fresh": o.fresh})
        arrays = {"image": o.view.image, "foreground": o.foreground}
        given = {"given": o.view.weight, "depth": o.view.depth, "body_m": o.body_m}
        arrays |= {name: array for name, array in given.items() if array is not None}
        if o.weight is not None:
            arrays["weight"] = o.weight
        if o.row is not None:
            arrays |= {"matrix": o.row.matrix, "vector": o.row.vector, "around": o.row.around}
        state |= _prefixed(f"frame_{k}.", arrays)
    state |= _prefixed("still.", field.still.state()) | _prefixed("static.", field.static.state())
    if field.supervision.depth is not None:
        state |= _prefixed("depth.", field.supervision.depth.state())
    if (earlier := field.supervision.earlier) is not None:
        state |= {"earlier": earlier.params.copy(), "earlier_step": np.array(earlier.step)}
    tracked = None
    if field.tracker is not None:
        state |= _prefixed("moving.", field.tracker.moving.state())
        tracked = _numbers(field.tracker, TRACKED)
    meta = {
        "version": VERSION,
        "field": NAME,
        "settings": msgspec.structs.asdict(field.settings),
        **_numbers(field, COUNTERS),
        **_numbers(field.supervision, SUPERVISED),
        "refused": sorted(field.refused),
        "tracked": tracked,
        "cameras": cameras,
        "frames": observations,
    }
    return {"meta": np.array(json.dumps(meta)), **{name: np.array(array) for name, array in state.items()}}


def unpack(field: Any, state: Arrays) -> None:
    """Restore ``field`` from the output of ``pack``. Raises ValueError, KeyError or TypeError for another state."""
    meta = unpack_meta(field.settings, state, NAME, ("sh_degree",), VERSION)
    field.still = StillField(field.settings, field.pool)
    field.still.load_state(_under("still.", state))
    field.static = StaticLayer(field.still)
    field.static.load_state(_under("static.", state))
    field.supervision = StaticSupervision(field.static, field.depth_network)
    if "depth.wrong" in state:
        field.supervision.make_depth().load_state(_under("depth.", state))
    field.cameras, field.observations, field.tracker = {}, Observations(), None
    for k, facts in enumerate(meta["cameras"]):
        arrays = _under(f"camera_{k}.", state)
        lens = {**facts["lens"], "distortion": tuple(facts["lens"]["distortion"])}
        image, pose = np.array(arrays["image"]), np.array(arrays["pose"])
        view = View(facts["camera"], image, pose, Pinhole(**lens), facts["generated_ns"])
        check_view(view)
        plate = Plate(view.image.shape[0], view.image.shape[1])
        plate.load_state(_under("plate.", arrays))
        fine = FinePlate.from_state(view, _under("fine.", arrays)) if "fine.color" in arrays else None
        camera = FixedCamera(view, plate, fine=fine, taken=deque(facts["taken"], maxlen=FRAMES_KNOWN))
        camera.turns = list(np.array(arrays["turns"]))
        for name in ARRAYS_OF_CAMERA:
            setattr(camera, name, np.array(arrays[name]) if name in arrays else None)
        _set(camera, OF_CAMERA, facts)
        if "depth.count" in arrays:
            field.supervision.make_depth_plate(camera).load_state(_under("depth.", arrays))
        field.cameras[view.camera] = camera
    for k, facts in enumerate(meta["frames"]):
        field.observations.add(_observation(field, facts, _under(f"frame_{k}.", state)))
    _set(field, COUNTERS, meta)
    _set(field.supervision, SUPERVISED, meta)
    if "earlier" in state:
        params, now = np.array(state["earlier"]), field.still.snapshot()
        if params.ndim != 2 or params.shape[1:] != now.params.shape[1:] or params.dtype != np.float32:
            raise ValueError("what was shown before layers are is damaged")
        field.supervision.earlier = replace(now, params=params, step=int(state["earlier_step"]))
    field.refused = set(meta["refused"])
    if meta["tracked"] is not None:
        if field.still.view_store.box is None:
            raise ValueError("the state has a moving set but no scene box")
        field.make_tracker()
        field.tracker.moving.load_state(_under("moving.", state))
        _set(field.tracker, TRACKED, meta["tracked"])
    field.finish_loading()


def _set(owner: Any, names: tuple[str, ...], values: dict[str, Any]) -> None:
    for name in names:
        value = values[name]
        setattr(owner, name, -np.inf if value is None and name.endswith("_s") else value)


def _observation(field: Any, facts: dict[str, Any], arrays: Arrays) -> Observation:
    found = {name: np.array(array) for name, array in arrays.items()}
    view = replace(
        field.cameras[facts["camera"]].view,
        image=found["image"],
        generated_ns=facts["generated_ns"],
        weight=found.get("given"),
        depth=found.get("depth"),
    )
    row = None
    if "matrix" in found:
        row = ViewRow(facts["instant_s"], found["matrix"], found["vector"], found["around"])
    return Observation(
        facts["instant_s"],
        view.camera,
        view,
        found["foreground"],
        found.get("weight"),
        row,
        body_m=found.get("body_m"),
        fresh=facts["fresh"],
    )


def _facts(view: View) -> dict[str, Any]:
    return {"camera": view.camera, "generated_ns": view.generated_ns}


def _numbers(owner: Any, names: tuple[str, ...]) -> dict[str, float | int | bool | None]:
    """Attributes as JSON can hold them: None for an infinite number."""
    values = {name: getattr(owner, name) for name in names}
    return {name: None if value is None or not np.isfinite(value) else value for name, value in values.items()}


def _prefixed(prefix: str, arrays: Arrays) -> Arrays:
    return {prefix + name: array for name, array in arrays.items()}


def _under(prefix: str, state: Arrays) -> Arrays:
    return {name[len(prefix) :]: array for name, array in state.items() if name.startswith(prefix)}
