"""The paper's equations 1 to 5, as printed and as corrected: pure functions.

MT-PCR multiplies each cloud by a resolution RES (Eq. 1), so that a pixel of its image is ``1 / RES`` metres;
here coordinates stay metres and ``1 / RES`` is the cell of the raster, which is the same thing. Pixels are
(i, j): i counts columns eastwards and j rows *northwards*. Images have north up: row = height - 1 - j.
"""

from __future__ import annotations

from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core.errors import RegistrationError
from mtpcr_geo.core.grid import Grid
from mtpcr_geo.core.types import Bev
from mtpcr_geo.method.bev import Rasteriser

Floats = NDArray[np.float64]
Grey = NDArray[np.uint8]
Gain = Literal["saturated", "normalised"]

W1 = np.full((3, 3), -2.0, np.float32)
W1[1, 1] = 32.0
"""First high-pass filter of Eq. 4; its sum is 16."""

W2 = np.full((3, 3), -1.0, np.float32)
W2[1, 1] = 10.0
"""Second high-pass filter of Eq. 4; its sum is 2."""

FINEST_CELL_M = 0.1
COARSEST_CELL_M = 20.0


def resolution(count: int, area_m2: float, gamma: float) -> float:
    """Return RES, pixels per metre (Eq. 1): ``count * gamma / area``.

    The printed area is that of the bounding box; `mtpcr_geo.method.bev.density` gives the occupied one,
    which is our variant. As ``count / area`` is per square metre and RES per metre, gamma has the unit metre.

    Args:
        count: points in the cloud.
        area_m2: area it covers, square metres.
        gamma: the paper's hyperparameter, metres; it has no value there.

    """
    return count * gamma / area_m2


def usual_gamma(densities: tuple[float, ...], cell: float) -> float:
    """Choose gamma, metres, where the user gives none: both cells then have the geometric mean ``cell``.

    Densities differ a hundredfold between surveys, and RES grows in step with them, so no single value
    serves: 0.1 m suits ten points per square metre, and makes 30 m cells of 0.3.

    Args:
        densities: points per square metre of each cloud.
        cell: the cell that one would choose for both, metres.

    """
    return float(1.0 / (cell * np.exp(np.mean(np.log(densities)))))


def cell_of(res: float) -> float:
    """Return the cell ``1 / RES`` in metres.

    Raises:
        RegistrationError: if it is of no use: below 0.1 m or above 20 m.

    """
    cell = 1.0 / res
    if not FINEST_CELL_M <= cell <= COARSEST_CELL_M:
        raise RegistrationError(
            f"Eq. 1 gives a cell of {cell:.3g} m, outside {FINEST_CELL_M:g} to {COARSEST_CELL_M:g} m; "
            "give another gamma, or --no-res"
        )
    return cell


def ceil_grid(minimum: Floats, maximum: Floats, cell: float) -> Grid:
    """Lay the grid of the printed convention: column i holds ``ceil((x - xmin) / cell) = i``, from 0.

    Column 0 holds what lies exactly at xmin and nothing else; likewise row j = 0.

    Args:
        minimum, maximum: (2,) or (3,) bounds of the points, metres.
        cell: edge of a cell, metres.

    """
    width, height = (np.ceil((np.asarray(maximum[:2]) - minimum[:2]) / cell) + 1).astype(int)
    north = float(minimum[1]) + (int(height) - 1) * cell
    return Grid(float(minimum[0]) - cell, north, cell, int(width), int(height))


class CeilRasteriser(Rasteriser):
    """Collects points by the printed convention of Eq. 2; its grid comes from `ceil_grid`."""

    def _cells(self, xyz: Floats) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
        grid = self.grid
        west = grid.west + grid.cell
        south = grid.north - (grid.height - 1) * grid.cell
        i = np.ceil((xyz[:, 0] - west) / grid.cell).astype(np.int64)
        j = np.ceil((xyz[:, 1] - south) / grid.cell).astype(np.int64)
        return i, grid.height - 1 - j


def grey(bev: Bev, *, printed: bool = False) -> Grey:
    """Make the grey image (Eq. 3): 0..255 from the lowest to the highest point, 0 where empty.

    Args:
        bev: the raster; zmin and zmax are those of all its points.
        printed: take the floor of the fraction alone, as printed, which leaves 0 or 255.

    Returns:
        (h, w) uint8.

    """
    filled = bev.count > 0
    if not filled.any():
        return np.zeros(bev.grid.shape, np.uint8)
    low, high = (float(value) for value in height_span(bev))
    span = max(high - low, 1e-6)
    fraction = (np.where(filled, bev.top, low).astype(np.float64) - low) / span
    scaled = np.floor(fraction) * 255 if printed else np.floor(255 * fraction)
    return np.where(filled, np.clip(scaled, 0, 255), 0).astype(np.uint8)


def height_span(bev: Bev) -> tuple[float, float]:
    """Return zmin and zmax over all points of a raster, metres; NaN where it is empty."""
    filled = bev.count > 0
    if not filled.any():
        return float("nan"), float("nan")
    return float(bev.low[filled].min()), float(bev.top[filled].max())


def enhance(image: Grey, gain: Gain = "saturated") -> Grey:
    """Sharpen a grey image by both high-pass filters (Eq. 4).

    Args:
        image: (h, w) uint8.
        gain: "saturated" cuts to 0..255 after each filter, as image libraries do; the filters multiply
            the mean by 16 and by 2, so most of the image becomes white. "normalised" divides each by its
            sum, and cuts once at the end.

    Returns:
        (h, w) uint8.

    """
    if gain == "saturated":
        return np.asarray(cv2.filter2D(cv2.filter2D(image, -1, W1), -1, W2), np.uint8)
    once = cv2.filter2D(image.astype(np.float32), -1, W1 / W1.sum())
    twice = cv2.filter2D(once, -1, W2 / W2.sum())
    return np.asarray(np.clip(np.rint(twice), 0, 255), np.uint8)


def inverse_mapping(
    ij: Floats, grey_value: Floats, minimum: Floats, maximum: Floats, res: float, *, printed: bool = True
) -> Floats:
    """Take pixels back to metres (Eq. 5), with heights from grey values.

    As printed Y is made of i, not of j, so that all points fall on one line; corrected it is made of j, and
    half a pixel is taken off, since pixel (i, j) covers ``i - 1 .. i``.

    Args:
        ij: (n, 2) pixels.
        grey_value: (n,) 0..255.
        minimum, maximum: (3,) bounds of the cloud, metres (*not* multiplied by RES, as in the paper).
        res: pixels per metre.
        printed: as printed, else corrected.

    Returns:
        (n, 3) metres.

    """
    ij = np.asarray(ij, np.float64)
    low, high = np.asarray(minimum, np.float64) * res, np.asarray(maximum, np.float64) * res
    half = 0.0 if printed else 0.5
    x = (ij[:, 0] - half + low[0]) / res
    y = ((ij[:, 0] if printed else ij[:, 1]) - half + low[1]) / res
    z = (np.asarray(grey_value, np.float64) * (high[2] - low[2]) / 255 + low[2]) / res
    return np.column_stack([x, y, z])
