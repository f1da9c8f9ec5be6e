from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from helpers_scene import make_pair


def test_values_with_arrays_are_compared_by_their_content() -> None:
    bev, again = (make_pair(1000, state="levelled").source.bev for _ in range(2))
    assert bev is not None
    assert again is not None
    # cells without points are NaN in both
    assert np.isnan(bev.top).any()
    assert bev == again
    higher = again.top.copy()
    higher[np.unravel_index(np.nanargmax(higher), higher.shape)] += np.float32(0.5)
    assert bev != replace(again, top=higher)
    assert bev != replace(again, top=again.top.astype(np.float64))
    assert bev != replace(again, grid=replace(again.grid, cell=2.0))
    assert bev != "a raster"


def test_a_pair_is_compared_through_its_parts() -> None:
    pair, solved = make_pair(1000), make_pair(1000, state="solved")
    assert pair.tie_points == solved.tie_points
    assert pair.T_target_source is not None
    assert pair != pair.with_(T_target_source=pair.T_target_source + 1e-12)
    # one has a transform, the other none
    assert pair != pair.with_(T_target_source=None)


def test_values_with_arrays_have_no_hash() -> None:
    with pytest.raises(TypeError, match="unhashable"):
        hash(make_pair(1000, state="levelled").source.bev)
