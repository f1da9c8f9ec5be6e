"""The paper's equations, with numbers worked out by hand."""

from __future__ import annotations

import numpy as np
import pytest

from mtpcr_geo.core.errors import RegistrationError
from mtpcr_geo.core.grid import Grid
from mtpcr_geo.core.types import Bev
from mtpcr_geo.method import images, paper
from mtpcr_geo.method.bev import density, grid_around, rasterise


def bev_of(top: np.ndarray, cell: float = 1.0) -> Bev:
    top = np.asarray(top, np.float32)
    count = np.isfinite(top).astype(np.uint32)
    return Bev(Grid(0.0, top.shape[0] * cell, cell, top.shape[1], top.shape[0]), top, top.copy(), count)


def test_eq1_resolution():
    # 1000 points on 50 m x 40 m: 0.5 a square metre; gamma 4 m gives 2 pixels a metre
    assert paper.resolution(1000, 50.0 * 40.0, 4.0) == 2.0
    assert paper.cell_of(2.0) == 0.5


def test_eq1_occupied_area_leaves_out_what_is_empty():
    # two patches of 4 m x 4 m at the ends of 104 m: 32 m2 occupied, 416 m2 in the bounding box
    x, y = np.meshgrid(np.arange(8) * 0.5 + 0.25, np.arange(8) * 0.5 + 0.25)
    patch = np.column_stack([x.ravel(), y.ravel(), np.zeros(64)])
    xyz = np.vstack([patch, patch + [100.0, 0.0, 0.0]])
    found = density(xyz, len(xyz))
    assert found.area_m2 == 32.0
    assert paper.resolution(128, found.area_m2, 0.25) == 1.0
    assert paper.resolution(128, 104.0 * 4.0, 0.25) == pytest.approx(0.0769, abs=1e-4)


def test_eq1_gamma_left_open_keeps_the_ratio_and_the_mean_cell():
    # densities 8 and 2 have the geometric mean 4; a cell of 1 m wants gamma 1/4, hence cells of 0.5 and 2 m
    gamma = paper.usual_gamma((8.0, 2.0), 1.0)
    assert gamma == pytest.approx(0.25)
    assert [1.0 / (d * gamma) for d in (8.0, 2.0)] == pytest.approx([0.5, 2.0])


@pytest.mark.parametrize("res", [0.01, 100.0])
def test_eq1_refuses_useless_cells(res):
    with pytest.raises(RegistrationError, match="gamma"):
        paper.cell_of(res)


def test_eq2_printed_convention_takes_the_ceiling():
    # xmin = 10: x = 10 is column 0, 10.2 and 11 are column 1, 11.2 is column 2; rows likewise, from the south
    xyz = np.array([[10.0, 5.0, 1.0], [10.2, 6.0, 2.0], [11.0, 5.5, 3.0], [11.2, 7.0, 4.0]])
    grid = paper.ceil_grid(xyz.min(axis=0), xyz.max(axis=0), 1.0)
    assert (grid.width, grid.height) == (3, 3)
    raster = paper.CeilRasteriser(grid)
    raster.add(xyz)
    bev = raster.finish()
    nan = np.nan
    # north up: j = 2 is the first row; the highest of the second and third point is 3
    np.testing.assert_array_equal(bev.top, [[nan, nan, 4.0], [nan, 3.0, nan], [1.0, nan, nan]])
    np.testing.assert_array_equal(bev.count, [[0, 0, 1], [0, 2, 0], [1, 0, 0]])


def test_eq2_corrected_convention_has_pixel_centres():
    xyz = np.array([[10.0, 5.0, 1.0], [10.2, 5.6, 2.0], [11.0, 5.5, 3.0]])
    bev = rasterise([xyz], grid_around(xyz.min(axis=0), xyz.max(axis=0), 1.0))
    np.testing.assert_array_equal(bev.top, [[2.0, 3.0]])
    np.testing.assert_array_equal(bev.grid.to_metres(np.array([[0.0, 0.0]])), [[10.5, 5.5]])


