"""Coordinate reference systems: facts, units, heights, operations, work frames."""

import json
import warnings

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pyproj import CRS, Transformer
from pyproj.crs import BoundCRS, CompoundCRS, ProjectedCRS
from pyproj.crs.coordinate_operation import ToWGS84Transformation, TransverseMercatorConversion

from mtpcr_geo.core import transforms
from mtpcr_geo.core.errors import CrsError, InputError
from mtpcr_geo.crs import TransformChain, facts_of, parse_crs, resolve_frames, same_place
from mtpcr_geo.io import ArrayCloud

FOOT, US_FOOT = 0.3048, 1200 / 3937
UTM = CRS.from_epsg(25832)
PLACE = np.array([440_000.0, 5_400_000.0, 120.0])


def site(n=400, seed=0, place=PLACE):
    rng = np.random.default_rng(seed)
    return np.round(rng.uniform(0, [300, 200, 30], (n, 3)), 3) + place


def in_units(crs, unit, name):
    """The same projected CRS, its axes in another unit."""
    data = crs.to_json_dict()
    for axis in data["coordinate_system"]["axis"]:
        axis["unit"] = {"type": "LinearUnit", "name": name, "conversion_factor": unit}
    data.pop("id", None)
    data["name"] += f" in {name}"
    return CRS.from_json_dict(data)


def bound(crs, shift=(598.1, 73.7, 418.2, 0.202, 0.045, -2.455, 6.7)):
    return BoundCRS(crs, CRS.from_epsg(4326), ToWGS84Transformation(crs.geodetic_crs, *shift))


def moved_to(crs, xyz, start=UTM, height=1.0):
    """Coordinates of another CRS, by pyproj alone; heights divided by a unit."""
    columns = Transformer.from_crs(start, crs, always_xy=True).transform(*xyz.T)
    result = np.column_stack(columns)
    result[:, 2] /= height
    return result


def compound(horizontal, vertical):
    vertical = CRS.from_user_input(vertical)
    return CompoundCRS(f"{horizontal.name} + {vertical.name}", components=[horizontal, vertical])


def test_facts_of_common_systems():
    rows = {
        "EPSG:25832": ("projected", 1.0, "unsaid", 1.0),
        "EPSG:2994": ("projected", FOOT, "unsaid", FOOT),
        "EPSG:2227": ("projected", US_FOOT, "unsaid", US_FOOT),
        "EPSG:7415": ("projected", 1.0, "datum", 1.0),
        "EPSG:2994+6360": ("projected", FOOT, "datum", US_FOOT),
        "EPSG:26910+8228": ("projected", 1.0, "datum", FOOT),
        "EPSG:4326": ("geographic", 1.0, "unsaid", 1.0),
        "EPSG:4979": ("geographic", 1.0, "ellipsoidal", 1.0),
        "EPSG:4978": ("geocentric", 1.0, "ellipsoidal", 1.0),
    }
    for code, (kind, unit, height, height_unit) in rows.items():
        facts = facts_of(CRS.from_user_input(code))
        assert (facts.kind, facts.height) == (kind, height), code
        assert facts.unit == pytest.approx(unit, rel=1e-12), code
        assert facts.height_unit == pytest.approx(height_unit, rel=1e-12), code


def test_facts_of_engineering_and_bound_systems():
    local = CRS.from_wkt(
        'LOCAL_CS["site grid",LOCAL_DATUM["site",0],UNIT["US survey foot",0.304800609601219],'
        'AXIS["X",EAST],AXIS["Y",NORTH]]'
    )
    facts = facts_of(local)
    assert facts.kind == "local"
    assert facts.unit == pytest.approx(US_FOOT)
    assert facts_of(bound(CRS.from_epsg(31467))).kind == "projected"
    assert facts_of(None).name == "local coordinates"


