"""The clouds that ``mtpcr-geo demo`` registers: made here, kept in the package."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from mtpcr_geo.benchmark.pairs import write_laz
from mtpcr_geo.benchmark.simulator.pairs import SimulatedPair, describe, simulate_pair
from mtpcr_geo.core.cloud import ArrayCloud
from mtpcr_geo.io.outputs import OutputSet

GROUND, AERIAL, TRUTH = "ground.laz", "aerial.laz", "truth.json"
TIME_STEPS = 128.0
"""GPS times are kept to this part of a second: more digits are noise, and most of the file."""


def demo_pair() -> SimulatedPair:
    """Simulate a few blocks of a town, with about a quarter of each cloud shared.

    The ground cloud keeps a point per half metre, which is what registering it needs and a small file.

    Raises:
        MissingPartError: if ``embreex`` is not installed.

    """
    tilt = float(np.random.default_rng([0, 3]).uniform(2.0, 6.0))
    return simulate_pair(
        "town",
        0,
        extent_m=240.0,
        overlap=0.25,
        tilt_deg=tilt,
        air_density=6.0,
        ground_beams=1_000_000,
        voxel_m=0.5,
    )


def write_demo(folder: Path, *, overwrite: bool = False) -> list[Path]:
    """Simulate the demonstration's pair and write ``ground.laz``, ``aerial.laz`` and ``truth.json``.

    Args:
        folder: where to; made if missing.
        overwrite: whether files there may be replaced.

    Returns:
        The paths written.

    Raises:
        MissingPartError: if ``embreex`` is not installed.
        OutputError: if a file exists already or the folder cannot be written.

    """
    pair = demo_pair()
    with OutputSet(overwrite) as out:
        for name, cloud in ((GROUND, pair.source), (AERIAL, pair.target)):
            time = np.round(cloud.extra["GpsTime"].astype(np.float64) * TIME_STEPS) / TIME_STEPS
            small = ArrayCloud(cloud.xyz, cloud.crs, cloud.name, {**cloud.extra, "GpsTime": time})
            write_laz(out.path(folder / name), small)
        truth = describe(pair, (GROUND, AERIAL))
        out.path(folder / TRUTH).write_text(json.dumps(truth, indent=1) + "\n", "utf-8")
        return out.commit()
