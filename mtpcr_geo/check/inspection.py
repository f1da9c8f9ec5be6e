"""What a check knows of one cloud, gathered step by step."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.scanner import PLAIN, Scanner

if TYPE_CHECKING:
    from mtpcr_geo.check.findings import CloudRole
    from mtpcr_geo.check.place import Claim
    from mtpcr_geo.check.points import Measured
    from mtpcr_geo.core.errors import RegistrationError
    from mtpcr_geo.io.file_cloud import FileCloud
    from mtpcr_geo.io.las import LasCloud
    from mtpcr_geo.io.sample import Scan


@dataclass(eq=False)
class Inspection:
    """What a check found out about one cloud.

    Attributes:
        role: "source" or "target".
        cloud: the opened file.
        claim: the CRS it is taken to be in.
        scan: its sample and true bounds, or None where its points cannot be used.
        measured: its sample and extent in metres of a frame of its own, or None where no frame is known.
        too_large: why no raster of it can be made, or None.
        scanner: unit and axes declared for it.
        seems_local: whether nothing states its CRS, and its coordinates look local.

    """

    role: CloudRole
    cloud: LasCloud | FileCloud
    claim: Claim
    scan: Scan | None = None
    measured: Measured | None = None
    too_large: RegistrationError | None = None
    scanner: Scanner = PLAIN
    seems_local: bool = False

    @property
    def is_local(self) -> bool:
        """Return whether its coordinates are known to be local: no CRS, or an engineering one."""
        return self.claim.facts is not None and not self.claim.facts.georeferenced

    @property
    def bounds(self) -> Floats:
        """Return the (2, 3) lowest and highest coordinates: of the points if known, else of the header."""
        known = self.known_bounds
        return np.stack([self.cloud.minimum, self.cloud.maximum]) if known is None else known

    @property
    def known_bounds(self) -> Floats | None:
        """Return the (2, 3) bounds of the points without noise and no returns; None if they were not read."""
        return None if self.scan is None else self.scan.bounds
