"""Loses frames: a lost frame occupies the link for its whole transmission, but never arrives."""

from __future__ import annotations

from channel_emu.model.faults import ChanceFault, ChanceParams
from channel_emu.model.link import Transit

Params = ChanceParams


class Effect(ChanceFault):
    purpose = "channel.loss"

    def loses(self, transit: Transit) -> bool:
        return self.hits(transit)
