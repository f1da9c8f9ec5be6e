from __future__ import annotations

import numpy as np
import pytest

from mtpcr_geo.core.cloud import ArrayCloud
from mtpcr_geo.io.no_returns import NoReturns, without
from mtpcr_geo.io.sample import scan, surface_chunks


def site(rng: np.random.Generator, n: int = 30_000) -> np.ndarray:
    xyz = rng.uniform(-40, 40, (n, 3)) * [1, 1, 0.1] + [500, 300, 60]
    return np.round(xyz, 3)


@pytest.mark.parametrize("place", [(0.0, 0.0, 0.0), (512.5, 310.25, 61.0)])
@pytest.mark.parametrize("share", [0.005, 0.07, 0.6])
def test_points_on_one_place_are_left_out_wherever_it_is(place: tuple[float, ...], share: float) -> None:
    rng = np.random.default_rng(1)
    xyz = site(rng)
    marks = np.tile(place, (round(share * len(xyz)), 1))
    mixed = rng.permutation(np.vstack([xyz, marks]))
    found = scan(ArrayCloud(mixed))
    assert found.no_returns == len(marks)
    assert found.complete
    assert len(found.sample) == len(xyz)
    assert np.array_equal(found.no_return_places, [place])
    assert np.array_equal(found.minimum, xyz.min(axis=0))
    assert np.array_equal(found.maximum, xyz.max(axis=0))


def test_several_scanners_have_several_places() -> None:
    rng = np.random.default_rng(2)
    places = np.array([[0.0, 0.0, 0.0], [520.0, 300.0, 61.0]])
    cloud = ArrayCloud(np.vstack([site(rng), np.repeat(places, 900, axis=0)]))
    found = scan(cloud)
    assert found.no_returns == 1800
    assert {tuple(place) for place in found.no_return_places} == {tuple(place) for place in places}


def test_a_place_that_shows_late_is_left_out_of_what_was_read_before(monkeypatch: pytest.MonkeyPatch) -> None:
    rng = np.random.default_rng(3)
    xyz = site(rng, 40_000)
    # too few in the first half to be seen there
    mixed = np.vstack([xyz[:20_000], np.zeros((5, 3)), xyz[20_000:], np.zeros((4_000, 3))])

    class InParts(ArrayCloud):
        def noise_chunks(self, size: int = 10_000):  # type: ignore[no-untyped-def]
            yield from super().noise_chunks(10_000)

    for budget in (4_000_000, 5_000):
        found = scan(InParts(mixed), budget=budget)
        assert found.no_returns == 4_005
        assert not (found.sample == 0).all(axis=1).any()
        assert np.array_equal(found.minimum, xyz.min(axis=0))
        assert found.complete == (budget > len(mixed))
    left = np.vstack(list(surface_chunks(InParts(mixed), places=found.no_return_places)))
    assert len(left) == len(xyz)


def test_points_that_stand_twice_or_on_a_coarse_lattice_are_kept() -> None:
    rng = np.random.default_rng(4)
    twice = np.repeat(site(rng, 5_000), 2, axis=0)
    lattice = np.round(rng.uniform(0, 30, (60_000, 3)) * [1, 1, 0.05])
    for xyz in (twice, lattice):
        found = scan(ArrayCloud(xyz))
        assert found.no_returns == 0
        assert len(found.sample) == len(xyz)


def test_points_near_the_origin_that_differ_are_kept() -> None:
    rng = np.random.default_rng(5)
    xyz = rng.normal(0, 0.05, (5_000, 3))
    looked = NoReturns()
    assert not looked.look(xyz)
    assert without(xyz, looked.places) is xyz
