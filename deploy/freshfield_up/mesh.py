"""Exports a mesh at the end of a run if the scenario asks for one (``edge.export``)."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from typing import Any

from freshfield.scenario import Scenario
from freshfield_up.commands import MissingCommand, program
from freshfield_up.processes import Child
from freshfield_up.status import number, read_json


def export_section(scenario: Scenario) -> dict[str, Any] | None:
    """The section ``edge.export``, or None. The edge server has checked it by the time a mesh is made."""
    section = scenario.edge.get("export")
    return section if isinstance(section, dict) else None


def check(scenario: Scenario) -> None:
    """Raise MissingCommand if the scenario asks for a mesh that could not be made. Call before the run."""
    if export_section(scenario) and importlib.util.find_spec("skimage") is None:
        raise MissingCommand(
            f"{scenario.path}: edge.export: a mesh needs scikit-image: pip install 'freshfield[surface]', or "
            "take the key out"
        )


def file_names(scenario: Scenario) -> tuple[str, ...]:
    """Name of the file that the scenario asks for."""
    section = export_section(scenario)
    return () if section is None else (str(section["mesh"]),)


def possible(out: Path) -> bool:
    """Whether the field of the run in ``out`` was ever updated; otherwise there is nothing to export."""
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
