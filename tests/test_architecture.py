"""The rules of the house that imports can break: arrows point one way, no circles, rooms stay small."""

import ast
from collections import Counter
from collections.abc import Callable
from functools import cache
from graphlib import TopologicalSorter
from pathlib import Path

import pytest

import freshfield
from tests.conftest import ROOT

SOURCES = {"freshfield": ROOT / "proto", "camera_node": ROOT, "channel_emu": ROOT, "edge_server": ROOT}
# importer -> what it may never import, in the order of the data
FORBIDDEN = {
    "freshfield": ("camera_node", "channel_emu", "edge_server"),
    "camera_node": ("channel_emu", "edge_server", "torch"),
    "channel_emu": ("camera_node", "edge_server", "torch"),
    "channel_emu.model": ("channel_emu.live", "channel_emu.virtual", "channel_emu.estimate"),
    "channel_emu.live": ("channel_emu.virtual", "channel_emu.estimate"),
    "channel_emu.virtual": ("channel_emu.live", "channel_emu.estimate"),
    "edge_server.fields": tuple(
        f"edge_server.{name}" for name in ("live", "scheduler", "fidelity", "page", "report", "surface")
    ),
    "edge_server.fields.common": tuple(
        f"edge_server.fields.{each}" for each in ("splat", "ngp", "nerfacto", "tensorf")
    ),
    "edge_server.embed": ("edge_server.live", "edge_server.fields", "edge_server.page", "edge_server.report"),
    "edge_server.scheduler": ("edge_server.live", "edge_server.page", "edge_server.report"),
    "edge_server.live": ("edge_server.page", "edge_server.report"),
    "edge_server.fidelity": ("edge_server.live", "edge_server.page"),
    "edge_server.report": ("edge_server.live", "edge_server.page"),
    "edge_server.viewpoints": ("edge_server.live", "edge_server.page", "edge_server.report", "edge_server.fidelity"),
}
# The library: names of the programs that ``import freshfield`` offers, each imported only once it is used.
LIBRARY = "freshfield"
FILES_A_LEVEL = 16  # fifteen and an __init__


@cache
def imports() -> dict[str, frozenset[str]]:
    """Module -> every module that it imports anywhere, lazily and for type checkers too."""
    files = {
        ".".join(path.relative_to(base).with_suffix("").parts).removesuffix(".__init__"): path
        for package, base in SOURCES.items()
        for path in (base / package).rglob("*.py")
        if not path.stem.endswith(("_pb2", "_pb2_grpc"))
    }
    graph = {}
    for module, path in files.items():
        found = set()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.Import):
                found |= {alias.name for alias in node.names}
            elif isinstance(node, ast.ImportFrom) and node.module:
                names = {f"{node.module}.{alias.name}" for alias in node.names}
                found |= {name if name in files else node.module for name in names}
        graph[module] = frozenset(found)
    return graph


def within(module: str, room: str) -> bool:
    return module == room or module.startswith(f"{room}.")


def wrong_arrows(of: Callable[[str], bool], forbidden: tuple[str, ...]) -> list[str]:
    """Imports of what is forbidden by the modules for which ``of`` holds."""
    arrows = [(module, target) for module, targets in imports().items() if of(module) for target in targets]
    return [f"{m} -> {target}" for m, target in arrows if any(within(target, other) for other in forbidden)]


@pytest.mark.parametrize("room", FORBIDDEN)
def test_arrows_point_one_way(room: str) -> None:
    assert not wrong_arrows(lambda module: within(module, room) and module != LIBRARY, FORBIDDEN[room])


def test_the_library_names_what_there_is_and_imports_nothing() -> None:
    at_import = {
        target
        for node in ast.parse((ROOT / "proto/freshfield/__init__.py").read_text()).body
        if isinstance(node, ast.Import | ast.ImportFrom)
        for target in ([alias.name for alias in node.names] if isinstance(node, ast.Import) else [node.module])
    }
    assert at_import == {"__future__", "importlib", "typing"}
    assert set(freshfield.__all__) == set(freshfield._LIBRARY)
    for name in freshfield.__all__:
        assert getattr(freshfield, name).__doc__, name
    with pytest.raises(AttributeError, match="the library has Channel, Fit"):
        freshfield.rander  # noqa: B018


def test_only_experiments_compose_the_packages_and_nothing_imports_experiments() -> None:
    room = "edge_server.experiments"
    outside = lambda module: within(module, "edge_server") and not within(module, room)  # noqa: E731
    assert not wrong_arrows(outside, (room, "camera_node", "channel_emu"))


def test_imports_form_no_circle() -> None:
    """At the top of a file or in a function alike. A package's __init__ may open its own files by name."""
    found = imports()
    graph = {m: {t for t in targets if t in found and not within(t, m)} for m, targets in found.items()}
    TopologicalSorter(graph).prepare()  # CycleError if there is one


def test_folders_of_experiments_form_no_circle() -> None:
    room = "edge_server.experiments"
    folder = {m: m.removeprefix(f"{room}.").split(".")[0] for m in imports() if m.startswith(f"{room}.")}
    arrows = {(folder[m], folder[t]) for m in folder for t in imports()[m] if t in folder}
    TopologicalSorter({m: {t for f, t in arrows if f == m != t} for m in folder.values()}).prepare()


def test_a_level_holds_about_fifteen_files() -> None:
    levels = Counter(
        path.parent.relative_to(ROOT)
        for package, base in SOURCES.items()
        for path in Path(base / package).rglob("*.py")
    )
    assert not {str(level): count for level, count in levels.items() if count > FILES_A_LEVEL}
