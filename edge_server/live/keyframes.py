"""Earlier viewpoints of cameras that move go on supervising: one camera on an arm is many cameras in time.

The buffer holds the newest frame of a camera and nothing else. For a camera that stands still that is all
there is to know; one that moves would have its field forget, update by update, what it no longer looks at. So
of every view that was used, its viewpoint is kept if it lies apart from those kept before; where it does not,
the newer picture takes the older one's place. Apart from what is measured from where a viewpoint was first
taken, never from the picture that has replaced it: a slow camera would push it along for ever. They go to the
field as views of cameras of their own, named ``hand#3``: no camera of a scenario may be called so. Their ages
are what they are: a scene that changes asks for few of them, or for a field that trusts old views less
(``age_tau_ms``).

What a field makes of one or two viewpoints fits those and nothing else, and stays in the way of all that
follow (measured: 3 dB in the cell): each time their number has doubled, up to ``ENOUGH``, it is begun anew.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import numpy as np

from edge_server.config import KeyframesConfig
from edge_server.fields import View

MARK = "#"
_NEAR = 0.5
ENOUGH = 16


@dataclasses.dataclass
class _Slot:
    """A viewpoint. anchor: the view that it was made for, which says where it is; view: its picture now."""

    anchor: View
    view: View
    apart: float = 0.0
    """How far the picture's place is from the anchor's, 1 where it would be another viewpoint."""


@dataclasses.dataclass
class _Kept:
    """One camera's viewpoints by number, and the one that it is at."""

    slots: dict[int, _Slot] = dataclasses.field(default_factory=dict)
    at: int | None = None


class Keyframes:
    """At most ``config.most`` viewpoints of each camera; the oldest gives way. resumed: the field has learnt
    from others before, and is not begun anew."""

    def __init__(self, config: KeyframesConfig, resumed: bool = False) -> None:
        self.config = config
        self._kept: dict[str, _Kept] = {}
        self._begun_with = ENOUGH if resumed else 0

    def outgrown(self, count: int) -> bool:
        """Whether an update of ``count`` views should begin the field anew; it is taken to do so."""
        if self._begun_with == 0:  # the very first: the field is new
            self._begun_with = min(count, ENOUGH)
            return False
        if self._begun_with >= ENOUGH or count < 2 * self._begun_with:
            return False
        self._begun_with = count
        return True

    def with_earlier(self, views: Sequence[View]) -> list[View]:
        """``views``, each with its own name, and the earlier viewpoints of their cameras after them."""
        earlier: list[View] = []
        for view in views:
            kept = self._kept.setdefault(view.camera, _Kept())
            own = self._keep(kept, view)
            earlier.extend(slot.view for number, slot in kept.slots.items() if number != own)
        return [*views, *earlier]

    def forget(self) -> None:
        """The scene is another one."""
        self._kept.clear()
        self._begun_with = 0

    def __len__(self) -> int:
        return sum(len(kept.slots) for kept in self._kept.values())

    def _keep(self, kept: _Kept, view: View) -> int:
        """The number of the viewpoint that ``view`` is at now."""
        slots = kept.slots
        apart, number = min(
            ((self._apart(slot.anchor, view), each) for each, slot in slots.items()), default=(np.inf, 0)
        )
        if apart >= 1.0:
            number, apart = len(slots), 0.0
            if number == self.config.most:
                number = min(slots, key=lambda each: slots[each].view.generated_ns)
            slots[number] = _Slot(view, self._named(view, number))
        elif slots[number].view.generated_ns != view.generated_ns and (
            # On its way out of a viewpoint, a slow camera would leave each with a picture from its edge.
            kept.at != number or apart <= max(_NEAR, slots[number].apart)
        ):
            slots[number].view, slots[number].apart = self._named(view, number), apart
        kept.at = number
        return number

    def _apart(self, a: View, b: View) -> float:
        """How far two views are apart, 1 where they become two viewpoints; infinite through two lenses."""
        if a.intrinsics != b.intrinsics:
            return np.inf
        apart_m = float(np.linalg.norm(a.camera_to_world[:3, 3] - b.camera_to_world[:3, 3]))
        turned = a.camera_to_world[:3, :3].T @ b.camera_to_world[:3, :3]
        turned_deg = float(np.rad2deg(np.arccos(np.clip((np.trace(turned) - 1.0) / 2.0, -1.0, 1.0))))
        return max(_share(apart_m, self.config.apart_m), _share(turned_deg, self.config.apart_deg))

    @staticmethod
    def _named(view: View, number: int) -> View:
        return dataclasses.replace(view, camera=f"{view.camera}{MARK}{number}")


def _share(of: float, limit: float) -> float:
    """``of / limit``; with a limit of zero everything is apart."""
    return of / limit if limit > 0.0 else np.inf
