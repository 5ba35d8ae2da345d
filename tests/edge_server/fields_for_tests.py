"""A real field, small enough that an update takes milliseconds."""

from edge_server.fields.registry import make_field

SIZES = {"levels": 2, "log2_table": 10, "rays": 256, "batch_samples": 4096, "samples": 24}
TINY = {**SIZES, "center_m": [0.0, 0.0, 0.0], "radius_m": 1.0}


def tiny_field(seed: int = 0):
    return make_field("ngp", TINY, seed)
