"""What a header states of bounds is a hint: the points decide, and that it was wrong is said."""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pytest
from helpers_scene import town
from pyproj import CRS

import mtpcr_geo as mg
from mtpcr_geo.check import check_clouds
from mtpcr_geo.core.cloud import ArrayCloud
from mtpcr_geo.core.errors import CrsError
from mtpcr_geo.io.las import open_cloud
from mtpcr_geo.io.write import write_cloud

PLACES = {
    "projected": (CRS.from_epsg(25833), np.array([367_000.0, 5_820_000.0, 30.0]), 1.0),
    "geographic": (CRS.from_epsg(4326), np.array([13.0, 52.5, 30.0]), 1e-5),
    "local": (None, np.zeros(3), 1.0),
}
BOUNDS = {
    "zero": np.zeros((2, 3)),
    "stale": np.array([[4.0, 4.0, 4.0], [5.0, 5.0, 5.0]]),
    "infinite": np.array([[np.inf] * 3, [-np.inf] * 3]),
    "no numbers": np.full((2, 3), np.nan),
    "of the whole world": np.array([[-1e9] * 3, [1e9] * 3]),
}


def restate(path: Path, bounds: np.ndarray) -> Path:
    """Write other bounds into a header: max and min of x, y, z."""
    with path.open("r+b") as stream:
        stream.seek(179)
        stream.write(bounds[::-1].T.astype("<f8").tobytes())
    return path


@pytest.fixture(scope="module", params=PLACES)
def pair(request, tmp_path_factory):
    crs, origin, unit = PLACES[request.param]
    folder = tmp_path_factory.mktemp(request.param)
    for role, seed in (("source", 1), ("target", 2)):
        xyz = town(np.random.default_rng(seed), 8_000) * [unit, unit, 1.0] + origin
        write_cloud(folder / f"{role}.las", ArrayCloud(xyz, crs), None, crs)
    return folder, crs is None


def levelled(folder: Path, local: bool, budget: int = 4_000_000):
    files = [str(folder / f"{role}.las") for role in ("target", "source")]
    stages = [*files, {"type": "mtpcr.level", "local": local, "budget": budget}, {"type": "mtpcr.bev"}]
    pipeline = mg.Pipeline(stages)
    pipeline.execute()
    assert pipeline.pair is not None
    return pipeline.pair


@pytest.mark.parametrize("budget", [4_000_000, 2_000])
@pytest.mark.parametrize("name", BOUNDS)
def test_frames_and_rasters_are_those_of_good_bounds(pair, name, budget, tmp_path):
    folder, local = pair
    right = levelled(folder, local, budget)
    for role in ("source", "target"):
        shutil.copy(folder / f"{role}.las", tmp_path)
        restate(tmp_path / f"{role}.las", BOUNDS[name])
    wrong = levelled(tmp_path, local, budget)
    for side, good in ((wrong.source, right.source), (wrong.target, right.target)):
        assert np.array_equal(side.link.origin, good.link.origin)
        assert np.array_equal(side.sample, good.sample)
        assert np.array_equal(side.bev.count, good.bev.count)
        assert "header" in side.remarks[0]
        assert good.remarks == ()
    report = check_clouds(tmp_path / "source.las", tmp_path / "target.las", local=local)
    assert report.exit_code == 0
    roles = {finding.role for finding in report.findings if finding.code in ("bounds-wrong", "bounds-wide")}
    assert roles == {"source", "target"}
    assert np.array_equal(report.clouds["source"].maximum, right.source.bounds[1])


def test_a_missing_crs_is_still_refused_before_the_run(pair, tmp_path):
    folder, _ = pair
    cloud = open_cloud(folder / "source.las")
    write_cloud(tmp_path / "source.las", cloud, None, None)
    shutil.copy(folder / "target.las", tmp_path)
    with pytest.raises(CrsError, match="no coordinate reference system"):
        levelled(tmp_path, False)


def test_moved_bounds_come_from_the_points_where_the_header_is_senseless(pair):
    from mtpcr_geo.io.views import Moved

    folder, _ = pair
    path = folder / "infinite.las"
    shutil.copy(folder / "source.las", path)
    restate(path, BOUNDS["infinite"])
    moved = Moved(open_cloud(path), lambda xyz: xyz + 1.0, None)
    assert np.allclose(moved.minimum, open_cloud(path).to_array().min(axis=0) + 1.0)
