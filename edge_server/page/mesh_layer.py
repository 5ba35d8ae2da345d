"""The mesh on the page: made on request from the newest publication, in the background."""

from __future__ import annotations

import logging
import threading
from typing import Any

import viser

from edge_server.live.state import EdgeState
from edge_server.page.controls import notify

log = logging.getLogger(__name__)

NODE = "/field/mesh"
VOXELS = 160  # along the longest side: a browser takes the triangles in a second or two
MEMORY_MB = 512.0
NOTICE_S = 10.0


class MeshLayer:
    """A button in the current GUI container that shows a mesh of the field, and hides it again.

    A separate thread makes one mesh at a time from an immutable snapshot, so neither the loop nor other
    visitors wait. Nothing for it is imported before the first press.
    """

    def __init__(self, server: viser.ViserServer, state: EdgeState) -> None:
        self._server, self._state = server, state
        self._lock = threading.Lock()
        self._node: Any = None
        self._thread: threading.Thread | None = None
        self.button: Any = server.gui.add_button(
            "show mesh", hint="The surface of the field as it is now, from depth rendered at its cameras."
        )
        self.button.on_click(self._pressed)

    def _pressed(self, event: Any) -> None:
        with self._lock:
            if self._thread is not None and self._thread.is_alive():
                return  # still being made
            if self._node is not None:
                self._node.remove()
                self._node = None
                self.button.label = "show mesh"
                return
            self.button.label, self.button.disabled = "making the mesh ...", True
            self._thread = threading.Thread(target=self._make, args=(event.client,), name="page-mesh", daemon=True)
            self._thread.start()

    def _make(self, client: Any) -> None:
        label = "show mesh"
        try:
            self._node = self._add_mesh()
            label = "hide mesh"
        except Exception as error:  # any failure is shown to the visitor and never ends the page
            log.info("page: no mesh: %s", error)
            notify(client, "No mesh", str(error) or type(error).__name__, bad=True, seconds=NOTICE_S)
        finally:
            self.button.label, self.button.disabled = label, False

    def _add_mesh(self) -> Any:
        import numpy as np
        import trimesh

        from edge_server.fields.common.threads.thread_pool import SERVER_NICE, shared_pool
        from edge_server.surface import SurfaceError
        from edge_server.surface.reconstruct import grid_for, make_depth_maps, mesh_from_depth_maps
        from edge_server.surface.settings import MeshSettings

        renderer = self._state.renderer
        views = getattr(renderer, "cameras", ())
        if renderer is None or not views:
            raise SurfaceError("the field has not been trained yet")
        # No sharpening: it compares images, and moving parts differ between them.
        settings, pool = MeshSettings(sharpen=False, memory_mb=MEMORY_MB), shared_pool(nice=SERVER_NICE)
        maps = make_depth_maps(renderer, views, settings, pool=pool)
        grid = grid_for(maps, settings)
        span = float(np.subtract(grid.upper, grid.lower).max())
        settings = MeshSettings(
            sharpen=False,
            memory_mb=MEMORY_MB,
            voxel_m=max(grid.voxel_m, span / VOXELS),
            bounds=(grid.lower, grid.upper),
        )
        mesh = mesh_from_depth_maps(maps, settings, pool=pool)
        return self._server.scene.add_mesh_trimesh(
            NODE, trimesh.Trimesh(mesh.vertices, mesh.faces, vertex_colors=mesh.color, process=False)
        )
