"""The vector-matrix field in the sizes of the tests that ask all representations the same."""

from edge_server.fields.tensorf.field import TensorfField
from edge_server.fields.tensorf.settings import TensorfSettings

FIELD = TensorfField
SMALL = TensorfSettings(
    color_rank=8,
    resolution_start=16,
    resolution=64,
    upsample=(20, 60, 120),
    hidden=16,
    rays=1024,
    batch_samples=8192,
    samples=96,
    samples_ramp=100,
    cells=32,
    threads=2,
)
TINY = TensorfSettings(
    color_rank=8,
    resolution_start=12,
    resolution=32,
    upsample=(10, 25),
    hidden=16,
    rays=512,
    batch_samples=4096,
    samples=48,
    samples_ramp=100,
    cells=16,
    threads=2,
)
REACHED_DB = {
    "held out": 24.76,
    "moved": 24.16,
    "one view": 20.18,
    "after noise": 19.19,
    "moving cameras": 27.27,
    "after no weights": 18.68,
}
