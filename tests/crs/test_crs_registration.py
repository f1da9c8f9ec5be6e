"""Whole registrations of one site, written in many coordinate reference systems."""

from __future__ import annotations

import html
import itertools
import json
import re
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest
import rasterio
from helpers_crs import (
    CORNERS,
    ELLIPSOIDAL,
    FEET,
    FOOT,
    GROUPS,
    LEVELLED,
    PLACE,
    PLAIN,
    T_MOVED,
    UTM,
    Variant,
    compound,
    options_of,
    placed,
    site,
)
from pyproj import CRS

from mtpcr_geo.core import transforms
from mtpcr_geo.core.errors import CrsError, OptionError
from mtpcr_geo.crs import TransformChain, same_place
from mtpcr_geo.export.apply import apply_transform
from mtpcr_geo.export.transform import read_transform
from mtpcr_geo.io.las import open_cloud
from mtpcr_geo.registration import Registration, register

Sides = tuple[np.ndarray, np.ndarray]


@pytest.fixture(scope="module")
def small() -> Sides:
    return site(24_000)


@pytest.fixture(scope="module")
def full() -> Sides:
    return site()


def run(sides: Sides, source: Variant, target: Variant, folder: Path, **options: Any) -> Registration:
    folder.mkdir(exist_ok=True)
    files = [
        side.write(folder / f"{role}.laz", xyz)
        for role, side, xyz in zip(("source", "target"), (source, target), sides, strict=True)
    ]
    return register(
        files[0],
        files[1],
        folder / "out",
        recording=False,
        overwrite=True,
        **{**options_of(source, target), **options},
    )


def xyz_of(path: Path) -> np.ndarray:
    return np.concatenate(list(open_cloud(path).xyz_chunks()))


@pytest.fixture(scope="module")
def metric(small: Sides, tmp_path_factory: pytest.TempPathFactory) -> np.ndarray:
    """Where the metric case brings the source's corners."""
    variant = PLAIN["metres"]
    found = run(small, variant, variant, tmp_path_factory.mktemp("metric"))
    assert found.verdict.name == "accepted"
    assert found.pair is not None
    corners = placed(found.pair, variant, variant)
    assert np.abs(corners - CORNERS).max() < 0.02, corners - CORNERS
    return corners


@pytest.fixture(scope="module")
def metric_full(full: Sides, tmp_path_factory: pytest.TempPathFactory) -> np.ndarray:
    variant = PLAIN["metres"]
    found = run(full, variant, variant, tmp_path_factory.mktemp("metric"))
    assert found.pair is not None
    return placed(found.pair, variant, variant)


QUICK = [
    (PLAIN, "international feet", "UTM zone 31"),
    (PLAIN, "UTM zone 31", "metres"),
    (PLAIN, "geographic", "US survey feet"),
    (PLAIN, "Lambert-93", "bound"),
    (PLAIN, "metres", "local"),
    (PLAIN, "no CRS but an option", "WGS 84 UTM"),
    (ELLIPSOIDAL, "geocentric", "geographic 3D"),
    (LEVELLED, "compound, feet both", "compound, zone 31"),
]


@pytest.mark.parametrize(("group", "target", "source"), QUICK)
def test_any_crs_gives_the_metric_place(
    group: dict[str, Variant], target: str, source: str, small: Sides, metric: np.ndarray, tmp_path: Path
) -> None:
    found = run(small, group[source], group[target], tmp_path)
    assert found.verdict.name == "accepted"
    assert found.pair is not None
    assert np.abs(placed(found.pair, group[source], group[target]) - metric).max() < 0.001
    chain = TransformChain.of(found.pair)
    file = xyz_of(tmp_path / "source.laz")
    # registered.laz by the chain and, where one says the same, by the single 4x4 of transform.json
    written = open_cloud(found.outputs["registered"])
    document = json.loads(found.outputs["transform"].read_text())
    scales = np.asarray(written.header.scales)
    moved = np.concatenate(list(written.xyz_chunks()))
    assert np.all(np.abs(moved - chain.forward(file)) <= 0.51 * scales)
    off = chain.target.to_work(transforms.apply(np.array(document["T_target_source"]), file))
    off -= chain.target.to_work(moved)
    assert np.linalg.norm(off, axis=1).max() < document["exactness"]["departure_m"] * 1.05 + 0.001
    assert document["exactness"]["departure_m"] < 0.001 or not document["exactness"]["exact"]
    stated = group[target].crs or UTM
    assert written.crs is not None
    assert same_place(written.crs, stated)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("group", "target", "source"),
    [(group, *names) for group in GROUPS for names in itertools.product(group, group)],
)
def test_every_crs_with_every_other(
    group: dict[str, Variant],
    target: str,
    source: str,
    full: Sides,
    metric_full: np.ndarray,
    tmp_path: Path,
) -> None:
    if {target, source} == {"Europe's Lambert", "local"}:
        with pytest.raises(CrsError, match="no rigid transform fits both"):
            run(full, group[source], group[target], tmp_path)
        return
    found = run(full, group[source], group[target], tmp_path)
    assert found.pair is not None
    assert found.verdict.name == "accepted"
    # metres of other grids are longer or shorter by up to 0.1 %: 3 cm from the middle to the corners here
    other_grid = {"UTM zone 31", "geographic", "Lambert-93"}
    within = 0.1 if "local" in (source, target) and {source, target} & other_grid else 0.001
    if target == "Europe's Lambert":
        # metres 3.4 % too short: correspondences of so many metres take in other points (2.4 mm)
        within = 0.003
    assert np.abs(placed(found.pair, group[source], group[target]) - metric_full).max() < within


