"""How simulated clouds differ from real ones, in what the method sees: heights, density, edges, margins.

Figures of a cloud are taken on its height raster at one cell for all. Put the figures of many simulated
and many real clouds side by side before tuning anything on the simulator.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from scipy import ndimage

from mtpcr_geo.benchmark.tables import grouped
from mtpcr_geo.core.arrays import Floats

STEP_M = 1.0
BAND_M = 12.0
QUANTILES = (5, 50, 95)


def cloud_figures(xyz: Floats, cell: float = 1.0) -> dict[str, float]:
    """Describe a cloud by its height raster.

    Args:
        xyz: (n, 3) metres, z up.
        cell: edge of a cell, metres.

    Returns:
        points_per_m2: over the occupied area.
        points_per_cell_p95_over_median: how unevenly they lie.
        occupied_share: of the cells of the bounding box.
        relief_m: 95th less 5th percentile of the highest z per cell.
        thickness_m_*: percentiles of highest less lowest z in a cell: what is seen of facades and canopy.
        banded_m_*: percentiles of the highest z less its mean over 12 m: what the matcher sees.
        edge_share: of the cells with neighbours whose highest z differs from theirs by 1 m or more.

    """
    low = xyz[:, :2].min(axis=0)
    at = np.floor((xyz[:, :2] - low) / cell).astype(np.int64)
    columns, rows = (at.max(axis=0) + 1).tolist()
    place = at[:, 1] * columns + at[:, 0]
    count = np.bincount(place, minlength=rows * columns).reshape(rows, columns)
    top = np.full(rows * columns, -np.inf)
    bottom = np.full(rows * columns, np.inf)
    np.maximum.at(top, place, xyz[:, 2])
    np.minimum.at(bottom, place, xyz[:, 2])
    top, bottom = top.reshape(rows, columns), bottom.reshape(rows, columns)
    full = count > 0
    height = np.where(full, top, 0.0)
    # the mean of the full cells around
    around = {"size": max(3, round(BAND_M / cell)), "mode": "constant"}
    weight = np.maximum(ndimage.uniform_filter(full.astype(np.float64), **around), 1e-9)
    banded = (height - ndimage.uniform_filter(height, **around) / weight)[full]
    difference = np.zeros((rows, columns))
    for axis in (0, 1):
        step = np.abs(np.diff(height, axis=axis))
        both = full.take(range(1, full.shape[axis]), axis) & full.take(range(full.shape[axis] - 1), axis)
        step = np.where(both, step, 0.0)
        pad = [(0, 0), (0, 0)]
        for side in ((1, 0), (0, 1)):
            pad[axis] = side
            difference = np.maximum(difference, np.pad(step, pad))
    counts = count[full]
    out = {
        "points_per_m2": float(len(xyz) / (full.sum() * cell**2)),
        "points_per_cell_p95_over_median": float(np.percentile(counts, 95) / np.median(counts)),
        "occupied_share": float(full.mean()),
        "relief_m": float(np.ptp(np.percentile(top[full], (5, 95)))),
        "edge_share": float((difference[full] >= STEP_M).mean()),
    }
    thickness = (top - np.where(full, bottom, 0.0))[full]
    for name, values in (("thickness_m", thickness), ("banded_m", banded)):
        out |= {f"{name}_p{q}": float(np.percentile(values, q)) for q in QUANTILES}
    return out


def spread(clouds: Sequence[Mapping[str, float]]) -> dict[str, tuple[float, float, float]]:
    """Return the least, median and greatest of each figure over several clouds."""
    return {
        name: (
            min(c[name] for c in clouds),
            float(np.median([c[name] for c in clouds])),
            max(c[name] for c in clouds),
        )
        for name in clouds[0]
    }


def compare(
    simulated: Sequence[Mapping[str, float]], real: Sequence[Mapping[str, float]]
) -> list[dict[str, Any]]:
    """Put simulated beside real: a line a figure, with where the simulated median lies.

    ``simulated_median`` is "within" the real clouds' range, or "below" or "above" it.
    """
    of_simulated, of_real = spread(simulated), spread(real)
    lines = []
    for name, (low, median, high) in of_real.items():
        middle = of_simulated[name][1]
        lies = "below" if middle < low else "above" if middle > high else "within"
        lines.append(
            {
                "figure": name,
                "simulated_min": of_simulated[name][0],
                "simulated_mid": middle,
                "simulated_max": of_simulated[name][2],
                "real_min": low,
                "real_mid": median,
                "real_max": high,
                "simulated_median": lies,
            }
        )
    return lines


def margins(rows: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Gather the hypothesis margins of the registration's runs by pair: lowest, median and highest.

    The margin is how many times stronger the best pose is than the next distinct one: the verdict's metric
    ``hypothesis_margin``.

    Args:
        rows: runs of a benchmark.

    """
    out = []
    for (pair,), own in grouped(rows, "pair").items():
        found = [m for m in (row["details"].get("hypothesis_margin") for row in own) if m is not None]
        if found:
            figures = {"runs": len(found), "min": min(found), "max": max(found)}
            out.append({"pair": pair, "mid": float(np.median(found))} | figures)
    return out
