"""The curves of time and memory: real clouds densified, jobs measured in processes of their own."""

from __future__ import annotations

import csv
import importlib.util
import sys

import laspy
import numpy as np
import pytest
from typer.testing import CliRunner

from mtpcr_geo.benchmark.scale import densify, run_scale
from mtpcr_geo.benchmark.yardsticks import job, measured
from mtpcr_geo.cli import app as cli
from mtpcr_geo.core.errors import MtpcrError, OptionError

pytestmark = pytest.mark.skipif(sys.platform == "win32", reason="Windows tells not what a process took")


def test_a_densified_cloud_keeps_its_place_crs_and_attributes(town_files, tmp_path):
    path = tmp_path / "dense.laz"
    real = laspy.read(town_files[1])
    densify(town_files[1], path, 2 * len(real) + 500)
    dense = laspy.read(path)
    assert len(dense) == 2 * len(real) + 500
    assert dense.header.parse_crs() == real.header.parse_crs()
    assert np.abs(np.asarray(dense.xyz[: len(real)]) - np.asarray(real.xyz)).max() < 0.001
    beside = np.asarray(dense.xyz[len(real) : 2 * len(real)]) - np.asarray(real.xyz)
    assert 0.05 < beside[:, 0].std() < 2.0
    assert beside[:, 2].std() < 0.2 * beside[:, 0].std()
    again = np.asarray(dense.classification[len(real) : 2 * len(real)])
    assert np.array_equal(again, np.asarray(real.classification))


def test_a_process_is_measured(town_files):
    took = measured(job("laspy-read", *town_files))
    assert took.wall_s > 0
    assert took.cpu_s > 0
    assert took.peak_mib is not None
    assert 10 < took.peak_mib < 4_000


def test_a_job_that_fails_is_an_error(tmp_path):
    with pytest.raises(MtpcrError, match=r"laspy-read.*failed: .*FileNotFoundError"):
        measured(job("laspy-read", tmp_path / "nothing.laz"))


@pytest.mark.parametrize("sizes", [[], [0.0], [5_000.0], [float("nan")]])
def test_sizes_of_no_use_are_refused(sizes, tmp_path):
    with pytest.raises(OptionError, match="millions of points"):
        run_scale(tmp_path, sizes, tmp_path / "out")


def test_the_verb_takes_one_pair(tmp_path):
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        (tmp_path / name / "pair.json").write_text("{}")
    result = CliRunner().invoke(
        cli.app, ["benchmark", "--scale", "1", "--data", str(tmp_path), "-o", str(tmp_path / "out")]
    )
    assert result.exit_code == 2
    assert "there are a, b" in result.output


@pytest.mark.slow
def test_tables_and_plot_of_a_small_scale(town_files, tmp_path):
    pytest.importorskip("matplotlib", reason="matplotlib is not installed")
    pair = tmp_path / "pair"
    pair.mkdir()
    for name, path in zip(("source", "target"), town_files, strict=True):
        (pair / f"{name}.laz").write_bytes(path.read_bytes())
    out = tmp_path / "out"
    rows = run_scale(pair, [0.1], out)
    names = {row["job"] for row in rows}
    assert {"laspy read of both", "register", "laspy read and write", "apply", "bev"} <= names
    assert ("PDAL writers.gdal" in names) == (importlib.util.find_spec("pdal") is not None)
    with (out / "stages.csv").open() as file:
        stages = list(csv.DictReader(file))
    assert {"level", "bev", "match", "refine", "registered"} <= {row["stage"] for row in stages}
    assert all(float(row["seconds"]) >= 0 and float(row["cpu_s"]) >= 0 for row in stages)
    assert (out / "scale.png").stat().st_size > 10_000
    assert not list(out.glob("*.laz"))
