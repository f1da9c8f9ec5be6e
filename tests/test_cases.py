"""The small inputs of ../shared/cases: each stands for a kind, which has tests of its own in its room."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest

import mtpcr_geo as mg
from mtpcr_geo.check import CheckReport, check_clouds
from mtpcr_geo.core.errors import InputError
from mtpcr_geo.io.las import open_cloud
from mtpcr_geo.io.write import write_cloud


@pytest.fixture(scope="session")
def cases(shared_cases: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = runpy.run_path(str(shared_cases / "make_cases.py"))
    folder = tmp_path_factory.mktemp("cases")
    made["main"](folder)
    made["odd_frames"](folder)
    return folder


def codes(report: CheckReport) -> set[str]:
    return {finding.code for finding in report.findings}


CRS_OF = {
    "f5_vertical_5103_swapped": ("EPSG:26910", "NAVD88 height"),
    "f6_padded_keys": ("EPSG:32617", "heights of no stated datum"),
    "f7_units_only": (None, None),
    "f8_vertical_units_only": ("EPSG:26910", "heights of no stated datum"),
    "f8_nothing_vertical": ("EPSG:26910", "heights of no stated datum"),
    "f8_navd88": ("EPSG:26910", "NAVD88 height"),
}


@pytest.mark.parametrize("name", CRS_OF)
def test_geotiff_keys(cases, name):
    code, heights = CRS_OF[name]
    report = check_clouds(cases / f"{name}.las")
    facts = report.clouds["source"]
    assert facts.heights == heights
    if code is None:
        assert report.exit_code == 6
        assert "crs-missing" in codes(report)
    else:
        assert report.exit_code == 0
        assert facts.crs_code is not None
        assert facts.crs_code.startswith(code)


@pytest.mark.parametrize("other", ["f8_navd88", "f8_nothing_vertical"])
def test_a_vertical_unit_is_no_datum(cases, other):
    files = cases / "f8_vertical_units_only.las", cases / f"{other}.las"
    report = check_clouds(*files)
    if other == "f8_navd88":
        assert report.exit_code == 6
        assert any('vertical="assume-same"' in finding.fix for finding in report.findings)
        report = check_clouds(*files, vertical="assume-same")
    assert report.exit_code == 0


@pytest.mark.parametrize("suffix", [".las", ".laz", ".copc.laz"])
@pytest.mark.parametrize(
    ("name", "extra"),
    [
        ("f9_latin1_user_id", []),
        ("f9_latin1_extra_name", ["Höhe"]),
        ("f9_extra_twice", ["Amplitude", "Amplitude_2"]),
        ("f9_extra_beyond", ["A"]),
        ("f10_two_extra_vlrs", ["Amplitude", "Confidence"]),
        ("f11_342_dims_in_evlr", [f"f{i}" for i in range(342)]),
        ("f12_evlr_17MB", []),
    ],
)
def test_odd_files_are_read_and_written_back(cases, tmp_path, name, extra, suffix):
    path = cases / f"{name}.las"
    assert check_clouds(path).exit_code == 0
    cloud = open_cloud(path)
    out = tmp_path / f"out{suffix}"
    write_cloud(out, cloud, None, cloud.crs)
    written = open_cloud(out)
    assert list(written.point_format.extra_dimension_names) == extra
    before, after = (
        np.sort(np.concatenate([record.array for record in one.record_chunks()]), order=("gps_time",))
        for one in (cloud, written)
    )
    for dimension in extra:
        assert np.array_equal(before[dimension], after[dimension])
    others = {record.user_id for record in cloud.records if record.is_kept}
    assert others <= {record.user_id for record in written.records}
    if name == "f12_evlr_17MB":
        sizes = {record.user_id: record.size for record in written.records}
        assert sizes["trajectory"] == 17_000_000


def test_bounds_that_are_no_numbers(cases):
    report = check_clouds(cases / "f13_infinite_bounds.las")
    assert report.exit_code == 0
    assert "bounds-wrong" in codes(report)
    assert "scale-senseless" not in codes(report)


def test_millimetres_are_named(cases):
    files = cases / "g2_source_millimetres.las", cases / "g2_target.las"
    report = check_clouds(*files, local=True)
    assert report.exit_code == 5
    unit = next(finding for finding in report.findings if finding.code == "unit")
    assert unit.role == "source"
    assert 'source_unit="mm"' in unit.fix
    assert "raster-size" not in codes(report)
    with pytest.raises(InputError, match='source_unit="mm"'):
        mg.register(*files, local=True)
    report = check_clouds(*files, local=True, source_unit="mm")
    assert report.exit_code == 0
    assert report.clouds["source"].horizontal_unit == "millimetre"
    missing = next(f for f in check_clouds(files[0]).findings if f.code == "crs-missing")
    assert "in millimetres" in missing.what


@pytest.mark.parametrize(
    ("name", "code", "axes"),
    [("g3_source_y_up", "lies-on-its-side", "y-up"), ("g4_source_upside_down", "upside-down", "z-down")],
)
def test_axes_are_named(cases, name, code, axes):
    files = cases / f"{name}.las", cases / "g2_target.las"
    # also where nothing states that the cloud is local
    for report in (check_clouds(*files, local=True), check_clouds(files[0])):
        found = next(finding for finding in report.findings if finding.code == code)
        assert f'source_axes="{axes}"' in found.fix
        assert "z-range" not in codes(report)
    report = check_clouds(*files, local=True, source_axes=axes)
    assert not {"lies-on-its-side", "upside-down", "tilted"} & codes(report)


def test_the_frames_follow_the_points(cases):
    def levelled(source: Path):
        files = [cases / "f2_utm_source_zero_bounds_target.las", source]
        pipeline = mg.Pipeline([*(str(file) for file in files), {"type": "mtpcr.level"}])
        pipeline.execute()
        assert pipeline.pair is not None
        return pipeline.pair

    wrong = levelled(cases / "f2_utm_source_zero_bounds_source.las")
    good = cases / "f2_source_good.las"
    cloud = open_cloud(cases / "f2_utm_source_zero_bounds_source.las")
    write_cloud(good, cloud, None, cloud.crs, 0.01)
    right = levelled(good)
    assert np.array_equal(wrong.source.link.origin, right.source.link.origin)
    assert np.array_equal(wrong.source.sample, right.source.sample)
    assert "header's bounds are wrong" in wrong.source.remarks[0]
    assert right.source.remarks == ()


@pytest.mark.slow
def test_a_pair_with_zero_bounds_is_registered(cases):
    found = mg.register(*(cases / f"f2_utm_source_zero_bounds_{role}.las" for role in ("source", "target")))
    assert found.verdict.name == "accepted"
    source = open_cloud(cases / "f2_utm_source_zero_bounds_source.las").to_array()
    truth = np.load(cases / "f2_utm_source_zero_bounds_truth.npy")
    assert np.median(np.linalg.norm(found.apply(source) - truth, axis=1)) < 0.5
