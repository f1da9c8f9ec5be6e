"""Casting rays at a mesh through Embree, whose binding is imported only here and only when needed."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.benchmark.simulator.mesh import Mesh
from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.errors import MissingPartError

BATCH_RAYS = 1_000_000


def _embree() -> tuple[Any, Any]:
    """Return the binding's modules of scenes and of meshes.

    Raises:
        MissingPartError: if ``embreex`` cannot be imported.

    """
    try:
        from embreex import mesh_construction, rtcore_scene
    except ImportError as error:
        raise MissingPartError(
            f"the simulator needs embreex, which cannot be imported ({error}); "
            "run pip install 'mtpcr-geo[benchmark]'"
        ) from error
    return rtcore_scene, mesh_construction


@dataclass(frozen=True)
class Hits:
    """Where rays met the mesh.

    Attributes:
        distance: (n,) metres along the ray, inf for a miss.
        material: (n,) uint8 `Material`; meaningless for a miss.
        normal: (n, 3) unit normals; meaningless for a miss.

    """

    distance: Floats
    material: NDArray[np.uint8]
    normal: Floats


class Caster:
    """A mesh made ready for rays. Results do not depend on the number of threads.

    Args:
        mesh: what can be hit.

    Raises:
        MissingPartError: if ``embreex`` is not installed.

    """

    def __init__(self, mesh: Mesh) -> None:
        scenes, meshes = _embree()
        self._material = mesh.material
        self._scene = scenes.EmbreeScene(robust=True)
        # held, since Embree refers to it
        self._mesh = meshes.TriangleMesh(
            self._scene, mesh.vertices.astype(np.float32), mesh.triangles.astype(np.int32)
        )

    def cast(self, origins: Floats, directions: Floats) -> Hits:
        """Find the first hit of each ray.

        Args:
            origins: (n, 3) metres.
            directions: (n, 3) unit vectors.

        """
        n = len(origins)
        distance = np.empty(n)
        material = np.empty(n, np.uint8)
        normal = np.empty((n, 3))
        for start in range(0, n, BATCH_RAYS):
            part = slice(start, min(start + BATCH_RAYS, n))
            rays = (np.ascontiguousarray(side[part], np.float32) for side in (origins, directions))
            answer = self._scene.run(*rays, query="INTERSECT", output=True)
            triangle = answer["primID"]
            missed = triangle < 0
            distance[part] = np.where(missed, np.inf, answer["tfar"])
            material[part] = self._material[np.where(missed, 0, triangle)]
            across = np.where(missed[:, None], (0.0, 0.0, 1.0), answer["Ng"].astype(np.float64))
            normal[part] = across / np.linalg.norm(across, axis=1, keepdims=True)
        return Hits(distance, material, normal)
