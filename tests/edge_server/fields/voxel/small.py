"""The voxel field in the sizes of the tests that ask all representations the same."""

from edge_server.fields import Rendering
from edge_server.fields.voxel.field import VoxelField
from edge_server.fields.voxel.kernels.update import MAX_DENSITY
from edge_server.fields.voxel.settings import VoxelSettings

FIELD = VoxelField
SMALL = VoxelSettings(sizes=(16, 32, 48), refine_at=(20, 60), rays=1024, cells=32, threads=2)
TINY = VoxelSettings(sizes=(12, 20, 32), refine_at=(10, 25), rays=512, cells=16, threads=2)
POISONED = SMALL
FINITE = ("table", "density", "behind")
REACHED_DB = {
    "held out": 22.64,
    "moved": 22.4,
    "one view": 27.01,
    "after noise": 18.81,
    "moving cameras": 28.12,
    "after no weights": 26.43,
}


def check_bounds(field: VoxelField, out: Rendering) -> None:
    """Of parameters, after anything that may have happened to them."""
    table = field.state()["table"]
    assert table.min() >= 0.0 and table[:, 0].max() <= MAX_DENSITY and table[:, 1:].max() <= 1.0
