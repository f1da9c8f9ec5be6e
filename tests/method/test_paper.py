"""The paper's equations, with numbers worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from mtpcr_geo.core.errors import RegistrationError
from mtpcr_geo.core.grid import Grid
from mtpcr_geo.core.types import Bev
from mtpcr_geo.method import bev as eq12
from mtpcr_geo.method import images
from mtpcr_geo.method.bev import coverage_of, grid_around, make_bev, rasterise
from mtpcr_geo.method.inverse_mapping import inverse_mapping


def bev_of(top: np.ndarray, cell: float = 1.0) -> Bev:
    top = np.asarray(top, np.float32)
    count = np.isfinite(top).astype(np.uint32)
    return Bev(Grid(0.0, top.shape[0] * cell, cell, top.shape[1], top.shape[0]), top, top.copy(), count)


def test_eq1_resolution():
    # 1000 points on 50 m x 40 m: 0.5 a square metre; gamma 4 m gives 2 pixels a metre
    assert eq12.resolution_of(1000, 50.0 * 40.0, 4.0) == 2.0
    assert eq12.cell_of(2.0) == 0.5


def test_eq1_occupied_area_leaves_out_what_is_empty():
    # two patches of 4 m x 4 m at the ends of 104 m: 32 m2 occupied, 416 m2 in the bounding box
    x, y = np.meshgrid(np.arange(8) * 0.5 + 0.25, np.arange(8) * 0.5 + 0.25)
    patch = np.column_stack([x.ravel(), y.ravel(), np.zeros(64)])
    xyz = np.vstack([patch, patch + [100.0, 0.0, 0.0]])
    found = coverage_of(xyz)
    assert found.occupied_m2 == 32.0
    assert eq12.resolution_of(128, found.occupied_m2, 0.25) == 1.0
    assert eq12.resolution_of(128, 104.0 * 4.0, 0.25) == pytest.approx(0.0769, abs=1e-4)


def test_eq1_gamma_left_open_keeps_the_ratio_and_the_mean_cell():
    # densities 8 and 2 have the geometric mean 4; a cell of 1 m wants gamma 1/4, hence cells of 0.5 and 2 m
    gamma = eq12.usual_gamma((8.0, 2.0), 1.0)
    assert gamma == pytest.approx(0.25)
    assert [1.0 / (d * gamma) for d in (8.0, 2.0)] == pytest.approx([0.5, 2.0])


@pytest.mark.parametrize("res", [0.01, 100.0])
def test_eq1_refuses_useless_cells(res):
    with pytest.raises(RegistrationError, match="gamma"):
        eq12.cell_of(res)


def test_eq2_printed_convention_takes_the_ceiling():
    # xmin = 10: x = 10 is column 0, 10.2 and 11 are column 1, 11.2 is column 2; rows likewise, from the south
    xyz = np.array([[10.0, 5.0, 1.0], [10.2, 6.0, 2.0], [11.0, 5.5, 3.0], [11.2, 7.0, 4.0]])
    grid = eq12.ceil_grid(xyz.min(axis=0), xyz.max(axis=0), 1.0)
    assert (grid.width, grid.height) == (3, 3)
    raster = eq12.Rasteriser(grid, "ceil")
    raster.add(xyz)
    bev = raster.finish()
    nan = np.nan
    # north up: j = 2 is the first row; the highest of the second and third point is 3
    np.testing.assert_array_equal(bev.top, [[nan, nan, 4.0], [nan, 3.0, nan], [1.0, nan, nan]])
    np.testing.assert_array_equal(bev.count, [[0, 0, 1], [0, 2, 0], [1, 0, 0]])


def test_eq2_corrected_convention_has_pixel_centres():
    xyz = np.array([[10.0, 5.0, 1.0], [10.2, 5.6, 2.0], [11.0, 5.5, 3.0]])
    bev = rasterise([xyz], grid_around(xyz.min(axis=0), xyz.max(axis=0), 1.0))
    # the first point lies on a line between cells, of which the southern one holds it
    np.testing.assert_array_equal(bev.top, [[2.0, 3.0], [1.0, np.nan]])
    np.testing.assert_array_equal(bev.grid.to_metres(np.array([[0.0, 0.0]])), [[10.5, 5.5]])


def test_eq2_scaled_coordinates_and_cells_are_the_same_thing():
    rng = np.random.default_rng(3)
    xyz = rng.uniform(0.0, 20.0, (500, 3))
    res = 1.6
    scaled = eq12.ceil_grid(xyz.min(axis=0) * res, xyz.max(axis=0) * res, 1.0)
    metric = eq12.ceil_grid(xyz.min(axis=0), xyz.max(axis=0), 1.0 / res)
    assert scaled.shape == metric.shape
    found = []
    for grid, factor in ((scaled, res), (metric, 1.0)):
        raster = eq12.Rasteriser(grid, "ceil")
        raster.add(xyz * factor)
        found.append(raster.finish().count)
    np.testing.assert_array_equal(found[0], found[1])


def test_eq3_printed_and_corrected():
    # zmin 0, zmax 10: 2.5 m is 63.75, floored to 63; as printed everything below the top is 0
    bev = bev_of(np.array([[0.0, 2.5], [10.0, np.nan]]))
    np.testing.assert_array_equal(images.grey(bev), [[0, 63], [255, 0]])
    np.testing.assert_array_equal(images.grey(bev, printed=True), [[0, 0], [255, 0]])


def test_eq3_zmin_is_that_of_all_points():
    # the lowest point of the first cell lies at -10, below all tops: 0 m is then half way
    bev = bev_of(np.array([[0.0, 10.0]]))
    bev.low[0, 0] = -10.0
    np.testing.assert_array_equal(images.grey(bev), [[127, 255]])


def test_eq4_saturates_after_each_filter():
    # on a flat 7 the first filter gives 16 * 7 = 112, the second 2 * 112 = 224
    assert (images.enhance(np.full((9, 9), 7, np.uint8)) == 224).all()
    # on a flat 20 the first filter would give 320 and is cut to 255; 2 * 255 is cut again
    assert (images.enhance(np.full((9, 9), 20, np.uint8)) == 255).all()
    # one pixel of 5 on black: 160 in the middle, -10 around it, cut to 0; then 1600 is cut to 255, and
    # -160 around it to 0
    image = np.zeros((9, 9), np.uint8)
    image[4, 4] = 5
    expected = np.zeros((9, 9), np.uint8)
    expected[4, 4] = 255
    np.testing.assert_array_equal(images.enhance(image), expected)


def test_eq4_normalised_keeps_flat_ground():
    assert (images.enhance(np.full((9, 9), 20, np.uint8), "normalised") == 20).all()
    # a pixel of 24 on 16: the first filter gives 16 + 8 * 32/16 = 32 there and 16 - 8 * 2/16 = 15 beside it;
    # the second 32 * 10/2 - 8 * 15/2 = 100 in the middle
    image = np.full((9, 9), 16, np.uint8)
    image[4, 4] = 24
    assert images.enhance(image, "normalised")[4, 4] == 100


def test_eq5_printed_and_corrected():
    # xmin = 100, ymin = 200, RES = 2: a raster by the ceiling of 7 x 10 pixels, i east and j north from 0
    xyz = np.array([[100.0, 200.0, 10.0], [103.0, 204.5, 15.25], [103.0, 204.5, 35.5]])
    bev = make_bev(xyz, 0.5, "ceil")
    assert bev.grid.shape == (10, 7)
    pixel = np.array([[6.0, bev.grid.height - 1 - 9.0]])
    # X = (6 + 200) / 2, Y = (6 + 400) / 2: i twice
    printed = inverse_mapping(pixel, bev, surface="top", pixel="printed")
    np.testing.assert_allclose(printed, [[103.0, 203.0, 35.5]])
    # Y = (9 + 400) / 2
    corner = inverse_mapping(pixel, bev, surface="top", pixel="ceil")
    np.testing.assert_allclose(corner, [[103.0, 204.5, 35.5]])
    # half a pixel less: X = (6 - 0.5 + 200) / 2, Y = (9 - 0.5 + 400) / 2
    centre = inverse_mapping(pixel, bev, surface="top", pixel="centre")
    np.testing.assert_allclose(centre, [[102.75, 204.25, 35.5]])


def test_eq5_height_from_grey_values_has_255_steps():
    # zmin = 10, zmax = 35.5: a step is 0.1 m; 15.17 m is grey 51, which is 15.1 m
    xyz = np.array([[0.5, 0.5, 10.0], [1.5, 0.5, 15.17], [2.5, 0.5, 35.5]])
    bev = make_bev(xyz, 1.0)
    assert images.grey(bev)[0, 1] == 51
    grey = inverse_mapping(np.array([[1.0, 0.0]]), bev, surface="grey")
    np.testing.assert_allclose(grey, [[1.5, 0.5, 15.1]])
    outside = inverse_mapping(np.array([[3.0, 0.0]]), bev, surface="grey")
    assert np.isnan(outside[0, 2])


@pytest.mark.parametrize("convention", ["centre", "ceil"])
def test_eq2_and_eq5_go_round(convention):
    # the centre of the cell that a point fell into is never more than half a cell away from it
    rng = np.random.default_rng(5)
    xyz = rng.uniform([100, 200, 0], [150, 260, 20], (50, 3))
    bev = make_bev(xyz, 0.5, convention)
    row, column = np.nonzero(bev.count)
    back = inverse_mapping(np.column_stack([column, row]).astype(float), bev, surface="top")
    for point in xyz:
        assert np.abs(back[:, :2] - point[:2]).max(axis=1).min() <= 0.25 + 1e-9


def test_band_image_has_20_greys_a_metre_and_127_where_empty():
    top = np.zeros((81, 81))
    top[40, 40] = np.nan
    assert (images.band_image(bev_of(top)) == 127).all()
    # a wide step of 2 m: far from its edge the surroundings follow, at the edge it stands 1 m over their mean
    top = np.zeros((81, 201))
    top[:, 101:] = 2.0
    image = images.band_image(bev_of(top)).astype(int)
    assert image[40, 5] == 127
    assert image[40, 103] - 127 == pytest.approx(20.0, abs=3)
    assert image[40, 98] - 127 == pytest.approx(-20.0, abs=3)


@pytest.mark.parametrize("look", images.LOOKS)
def test_every_look_of_an_empty_raster_is_blank(look):
    bev = bev_of(np.full((8, 8), np.nan))
    assert (images.image_of(bev, look) == images.empty_grey(look)).all()