def test_eq2_scaled_coordinates_and_cells_are_the_same_thing():
    rng = np.random.default_rng(3)
    xyz = rng.uniform(0.0, 20.0, (500, 3))
    res = 1.6
    scaled = paper.ceil_grid(xyz.min(axis=0) * res, xyz.max(axis=0) * res, 1.0)
    metric = paper.ceil_grid(xyz.min(axis=0), xyz.max(axis=0), 1.0 / res)
    assert scaled.shape == metric.shape
    found = []
    for grid, factor in ((scaled, res), (metric, 1.0)):
        raster = paper.CeilRasteriser(grid)
        raster.add(xyz * factor)
        found.append(raster.finish().count)
    np.testing.assert_array_equal(found[0], found[1])


def test_eq3_printed_and_corrected():
    # zmin 0, zmax 10: 2.5 m is 63.75, floored to 63; as printed everything below the top is 0
    bev = bev_of(np.array([[0.0, 2.5], [10.0, np.nan]]))
    np.testing.assert_array_equal(paper.grey(bev), [[0, 63], [255, 0]])
    np.testing.assert_array_equal(paper.grey(bev, printed=True), [[0, 0], [255, 0]])


def test_eq3_zmin_is_that_of_all_points():
    # the lowest point of the first cell lies at -10, below all tops: 0 m is then half way
    bev = bev_of(np.array([[0.0, 10.0]]))
    bev.low[0, 0] = -10.0
    np.testing.assert_array_equal(paper.grey(bev), [[127, 255]])


def test_eq4_saturates_after_each_filter():
    # on a flat 7 the first filter gives 16 * 7 = 112, the second 2 * 112 = 224
    assert (paper.enhance(np.full((9, 9), 7, np.uint8)) == 224).all()
    # on a flat 20 the first filter would give 320 and is cut to 255; 2 * 255 is cut again
    assert (paper.enhance(np.full((9, 9), 20, np.uint8)) == 255).all()
    # one pixel of 5 on black: 160 in the middle, -10 around it, cut to 0; then 1600 is cut to 255, and
    # -160 around it to 0
    image = np.zeros((9, 9), np.uint8)
    image[4, 4] = 5
    expected = np.zeros((9, 9), np.uint8)
    expected[4, 4] = 255
    np.testing.assert_array_equal(paper.enhance(image), expected)


def test_eq4_normalised_keeps_flat_ground():
    assert (paper.enhance(np.full((9, 9), 20, np.uint8), "normalised") == 20).all()
    # a pixel of 24 on 16: the first filter gives 16 + 8 * 32/16 = 32 there and 16 - 8 * 2/16 = 15 beside it;
    # the second 32 * 10/2 - 8 * 15/2 = 100 in the middle
    image = np.full((9, 9), 16, np.uint8)
    image[4, 4] = 24
    assert paper.enhance(image, "normalised")[4, 4] == 100


def test_eq5_printed_and_corrected():
    minimum, maximum = np.array([100.0, 200.0, 10.0]), np.array([150.0, 260.0, 35.5])
    ij, value = np.array([[6.0, 9.0]]), np.array([51.0])
    # X = (6 + 200) / 2, Y = (6 + 400) / 2: i twice; Z = (51 * 51 / 255 + 20) / 2
    printed = paper.inverse_mapping(ij, value, minimum, maximum, 2.0)
    np.testing.assert_allclose(printed, [[103.0, 203.0, 15.1]])
    # X = (6 - 0.5 + 200) / 2, Y = (9 - 0.5 + 400) / 2
    corrected = paper.inverse_mapping(ij, value, minimum, maximum, 2.0, printed=False)
    np.testing.assert_allclose(corrected, [[102.75, 204.25, 15.1]])


def test_eq2_and_eq5_go_round():
    # the centre of the cell that a point fell into is never more than half a cell away from it
    rng = np.random.default_rng(5)
    xyz = rng.uniform([100, 200, 0], [150, 260, 20], (50, 3))
    low, high, res = xyz.min(axis=0), xyz.max(axis=0), 2.0
    ij = np.ceil((xyz[:, :2] - low[:2]) * res)
    back = paper.inverse_mapping(ij, np.zeros(50), low, high, res, printed=False)
    assert np.abs(back[:, :2] - xyz[:, :2]).max() <= 0.25 + 1e-9
    grid = paper.ceil_grid(low, high, 1.0 / res)
    row = grid.height - 1 - ij[:, 1]
    np.testing.assert_allclose(grid.to_metres(np.column_stack([ij[:, 0], row])), back[:, :2])


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
