"""A registration has the same bits at any number of threads."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest

from mtpcr_geo.pipeline.api import Pipeline


def registered(threads: int, files: tuple[Path, Path], out: Path) -> tuple[dict[str, Any], Path]:
    """Register in a process of its own: libraries take their number of threads when they are first used."""
    command = [sys.executable, "-m", "mtpcr_geo", "register", *map(str, files), "-o", str(out), "--quiet"]
    ended = subprocess.run(
        [*command, "--no-recording", "--threads", str(threads)],
        env={key: value for key, value in os.environ.items() if not key.endswith("_NUM_THREADS")},
        capture_output=True,
        text=True,
        check=False,
    )
    assert ended.returncode in (0, 3), ended.stderr
    return json.loads((out / "run.json").read_text()), out / "registered.laz"


@pytest.mark.slow
def test_same_bits_at_any_number_of_threads(town_files, tmp_path):
    (one, cloud_one), (two, cloud_two), (many, _) = (
        registered(threads, town_files, tmp_path / str(threads)) for threads in (1, 2, 5)
    )
    assert one["T_target_source"] is not None
    for other in (two, many):
        assert other["T_target_source"] == one["T_target_source"]
        assert other["metrics"] == one["metrics"]
        assert other["uncertainty"] == one["uncertainty"]
    assert np.array_equal(laspy.read(cloud_one).points.array, laspy.read(cloud_two).points.array)


def test_a_raster_from_kept_points_is_that_of_the_points_in_memory(town_files, decoded):
    rasters = {}
    for budget in (4_000_000, 20_000):
        decoded.clear()
        level = {"type": "mtpcr.level", "budget": budget}
        pipeline = Pipeline([str(town_files[1]), level, {"type": "mtpcr.bev", "cell": 1.0}])
        pipeline.execute()
        assert pipeline.pair is not None
        assert pipeline.pair.target.complete == (budget > 100_000)
        rasters[budget] = pipeline.pair.target.bev
        assert decoded == [str(town_files[1])]
    whole, kept = rasters.values()
    assert whole is not None
    assert kept is not None
    assert whole.grid == kept.grid
    for band in ("top", "low", "count"):
        assert np.array_equal(getattr(whole, band), getattr(kept, band), equal_nan=True)
