"""Options of PDAL under their other names."""

from __future__ import annotations

import numpy as np
import pytest

import mtpcr_geo as mg
from mtpcr_geo.core.cloud import ArrayCloud
from mtpcr_geo.core.errors import OptionError
from mtpcr_geo.io.las import open_cloud
from mtpcr_geo.io.write import write_cloud


def test_spatialreference_is_the_override_of_a_reader_and_the_statement_of_a_writer(tmp_path):
    xyz = np.random.default_rng(1).uniform(0, 50, (200, 3)) + [500_000, 5_200_000, 0]
    write_cloud(tmp_path / "in.las", ArrayCloud(xyz), None, None)
    reader = {"type": "readers.las", "filename": str(tmp_path / "in.las"), "spatialreference": "EPSG:25832"}
    mg.Pipeline([reader, str(tmp_path / "out.las")]).execute()
    written = open_cloud(tmp_path / "out.las").crs
    assert written is not None
    assert written.to_epsg() == 25832
    writer = {"type": "writers.las", "filename": str(tmp_path / "b.las"), "spatialreference": "EPSG:25833"}
    mg.Pipeline([reader, writer]).execute()
    written = open_cloud(tmp_path / "b.las").crs
    assert written is not None
    assert written.to_epsg() == 25833


def test_both_names_at_once_are_refused(tmp_path):
    names = {"spatialreference": "EPSG:25832", "override_srs": "EPSG:25832"}
    with pytest.raises(OptionError, match="spatialreference"):
        mg.Pipeline([{"type": "readers.las", "filename": "a.las", **names}, "b.las"]).execute()
