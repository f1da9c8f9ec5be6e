import json
import subprocess
import sys
from typing import Any

import laspy
import numpy as np
import pytest

from mtpcr_geo.benchmark import metrics
from mtpcr_geo.benchmark.baselines.open3d import import_open3d
from mtpcr_geo.benchmark.simulator import instruments
from mtpcr_geo.benchmark.simulator.buildings import Building, add_building
from mtpcr_geo.benchmark.simulator.mesh import Frame, Material, MeshBuilder
from mtpcr_geo.benchmark.simulator.overlap import near_shares, occupied_cells, place_block
from mtpcr_geo.benchmark.simulator.pairs import KINDS, simulate_pair, write_pair
from mtpcr_geo.benchmark.simulator.raycast import Caster
from mtpcr_geo.benchmark.simulator.roads import RoadStyle, make_network
from mtpcr_geo.benchmark.simulator.scanners import Block, airborne_beams, path_length, robot_beams, uav_beams
from mtpcr_geo.benchmark.simulator.site import make_site
from mtpcr_geo.benchmark.simulator.terrain import relief
from mtpcr_geo.benchmark.simulator.vegetation import Plants, Species
from mtpcr_geo.core import transforms
from mtpcr_geo.core.errors import MissingPartError, OptionError, OutputError

SMALL: dict[str, Any] = {
    "extent_m": 160.0,
    "overlap": 0.25,
    "ground_beams": 150_000,
    "air_density": 3.0,
    "voxel_m": 0.2,
}


@pytest.fixture(scope="module")
def pair():
    return simulate_pair("suburb", 3, tilt_deg=6.0, **SMALL)


def sheet(z: float, material: int, half: float = 50.0) -> np.ndarray:
    return np.array([[[-half, -half, z], [half, -half, z], [half, half, z], [-half, half, z]]])


def plumb_beams(xy: np.ndarray, z: float) -> instruments.Beams:
    n = len(xy)
    return instruments.Beams(
        np.c_[xy, np.full(n, z)],
        np.tile([0.0, 0.0, -1.0], (n, 1)),
        np.arange(n, dtype=np.float64),
        np.zeros((n, 3)),
    )


def test_same_seed_same_pair(pair):
    again = simulate_pair("suburb", 3, tilt_deg=6.0, **SMALL)
    assert np.array_equal(pair.source.xyz, again.source.xyz)
    assert np.array_equal(pair.target.xyz, again.target.xyz)
    assert np.array_equal(pair.T_target_source, again.T_target_source)
    assert not np.array_equal(pair.target.xyz[:50], simulate_pair("suburb", 4, **SMALL).target.xyz[:50])


def test_truth_is_rigid_and_lays_ground_on_ground(pair):
    R = pair.T_target_source[:3, :3]
    assert np.allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(R) == pytest.approx(1.0)
    assert np.rad2deg(np.arccos(R[2, 2])) == pytest.approx(6.0, abs=1e-6)
    moved = transforms.apply(pair.T_target_source, pair.source.xyz)
    heights = []
    for xyz, cloud in ((moved, pair.source), (pair.target.xyz, pair.target)):
        ground = xyz[cloud.extra["Classification"] == 2]
        cell = np.floor(ground[:, :2] / 0.5).astype(int)
        heights.append({(i, j): z for (i, j), z in zip(cell.tolist(), ground[:, 2], strict=True)})
    step = np.array([heights[0][c] - heights[1][c] for c in heights[0].keys() & heights[1].keys()])
    assert len(step) > 300
    assert abs(np.median(step)) < 0.05
    assert np.quantile(np.abs(step), 0.8) < 0.25


def test_overlap_is_as_reported_and_near_what_was_asked(pair):
    moved = transforms.apply(pair.T_target_source, pair.source.xyz)
    shares = metrics.overlap_ratios(moved, pair.target.xyz)
    # the cells of another grid: turned and shifted against the site's
    assert shares == pytest.approx((pair.overlap_source, pair.overlap_target), abs=0.03)
    assert 0.12 < pair.overlap_source < 0.4
    assert 0.12 < pair.overlap_target < 0.4


