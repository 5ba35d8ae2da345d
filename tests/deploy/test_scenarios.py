"""Every shipped scenario is what its packages accept, and says what it is."""

from __future__ import annotations

from pathlib import Path

import pytest

from camera_node.settings import LiveConfig, source_config
from camera_node.sources.registry import open_sources
from freshfield.scenario import SCENARIO_FOLDER, load
from freshfield_up.scenario_command import checked
from tests.conftest import data_dir

FILES = sorted(SCENARIO_FOLDER.glob("*.yaml"))


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_every_package_accepts_its_section(file: Path) -> None:
    scenario = load(file)
    assert scenario.name == file.stem, "a report names the scenario: it must lead back to the file"
    assert scenario.description
    source = source_config(scenario)
    arm = getattr(source, "arm", None)
    # A scene needs views from several sides: of several cameras, of two that measure depth, or of one that an arm or
    # somebody carries round it.
    depth = "depth_sensor" in source.effects or source.kind in ("oak", "realsense")
    least = 1 if scenario.held_out_every else 2 if depth else 3
    assert len(scenario.training) >= least or set(arm.cameras) >= set(scenario.training)
    assert checked(scenario)


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_every_camera_has_a_first_image(file: Path) -> None:
    scenario = load(file)
    config = source_config(scenario)
    if isinstance(config, LiveConfig):
        pytest.skip("needs cameras: tests/camera_node/sources/devices has them")
    if getattr(config, "arm", None) is not None:
        pytest.skip("needs an arm: tests/camera_node/robot/test_flange_camera.py has one")
    folder = getattr(config, "data", "")
    data = data_dir(folder.split("/")[0]).parent if folder else None
    # One trained and one held-out camera: a world takes a while to prepare each.
    cameras = [scenario.training[0], *scenario.held_out[:1]]
    sources = open_sources(scenario, config, cameras, data)
    assert set(sources) == set(cameras)
    for source in sources.values():
        shot = source.read(source.content(0))
        assert (shot.intrinsics.width, shot.intrinsics.height) == (source.intrinsics.width, source.intrinsics.height)
