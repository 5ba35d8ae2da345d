"""The hash-grid field in the sizes of the tests that ask all representations the same (``fields.small``)."""

from edge_server.fields.ngp.field import NgpField
from edge_server.fields.ngp.settings import NgpSettings

FIELD = NgpField
SMALL = NgpSettings(
    levels=6,
    log2_table=12,
    finest_resolution=64,
    hidden=16,
    rays=1024,
    batch_samples=8192,
    samples=96,
    cells=32,
    levels_every=15,
    samples_ramp=100,
    threads=2,
)
TINY = NgpSettings(
    levels=4,
    levels_every=10,
    log2_table=11,
    finest_resolution=32,
    hidden=16,
    rays=512,
    batch_samples=4096,
    samples=48,
    samples_ramp=100,
    cells=16,
    threads=2,
)
REACHED_DB = {
    "held out": 23.25,
    "moved": 21.77,
    "one view": 32.25,
    "after noise": 18.21,
    "moving cameras": 26.95,
    "after no weights": 20.97,
}
