"""One seed, one result, whoever compiled the kernels: the process that does, and those that load them."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

FIT = """
import hashlib, sys
from edge_server.fields import Budget
from edge_server.fields.registry import make_field
from tests.edge_server.fields.scenes import ring
views = ring(7, size=32)
field = make_field(sys.argv[1])
if sys.argv[2] == "render":  # loads its kernels before those that train
    field.render(views[0].camera_to_world, views[0].intrinsics)
field.fit(views, Budget(steps=30))
field.render(views[0].camera_to_world, views[0].intrinsics)
digest = hashlib.sha256()
for name, array in sorted(field.state().items()):
    digest.update(array.tobytes())
print("digest", digest.hexdigest())
"""


@pytest.mark.slow
def test_results_do_not_depend_on_who_compiled_the_kernels(tmp_path: Path) -> None:
    """What compiles and loads is shared by all representations: one stands for them."""
    environment = {**os.environ, "NUMBA_CACHE_DIR": str(tmp_path)}
    digests = []
    for first in ("fit", "fit", "render"):
        command = [sys.executable, "-c", FIT, "splat", first]
        done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=300)
        assert done.returncode == 0, done.stderr[-2000:]
        digests.append(done.stdout.split("digest ")[1])
    assert list(tmp_path.rglob("*.nbc")), "nothing was compiled into the cache: nothing was tested"
    assert digests[0] == digests[1] == digests[2]
