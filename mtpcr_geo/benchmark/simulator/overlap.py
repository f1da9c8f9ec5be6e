"""How much two clouds share, in cells seen from above, and a block that makes them share as asked."""

from __future__ import annotations

import numpy as np
from scipy import ndimage

from mtpcr_geo.benchmark.simulator.scanners import Block
from mtpcr_geo.core.arrays import Floats, Indices


def occupied_cells(xy: Floats, cell: float = 1.0) -> Indices:
    """Find the cells (n, 2) (column, row), `cell` metres wide, that hold any of the (m, 2) places."""
    index = np.floor(np.asarray(xy)[:, :2] / cell).astype(np.int64)
    if not len(index):
        return index
    low = index.min(axis=0)
    shifted = index - low
    width = int(shifted[:, 0].max()) + 1
    key = np.unique(shifted[:, 1] * width + shifted[:, 0])
    return np.asarray(np.stack([key % width, key // width], axis=1) + low, np.int64)


def near_shares(a: Indices, b: Indices) -> tuple[float, float]:
    """Share of the cells `a` with a cell of `b` in their 3x3 neighbourhood, and the other way round.

    Args:
        a: (n, 2) cells of one cloud.
        b: (m, 2) cells of the other, on the same grid.

    Returns:
        The two shares in 0..1; (0, 0) if either cloud is empty.

    """
    if not len(a) or not len(b):
        return 0.0, 0.0
    low = np.minimum(a.min(axis=0), b.min(axis=0)) - 1
    size = np.maximum(a.max(axis=0), b.max(axis=0)) - low + 2
    images = []
    for cells in (a, b):
        image = np.zeros((size[1], size[0]), bool)
        image[cells[:, 1] - low[1], cells[:, 0] - low[0]] = True
        images.append(image)
    grown = [ndimage.binary_dilation(image, np.ones((3, 3), bool)) for image in images]
    return (
        float((images[0] & grown[1]).sum() / len(a)),
        float((images[1] & grown[0]).sum() / len(b)),
    )


def place_block(
    cells: Indices, half: float, yaw: float, source_share: float, target_share: float
) -> tuple[Block, float]:
    """Find the block from whose air survey the ground cloud gets the shares asked for.

    The block is a rectangle at the +x end of the site (turned by `yaw`), about as wide as deep. Its
    near edge settles the ground cloud's share, its size the aerial cloud's.

    Args:
        cells: (n, 2) one-metre cells of the ground cloud.
        half: half the edge of the site, metres.
        yaw: turn of the block, radians.
        source_share: share of the ground cloud's cells that shall lie in the block.
        target_share: share of the block's cells that the ground cloud shall cover.

    Returns:
        The block, and by how much the two shares miss what was asked, added up.

    """
    frame = Block(np.zeros(2), np.zeros(2), yaw)
    middle = cells.astype(np.float64) + 0.5
    uv = frame.to_block(middle)
    low = cells.min(axis=0) - 1
    image = np.zeros(tuple((cells.max(axis=0) - low + 2)[::-1]), bool)
    image[cells[:, 1] - low[1], cells[:, 0] - low[0]] = True
    rows, columns = np.nonzero(ndimage.binary_dilation(image, np.ones((3, 3), bool)))
    covered = np.stack([columns, rows], axis=1).astype(np.float64) + low + 0.5
    wanted = max(1, round(source_share * len(cells)))

    def block(edge: float) -> Block:
        # nearest edge at which a block this wide holds enough ground cells
        u0 = float(np.quantile(uv[:, 0], 1 - source_share))
        v0 = -half
        for _ in range(30):
            inside = uv[uv[:, 0] >= u0]
            v_mid = float(np.median(inside[:, 1])) if len(inside) else 0.0
            v0 = float(np.clip(v_mid - edge / 2, -half, max(half - edge, -half)))
            strip = uv[(uv[:, 1] >= v0) & (uv[:, 1] < v0 + edge), 0]
            if len(strip) <= wanted:
                new = float(strip.min()) if len(strip) else u0
            else:
                new = float(np.partition(strip, len(strip) - wanted)[len(strip) - wanted])
            if abs(new - u0) < 0.25:
                break
            u0 = new
        return Block(np.array([u0, v0]), np.array([u0 + min(edge, half - u0), v0 + edge]), yaw)

    def gap(b: Block) -> float:
        source = b.contains(middle).sum() / len(cells)
        target = b.contains(covered).sum() / max(b.area, 1.0)
        return float(abs(source - source_share) + abs(target - target_share))

    best = min((block(float(edge)) for edge in np.linspace(60.0, 2 * half, 50)), key=gap)
    return best, gap(best)