REFUSED = [
    (PLAIN["metres"], LEVELLED["compound"], "heights do not go together"),
    (ELLIPSOIDAL["geographic 3D"], PLAIN["metres"], "heights do not go together"),
    (ELLIPSOIDAL["geocentric"], Variant(compound(UTM, CRS.from_epsg(5703)), UTM), "NAVD88"),
    (Variant(None), PLAIN["metres"], 'source_crs="'),
    (PLAIN["metres"], Variant(None), 'target_crs="'),
]


@pytest.mark.parametrize(("source", "target", "reason"), REFUSED)
def test_what_does_not_go_together_is_refused_with_its_reason(
    source: Variant, target: Variant, reason: str, small: Sides, tmp_path: Path
) -> None:
    with pytest.raises(CrsError, match=reason):
        run(small, source, target, tmp_path)
    assert not (tmp_path / "out").exists() or not list((tmp_path / "out").rglob("*.*"))


def test_a_far_shift_of_both_changes_no_whole_registration(small: Sides, tmp_path: Path) -> None:
    found = []
    # whole centimetres, which both places hold alike
    near = [np.round(xyz - PLACE, 2) for xyz in small]
    for k, far in enumerate((0.0, 5_000_000.0)):
        files = []
        for role, xyz in zip(("source", "target"), near, strict=True):
            header = laspy.LasHeader(point_format=6, version="1.4")
            header.scales, header.offsets = np.full(3, 0.01), np.full(3, far)
            las = laspy.LasData(header)
            for axis, name in enumerate("XYZ"):
                las[name] = np.rint(xyz[:, axis] * 100).astype(np.int32)
            files.append(tmp_path / f"{role}{k}.laz")
            las.write(files[-1])
        result = register(files[0], files[1], tmp_path / f"out{k}", local=True, level="none", recording=False)
        assert result.pair is not None
        found.append(TransformChain.of(result.pair).forward(near[0] + far) - far)
    assert np.abs(found[0] - found[1]).max() < 1e-6


@pytest.fixture(scope="module")
def in_feet(small: Sides, tmp_path_factory: pytest.TempPathFactory) -> tuple[Registration, Path]:
    """A source in metres of another zone, registered to a target in feet."""
    folder = tmp_path_factory.mktemp("feet")
    return run(small, PLAIN["UTM zone 31"], PLAIN["international feet"], folder), folder


def test_a_target_in_feet_gives_a_result_in_feet(in_feet: tuple[Registration, Path]) -> None:
    found, folder = in_feet
    with laspy.open(found.outputs["registered"]) as file:
        crs = file.header.parse_crs()
        assert crs is not None
        assert crs.axis_info[0].unit_name == "foot"
        assert crs.axis_info[0].unit_conversion_factor == FOOT
    document = json.loads(found.outputs["transform"].read_text())
    assert document["units"] == {"source": ["metre"] * 3, "target": ["foot"] * 3}
    moved, target = xyz_of(found.outputs["registered"]), xyz_of(folder / "target.laz")
    assert np.abs(np.median(moved, axis=0) - np.median(target, axis=0)).max() < 100.0


