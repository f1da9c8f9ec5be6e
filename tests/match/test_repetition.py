"""Whether a scene fits itself after a shift."""

import numpy as np
import pytest

from mtpcr_geo.core.grid import Grid
from mtpcr_geo.match.pose import Pose
from mtpcr_geo.match.repetition import REPEATS, self_likeness
from mtpcr_geo.match.search import Layer
from mtpcr_geo.method.bev import rasterise
from mtpcr_geo.method.images import channels


def layer_of(places: np.ndarray, cell: float, extent: float) -> Layer:
    rng = np.random.default_rng(1)
    ground = np.column_stack([rng.uniform(0, extent, (20_000, 2)), np.zeros(20_000)])
    crowns = (places[:, None, :] + rng.uniform(-0.2, 0.2, (len(places), 60, 2)) * extent / 20).reshape(-1, 2)
    top = np.column_stack([crowns, np.full(len(crowns), extent / 20)])
    grid = Grid(0.0, extent, cell, round(extent / cell), round(extent / cell))
    bev = rasterise([np.vstack([ground, top])], grid)
    return Layer(grid, channels(bev))


@pytest.mark.parametrize("extent", [20.0, 80.0])
def test_rows_repeat_and_scattered_trees_do_not(extent):
    step = np.arange(extent / 20, extent, extent / 10)
    rows = np.stack(np.meshgrid(step, step), axis=-1).reshape(-1, 2)
    scattered = np.random.default_rng(5).uniform(0, extent, (40, 2))
    still = Pose(0.0, extent / 2, extent / 2)
    cell = extent / 80
    lattice, wood = layer_of(rows, cell, extent), layer_of(scattered, cell, extent)
    assert self_likeness(lattice, lattice, still) > REPEATS
    assert self_likeness(wood, wood, still) < REPEATS
    assert self_likeness(wood, wood, Pose(0.0, 50 * extent, 0.0)) == 0.0
