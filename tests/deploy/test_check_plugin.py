"""``freshfield check-plugin``: what keeps its contract passes, and each check can fail."""

import itertools
from pathlib import Path

import numpy as np
import pytest

from channel_emu.model import faults
from edge_server.scheduler import POLICIES, SelectionWindow
from freshfield.settings import Settings
from freshfield_up.cli import main
from tests.integration.own_classes import Darker, Flat, LastFirst, Late, Turning, Youngest

COUNT = itertools.count()
OWN = Path(__file__).parent.parent / "integration/own_classes.py"
# Effects: tests/camera_node/synthetic/effects/test_effects.py.
BUILT_IN = [("policy", name) for name in POLICIES] + [("fault", name) for name in faults.NAMES]
BUILT_IN += [("selector", name) for name in ("random", "coverage", "fisher")]
FAULTS = {"loss": "probability=0.5", "duplication": "probability=0.5", "corruption": "probability=0.5 count=3"}
FAULTS |= {"blackout": "windows_ms=[[0,50]]", "reset": "mean_interval_ms=100", "bandwidth": "megabits_per_s=1"}


class OnlyOpen(LastFirst):
    """Values nothing that is captured."""

    def values(self, state):
        return np.where(np.isin(np.arange(len(state.open)), state.order), np.nan, 1.0)


def painted(level):
    """A render of this level: a function of the field."""

    def render(self, camera_to_world, intrinsics):
        out = Flat.render(self, camera_to_world, intrinsics)
        out.color[:] = level(self)
        return out

    return render


def seen(self):
    return self.views[0].image.mean() / 255 if self.views else 0.0


def in_turn(self, transit):
    self.asked = getattr(self, "asked", 0) + 1
    return self.asked < 10


def take_views(self, state):
    self.views = state["level"].views


def first_of(share):
    return lambda self, epoch, window: tuple(epoch.generated_ns)[: share(epoch.generated_ns)]


LATE = SelectionWindow(wait_until_ns=24 * 3600 * 10**9)
NO_DEFAULT = type(Settings)("Params", (Settings,), {"__annotations__": {"ms": float}})
NO_COPY = {"render": painted(seen), "state": lambda s: {"level": s}, "load_state": take_views}
BASES = {"policy": Youngest, "effect": Darker, "fault": Late, "field": Flat, "selector": LastFirst, "source": Turning}
OWN_CLASSES = [(kind, f"{OWN}:{good.__name__}") for kind, good in BASES.items()]
# Kind -> name of a class -> how it differs from the good one, and what the command says.
BROKEN = {
    "source": {
        "Ends": ({"contents": 3, "content": lambda s, tick: tick}, "the first frames: content: expected 0 to contents"),
        "Picture": ({"read": lambda s, n: Turning.read(s, n).image}, "the first frames: read: expected a Shot"),
    },
    "policy": {
        "Patient": ({"plan": lambda *_: LATE}, "six cameras: plan: it waits for more than an hour"),
        "Nothing": ({"select": lambda *_: ()}, "one camera: select: expected a tuple of cameras, one at least"),
        "Changes": ({"select": first_of(lambda names: next(COUNT) % 7 or 1)}, "six cameras: two runs differ"),
        "AnyValue": ({"__init__": lambda s, value, rng: None}, "value out of range is refused: -1 is accepted"),
    },
    "effect": {
        "Floats": ({"apply": lambda s, image, *_: image / 2}, "a black image: image: expected array uint8 (12, 16, 3)"),
        "InPlace": ({"apply": lambda s, image, *_: np.subtract(image, 1, out=image)}, "a noisy image: an input was"),
    },
    "fault": {
        "Early": ({"extra_ns": lambda *_: -1}, "usual messages: extra_ns: expected nanoseconds from 0"),
        "InTurn": ({"loses": in_turn}, "does not depend on the order of questions: draw by the number"),
        "Demanding": ({"Params": NO_DEFAULT}, "is constructed: ScenarioError"),
    },
    "field": {
        "Bytes": ({"render": painted(lambda s: 255)}, "one camera: color: below 0, or above 1"),
        "Forgets": ({"render": painted(seen)}, "snapshots stay and states go on: load_state: it renders"),
        "Itself": (NO_COPY, "snapshots stay and states go on: snapshot: it changes"),
        "AnyState": ({"load_state": lambda *_: None}, "snapshots stay and states go on: load_state: the state of"),
    },
    "selector": {"OneValue": ({"values": lambda *_: np.zeros(1)}, "half captured: values: expected one a candidate")},
}
ROWS = [(kind, name, *row) for kind, rows in BROKEN.items() for name, row in rows.items()]
globals().update({name: type(BASES[kind])(name, (BASES[kind],), dict(has)) for kind, name, has, _ in ROWS})


@pytest.mark.parametrize(("kind", "name"), [*BUILT_IN, *OWN_CLASSES, ("selector", f"{__file__}:OnlyOpen")])
def test_what_keeps_its_contract_passes(kind, name, capsys):
    words = FAULTS[name].split() if name in FAULTS else []
    assert main(["check-plugin", kind, name, *words]) == 0, capsys.readouterr().out


@pytest.mark.parametrize(("kind", "name", "says"), [(kind, name, says) for kind, name, _, says in ROWS])
def test_each_check_can_fail(kind, name, says, capsys):
    assert main(["check-plugin", kind, f"{__file__}:{name}"]) == 1
    assert f"FAILED  {says}" in capsys.readouterr().out
