"""What the points of one cloud show: their true bounds, their density, and outliers."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from mtpcr_geo.check.findings import Finding, Role, rewrite
from mtpcr_geo.core.arrays import ComparesArrays, Floats
from mtpcr_geo.core.errors import CrsError, OutputError
from mtpcr_geo.core.frames import box_points
from mtpcr_geo.io.file_cloud import COARSE_SINGLE, FileCloud, single_precision_step
from mtpcr_geo.io.sample import bounds_tolerance
from mtpcr_geo.io.storage import MOST_STEPS
from mtpcr_geo.io.write import STEP

if TYPE_CHECKING:
    from mtpcr_geo.core.frames import FrameLink
    from mtpcr_geo.io.las import LasCloud
    from mtpcr_geo.io.sample import Scan


VERY_COARSE_SINGLE_M = 0.05
MUCH_NOISE, VERY_MUCH_NOISE = 0.05, 0.3
TALLEST_M = 1500.0
TALLEST_GROWN_OR_BUILT_M = 120.0
"""Trees grow no higher, and few buildings: a plot may well be narrower than what stands on it is high."""
LOWEST_LAND_M, HIGHEST_LAND_M = -500.0, 9000.0


@dataclass(frozen=True, eq=False)
class Measured(ComparesArrays):
    """A cloud in metres of its own frame.

    Attributes:
        sample: (n, 3) metres, near zero; without noise.
        low, high: (3,) bounds of the whole cloud, likewise.
        height: metres to add to the third column for the heights of the CRS.
        per_m2: points per occupied square metre.
        area_m2: area of the occupied cells.

    """

    sample: Floats
    low: Floats
    high: Floats
    height: float
    per_m2: float
    area_m2: float

    @property
    def extent(self) -> Floats:
        """(3,) metres from the lowest to the highest coordinate."""
        return np.asarray(self.high - self.low)


def bounds_findings(cloud: LasCloud, whole: Floats, role: Role) -> Iterator[Finding]:
    """Yield where the header's bounds differ from those of the points read, (2, 3)."""
    low, high = whole
    tolerance = bounds_tolerance(np.asarray(cloud.header.scales), whole)
    if not np.isfinite([cloud.minimum, cloud.maximum]).all():
        yield Finding(
            "warning",
            "bounds-wrong",
            role,
            "the header's bounds are no finite numbers: the points are used, and programs that trust the "
            "header will not find them",
            rewrite(cloud.path),
        )
        return
    outside = np.maximum(cloud.minimum - low, high - cloud.maximum)
    spare = np.maximum(low - cloud.minimum, cloud.maximum - high)
    with np.errstate(over="ignore"):
        # the header may state bounds of any size
        outside_steps, spare_steps = outside / tolerance, spare / tolerance
    if (outside > tolerance).any() and not np.any([cloud.minimum, cloud.maximum]):
        yield Finding(
            "warning",
            "bounds-wrong",
            role,
            "the header's bounds are all zero: the points are used, and programs that trust the header will "
            "not find them",
            rewrite(cloud.path),
        )
    elif (outside > tolerance).any():
        axis = int(outside_steps.argmax())
        yield Finding(
            "warning",
            "bounds-wrong",
            role,
            f"points lie up to {outside[axis]:.6g} units beyond the header's bounds in {'xyz'[axis]}: "
            "programs that trust the header will miss them",
            rewrite(cloud.path),
        )
    elif (spare > tolerance).any():
        axis = int(spare_steps.argmax())
        extent = float((high - low)[axis])
        yield Finding(
            "warning" if spare[axis] > max(extent, 1.0) else "note",
            "bounds-wide",
            role,
            f"the header's bounds extend up to {spare[axis]:.6g} units beyond the points in {'xyz'[axis]}",
            rewrite(cloud.path),
        )


def check_scale(link: FrameLink, scan: Scan, scale: float | None) -> None:
    """Refuse a scale at which a LAS file does not hold the cloud.

    Raises:
        OutputError: naming the finest one that does.

    """
    if scale is None:
        return
    corners = link.to_work(box_points(scan.bounds, 2))
    apart = float(np.linalg.norm(np.ptp(corners, axis=0)))
    if apart / 2 > scale * MOST_STEPS:
        finest = 10.0 ** np.ceil(np.log10(apart / 2 / MOST_STEPS))
        raise OutputError(
            f"at --scale {scale:g} a LAS file spans {2 * scale * MOST_STEPS:,.0f} m, and the source "
            f"{apart:,.0f} m; give --scale {finest:g} or coarser"
        )


def precision_findings(cloud: object, scan: Scan, metres: Floats, role: Role) -> Iterator[Finding]:
    """Yield that coordinates are single-precision numbers, and too coarse where they are large.

    Args:
        cloud: the file; LAS has whole numbers, whatever they were made of.
        scan: its points.
        metres: (3,) a unit of x, y and z.
        role: which cloud it is.

    """
    step = single_precision_step(scan.sample)
    if step is None or not isinstance(cloud, FileCloud):
        return
    worst = float((step * metres).max())
    if worst < COARSE_SINGLE:
        return
    yield Finding(
        "warning" if worst >= VERY_COARSE_SINGLE_M else "note",
        "single-precision",
        role,
        f"its coordinates are single-precision numbers, in steps of {worst:.2g} m where they are as large as "
        f"{np.abs(scan.sample).max():,.0f}: what is finer was lost when it was written",
        "export it in double precision, or shifted to a local origin",
    )


