"""Casting rays at a mesh through Open3D, imported only here and only when needed."""

from __future__ import annotations

import ctypes
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.benchmark.simulator.mesh import Mesh
from mtpcr_geo.core.errors import MissingPartError

Floats = NDArray[np.float64]
BATCH_RAYS = 1_000_000


def import_open3d() -> Any:
    """Import Open3D, lending it the libusb of the wheel ``libusb-package`` where the system has none.

    Raises:
        MissingPartError: if Open3D or a system library it needs is not installed.

    """
    try:
        import open3d
    except ImportError:
        try:
            import libusb_package

            ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
            import open3d
        except (ImportError, OSError) as error:
            raise MissingPartError(
                f"the simulator needs Open3D, which cannot be loaded ({error}); "
                "run 'pip install open3d libusb-package', or install the named system library"
            ) from error
    return open3d


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

    """

    def __init__(self, mesh: Mesh) -> None:
        self._o3d = import_open3d()
        self._material = mesh.material
        tensor = self._o3d.core.Tensor
        self._scene = self._o3d.t.geometry.RaycastingScene()
        self._scene.add_triangles(
            tensor(mesh.vertices.astype(np.float32)), tensor(mesh.triangles.astype(np.uint32))
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
            rays = np.concatenate([origins[part], directions[part]], axis=1).astype(np.float32)
            answer = self._scene.cast_rays(self._o3d.core.Tensor(rays))
            distance[part] = answer["t_hit"].numpy()
            ids = answer["primitive_ids"].numpy()
            material[part] = self._material[np.minimum(ids, len(self._material) - 1)]
            normal[part] = answer["primitive_normals"].numpy()
        return Hits(distance, material, normal)