@pytest.mark.parametrize("code", [5513, 2048, 5714])
def test_systems_that_are_not_handled_say_so(code):
    with pytest.raises(CrsError):
        facts_of(CRS.from_epsg(code))


@pytest.mark.parametrize("version", ["WKT1_GDAL", "WKT1_ESRI", "WKT2_2015", "WKT2_2019"])
@pytest.mark.parametrize(
    "code", ["EPSG:25832", "EPSG:28992", "EPSG:2154", "EPSG:7415", "EPSG:2227", "EPSG:4326"]
)
def test_the_same_place_in_any_wkt(code, version):
    crs = CRS.from_user_input(code)
    assert same_place(crs, CRS.from_wkt(crs.to_wkt(version)))
    assert not same_place(crs, CRS.from_epsg(25833))


def test_the_same_place_needs_the_same_units_and_heights():
    assert not same_place(UTM, in_units(UTM, FOOT, "foot"))
    assert not same_place(UTM, compound(UTM, "EPSG:5783"))
    assert same_place(UTM, bound(UTM))


def test_parse_crs():
    assert parse_crs("local") is None
    assert parse_crs(" Local ") is None
    assert parse_crs("epsg:25832") == UTM
    with pytest.raises(CrsError, match="EPSG:25832"):
        parse_crs("EPSG:twelve")


def test_missing_crs_says_what_to_do():
    known, unknown = ArrayCloud(site(), UTM), ArrayCloud(site())
    with pytest.raises(CrsError, match="--source-crs local"):
        resolve_frames(known, unknown)
    with pytest.raises(CrsError, match="--target-crs"):
        resolve_frames(unknown, known)
    frame, target, source = resolve_frames(known, unknown, source_crs="local")
    assert frame.crs == UTM
    assert (target.file_crs, source.file_crs) == (UTM, None)
    frame, target, source = resolve_frames(unknown, unknown, local=True)
    assert frame.crs is None
    assert resolve_frames(unknown, known, target_crs="local")[0].crs is None
    assert resolve_frames(unknown, unknown, target_crs="EPSG:25832", source_crs=UTM)[0].crs == UTM


def test_clouds_a_thousand_kilometres_apart_are_refused():
    far = ArrayCloud(site() + np.array([0, 1_000_000.0, 0]), UTM)
    with pytest.raises(CrsError, match="1000 km apart"):
        resolve_frames(ArrayCloud(site(), UTM), far)
    resolve_frames(ArrayCloud(site(), UTM), far, source_crs="local")
    feet = in_units(UTM, FOOT, "foot")
    with pytest.raises(CrsError, match="apart"):
        # metres that claim to be feet end up elsewhere
        resolve_frames(ArrayCloud(site(), UTM), ArrayCloud(site(), feet))


def test_bounds_that_make_no_sense():
    empty = ArrayCloud(np.zeros((0, 3)), UTM)
    with pytest.raises(InputError, match="bounds"):
        resolve_frames(empty, empty)
    swapped = ArrayCloud(moved_to(CRS.from_epsg(4326), site())[:, [1, 0, 2]] + np.array([0, 100, 0]), None)
    with pytest.raises(CrsError, match="swapped"):
        resolve_frames(swapped, swapped, target_crs="EPSG:4326", source_crs="EPSG:4326")


SHIFTED_COORDINATE = st.integers(-100_000, 100_000)


@settings(max_examples=50)
@given(
    steps=st.lists(st.tuples(*[SHIFTED_COORDINATE] * 3), min_size=2, max_size=20),
    shift=st.sampled_from([5_000_000.0, -5_000_000.0, 1_000_000.0]),
)
def test_a_far_shift_changes_no_work_coordinate(steps, shift):
    near = (
        np.array(steps) / 128
    )  # exact in binary, so that the file's coordinates are exact after the shift too
    links = [resolve_frames(ArrayCloud(xyz), ArrayCloud(xyz), local=True)[1] for xyz in (near, near + shift)]
    assert np.array_equal(links[0].origin + shift, links[1].origin)
    assert np.array_equal(links[0].to_work(near), links[1].to_work(near + shift))


