"""Code shared by all processes: wire format, geometry, scenario, files and limits. Its names below are the library:

  import freshfield as ff

The programs define them and are imported on first use of a name, so a process that uses none imports no program.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from channel_emu.virtual.virtual_channel import VirtualChannel as Channel
    from edge_server.experiments.fitting.fit import Fit as Fit
    from edge_server.experiments.fitting.fit import fit as fit
    from edge_server.experiments.fitting.fit import load as load
    from edge_server.experiments.virtual.try_policy import Trial as Trial
    from edge_server.experiments.virtual.try_policy import try_policy as try_policy
    from edge_server.export.images_and_video import write_video as write_video
    from edge_server.scheduler import Policy as Policy
    from freshfield_up.deployment import Deployment as deployment

__version__ = "0.1.0"

_LIBRARY = {
    "Channel": "channel_emu.virtual.virtual_channel:VirtualChannel",
    "Fit": "edge_server.experiments.fitting.fit:Fit",
    "Policy": "edge_server.scheduler:Policy",
    "Trial": "edge_server.experiments.virtual.try_policy:Trial",
    "deployment": "freshfield_up.deployment:Deployment",
    "fit": "edge_server.experiments.fitting.fit:fit",
    "load": "edge_server.experiments.fitting.fit:load",
    "try_policy": "edge_server.experiments.virtual.try_policy:try_policy",
    "write_video": "edge_server.export.images_and_video:write_video",
}
"""Public name -> module and name there."""

__all__ = ["Channel", "Fit", "Policy", "Trial", "deployment", "fit", "load", "try_policy", "write_video"]


def __getattr__(name: str) -> Any:
    """PEP 562. ImportError where the package of a name, or one that it needs, is not installed."""
    if name not in _LIBRARY:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}; the library has {', '.join(__all__)}")
    module, _, there = _LIBRARY[name].partition(":")
    try:
        found = getattr(importlib.import_module(module), there)
    except ModuleNotFoundError as error:
        raise ImportError(f"freshfield.{name} needs {error.name}: pip install 'freshfield[edge]'") from error
    globals()[name] = found
    return found


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