def test_apply_there_and_back_within_half_the_scale(
    in_feet: tuple[Registration, Path], tmp_path: Path
) -> None:
    found, folder = in_feet
    transform = found.outputs["transform"]
    apply_transform(transform, folder / "source.laz", tmp_path / "there.laz")
    apply_transform(transform, tmp_path / "there.laz", tmp_path / "back.laz", inverse=True)
    start, back = open_cloud(folder / "source.laz"), xyz_of(tmp_path / "back.laz")
    assert np.all(np.abs(back - xyz_of(folder / "source.laz")) <= np.asarray(start.header.scales) / 2)
    again = xyz_of(tmp_path / "there.laz") - xyz_of(found.outputs["registered"])
    assert np.abs(again).max() < 0.00021  # feet: both digits rounded


def test_pdal_opens_the_result_in_feet(in_feet: tuple[Registration, Path], pdal: Any) -> None:
    found, _ = in_feet
    pipeline = pdal.Pipeline(json.dumps([str(found.outputs["registered"])]))
    pipeline.execute()
    array = pipeline.arrays[0]
    opened = np.column_stack([array[axis] for axis in "XYZ"])
    assert np.abs(opened - xyz_of(found.outputs["registered"])).max() < 1e-6
    wkt = pipeline.metadata["metadata"]["readers.las"]["comp_spatialreference"]
    assert same_place(CRS.from_wkt(wkt), FEET)


@pytest.mark.parametrize("role", ["source", "target"])
def test_rasters_in_metres_lie_where_the_files_in_feet_do(
    in_feet: tuple[Registration, Path], role: str
) -> None:
    """Rasters are in the work frame: the target's projection in metres, whatever the files' units."""
    found, folder = in_feet
    side = PLAIN["UTM zone 31" if role == "source" else "international feet"]
    xyz = side.read(xyz_of(folder / f"{role}.laz"))
    with rasterio.open(found.outputs[f"bev_{role}"]) as raster:
        assert raster.units[:2] == ("metre", "metre")
        assert raster.tags()["AREA_OR_POINT"] == "Area"
        crs = CRS.from_wkt(raster.crs.to_wkt())
        assert crs.axis_info[0].unit_name == "metre"
        assert same_place(crs, UTM)
        top, low, count = raster.read()
        edge = raster.transform
        column, row = (xyz[:, 0] - edge.c) / edge.a, (xyz[:, 1] - edge.f) / edge.e
        centre = np.array(raster.xy(0, 0)) - [raster.bounds.left, raster.bounds.top]
        assert np.allclose(centre, [raster.res[0] / 2, -raster.res[1] / 2])
    cell = np.floor(row).astype(int), np.floor(column).astype(int)
    # a few points lie within round-off of a line between cells
    inside = np.minimum(np.abs(row - np.rint(row)), np.abs(column - np.rint(column))) > 1e-3
    assert count.sum() == len(xyz)
    assert np.all(xyz[inside, 2] <= top[cell][inside] + 1e-3)
    assert np.all(xyz[inside, 2] >= low[cell][inside] - 1e-3)
    highest = np.full(count.shape, -np.inf)
    np.maximum.at(highest, cell, xyz[:, 2])
    touched = np.zeros(count.shape, bool)
    touched[cell[0][~inside], cell[1][~inside]] = True
    settled = (count > 0) & ~touched
    assert np.abs(highest[settled] - top[settled]).max() < 1e-3


@pytest.mark.parametrize(
    ("said", "read"), [("EPSG:25831", PLAIN["UTM zone 31"]), ("EPSG:4258", PLAIN["geographic"])]
)
def test_the_result_in_a_crs_of_choice(
    said: str, read: Variant, small: Sides, metric: np.ndarray, tmp_path: Path
) -> None:
    variant = PLAIN["metres"]
    found = run(small, variant, variant, tmp_path, out_crs=said)
    written = open_cloud(found.outputs["registered"])
    assert written.crs is not None
    assert same_place(written.crs, CRS.from_user_input(said))
    assert found.pair is not None
    assert np.abs(placed(found.pair, variant, read) - metric).max() < 0.001
    chain = read_transform(found.outputs["transform"])
    moved = np.concatenate(list(written.xyz_chunks()))
    assert np.all(
        np.abs(moved - chain.forward(xyz_of(tmp_path / "source.laz")))
        <= 0.51 * np.asarray(written.header.scales)
    )


