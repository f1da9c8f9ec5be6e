"""Pictures of rasters, matches and overlays, as (h, w, 3) uint8 RGB arrays with north up."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats, Image, Mask
from mtpcr_geo.core.grid import Grid
from mtpcr_geo.core.types import Bev, Pair
from mtpcr_geo.export.resample import cut_to, grid_around, placed, snapped, warp_bev

Picture = NDArray[np.uint8]

SOURCE_RGB = (240, 120, 20)
TARGET_RGB = (50, 130, 220)
GOOD_RGB = (40, 190, 90)
FAIR_RGB = (250, 190, 60)
BAD_RGB = (220, 50, 40)
HELD_OUT_RGB = (70, 170, 255)
UNJUDGED_RGB = (250, 220, 80)
EMPTY_RGB = (32, 34, 40)
MATCH_SIDE, MATCH_GAP = 2048, 12
"""Longest side of a raster in a picture of matches, cells, and the gap between both, pixels."""

_SMOOTH_CELLS = 0.7
_LOCAL_MEAN_M = 12.0
_GREY_PER_METRE = 20.0


def band_grey(top: Image, cell: float) -> Picture:
    """Return band-passed height as grey: 127 + 20 per metre above the surroundings, 127 where empty.

    Args:
        top: (h, w) heights in metres, NaN where empty.
        cell: edge of a cell in metres.

    Returns:
        (h, w) uint8: heights smoothed over 0.7 cells minus their mean over 12 m.

    """
    filled = np.isfinite(top)
    smooth = _masked_blur(top, filled, _SMOOTH_CELLS)
    around = _masked_mean(top, filled, max(round(_LOCAL_MEAN_M / cell) | 1, 3))
    grey = np.full(top.shape, 127.0, np.float32)
    grey[filled] = 127.0 + _GREY_PER_METRE * (smooth - around)[filled]
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def hillshade(top: Image, cell: float) -> Picture:
    """Return heights shaded as if lit from north-west, softened by light from the sides; 0 where empty.

    Args:
        top: (h, w) heights in metres, NaN where empty.
        cell: edge of a cell in metres.

    Returns:
        (h, w) uint8, 1-255 where filled.

    """
    filled = np.isfinite(top)
    if not filled.any():
        return np.zeros(top.shape, np.uint8)
    z = _masked_blur(top, filled, 1.0, fill=True)
    dx = np.gradient(z, cell, axis=1) if z.shape[1] > 1 else np.zeros_like(z)
    dy = -np.gradient(z, cell, axis=0) if z.shape[0] > 1 else np.zeros_like(z)  # rows run south
    light = np.zeros(top.shape, np.float32)
    steepness = np.sqrt(1.0 + dx**2 + dy**2)
    for azimuth, weight in ((315.0, 0.6), (270.0, 0.2), (0.0, 0.2)):
        a, h = np.deg2rad(azimuth), np.deg2rad(45.0)
        sun = np.array([np.sin(a) * np.cos(h), np.cos(a) * np.cos(h), np.sin(h)], np.float32)
        shade = (sun[2] - dx * sun[0] - dy * sun[1]) / steepness
        light += np.float32(weight) * np.clip(shade, 0.0, 1.0)
    return np.where(filled, np.clip(1.0 + 254.0 * light, 1, 255), 0).astype(np.uint8)


def shaded_relief(top: Image, cell: float) -> Picture:
    """Return heights as colour under a hillshade, (h, w, 3) uint8; dark where empty."""
    filled = np.isfinite(top)
    colour = height_colours(np.where(filled, top, 0.0), *height_range(top[filled]))
    shade = hillshade(top, cell).astype(np.float32)[..., None] / 255.0
    lit = colour.astype(np.float32) * (0.35 + 0.85 * shade)
    return np.where(filled[..., None], np.clip(lit, 0, 255), np.array(EMPTY_RGB)).astype(np.uint8)


def thinned(bev: Bev, max_side: int) -> tuple[Image, float, int]:
    """Return a BEV's heights with at most `max_side` cells a side: every n-th cell, its edge, and n."""
    step = max(1, -(-max(bev.grid.shape) // max_side))
    return bev.top[::step, ::step], bev.grid.cell * step, step


def height_range(z: NDArray[np.floating]) -> tuple[float, float]:
    """Return the heights in metres that colours span: the middle 96 % of those given."""
    if z.size == 0:
        return 0.0, 1.0
    step = max(1, z.size // 20_000)
    low, high = np.percentile(z.ravel()[::step], [2.0, 98.0])
    return float(low), float(max(high, low + 0.5))


def height_colours(z: NDArray[np.floating], low: float, high: float) -> Picture:
    """Return heights in metres as colours from dark blue (low) to yellow (high): (...) in, (..., 3) out."""
    import cv2

    ramp = cv2.applyColorMap(np.arange(256, dtype=np.uint8)[:, None], cv2.COLORMAP_VIRIDIS)[:, 0, ::-1]
    index = np.clip((np.asarray(z, np.float32) - low) * (255.0 / (high - low)), 0, 255).astype(np.uint8)
    return np.asarray(ramp[index], np.uint8)


def residual_colours(residual_m: Floats, good_m: float, bad_m: float) -> Picture:
    """Return (n,) residuals as (n, 3) colours: green up to `good_m`, over yellow, to red from `bad_m`."""
    stops = np.array([GOOD_RGB, FAIR_RGB, BAD_RGB], np.float64)
    place = np.clip((residual_m - good_m) / max(bad_m - good_m, 1e-9), 0.0, 1.0) * 2.0
    mixed = [np.interp(place, [0, 1, 2], stops[:, k]) for k in range(3)]
    return np.asarray(np.rint(np.stack(mixed, axis=-1)), np.uint8)


def residual_limits(residual_m: Floats, inlier: Mask) -> tuple[float, float]:
    """Return where green ends and red begins, from the inliers' own spread, in whole centimetres."""
    if not inlier.any():
        return 0.1, 0.5
    low = max(round(2.0 * float(np.median(residual_m[inlier])), 2), 0.02)
    return low, round(3.0 * low, 2)


def side_by_side(left: Picture, right: Picture, gap: int = 12) -> tuple[Picture, tuple[float, float]]:
    """Return two pictures beside each other, each in the middle of the common height.

    Returns:
        the picture, and the (column, row) at which the right one's top-left pixel lies; the left one
        lies at column 0 and is centred likewise.

    """
    height = max(left.shape[0], right.shape[0])
    out = np.full((height, left.shape[1] + gap + right.shape[1], 3), EMPTY_RGB, np.uint8)
    row_left, row_right = (height - left.shape[0]) // 2, (height - right.shape[0]) // 2
    out[row_left : row_left + left.shape[0], : left.shape[1]] = _rgb(left)
    column = left.shape[1] + gap
    out[row_right : row_right + right.shape[0], column:] = _rgb(right)
    return out, (float(column), float(row_right))


def match_lines(
    pair: Pair, gap: int = MATCH_GAP, max_side: int = MATCH_SIDE
) -> tuple[Picture, Floats, NDArray[np.uint8], NDArray[np.int8]]:
    """Return both BEVs side by side (source left) with the lines that link them.

    Tie points are drawn once there are any (they know inliers), else the matches themselves. Of a BEV with
    more than
    `max_side` cells a side only every n-th is drawn.

    Returns:
        the picture; (n, 2, 2) line ends in its pixels (column, row; pixel centres at integers);
        (n, 3) colours; (n,) kind: 0 outlier, 1 inlier, 2 held out, 3 not yet judged.

    Raises:
        ValueError: if the pair has no BEVs or no matches yet.

    """
    source, target = pair.source.bev, pair.target.bev
    if source is None or target is None or pair.matches is None:
        raise ValueError("matches are drawn once both BEVs and the matches are there")
    source_top, source_cell, source_step = thinned(source, max_side)
    target_top, target_cell, target_step = thinned(target, max_side)
    left, right = band_grey(source_top, source_cell), band_grey(target_top, target_cell)
    picture, (column, row) = side_by_side(left, right, gap)
    if pair.tie_points is None:
        source_px, target_px = pair.matches.source_px, pair.matches.target_px
        kind = np.full(len(source_px), 3, np.int8)
    else:
        source_px = source.grid.to_pixel(pair.tie_points.source[:, :2])
        target_px = target.grid.to_pixel(pair.tie_points.target[:, :2])
        kind = np.where(pair.tie_points.inlier, 1, 0).astype(np.int8)
        kind[np.asarray(pair.tie_points.held_out, bool) & np.asarray(pair.tie_points.inlier, bool)] = 2
        if pair.T_target_source is None:
            kind[:] = 3
    offset_left = np.array([0.0, (picture.shape[0] - left.shape[0]) // 2])
    offset_right = np.array([column, row])
    ends = np.stack([source_px / source_step + offset_left, target_px / target_step + offset_right], axis=1)
    colours = np.array([BAD_RGB, GOOD_RGB, HELD_OUT_RGB, UNJUDGED_RGB], np.uint8)[kind]
    return picture, ends, colours, kind


def matches_picture(pair: Pair, max_side: int = 1400, most: int = 150) -> Picture:
    """Return both BEVs side by side with at most `most` matches as lines: outliers red, inliers green.

    Raises:
        ValueError: if the pair has no BEVs or no matches yet.

    """
    import cv2

    picture, ends, colours, kind = match_lines(pair, max_side=max_side)
    scale = max_side / max(picture.shape[:2])
    if scale >= 2.0:
        scale = float(int(scale))
        small = picture.repeat(int(scale), axis=0).repeat(int(scale), axis=1)
    else:
        scale = min(1.0, scale)
        small = fit(picture, max_side)
    small = np.ascontiguousarray((small.astype(np.float32) * 0.75).astype(np.uint8))
    order = np.argsort(kind != 0, kind="stable")  # outliers first, so that inliers lie on top
    order = order[np.linspace(0, len(order) - 1, min(most, len(order))).astype(int)] if len(order) else order
    for i in order:
        (x1, y1), (x2, y2) = ((ends[i] + 0.5) * scale - 0.5) * 16.0
        colour = tuple(int(c) for c in colours[i])
        first, last = (round(x1), round(y1)), (round(x2), round(y2))
        cv2.line(small, first, last, colour, 1, cv2.LINE_AA, 4)
        for end in (first, last):
            cv2.circle(small, end, 3 * 16, colour, 1, cv2.LINE_AA, 4)
    return small


def common_rasters(pair: Pair, margin_m: float = 15.0, max_side: int = 1600) -> tuple[Bev, Bev]:
    """Return both BEVs on one grid where they overlap, in levelled target coordinates.

    See `mtpcr_geo.export.resample.placed` for what their cells hold.

    Args:
        pair: with BEVs and a transform.
        margin_m: margin around the overlap, metres.
        max_side: cells that the grid may have along its longer side; larger ones get coarser cells.

    Returns:
        (source, target) on the same grid; the whole source where nothing overlaps.

    Raises:
        ValueError: if the pair has no BEVs or no transform yet.

    """
    source, target = pair.source.bev, pair.target.bev
    if source is None or target is None or pair.T_target_source is None:
        raise ValueError("an overlay needs both BEVs and a transform")
    T = pair.target.T_level_work @ pair.T_target_source @ transforms.inverse(pair.source.T_level_work)
    whole = grid_around(source, T)
    step = max(1.0, max(whole.shape) / 300.0)
    rough = _regrid(whole, 0.0, whole.cell * step)
    both = np.isfinite(warp_bev(source, T, rough).top)
    both &= np.isfinite(warp_bev(target, np.eye(4), rough).top)
    grid = _crop(rough, both) if both.any() else rough
    cell = max(target.grid.cell, source.grid.cell)
    longest = max(grid.shape) * grid.cell + 2 * margin_m
    grid = _regrid(grid, margin_m, cell * max(1.0, longest / cell / max_side))
    if grid.cell == target.grid.cell:
        grid = snapped(grid, target.grid)
    T_level = pair.target.T_level_work
    fixed = cut_to(target, grid)
    if fixed is None and not (pair.source.complete and pair.target.complete):
        # both alike: of slopes the lowest of a coarse cell lies lower than that of a fine one
        return warp_bev(source, T, grid), warp_bev(target, np.eye(4), grid)
    fixed = fixed or placed(pair.target, T_level, grid)
    return placed(pair.source, T_level @ pair.T_target_source, grid), fixed


def _crop(grid: Grid, mask: Mask) -> Grid:
    """Return a grid cut down to the rows and columns in which a mask holds."""
    rows, columns = np.flatnonzero(mask.any(axis=1)), np.flatnonzero(mask.any(axis=0))
    west = grid.west + float(columns[0]) * grid.cell
    north = grid.north - float(rows[0]) * grid.cell
    return Grid(west, north, grid.cell, int(np.ptp(columns)) + 1, int(np.ptp(rows)) + 1)


def _regrid(grid: Grid, margin_m: float, cell: float) -> Grid:
    """Return a grid that covers another's extent and a margin around it with cells of another size."""
    width = int(np.ceil((grid.width * grid.cell + 2 * margin_m) / cell))
    height = int(np.ceil((grid.height * grid.cell + 2 * margin_m) / cell))
    return Grid(float(grid.west) - margin_m, float(grid.north) + margin_m, cell, width, height)


def step_edges(top: Image) -> Floats:
    """Return height steps as (h, w) 0..1: the range within 3x3 filled cells, from 1 m (0) to 4 m (1)."""
    import cv2

    filled = np.isfinite(top)
    kernel = np.ones((3, 3), np.uint8)
    high = cv2.dilate(np.where(filled, top, -1e6).astype(np.float32), kernel)
    low = cv2.erode(np.where(filled, top, 1e6).astype(np.float32), kernel)
    inner = np.where(filled, top, high)
    # the upper side of a step only, so that it is drawn one cell wide
    step = np.where(filled & (inner - low > 0.6 * (high - low)), high - low, 0.0)
    return np.asarray(np.clip((step - 1.0) / 3.0, 0.0, 1.0), np.float64)


def fit(picture: Picture, max_side: int) -> Picture:
    """Return a picture shrunk so that its longer side is at most `max_side` pixels; never enlarge."""
    import cv2

    scale = max_side / max(picture.shape[:2])
    if scale >= 1.0:
        return picture
    size = (max(1, round(picture.shape[1] * scale)), max(1, round(picture.shape[0] * scale)))
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)


def round_number(value: float) -> float:
    """Return the largest of 1, 2, 5 times a power of ten that is not above a positive number."""
    power = 10.0 ** np.floor(np.log10(max(value, 1e-9)))
    return float(max(step for step in (1.0, 2.0, 5.0) if step * power <= value * (1 + 1e-9)) * power)


def png(picture: Picture) -> bytes:
    """Return as encoded bytes a (h, w) or (h, w, 3) RGB picture as PNG."""
    return _encode(picture, ".png", [16, 3])


def jpeg(picture: Picture, quality: int = 90) -> bytes:
    """Return as encoded bytes a (h, w) or (h, w, 3) RGB picture as JPEG."""
    return _encode(picture, ".jpg", [1, quality])


def _encode(picture: Picture, suffix: str, options: list[int]) -> bytes:
    import cv2

    good, data = cv2.imencode(suffix, picture[..., ::-1] if picture.ndim == 3 else picture, options)
    if not good:
        raise ValueError(f"a picture of shape {picture.shape} cannot be encoded as {suffix}")
    return bytes(data)


def _rgb(picture: Picture) -> Picture:
    return np.repeat(picture[..., None], 3, axis=2) if picture.ndim == 2 else picture


def middle_height(top: Image, filled: Mask) -> np.float32:
    """Return a height about which filled cells lie, of some thousand of them; 0 where there are none."""
    known = top[filled]
    return np.float32(np.median(known[:: max(1, len(known) // 20_000)]) if len(known) else 0.0)


def _masked_blur(top: Image, filled: Mask, sigma: float, fill: bool = False) -> Image:
    """Return a Gaussian mean of filled cells; with `fill` empty cells take their neighbourhood's mean."""
    import cv2

    middle = middle_height(top, filled)
    z = np.where(filled, top - middle, np.float32(0.0))
    weight = filled.astype(np.float32)
    total = cv2.GaussianBlur(z, (0, 0), sigma)
    share = cv2.GaussianBlur(weight, (0, 0), sigma)
    smooth = total / np.maximum(share, 1e-6) + middle
    if fill:
        far = _masked_mean(top, filled, 31)
        smooth = np.where(share > 1e-3, smooth, far)
    return np.asarray(smooth, np.float32)


def _masked_mean(top: Image, filled: Mask, size: int) -> Image:
    """Return the mean of filled cells in a square of `size` cells; a middle height where it has none."""
    import cv2

    middle = middle_height(top, filled)
    z = np.where(filled, top - middle, np.float32(0.0))
    total = cv2.boxFilter(z, -1, (size, size), normalize=False, borderType=cv2.BORDER_CONSTANT)
    number = cv2.boxFilter(
        filled.astype(np.float32), -1, (size, size), normalize=False, borderType=cv2.BORDER_CONSTANT
    )
    return np.asarray(total / np.maximum(number, 1.0) + middle, np.float32)
