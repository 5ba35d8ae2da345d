"""Maps the cameras of a scenario to cameras of a data set."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from freshfield.scenario import Scenario, ScenarioError


def assign_cameras(
    scenario: Scenario, assignment: Mapping[str, str], cameras: Sequence[str], available: Sequence[str]
) -> dict[str, str]:
    """The data set camera of each of ``cameras``.

    assignment: scenario camera to data set camera; cameras that it lacks have the same name in both.
    available: names of the data set's cameras.
    Raises ScenarioError if a camera does not exist, or two of the scenario's cameras would show the same one.
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