def test_an_estimated_height_offset_is_told_everywhere(small: Sides, tmp_path: Path) -> None:
    source, target = PLAIN["metres"], LEVELLED["compound"]
    raised = small[0] + [0.0, 0.0, 10.0]
    found = run((raised, small[1]), source, target, tmp_path, vertical="estimate")
    assert found.verdict.name == "accepted"
    # the pivot turns with the cloud: the rise of the middle is that of the move and what was added
    offset = found.verdict.metrics["vertical_offset_m"]
    assert offset == pytest.approx(-(T_MOVED[2, 3] + 10.0), abs=0.02)
    run_json = json.loads(found.outputs["run"].read_text())
    assert run_json["metrics"]["vertical_offset_m"] == offset
    assert json.loads(found.outputs["transform"].read_text())["motion"]["vertical_offset_m"] == offset
    page = html.unescape(re.sub(r"<[^>]+>", "", found.outputs["report"].read_text()))
    assert f"{offset:+.3f} m, added to the source's heights" in page


def test_report_and_run_name_frames_and_units(in_feet: tuple[Registration, Path]) -> None:
    found, _ = in_feet
    report = found.outputs["report"].read_text()
    for words in ("ETRS89 / UTM zone 31N", "UTM zone 32N in foot: foot; heights of no stated datum"):
        assert words in report
    frames = json.loads(found.outputs["run"].read_text())["frames"]
    assert frames["source"]["units"] == ["metre"] * 3
    assert frames["result"]["units"] == ["foot"] * 3
    assert frames["work"]["units"] == ["metre"] * 3
    assert "UTM zone 31N" in frames["source"]["operation"]
    assert frames["source"]["accuracy_m"] == 0.0


def test_a_prior_does_no_harm_to_what_lies_right(small: Sides, tmp_path: Path) -> None:
    variant = PLAIN["metres"]
    right = transforms.apply(transforms.inverse(T_MOVED), small[0] - PLACE) + PLACE
    for motion in ("rigid", "yaw", "translation"):
        found = run((right, small[1]), variant, variant, tmp_path, prior="georef", motion=motion)
        assert found.verdict.name == "accepted"
        assert found.pair is not None
        chain = TransformChain.of(found.pair)
        assert np.abs(chain.forward(CORNERS) - CORNERS).max() < 0.01
        if motion == "translation":
            assert np.array_equal(chain.T_target_source[:3, :3], np.eye(3))


def test_a_prior_finds_a_shift_in_feet(small: Sides, metric: np.ndarray, tmp_path: Path) -> None:
    source, target = PLAIN["geographic"], PLAIN["international feet"]
    found = run(small, source, target, tmp_path, prior="georef")
    assert found.pair is not None
    assert np.abs(placed(found.pair, source, target) - metric).max() < 0.001


SITE_GRID = 'LOCAL_CS["site grid",LOCAL_DATUM["site",0],UNIT["metre",1],AXIS["X",EAST],AXIS["Y",NORTH]]'


def test_an_engineering_crs_defines_no_vertical(town_files: tuple[Path, Path], tmp_path: Path) -> None:
    las = laspy.read(town_files[0])
    middle = (las.header.mins + las.header.maxs) / 2
    T_tilted = transforms.about(middle, transforms.tilt_matrix(0.5, np.deg2rad(4.0)))
    las.x, las.y, las.z = transforms.apply(T_tilted, np.asarray(las.xyz)).T
    las.write(tmp_path / "tilted.laz")
    found = register(
        tmp_path / "tilted.laz", town_files[1], tmp_path / "out", source_crs=SITE_GRID, recording=False
    )
    assert found.verdict.name == "accepted"
    assert found.pair is not None
    assert found.pair.source.levelling.method != "none"
    assert found.pair.source.levelling.tilt_deg > 1.0
    assert found.pair.target.levelling.why == "the CRS defines the vertical"


def test_an_engineering_crs_is_no_prior(town_files: tuple[Path, Path], tmp_path: Path) -> None:
    both: dict[str, Any] = {"source_crs": SITE_GRID, "target_crs": SITE_GRID}
    one_sided: list[dict[str, Any]] = [{key: SITE_GRID} for key in both]
    for crs in [*one_sided, both]:
        with pytest.raises(OptionError, match="needs a CRS on both"):
            register(town_files[0], town_files[1], tmp_path / "out", prior="georef", recording=False, **crs)
