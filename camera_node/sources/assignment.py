"""Which camera of a data set stands for which camera of the scenario."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from freshfield.scenario import Scenario, ScenarioError


def assign_cameras(
    scenario: Scenario, assignment: Mapping[str, str], cameras: Sequence[str], available: Sequence[str]
) -> dict[str, str]:
    """Data set camera of each of ``cameras``.

    assignment: scenario camera -> data set camera; where it says nothing, the names are the same.
    available: the data set's cameras.

    Raises ScenarioError where a camera does not exist, or two cameras would show the same.
    """
    where = f"{scenario.path}: source.assignment"
    for camera in assignment:
        if camera not in scenario.cameras:
            raise ScenarioError(f"{where}.{camera}: not a camera of this scenario")
    names = {camera: assignment.get(camera, camera) for camera in scenario.cameras}
    doubles = {n for n in names.values() if list(names.values()).count(n) > 1}
    if doubles:
        raise ScenarioError(f"{where}: more than one camera shows {', '.join(sorted(doubles))}")
    for camera in cameras:
        if names[camera] not in available:
            raise ScenarioError(
                f"{where}: the data has no camera {names[camera]!r} (it has {', '.join(available)}); name it "
                f"in cameras.ids, or here as {camera}: NAME"
            )
    return {camera: names[camera] for camera in cameras}