@settings(max_examples=50)
@given(
    steps=st.lists(st.tuples(*[SHIFTED_COORDINATE] * 3), min_size=2, max_size=20),
    yaw=st.floats(-np.pi, np.pi),
    move=st.tuples(*[st.floats(-100, 100)] * 3),
)
def test_a_far_shift_changes_the_result_by_less_than_a_micrometre(steps, yaw, move):
    near = np.array(steps) / 1000
    T = transforms.compose(transforms.yaw_matrix(yaw), np.array(move))
    results = []
    for shift in (0.0, 5_000_000.0):
        cloud = ArrayCloud(near + shift)
        _, target, source = resolve_frames(cloud, cloud, local=True)
        chain = TransformChain(source, target, T, cloud.xyz[0], np.stack([cloud.minimum, cloud.maximum]))
        results.append(chain.forward(cloud.xyz) - shift)
        assert np.abs(chain.inverse(chain.forward(cloud.xyz)) - cloud.xyz).max() < 1e-8
    assert np.abs(results[0] - results[1]).max() < 1e-6


def tm_on(geodetic, name):
    return ProjectedCRS(
        TransverseMercatorConversion(48.7, 8.2, 200_000, 100_000, 1.0), name=name, geodetic_crs=geodetic
    )


ETRS3D = UTM.to_3d()
VARIANTS = {
    "metres": (UTM, 1.0),
    "international feet": (in_units(UTM, FOOT, "foot"), FOOT),
    "US survey feet": (in_units(UTM, US_FOOT, "US survey foot"), US_FOOT),
    "other UTM zone": (CRS.from_epsg(25833), 1.0),
    "other datum": (CRS.from_epsg(32632), 1.0),
    "geographic": (CRS.from_epsg(4258), 1.0),
    "WGS 84": (CRS.from_epsg(4326), 1.0),
    "conformal conic": (CRS.from_epsg(3034), 1.0),
    "bound": (bound(UTM, (0,) * 7), 1.0),
    "grid of its own": (tm_on(CRS.from_epsg(4258), "town grid"), 1.0),
}
WITH_HEIGHTS = {
    "ellipsoidal": (ETRS3D, 1.0),
    "geographic 3D": (CRS.from_epsg(4937), 1.0),
    "geocentric": (CRS.from_epsg(4936), 1.0),
}
LEVELLED = {
    "compound": (compound(UTM, "EPSG:5783"), 1.0),
    "compound, other zone": (compound(CRS.from_epsg(25833), "EPSG:5783"), 1.0),
    "compound, geographic": (compound(CRS.from_epsg(4258), "EPSG:5783"), 1.0),
    "compound, feet across": (compound(in_units(UTM, FOOT, "foot"), "EPSG:5783"), 1.0),
}


def group_of(name):
    return next(group for group in GROUPS if name in group)


def written_in(crs, height, xyz):
    start = ETRS3D if facts_of(crs).height == "ellipsoidal" else UTM
    target = crs if facts_of(crs).vertical is None else crs.sub_crs_list[0]
    return ArrayCloud(moved_to(target, xyz, start, height), crs)


GROUPS = (VARIANTS, WITH_HEIGHTS, LEVELLED)
TOGETHER = [(one, other) for group in GROUPS for one in group for other in group]
APART = [(next(iter(one)), next(iter(other))) for one in GROUPS for other in GROUPS if one is not other]