def test_clouds_are_what_they_claim(pair):
    assert pair.source.crs is None
    assert pair.target.crs.to_epsg() == 25832
    assert pair.target.minimum[0] > 4e5
    assert pair.target.minimum[1] > 5e6
    for cloud in (pair.source, pair.target):
        assert np.isfinite(cloud.xyz).all()
        assert set(cloud.extra) == {
            "Intensity", "ReturnNumber", "NumberOfReturns", "Classification", "GpsTime"
        }  # fmt: skip
        assert all(len(values) == cloud.count for values in cloud.extra.values())
        assert (cloud.extra["ReturnNumber"] <= cloud.extra["NumberOfReturns"]).all()
        assert (np.diff(cloud.extra["GpsTime"]) >= 0).all() or cloud is pair.target
    assert pair.source.extra["NumberOfReturns"].max() == 1
    assert pair.target.extra["NumberOfReturns"].max() > 1


def test_ground_sees_walls_and_air_sees_roofs(pair):
    def above_ground(cloud, xyz):
        built = cloud.extra["Classification"] == 6
        cells, count = np.unique(np.floor(xyz[built, :2]).astype(int), axis=0, return_counts=True)
        return count.mean(), len(cells)

    moved = transforms.apply(pair.T_target_source, pair.source.xyz)
    assert above_ground(pair.source, moved)[0] > 4 * above_ground(pair.target, pair.target.xyz)[0]


def test_pair_is_written_and_read_back(pair, tmp_path):
    written = write_pair(tmp_path / "a", pair)
    assert [p.name for p in written] == ["source.laz", "target.laz", "pair.json"]
    facts = json.loads((tmp_path / "a" / "pair.json").read_text())
    assert np.array_equal(facts["ground_truth"]["T_target_from_source"], pair.T_target_source)
    for name, cloud in (("source", pair.source), ("target", pair.target)):
        las = laspy.read(tmp_path / "a" / f"{name}.laz")
        assert (str(las.header.version), las.header.point_format.id) == ("1.4", 6)
        assert np.abs(np.asarray(las.xyz) - cloud.xyz).max() < 0.00051
        assert np.array_equal(las.classification, cloud.extra["Classification"])
        assert np.array_equal(las.gps_time, cloud.extra["GpsTime"])
    assert laspy.read(tmp_path / "a" / "target.laz").header.parse_crs().to_epsg() == 25832
    with pytest.raises(OutputError, match="exists already"):
        write_pair(tmp_path / "a", pair)


@pytest.mark.parametrize(
    ("kind", "options"),
    [("village", {}), ("town", {"extent_m": 20.0}), ("town", {"overlap": 0.0}), ("town", {"air": "kite"})],
)
def test_options_out_of_range_are_refused(kind, options):
    with pytest.raises(OptionError):
        simulate_pair(kind, 0, **options)


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_has_what_it_is_made_of(kind):
    site = make_site(kind, 5, 180.0)
    first, second = site.mesh(0), site.mesh(1)
    assert np.isfinite(first.vertices).all()
    assert first.triangles.max() < len(first.vertices)
    share = np.bincount(first.material, minlength=len(Material))
    assert share[Material.ASPHALT] > 0
    assert share[Material.LEAF] > 0
    if kind not in ("forest", "farmland"):
        assert share[Material.ROOF] > 2
    # leaves differ between the epochs; most houses do not, but some come and go
    roof = [
        {tuple(corner) for corner in m.vertices[m.triangles[m.material == Material.ROOF]].reshape(-1, 3)}
        for m in (first, second)
    ]
    if roof[0]:
        assert len(roof[0] & roof[1]) > 0.8 * len(roof[0] | roof[1])
    leaf = [m.vertices[m.triangles[m.material == Material.LEAF]] for m in (first, second)]
    assert leaf[0].shape != leaf[1].shape or not np.allclose(*leaf)


def test_buildings_come_and_go_between_epochs():
    site = make_site("suburb", 3, 400.0)
    epochs = [site.mesh(epoch) for epoch in (0, 1, 2)]
    roofs = [
        {tuple(corner) for corner in m.vertices[m.triangles[m.material == Material.ROOF]].reshape(-1, 3)}
        for m in epochs
    ]
    assert roofs[0] - roofs[1]
    assert roofs[1] - roofs[0]
    assert roofs[1] == roofs[2]
    assert len(roofs[0] & roofs[1]) > 0.85 * len(roofs[0] | roofs[1])


