"""The mesh at the end of a run, where the scenario asks for one (``edge.export``)."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

from freshfield.scenario import Scenario
from freshfield_up.commands import MissingCommand, program
from freshfield_up.processes import Child
from freshfield_up.status import number, read_json


def export_section(scenario: Scenario) -> dict[str, Any] | None:
    """The section ``edge.export``, or None. The edge server has checked it before a mesh is made."""
    section = scenario.edge.get("export")
    return section if isinstance(section, dict) else None


def check(scenario: Scenario) -> None:
    """Raises MissingCommand before the run if the mesh that is asked for could not be made."""
    if export_section(scenario) and importlib.util.find_spec("skimage") is None:
        raise MissingCommand(
            f"{scenario.path}: edge.export: a mesh needs scikit-image: pip install 'freshfield[surface]', or "
            "take the key out"
        )


def possible(out: Path) -> bool:
    """Whether the field of the run in ``out`` was updated; before, there is nothing to export."""
    return bool(number(read_json(out / "edge.json"), "updates", "count"))


def export_process(scenario: Scenario, out: Path) -> Child | None:
    """The process that makes and measures the mesh of the run in ``out``; None if none is asked for."""
    section = export_section(scenario)
    if section is None:
        return None
    command = [program("edge-server"), "export", str(out), "--mesh", str(out / str(section["mesh"]))]
    if section.get("voxel_mm") is not None:
        command += ["--voxel", str(section["voxel_mm"])]
    command += ["--measure", str(scenario.path), "--json", str(out / "mesh.json")]
    return Child("export", "the export", command, out / "log-export.txt")