@pytest.mark.parametrize(("target_name", "source_name"), TOGETHER + APART)
def test_one_site_in_many_systems(target_name, source_name):
    """A rigid move in metres is found again in any two systems, or they are refused with a reason."""
    target_crs, target_height = group_of(target_name)[target_name]
    source_crs, source_height = group_of(source_name)[source_name]
    metric_source, shift = site(100), np.array([12.5, -7.25, 1.5])
    turn = transforms.about(metric_source.mean(axis=0), transforms.yaw_matrix(0.4))
    metric_target = transforms.apply(turn, metric_source) + shift
    target = written_in(target_crs, target_height, metric_target)
    source = written_in(source_crs, source_height, metric_source)
    if group_of(target_name) is not group_of(source_name):
        with pytest.raises(CrsError, match=r"heights|operation from"):
            resolve_frames(target, source)
        return
    _, target_link, source_link = resolve_frames(target, source)
    source_work, target_work = source_link.to_work(source.xyz), target_link.to_work(target.xyz)
    # the best rigid transform between known correspondences
    a, b = source_work - source_work.mean(axis=0), target_work - target_work.mean(axis=0)
    U, _, Vt = np.linalg.svd(b.T @ a)
    R = U @ np.diag([1, 1, np.linalg.det(U @ Vt)]) @ Vt
    T = transforms.compose(R, target_work.mean(axis=0) - R @ source_work.mean(axis=0))
    chain = TransformChain(
        source_link, target_link, T, source.xyz.mean(axis=0), np.stack([source.minimum, source.maximum])
    )
    placed = chain.forward(source.xyz)
    wanted = transforms.apply(turn, metric_source) + shift
    start = ETRS3D if facts_of(target_crs).height == "ellipsoidal" else UTM
    end = target_crs if facts_of(target_crs).vertical is None else target_crs.sub_crs_list[0]
    placed[:, 2] *= target_height
    back = np.column_stack(Transformer.from_crs(end, start, always_xy=True).transform(*placed.T))
    assert np.abs(back - wanted).max() < 0.001
    assert np.abs(chain.inverse(chain.forward(source.xyz)) - source.xyz).max() < 1e-3
    assert target_link.report.operation


def test_local_and_missing_crs_give_the_metric_result():
    metric_source = site()
    target = ArrayCloud(metric_source + np.array([3.0, 4.0, 5.0]), UTM)
    base = resolve_frames(target, ArrayCloud(metric_source, UTM))
    for crs, options in (
        (None, {"source_crs": "EPSG:25832"}),
        (None, {"source_crs": "local"}),
        (None, {"local": True}),
    ):
        frame, target_link, source_link = resolve_frames(target, ArrayCloud(metric_source, crs), **options)
        assert np.array_equal(source_link.to_work(metric_source), base[2].to_work(metric_source))
        assert np.array_equal(target_link.to_work(target.xyz), base[1].to_work(target.xyz))
    frame, _, source_link = resolve_frames(target, ArrayCloud(metric_source), source_crs="local")
    assert frame.crs == UTM


def test_local_feet_from_an_engineering_crs():
    feet = CRS.from_wkt(
        'LOCAL_CS["site grid",LOCAL_DATUM["site",0],UNIT["foot",0.3048],AXIS["X",EAST],AXIS["Y",NORTH]]'
    )
    xyz = site(place=np.zeros(3))
    _, _, link = resolve_frames(ArrayCloud(site(), UTM), ArrayCloud(xyz / FOOT, feet))
    assert np.allclose(link.to_work(xyz / FOOT) + link.origin, xyz, atol=1e-9)


@pytest.mark.parametrize(
    ("crs", "known"),
    [
        (UTM, True),
        (CRS.from_epsg(4979), True),
        (CRS.from_epsg(4978), True),
        (None, False),
        (CRS.from_wkt('LOCAL_CS["site grid",UNIT["metre",1],AXIS["X",EAST],AXIS["Y",NORTH]]'), False),
        (
            CRS.from_wkt(
                'ENGCRS["plant",EDATUM["plant datum"],CS[Cartesian,3],AXIS["x",east],AXIS["y",north],'
                'AXIS["z",up],LENGTHUNIT["metre",1]]'
            ),
            False,
        ),
    ],
)
def test_an_engineering_crs_is_no_georeference(crs, known):
    place = {4979: [8.0, 48.7, 100.0], 4978: [4.17e6, 0.59e6, 4.77e6]}.get(crs and crs.to_epsg(), PLACE)
    spread = [1e-4, 1e-4, 30] if crs is not None and crs.is_geographic else [30, 20, 30]
    xyz = np.random.default_rng(0).uniform(0, spread, (50, 3)) + place
    cloud = ArrayCloud(xyz, crs)
    _, target_link, source_link = resolve_frames(cloud, cloud, local=crs is None)
    assert target_link.georeferenced is source_link.georeferenced is known
    assert facts_of(crs).georeferenced is known


