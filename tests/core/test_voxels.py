from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mtpcr_geo.core.voxels import first_in_voxels


def test_first_of_each_voxel_in_order():
    xyz = np.array([[0.0, 0.0, 0.0], [0.9, 0.9, 0.9], [1.1, 0.0, 0.0], [0.2, 0.1, 0.3], [1.2, 0.0, 0.4]])
    assert first_in_voxels(xyz, 1.0).tolist() == [0, 2]
    # another corner cuts otherwise
    assert first_in_voxels(xyz, 1.0, np.full(3, 0.5)).tolist() == [0, 1, 2]
    assert first_in_voxels(xyz[:0], 1.0).tolist() == []


@given(st.integers(0, 10_000), st.floats(0.05, 5.0))
def test_thinning_twice_on_one_lattice_is_thinning_once(seed, edge):
    xyz = np.random.default_rng(seed).uniform(-10, 10, (300, 3))
    once = xyz[first_in_voxels(xyz, edge, np.zeros(3))]
    assert len(np.unique(np.floor(once / edge), axis=0)) == len(once)
    assert np.array_equal(once[first_in_voxels(once, edge, np.zeros(3))], once)
