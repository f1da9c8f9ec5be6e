"""Points far from all others are found wherever they are; what stands or lies apart in company is kept."""

from __future__ import annotations

import laspy
import numpy as np
import pytest

import mtpcr_geo as mg
from mtpcr_geo.check import check_clouds
from mtpcr_geo.core.cloud import ArrayCloud
from mtpcr_geo.export.descriptions import side_rows
from mtpcr_geo.io.sample import scan
from mtpcr_geo.io.strays import stray_box
from mtpcr_geo.io.write import write_cloud

RNG = np.random.default_rng


def site(seed: int = 1, n: int = 30_000, size: float = 100.0) -> np.ndarray:
    rng = RNG(seed)
    xyz = rng.uniform(0, size, (n, 3)) * [1, 1, 0]
    xyz[:, 2] = 2 * np.sin(xyz[:, 0] / 15) + rng.normal(0, 0.05, n)
    xyz[: n // 5, 2] += rng.uniform(0, 12, n // 5)
    return xyz


def around(middle, spread, n, seed=2) -> np.ndarray:
    return RNG(seed).uniform(-1, 1, (n, 3)) * spread + middle


STRAYS = {
    "one flyer": np.array([[50.0, 50.0, 900.0]]),
    "birds": around([50, 50, 150], [50, 50, 90], 12),
    "multipath below": around([50, 50, -120], [60, 60, 60], 20),
    "far in plan": around([9_000, -4_000, 30], [5_000, 5_000, 20], 15),
    "everywhere": around([0, 0, 0], [50_000, 50_000, 4_000], 100),
    "one place twice": np.repeat(np.array([[700.0, 20.0, 5.0]]), 2, axis=0),
}


@pytest.mark.parametrize("place", [(0.0, 0.0, 0.0), (500_000.0, 5_200_000.0, 400.0)])
@pytest.mark.parametrize("budget", [4_000_000, 4_000])
@pytest.mark.parametrize("name", STRAYS)
def test_strays_are_left_out_of_sample_and_bounds(name, budget, place):
    xyz = site()
    strays = STRAYS[name]
    # chance puts some of those everywhere near enough to be no strays
    sure = int((np.abs(strays - [50, 50, 0]) > [160, 160, 40]).any(axis=1).sum())
    found = scan(ArrayCloud(RNG(3).permutation(np.vstack([xyz, strays])) + place), budget=budget)
    assert sure <= found.strays <= len(strays)
    assert found.count == len(xyz) + len(strays)
    assert found.complete == (budget > found.count)
    assert (found.maximum - place <= [260, 260, 60]).all()
    assert (found.minimum - place >= [-160, -160, -60]).all()
    assert found.sample[:, 2].max() <= found.maximum[2]
    assert (found.whole[1] >= found.maximum).all()


COMPANY = {
    "a tower": np.column_stack([np.full((2, 400), 50.0).T, np.linspace(0, 120, 400)]),
    "a far wall": around([400, 50, 5], [0.1, 20, 5], 400),
    "cables": np.column_stack([np.linspace(0, 100, 600), np.full(600, 30.0), np.full(600, 45.0)]),
    "a second scan": site(4, 8_000) + [600, 0, 60],
    "a pit": around([50, 50, -60], [6, 6, 2], 500),
}


@pytest.mark.parametrize("name", COMPANY)
def test_what_lies_apart_in_company_is_kept(name):
    xyz = np.vstack([site(), COMPANY[name]])
    found = scan(ArrayCloud(xyz))
    assert found.strays == 0
    assert found.box is None
    assert np.array_equal(found.sample, xyz)


def test_the_long_tail_of_a_ground_scan_is_kept():
    rng = RNG(5)
    distance = np.minimum(rng.pareto(1.2, 40_000) + 1, 80)
    angle = rng.uniform(0, 2 * np.pi, len(distance))
    xyz = np.column_stack(
        [distance * np.cos(angle), distance * np.sin(angle), rng.uniform(-1, 8, len(distance))]
    )
    assert scan(ArrayCloud(xyz)).strays < 0.005 * len(xyz)


def test_few_points_and_flat_ones_tell_nothing():
    assert stray_box(site(n=500)) is None
    assert stray_box(np.zeros((5_000, 3))) is None


@pytest.mark.parametrize("budget", [4_000_000, 5_000])
def test_rasters_are_those_without_and_the_output_has_them(tmp_path, budget):
    xyz = site()
    strays = STRAYS["everywhere"][(np.abs(STRAYS["everywhere"]) > [500, 500, 100]).any(axis=1)]
    write_cloud(tmp_path / "clean.laz", ArrayCloud(xyz), None, None, 0.001)
    write_cloud(tmp_path / "stray.laz", ArrayCloud(np.vstack([xyz, strays])), None, None, 0.001)

    def raster(name: str):
        level = {"type": "mtpcr.level", "local": True, "method": "none", "budget": budget}
        pipeline = mg.Pipeline([str(tmp_path / name), level, {"type": "mtpcr.bev", "cell": 1.0}])
        pipeline.execute()
        assert pipeline.pair is not None
        return pipeline.pair.target

    clean, mixed = raster("clean.laz"), raster("stray.laz")
    assert mixed.strays == len(strays)
    assert clean.strays == 0
    assert np.allclose(mixed.bounds, clean.bounds, rtol=0, atol=1e-9)
    assert np.array_equal(mixed.bev.count, clean.bev.count)
    assert np.array_equal(mixed.bev.low, clean.bev.low, equal_nan=True)
    assert dict(side_rows(mixed))["stray points"].startswith(f"{len(strays)}, far from all others")
    assert len(laspy.read(tmp_path / "stray.laz")) == len(xyz) + len(strays)
    report = check_clouds(tmp_path / "stray.laz", source_crs="local")
    stray = next(finding for finding in report.findings if finding.code == "stray")
    assert stray.what.startswith(f"{len(strays)} of its points lie far from all others")
    assert not {"z-stray", "plan-stray"} & {finding.code for finding in report.findings}


def test_real_pairs_have_hardly_any(shared_data):
    from mtpcr_geo.io.las import open_cloud

    for path in sorted(shared_data.glob("*/source.laz")):
        found = scan(open_cloud(path))
        assert found.strays <= 1e-4 * found.count, path
