"""Filters of PDAL that a pipeline may name without a switch: each runs, and gives the points PDAL gives."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers_scene import ORIGIN, town
from numpy.typing import NDArray

import mtpcr_geo
from mtpcr_geo.core.cloud import ArrayCloud
from mtpcr_geo.io.write import write_cloud
from mtpcr_geo.pipeline.pdal.allowed import ALLOWED
from mtpcr_geo.pipeline.pdal.bindings import drivers

EAST, NORTH = ORIGIN[:2].tolist()
TRIANGLE = f"POLYGON(({EAST} {NORTH}, {EAST + 30} {NORTH}, {EAST + 30} {NORTH + 30}, {EAST} {NORTH}))"
NAMED: dict[str, dict[str, Any]] = {
    "filters.assign": {"value": "Classification = 8"},
    "filters.chipper": {"capacity": 500},
    "filters.cluster": {"tolerance": 2.0},
    "filters.colorinterp": {"minimum": 0, "maximum": 30},
    "filters.dbscan": {"eps": 3.0},
    "filters.decimation": {"step": 3},
    "filters.divider": {"count": 4},
    "filters.expression": {"expression": "Z > 35"},
    "filters.ferry": {"dimensions": "Z=>HeightAboveGround"},
    "filters.fps": {"count": 100},
    "filters.geomdistance": {"geometry": TRIANGLE},
    "filters.groupby": {"dimension": "Classification"},
    "filters.gpstimeconvert": {"conversion": "gst2gt", "in_time": "gst", "out_time": "gt"},
    "filters.hexbin": {"edge_size": 10.0},
    "filters.iqr": {"dimension": "Z"},
    "filters.label_duplicates": {"dimensions": "X,Y,Z"},
    "filters.locate": {"dimension": "Z", "minmax": "max"},
    "filters.mad": {"dimension": "Z"},
    "filters.mongo": {"expression": {"Z": {"$gt": 35}}},
    "filters.mongoexpression": {"expression": {"Z": {"$gt": 35}}},
    "filters.neighborclassifier": {"k": 5},
    "filters.projpipeline": {"coord_op": "+proj=affine +xoff=3"},
    "filters.radialdensity": {"radius": 3.0},
    "filters.radiusassign": {"radius": 3.0, "update_expression": "Classification = 3"},
    "filters.randomize": {"seed": 5},
    "filters.range": {"limits": "Classification[2:2]"},
    "filters.relaxationdartthrowing": {"count": 200, "radius": 1.0, "seed": 3},
    "filters.reprojection": {"out_srs": "EPSG:32633"},
    "filters.returns": {"groups": "only"},
    "filters.sample": {"radius": 2.0},
    "filters.sort": {"dimension": "Z"},
    "filters.splitter": {"length": 40.0},
    "filters.supervoxel": {"resolution": 5.0},
    "filters.transformation": {"matrix": "1 0 0 5 0 1 0 -3 0 0 1 2 0 0 0 1"},
}
"""Options that a filter needs to say anything, or to say it quickly."""
NOT_HERE = {
    "filters.colorization": "needs a raster",
    "filters.cpd": "takes two clouds; a plugin",
    "filters.crop": "done by this package, which names the flags as newer versions of PDAL do",
    "filters.dem": "needs a raster",
    "filters.delaunay": "makes a mesh, which no later stage takes",
    "filters.faceraster": "needs a mesh",
    "filters.gpstimeconvert": "needs times of a kind that the cloud has not",
    "filters.greedyprojection": "makes a mesh, which no later stage takes",
    "filters.griddecimation": "stands under two spellings",
    "filters.h3": "needs geographic coordinates",
    "filters.hag_delaunay": "needs classified ground and heights between",
    "filters.hag_dem": "needs a raster",
    "filters.icp": "takes two clouds",
    "filters.litree": "needs heights above ground",
    "filters.m3c2": "takes two clouds",
    "filters.merge": "takes several inputs; test_pdal.py",
    "filters.overlay": "needs polygons",
    "filters.poisson": "makes a mesh",
    "filters.separatescanline": "needs scan lines",
    "filters.straighten": "needs a line",
    "filters.teaser": "takes two clouds; a plugin",
    "filters.trajectory": "needs times and angles of a flight",
}
PLAIN = """
import json, sys, numpy, pdal
pipeline = pdal.Pipeline(sys.argv[1])
pipeline.execute()
numpy.save(sys.argv[2], numpy.concatenate(pipeline.arrays))
"""
BY_CHANCE = {"filters.randomize", "filters.lloydkmeans", "filters.relaxationdartthrowing"}
"""Filters that draw numbers; PDAL's own two runs need not agree."""
FILTERS = sorted(name for name in ALLOWED if name.startswith("filters.") and name not in NOT_HERE)


@pytest.fixture(scope="module")
def cloud(tmp_path_factory: pytest.TempPathFactory):
    """A LAZ file of 1,500 points of a town, classified."""
    from pyproj import CRS

    rng = np.random.default_rng(3)
    xyz = town(rng, 1500) + ORIGIN
    extra: dict[str, NDArray[np.generic]] = {
        "Classification": np.where(xyz[:, 2] > ORIGIN[2] + 5.0, 6, 2).astype(np.uint8),
        "Intensity": rng.integers(0, 2000, len(xyz)).astype(np.uint16),
        "ReturnNumber": np.ones(len(xyz), np.uint8),
        "NumberOfReturns": np.ones(len(xyz), np.uint8),
        "GpsTime": np.linspace(1e6, 1.0005e6, len(xyz)),
    }
    path = tmp_path_factory.mktemp("cloud") / "town.laz"
    crs = CRS.from_epsg(25833)
    write_cloud(path, ArrayCloud(xyz, crs, "town", extra), None, crs)
    return path


@pytest.mark.slow
@pytest.mark.parametrize("name", FILTERS)
def test_a_filter_gives_the_points_that_pdal_gives(
    name: str, pdal, cloud: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    if name not in drivers():
        pytest.skip(f"this PDAL has no {name}")
    stages: list[Any] = [str(cloud), {"type": name, **NAMED.get(name, {})}]
    made = tmp_path / "theirs.npy"
    # in a process of its own: some filters of some versions crash on small clouds
    command = [sys.executable, "-c", PLAIN, json.dumps(stages), str(made)]
    done = subprocess.run(command, cwd=tmp_path, check=False)
    if done.returncode < 0:
        pytest.skip("PDAL itself crashes here")
    assert done.returncode == 0
    theirs = np.load(made)
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    ours = mtpcr_geo.Pipeline(stages)
    ours.validate()
    ours.execute()
    points = np.concatenate(ours.arrays)
    assert not list(Path().iterdir()), "files beside the outputs"
    names = theirs.dtype.names or ()
    assert set(points.dtype.names or ()) == set(names)
    assert len(points) == len(theirs)
    if name not in BY_CHANCE:
        for dimension in names:
            np.testing.assert_array_equal(points[dimension], theirs[dimension], err_msg=dimension)


def test_every_filter_is_run_or_its_reason_is_given() -> None:
    assert set(NAMED) - {"filters.gpstimeconvert"} <= set(FILTERS)
    assert set(NOT_HERE) <= set(ALLOWED)
