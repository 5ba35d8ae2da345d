"""Delivers a frame twice: the edge must notice the repeated sequence number."""

from __future__ import annotations

from channel_emu.model.faults import ChanceFault, ChanceParams
from channel_emu.model.link import Transit

Params = ChanceParams


class Effect(ChanceFault):
    purpose = "channel.duplication"

    def duplicates(self, transit: Transit) -> bool:
        return self.hits(transit)