def test_horizontal_and_vertical_units_apart():
    crs = CRS.from_user_input("EPSG:2994+6360")  # feet across, US survey feet up
    xyz = np.array([[636_000.0, 849_000.0, 430.0], [636_500.0, 849_600.0, 500.0]])
    _, link, _ = resolve_frames(ArrayCloud(xyz, crs), ArrayCloud(xyz, crs))
    work = link.to_work(xyz) + link.origin
    assert np.allclose(work, xyz * [FOOT, FOOT, US_FOOT], rtol=0, atol=1e-9)
    assert np.allclose(link.to_file(link.to_work(xyz)), xyz, rtol=0, atol=1e-9)
    assert np.allclose(transforms.apply(link.T_work_file, xyz), link.to_work(xyz), rtol=0, atol=1e-8)
    assert np.allclose(link.T_file_work @ link.T_work_file, np.eye(4), atol=1e-8)


def test_the_same_datum_in_other_units_is_no_difference():
    metre, us = "EPSG:5703", "EPSG:6360"
    base = CRS.from_epsg(26910)
    xyz = site(place=np.array([500_000.0, 4_900_000.0, 100.0]))
    target = ArrayCloud(xyz, compound(base, metre))
    source = ArrayCloud(xyz / [1, 1, US_FOOT], compound(base, us))
    _, target_link, source_link = resolve_frames(target, source)
    assert np.allclose(
        source_link.to_work(source.xyz) + source_link.origin,
        target_link.to_work(xyz) + target_link.origin,
        rtol=0,
        atol=1e-9,
    )


def test_unequal_heights_are_refused_with_the_ways_out():
    plain, levelled = ArrayCloud(site(), UTM), ArrayCloud(site(), compound(UTM, "EPSG:5783"))
    for target, source in ((plain, levelled), (levelled, plain)):
        with pytest.raises(CrsError) as caught:
            resolve_frames(target, source)
        for word in ("assume-same", "estimate", "DHHN92"):
            assert word in str(caught.value)
        for vertical in ("assume-same", "estimate"):
            _, _, link = resolve_frames(target, source, vertical=vertical)
            assert np.allclose(link.to_work(source.xyz) + link.origin, site(), atol=1e-9)
            assert any("heights differ" in note for note in link.report.notes)


def test_different_vertical_datums_never_pass_in_silence():
    one, other = compound(UTM, "EPSG:5783"), compound(UTM, "EPSG:5703")  # DHHN92, NAVD88
    with pytest.raises(CrsError, match="operation from"):
        resolve_frames(ArrayCloud(site(), one), ArrayCloud(site(), other))


def test_a_missing_geoid_is_named():
    base = CRS.from_epsg(6340)  # NAD83(2011) / UTM zone 11N
    xyz = site(place=np.array([500_000.0, 4_000_000.0, 100.0]))
    target, source = ArrayCloud(xyz, compound(base, "EPSG:5703")), ArrayCloud(xyz, base.to_3d())
    with pytest.raises(CrsError, match=r"us_noaa_g\S+\.tif"):
        resolve_frames(target, source)
    _, _, link = resolve_frames(target, source, vertical="estimate")
    assert np.allclose(link.to_work(xyz) + link.origin, xyz, atol=1e-9)


