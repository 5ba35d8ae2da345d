"""deploy/ is a folder of scripts, not an installed package: its tests put it on the path as python does."""

from __future__ import annotations

import sys

from tests.conftest import ROOT

sys.path.insert(0, str(ROOT / "deploy"))
