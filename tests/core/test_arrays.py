from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from mtpcr_geo.core.arrays import median


@given(st.lists(st.floats(-1e6, 1e6), min_size=1, max_size=40))
def test_the_median_is_that_of_numpy(values: list[float]) -> None:
    given_ = np.array(values)
    before = given_.copy()
    assert median(given_) == np.median(given_)
    assert (given_ == before).all()