def storage_findings(link: FrameLink, scan: Scan, role: Role, scale: float | None) -> Iterator[Finding]:
    """Yield that some points lie too far from the others to be stored with them in one file."""
    step = STEP if scale is None else scale
    try:
        corners = link.to_work(box_points(scan.whole, 2))
    except CrsError:
        return  # noise or marks at a place where the CRS means nothing
    apart = float(np.ptp(corners, axis=0).max())
    if not apart / 2 <= step * MOST_STEPS:
        yield Finding(
            "note",
            "points-far",
            role,
            f"some of its points lie {apart / 1000:,.0f} km from others: those that do not fit a LAS file at "
            f"a scale of {step:g} m will be left out of what is written, and counted",
            f"remove them beforehand, or give a coarser scale (--scale {10 * step:g})",
        )


def noise_findings(scan: Scan, role: Role) -> Iterator[Finding]:
    """Yield the share of noise, where it is large."""
    share = scan.dropped / max(scan.count, 1)
    if share > MUCH_NOISE:
        yield Finding(
            "warning" if share > VERY_MUCH_NOISE else "note",
            "noise",
            role,
            f"{share:.0%} of its points are classified as noise (7, 18) or withheld, and are left out",
            "check its classification, if they are not noise",
        )


def no_return_findings(scan: Scan, role: Role) -> Iterator[Finding]:
    """Yield points that mark beams without a return."""
    if scan.no_returns:
        where = "; ".join(
            "(" + ", ".join(f"{v:g}" for v in place) + ")" for place in scan.no_return_places[:3]
        )
        yield Finding(
            "note",
            "no-returns",
            role,
            f"{scan.no_returns:,} of its points ({scan.no_returns / scan.count:.1%}) lie exactly at {where}: "
            "beams without a return; they are kept in what is written, and left out of all else",
        )


def stray_findings(scan: Scan, role: Role) -> Iterator[Finding]:
    """Yield points that lie far from all others."""
    if scan.strays:
        far = float(np.maximum(scan.minimum - scan.whole[0], scan.whole[1] - scan.maximum).max())
        yield Finding(
            "note",
            "stray",
            role,
            f"{scan.strays:,} of its points lie far from all others, up to {far:,.0f} units beyond them: "
            "they are kept in what is written, and left out of all else",
            "classify them as noise (7 or 18), if other programs shall know",
        )


def height_findings(measured: Measured, unit_name: str, stated: bool, role: Role) -> Iterator[Finding]:
    """Yield heights that are no heights of a place: constant, stray, in other units, or off the earth.

    Args:
        measured: the cloud in metres.
        unit_name: unit in which its heights are taken to be.
        stated: whether a CRS states that, so that absolute heights have a meaning.
        role: which cloud it is.

    """
    z = measured.sample[:, 2] + measured.height
    low, middle, high = np.percentile(z, [0.1, 50.0, 99.9])
    body = float(high - low)
    lowest, highest = float(measured.low[2]) + measured.height, float(measured.high[2]) + measured.height
    stray = max(highest - high, low - lowest)
    if highest == lowest:
        yield Finding(
            "warning",
            "z-constant",
            role,
            "all its points are at one height: there is nothing to match",
            "check how it was exported",
        )
    elif stray > 5.0 * body + 20.0:
        far = highest if highest - high >= low - lowest else lowest
        yield Finding(
            "warning",
            "z-stray",
            role,
            f"a few points lie far from the rest in height, up to {far:.0f} m while nearly all are "
            f"between {low:.0f} and {high:.0f} m",
            "classify them as noise (7 or 18), or crop them",
        )
    elif highest - lowest > TALLEST_M or body > max(
        float(measured.extent[:2].max()), TALLEST_GROWN_OR_BUILT_M
    ):
        yield Finding(
            "warning",
            "z-range",
            role,
            f"its heights span {highest - lowest:.0f} m over a plan of "
            f"{measured.extent[0]:.0f} x {measured.extent[1]:.0f} m, taken in units of {unit_name}",
            "check the unit of its heights (feet?) and its plan, and look for stray points",
        )
    if stated and not LOWEST_LAND_M <= middle <= HIGHEST_LAND_M:
        yield Finding(
            "warning",
            "z-level",
            role,
            f"its heights lie about {middle:.0f} m, where there is no land; taken in units of {unit_name}",
            "check the unit of its heights (feet? millimetres?) and its CRS",
        )


def plan_findings(measured: Measured, role: Role) -> Iterator[Finding]:
    """Yield the few points far away that make a raster huge."""
    low, high = np.percentile(measured.sample[:, :2], [0.1, 99.9], axis=0)
    stray = np.maximum(measured.high[:2] - high, low - measured.low[:2])
    if (stray > 5.0 * (high - low) + 20.0).any():
        yield Finding(
            "warning",
            "plan-stray",
            role,
            f"a few points lie up to {stray.max():,.0f} m away from the rest",
            "crop them: readers.las and filters.crop in a pipeline do it",
        )