def test_who_passes_by_is_met_at_times_and_elsewhere_in_another_epoch():
    site = make_site("town", 4, 180.0)
    first, second = (m.vertices[m.triangles[m.material == Material.PASSING]] for m in map(site.mesh, (0, 1)))
    assert len(first) > 100
    assert first.shape != second.shape or not np.allclose(first, second)
    screen, wall = MeshBuilder(), Frame(0.0, 0.0, 0.0, 0.0)
    screen.box(wall, (4.0, -1.0, 0.0), (4.3, 1.0, 2.0), Material.PASSING)
    screen.box(wall, (9.0, -1.0, 0.0), (9.5, 1.0, 2.0), Material.STONE)
    n = 4000
    beams = instruments.Beams(
        np.tile([0.0, 0.0, 1.0], (n, 1)), np.tile([1.0, 0.0, 0.0], (n, 1)), np.zeros(n), np.zeros((n, 3))
    )
    scan = instruments.measure(Caster(screen.build()), beams, instruments.ROBOT, np.random.default_rng(0))
    # met at the front or the back of the body, or not at all
    assert 0.12 < (scan.xyz[:, 0] < 5.0).mean() < 0.3
    behind = scan.xyz[:, 0] > 5.0
    assert (scan.xyz[behind, 0] > 8.5).all()
    assert 0.6 < behind.sum() / n < 0.85


def test_simulated_pairs_of_other_scanners():
    pair = simulate_pair("steep", 2, ground="tripod", air="uav", tilt_deg=0.0, **SMALL)
    assert pair.source.count > 10_000
    assert pair.target.count > 10_000
    assert pair.overlap_target > 0.05


def test_beam_goes_on_behind_a_leaf():
    out = MeshBuilder()
    out.polygons(sheet(0.0, 0), Material.SOIL)
    out.polygons(sheet(8.0, 0), Material.LEAF)
    rng = np.random.default_rng(1)
    beams = plumb_beams(rng.uniform(-40, 40, (4000, 2)), 60.0)
    scan = instruments.measure(Caster(out.build()), beams, instruments.AIRBORNE, rng)
    leaf = scan.extra["Classification"] == 5
    assert 0.9 < leaf.sum() / 4000 <= 1.0
    assert 0.3 < (~leaf).sum() / 4000 < 0.6
    both = scan.extra["NumberOfReturns"] == 2
    assert (scan.extra["ReturnNumber"][both & leaf] == 1).all()
    assert (scan.extra["ReturnNumber"][both & ~leaf] == 2).all()
    robot = instruments.measure(Caster(out.build()), beams, instruments.ROBOT, rng)
    assert robot.extra["NumberOfReturns"].max() == 1


def test_range_noise_and_reach():
    out = MeshBuilder()
    out.polygons(sheet(0.0, 0, 500.0), Material.ASPHALT)
    caster, rng = Caster(out.build()), np.random.default_rng(2)
    xy = rng.uniform(-20, 20, (5000, 2))
    near = instruments.measure(caster, plumb_beams(xy, 10.0), instruments.ROBOT, rng)
    assert len(near.xyz) == pytest.approx(5000 * 0.94, rel=0.03)
    assert near.xyz[:, 2].std() == pytest.approx(np.hypot(0.02, 0.006), rel=0.1)
    assert abs(near.xyz[:, 2].mean()) < 0.002
    far = instruments.measure(caster, plumb_beams(xy, 150.0), instruments.ROBOT, rng)
    assert len(far.xyz) == 0


