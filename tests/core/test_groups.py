"""Figures of groups are those of each group by itself."""

from __future__ import annotations

import numpy as np
import pytest

from mtpcr_geo.core.groups import Groups


@pytest.mark.parametrize(("seed", "count", "fewest"), [(1, 500, 1), (2, 500, 6), (3, 2, 1), (4, 40, 50)])
def test_each_group_by_itself(seed, count, fewest):
    rng = np.random.default_rng(seed)
    column, row = rng.integers(-5, 4, (2, count))
    values = rng.normal(size=count).round(1)
    groups = Groups.of(column, row, fewest)
    keys = sorted(set(zip(column.tolist(), row.tolist(), strict=True)))
    parts = [values[(column == c) & (row == r)] for c, r in keys]
    parts = [part for part in parts if len(part) >= fewest]
    assert len(groups) == len(parts)
    assert groups.sizes.tolist() == [len(part) for part in parts]
    np.testing.assert_allclose(groups.means(values), [part.mean() for part in parts], atol=1e-12)
    np.testing.assert_array_equal(groups.medians(values), [np.median(part) for part in parts])


def test_no_values_are_no_groups():
    none = np.empty(0, np.int64)
    groups = Groups.of(none, none)
    assert len(groups) == 0
    assert groups.medians(np.empty(0)).shape == (0,)
    assert groups.means(np.empty(0)).shape == (0,)