def test_missing_grid_is_named():
    xyz = moved_to(
        CRS.from_epsg(28992), np.array([[5.0, 52.0, 0.0], [5.01, 52.01, 1.0]]), CRS.from_epsg(4289)
    )
    with pytest.raises(CrsError, match=r"nl_nsgi_rdtrans\d+\.tif"):
        resolve_frames(
            ArrayCloud(moved_to(CRS.from_epsg(25831), xyz, CRS.from_epsg(28992)), CRS.from_epsg(25831)),
            ArrayCloud(xyz, CRS.from_epsg(28992)),
        )


def test_vertical_datums_with_an_operation_are_transformed():
    one, other = compound(UTM, "EPSG:5783"), compound(UTM, "EPSG:5621")  # DHHN92, EVRF2007: EPSG 5428
    _, target_link, source_link = resolve_frames(ArrayCloud(site(), one), ArrayCloud(site(), other))
    difference = source_link.to_work(site()) + source_link.origin - site()
    assert np.allclose(difference[:, :2], 0, atol=1e-6)
    assert np.all((difference[:, 2] > -0.03) & (difference[:, 2] < -0.01))
    assert np.allclose(difference[:, 2], (moved_to(one, site(), other) - site())[:, 2], atol=1e-9)
    assert "EVRF2007" in source_link.report.operation
    assert target_link.pipeline is None


def test_datum_shift_of_a_bound_crs_is_used():
    gauss = CRS.from_epsg(31467)
    shifted = bound(gauss)
    xyz = moved_to(shifted, site())
    _, _, source_link = resolve_frames(ArrayCloud(site(), CRS.from_epsg(32632)), ArrayCloud(xyz, shifted))
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        expected = moved_to(CRS.from_epsg(32632), xyz, shifted)
    assert np.allclose((source_link.to_work(xyz) + source_link.origin)[:, :2], expected[:, :2], atol=1e-3)


def test_operations_agree_with_pyproj_and_are_recorded():
    """pyproj by another route: through degrees, one CRS at a time."""
    source_xyz = moved_to(CRS.from_epsg(25833), site())
    _, _, link = resolve_frames(ArrayCloud(site(), UTM), ArrayCloud(source_xyz, CRS.from_epsg(25833)))
    degrees = moved_to(CRS.from_epsg(4258), source_xyz, CRS.from_epsg(25833))
    again = moved_to(UTM, degrees, CRS.from_epsg(4258))
    assert np.allclose(link.to_work(source_xyz) + link.origin, again, rtol=0, atol=1e-6)
    assert link.report.accuracy_m == 0.0
    assert link.report.grids == ()
    assert "UTM zone 33N" in link.report.operation
    assert link.departure < 0.01


def test_the_matrix_of_a_pipeline_says_how_far_it_is_off():
    xyz = moved_to(CRS.from_epsg(4258), site())
    _, _, link = resolve_frames(ArrayCloud(site(), UTM), ArrayCloud(xyz, CRS.from_epsg(4258)))
    off = np.linalg.norm(transforms.apply(link.T_work_file, xyz) - link.to_work(xyz), axis=1).max()
    assert 1e-6 < off <= link.departure * 1.05
    assert link.departure < 0.05


def test_points_beyond_an_operation_are_an_error():
    _, _, link = resolve_frames(
        ArrayCloud(site(), UTM), ArrayCloud(moved_to(CRS.from_epsg(4258), site()), CRS.from_epsg(4258))
    )
    with pytest.raises(CrsError, match="outside"):
        link.to_work(np.array([[8.0, 1e6, 0.0]]))