@pytest.mark.parametrize("roof", ["gable", "hip", "shed", "flat", "mansard", "sawtooth"])
def test_roofs_are_as_high_as_said_and_closed_from_above(roof):
    building = Building(Frame(3.0, -2.0, 5.0, 0.4), 12.0, 9.0, 6.0, roof, 0.4, 0.3)
    out = MeshBuilder()
    add_building(out, building, np.random.default_rng(0))
    u, v = np.meshgrid(np.linspace(-5.9, 5.9, 40), np.linspace(-4.4, 4.4, 40))
    top = building.frame.place(np.stack([u, v, 0 * u + 50.0], -1)).reshape(-1, 3)
    hits = Caster(out.build()).cast(top, np.tile([0.0, 0.0, -1.0], (len(top), 1)))
    z = 55.0 - hits.distance - 5.0
    assert np.isfinite(z).all()
    is_roof = hits.material == Material.ROOF
    assert is_roof.mean() > 0.8
    assert z[is_roof].min() >= 6.0 - 0.3 * 0.4 - 0.3
    assert z[is_roof].max() <= building.ridge + 1e-3
    assert z[is_roof].max() > building.ridge - 0.6


def test_robot_stays_on_its_path_above_ground():
    path = np.stack([np.linspace(0, 60, 61), np.zeros(61)], 1)
    beams = robot_beams(path, lambda xy: 0.1 * xy[:, 0], 5000, np.random.default_rng(0), drift_m=0.05)
    assert path_length(path) == pytest.approx(60.0)
    assert np.allclose(beams.origin[:, 2] - 0.1 * beams.origin[:, 0], 1.3)
    assert np.allclose(np.linalg.norm(beams.direction, axis=1), 1.0)
    assert np.abs(beams.drift.mean(axis=0)).max() < 0.05
    assert 0.005 < beams.drift.std() < 0.1


@pytest.mark.parametrize("fly", [airborne_beams, uav_beams])
def test_aerial_beams_cover_the_block_as_densely_as_asked(fly):
    block = Block(np.array([-30.0, -80.0]), np.array([50.0, 40.0]), 0.3)
    beams = fly(block, lambda xy: np.zeros(len(xy)), 8.0, np.random.default_rng(0))
    reach = -beams.origin[:, 2] / beams.direction[:, 2]
    spot = beams.origin[:, :2] + reach[:, None] * beams.direction[:, :2]
    density = block.contains(spot).sum() / block.area
    assert 0.6 * 8 < density < 1.1 * 8
    assert np.allclose(block.to_block(block.to_site(spot)), spot)


def test_block_meets_both_shares():
    x, y = np.meshgrid(np.arange(-150, 60), np.arange(-30, 30))
    cells = np.stack([x.ravel(), y.ravel()], 1)
    block, gap = place_block(cells, 150.0, 0.0, 0.2, 0.2)
    inside = block.contains((cells + 0.5).astype(np.float64)).sum()
    assert gap < 0.05
    assert inside / len(cells) == pytest.approx(0.2, abs=0.03)
    assert inside / block.area == pytest.approx(0.2, abs=0.05)


def test_cells_and_shares_by_hand():
    cells = occupied_cells(np.array([[0.2, 0.2], [0.9, 0.1], [-0.1, 5.5]]))
    assert sorted(map(tuple, cells.tolist())) == [(-1, 5), (0, 0)]
    other = np.array([[1, 1], [7, 7], [9, 9], [8, 2]])
    assert near_shares(cells, other) == (0.5, 0.25)
    assert near_shares(cells, other[:0]) == (0.0, 0.0)


def test_walk_follows_roads_and_ends_where_told():
    roads = make_network(150.0, RoadStyle((60.0, 60.0), 3.0, 4.0, 0.1, 6.0), np.random.default_rng(4))
    nodes = roads.nodes
    start, end = int(nodes[:, 0].argmin()), int(nodes[:, 0].argmax())
    path = roads.walk(nodes[:, 0] < 0, start, end, 400.0)
    assert np.allclose(path[0], nodes[start])
    assert np.allclose(path[-1], nodes[end])
    assert np.linalg.norm(np.diff(path, axis=0), axis=1).max() < 1.6
    points, _ = roads.points()
    assert all((np.abs(points - p).sum(axis=1) < 1e-6).any() for p in path[::37])


def test_relief_is_standard_and_band_limited():
    field = relief((128, 100), 1.0, 60.0, 10.0, np.random.default_rng(0))
    assert field.shape == (128, 100)
    assert field.std() == pytest.approx(1.0)
    assert np.abs(np.diff(field, axis=0)).max() < 1.0  # nothing shorter than ten cells


