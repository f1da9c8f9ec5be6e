"""Sites that look the same when turned."""

import numpy as np
import pytest

from mtpcr_geo.benchmark.simulator.symmetric import KINDS, SITE_M, symmetric_pair
from mtpcr_geo.method.overlap import overlap_of


@pytest.mark.parametrize("kind", KINDS)
def test_halves_share_a_strip_or_nothing(kind):
    source, target = symmetric_pair(kind, 4)
    assert np.array_equal(source, symmetric_pair(kind, 4)[0])
    strip = source[:, 0].max() - target[:, 0].min()
    assert 10 < strip < 32
    assert 0.5 * strip * SITE_M[1] < overlap_of(source, target).area_m2 < 1.5 * strip * SITE_M[1]
    apart = symmetric_pair(kind, 4, apart=True)
    assert apart[0][:, 0].max() < apart[1][:, 0].min()


def test_what_was_built_fits_itself_turned_by_half():
    source, target = symmetric_pair("stadium", 2)
    turned = source * [-1.0, -1.0, 1.0]
    overlap = overlap_of(turned, target)
    both = (overlap.source.count > 0) & (overlap.target.count > 0)
    off = np.abs(overlap.source.top[both] - overlap.target.top[both])
    assert both.sum() > 2000
    assert np.median(off) < 0.2