@pytest.mark.parametrize(
    ("code", "height"),
    [("EPSG:25833", 1.0), ("EPSG:4258", 1.0), ("EPSG:25832", 1.0), (in_units(UTM, FOOT, "foot"), FOOT)],
)
def test_output_in_a_crs_of_choice(code, height):
    target, source = ArrayCloud(site(), UTM), ArrayCloud(site(), UTM)
    frame, target_link, _ = resolve_frames(target, source, out_crs=code)
    link = frame.output or target_link
    crs = CRS.from_user_input(code)
    out = link.to_file(target_link.to_work(site()))
    assert link.file_crs is not None
    assert same_place(link.file_crs, crs)
    expected = moved_to(crs, site(), height=height)
    assert np.allclose(out, expected, rtol=0, atol=1e-8 if crs.is_geographic else 1e-6)
    assert np.allclose(link.to_work(out), target_link.to_work(site()), atol=1e-6)


def test_a_map_of_untrue_scale_says_so_and_takes_no_local_source():
    local, metres = ArrayCloud(site() - PLACE), site()
    for code, scale in ((25832, 0.9996), (3857, 1.5), (3034, 0.966)):
        crs = CRS.from_epsg(code)
        target = ArrayCloud(moved_to(crs, metres), crs)
        _, link, _ = resolve_frames(target, target)
        assert link.report.grid_scale == pytest.approx([scale, scale], rel=0.02)
        assert any("off by that" in note for note in link.report.notes) == (code != 25832)
        if code == 25832:
            resolve_frames(target, local, source_crs="local")
        else:
            with pytest.raises(CrsError, match="no rigid transform fits both"):
                resolve_frames(target, local, source_crs="local")


def test_output_crs_needs_a_place_on_earth():
    cloud = ArrayCloud(site())
    with pytest.raises(CrsError, match="--out-crs"):
        resolve_frames(cloud, cloud, local=True, out_crs="EPSG:25832")
    known = ArrayCloud(site(), UTM)
    with pytest.raises(CrsError, match="--out-crs"):
        resolve_frames(known, known, out_crs="local")


ROUTES = [
    ("EPSG:25833", "EPSG:25832"),
    ("EPSG:4258", "EPSG:25832"),
    ("EPSG:4326", "EPSG:32632"),
    ("EPSG:4936", "EPSG:4937"),
    ("EPSG:3034", "EPSG:25832"),
]
# PDAL 2.2 leaves such heights as they are; GDAL since then does not
LEVEL_ROUTE = ("EPSG:25832+5783", "EPSG:25832+5621")


def by_pdal(start, end, xyz):
    pdal = pytest.importorskip("pdal", reason="PDAL is not installed")
    array = np.zeros(len(xyz), [(axis, "<f8") for axis in "XYZ"])
    for axis, name in enumerate("XYZ"):
        array[name] = xyz[:, axis]
    stage = {"type": "filters.reprojection", "in_srs": start, "out_srs": end}
    pipeline = pdal.Pipeline(json.dumps([stage]), arrays=[array])
    pipeline.execute()
    return np.column_stack([pipeline.arrays[0][axis] for axis in "XYZ"])


def by_gdal(start, end, xyz):
    from rasterio.warp import transform

    return np.column_stack(transform(start, end, *xyz.T))


@pytest.mark.parametrize(
    ("tool", "start", "end"),
    [*((by_pdal, *r) for r in ROUTES), *((by_gdal, *r) for r in (*ROUTES, LEVEL_ROUTE))],
)
def test_operations_agree_with_other_tools(tool, start, end):
    first, last = CRS.from_user_input(start), CRS.from_user_input(end)
    xyz = site(50) if first.is_compound else written_in(first, 1.0, site(50)).xyz
    theirs = tool(start, end, xyz)
    _, target_link, source_link = resolve_frames(ArrayCloud(theirs, last), ArrayCloud(xyz, first))
    ours = source_link.to_work(xyz) + source_link.origin
    assert np.allclose(ours, target_link.to_work(theirs) + target_link.origin, rtol=0, atol=0.001)
    assert np.allclose(target_link.to_file(ours - target_link.origin)[:, 2], theirs[:, 2], rtol=0, atol=0.001)