def test_another_epoch_keeps_the_stems():
    rng = np.random.default_rng(0)
    stand = Plants(rng.uniform(0, 100, (500, 2)), np.full(500, 10.0), np.full(500, int(Species.BROADLEAF)))
    later = stand.aged(rng, gone=0.1, growth=0.05)
    assert 400 < len(later.xy) < 490
    assert {tuple(p) for p in later.xy.tolist()} <= {tuple(p) for p in stand.xy.tolist()}
    assert later.height.mean() == pytest.approx(10.5, rel=0.01)


def test_ray_casting_is_not_loaded_by_import():
    code = (
        "import sys, mtpcr_geo.benchmark.simulator.pairs, mtpcr_geo.benchmark.command; "
        "print({'open3d', 'embreex'} & set(sys.modules))"
    )
    out = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert out.stdout.strip() == "set()"


def test_missing_ray_casting_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "embreex", None)
    with pytest.raises(MissingPartError, match=r"mtpcr-geo\[benchmark\]"):
        simulate_pair("town", 0, **SMALL)


def test_rays_meet_what_they_meet_by_hand():
    out = MeshBuilder()
    out.polygons(sheet(2.0, 0, 10.0), Material.ASPHALT)
    out.polygons(sheet(5.0, 0, 1.0), Material.ROOF)
    slope = np.array([0.6, 0.0, -0.8])
    origins = np.array([[0.0, 0.0, 9.0], [5.0, 5.0, 9.0], [0.0, 0.0, 9.0], [-5.0, 0.0, 10.0]])
    directions = np.array([[0.0, 0.0, -1.0], [0.0, 0.0, -1.0], [0.0, 0.0, 1.0], slope])
    hits = Caster(out.build()).cast(origins, directions)
    assert hits.distance == pytest.approx([4.0, 7.0, np.inf, 10.0], rel=1e-6)
    assert hits.material[[0, 1, 3]].tolist() == [Material.ROOF, Material.ASPHALT, Material.ASPHALT]
    assert np.abs(hits.normal[[0, 1, 3]]) == pytest.approx(np.tile([0.0, 0.0, 1.0], (3, 1)))


def test_rays_agree_with_open3d():
    o3d = import_open3d()
    mesh = make_site("suburb", 1, 120.0).mesh(0)
    rng = np.random.default_rng(0)
    origins = np.c_[rng.uniform(-60, 60, (50_000, 2)), rng.uniform(20, 60, 50_000)]
    directions = rng.normal(size=(50_000, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    hits = Caster(mesh).cast(origins, directions)
    scene, tensor = o3d.t.geometry.RaycastingScene(), o3d.core.Tensor
    scene.add_triangles(tensor(mesh.vertices.astype(np.float32)), tensor(mesh.triangles.astype(np.uint32)))
    other = scene.cast_rays(tensor(np.c_[origins, directions].astype(np.float32)))
    distance = other["t_hit"].numpy()
    met = np.isfinite(distance)
    assert np.array_equal(np.isfinite(hits.distance), met)
    assert np.abs(hits.distance[met] - distance[met]).max() < 1e-4
    same = mesh.material[other["primitive_ids"].numpy()[met]] == hits.material[met]
    assert same.mean() > 0.999


def test_one_beam_that_meets_something_else_changes_no_other():
    out = MeshBuilder()
    out.polygons(sheet(0.0, 0), Material.SOIL)
    out.polygons(sheet(8.0, 0), Material.LEAF)
    caster = Caster(out.build())
    xy = np.random.default_rng(1).uniform(-40, 40, (500, 2))
    beams = plumb_beams(xy, 60.0)
    away = plumb_beams(xy, 60.0)
    away.direction[7] = (0.0, 0.0, 1.0)
    scans = [
        instruments.measure(caster, b, instruments.AIRBORNE, np.random.default_rng(2)) for b in (beams, away)
    ]
    others = [scan.part(scan.extra["GpsTime"] != 7.0) for scan in scans]
    assert not (scans[1].extra["GpsTime"] == 7.0).any()
    assert np.array_equal(others[0].xyz, others[1].xyz)
    assert np.array_equal(others[0].extra["Intensity"], others[1].extra["Intensity"])
