# SPDX-License-Identifier: Apache-2.0
"""Rays through triangles, by Embree (`embreex`, the extra `worlds`)."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from cvcdepth_core.errors import ConfigError
from cvcdepth_core.worlds.shapes.meshes import Floats, Ints

FAR = np.float32(1e30)


class Hits(NamedTuple):
    """What N rays meet first."""

    faces: Ints
    """[N] index of the triangle, -1 for none."""
    distances: Floats
    """[N] float32; FAR for none."""
    u: Floats
    """[N] weight of the triangle's second corner."""
    v: Floats
    """[N] weight of its third corner."""


def require_engine() -> Any:
    """Import Embree's binding; ConfigError says how to install it."""
    try:
        from embreex import mesh_construction, rtcore_scene
    except ImportError as error:
        raise ConfigError(
            f"worlds cannot be rendered: {error}; pip install 'cvcdepth_ros[worlds]' brings embreex"
        ) from error
    return mesh_construction, rtcore_scene


class TriangleScene:
    """Triangles that rays can be shot at."""

    def __init__(self, corners: Floats) -> None:
        """`corners`: [F, 3, 3] float32 metres."""
        self._scene = None
        if len(corners):
            mesh_construction, rtcore_scene = require_engine()
            self._scene = rtcore_scene.EmbreeScene()
            mesh_construction.TriangleMesh(self._scene, np.ascontiguousarray(corners, np.float32))

    def nearest(self, origins: Floats, directions: Floats, limits: Floats | None = None) -> Hits:
        """First triangle on each ray; `origins`, `directions` [N, 3] float32, `limits` [N] the greatest distances."""
        if self._scene is None or not len(origins):
            count = len(origins)
            zeros = np.zeros(count, np.float32)
            return Hits(np.full(count, -1, np.int32), np.full(count, FAR), zeros, zeros)
        # Embree writes the distances that it finds into the array of the limits.
        own_limits = None if limits is None else limits.copy()
        found = self._scene.run(origins, directions, own_limits, output=True)
        missed = found["primID"] < 0
        return Hits(found["primID"], np.where(missed, FAR, found["tfar"]), found["u"], found["v"])

    def blocked(self, origins: Floats, directions: Floats, limits: Floats) -> Floats:
        """Whether anything lies on each ray within its limit, bool [N]."""
        if self._scene is None or not len(origins):
            return np.zeros(len(origins), bool)
        found: Floats = self._scene.run(origins, directions, limits.copy(), query="OCCLUDED") >= 0
        return found
