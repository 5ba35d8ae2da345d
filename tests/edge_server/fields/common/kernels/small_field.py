"""A small hash-grid field that has made ten steps, for tests of the kernels that fields with rays share."""

from __future__ import annotations

from functools import cache

from edge_server.fields import Budget
from edge_server.fields.common.threads.thread_pool import CallerPool
from edge_server.fields.ngp.field import NgpField
from edge_server.fields.ngp.settings import NgpSettings
from tests.edge_server.fields.scenes import ring

VIEWS = ring(5, size=24)
SETTINGS = NgpSettings(
    levels=4,
    log2_table=10,
    finest_resolution=32,
    hidden=16,
    rays=64,
    batch_samples=2048,
    samples=48,
    cells=16,
    samples_start=48,
    threads=1,
)


@cache
def fitted() -> NgpField:
    made = NgpField(SETTINGS, CallerPool())
    made.fit(VIEWS, Budget(steps=10))
    return made
