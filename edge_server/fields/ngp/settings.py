"""Settings of the hash-grid field; their texts become help and error messages."""

from __future__ import annotations

from edge_server.fields.common.hash_grid_settings import HashGridSettings

STATE_SHAPE = (
    "levels",
    "log2_table",
    "base_resolution",
    "finest_resolution",
    "hidden",
    "hidden_layers",
    "sh_degree",
    "cells",
    "samples",
)
"""Options in which a state and the field that loads it must agree."""


class NgpSettings(HashGridSettings, frozen=True):
    """What can be chosen about an ``NgpField``."""

    name = "ngp"


SETTINGS = NgpSettings
