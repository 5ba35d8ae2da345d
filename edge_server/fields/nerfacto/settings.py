"""Settings of the proposal-sampled field; their texts become help and error messages."""

from __future__ import annotations

from typing import Annotated

from edge_server.fields.ngp.settings import NgpSettings
from freshfield.settings import within


class NerfactoSettings(NgpSettings, frozen=True):
    """What can be chosen about a ``NerfactoField``.

    Tuned: a ray has ``bins`` bins, with one lookup each of the proposal, whose grid has ``proposal_cells``
    cells a side (a multiple of 4). ``interlevel`` weighs the loss that trains the proposal (0: samples are
    uniform), ``proposal_decay`` the pull of its raw densities back to thin fog. The share of a ray's samples
    that is allocated uniformly falls from 1 to ``even`` over ``anneal`` steps.
    """

    name = "nerfacto"

    samples: Annotated[int, within(8, 512, "samples of a ray, placed by the proposal density")] = 24
    appearance: Annotated[
        int, within(0, 16, "numbers learned for each camera's appearance (exposure, tint); 0: none")
    ] = 0
    rate_net: float = 2e-2
    samples_start: int = 24
    samples_ramp: int = 200
    bins: int = 96
    proposal_cells: int = 64
    interlevel: float = 5.0
    proposal_decay: float = 3e-2
    even: float = 0.4
    anneal: int = 40


SETTINGS = NerfactoSettings
