"""Coordinates kept in a temporary file are those that were decoded, bit for bit."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import ExitStack
from pathlib import Path

import laspy
import numpy as np
import pytest

from mtpcr_geo.io import kept
from mtpcr_geo.io.formats import open_any
from mtpcr_geo.io.las import LasCloud, open_cloud
from mtpcr_geo.io.sample import scan, surface_chunks
from mtpcr_geo.io.views import Moved

COUNT = 25_000
SIZE = 10_000


@pytest.fixture(params=[1, 6])
def file(request, tmp_path) -> Path:
    rng = np.random.default_rng(3)
    header = laspy.LasHeader(version="1.4", point_format=request.param)
    header.scales, header.offsets = [0.001, 0.001, 0.0003], [600_000.0, 5_000_000.0, -3.7]
    las = laspy.LasData(header)
    las.xyz = rng.uniform([600_000, 5_000_000, 0], [600_100, 5_000_100, 20], (COUNT, 3))
    las.classification = rng.choice([2, 5, 7], COUNT).astype(np.uint8)
    las.withheld = rng.random(COUNT) < 0.1
    path = tmp_path / "cloud.laz"
    las.write(str(path))
    return path


class Counted(LasCloud):
    """A cloud that counts how often it is decoded."""

    decoded = 0

    def record_chunks(self, *args, **more):
        self.decoded += 1
        return super().record_chunks(*args, **more)


def counted(path: Path) -> Counted:
    cloud = open_cloud(path)
    cloud.__class__ = Counted
    assert isinstance(cloud, Counted)
    return cloud


def passes_equal(one, other) -> bool:
    return len(one) == len(other) and all(
        np.array_equal(a, c) and np.array_equal(b, d) for (a, b), (c, d) in zip(one, other, strict=True)
    )


def test_later_passes_are_the_same_and_decode_nothing(file):
    plain = list(open_cloud(file).noise_chunks(SIZE))
    cloud = counted(file)
    with ExitStack() as until:
        cloud.keep(until)
        assert passes_equal(list(cloud.noise_chunks(SIZE)), plain)
        for _ in range(2):
            assert passes_equal(list(cloud.noise_chunks(SIZE)), plain)
        assert cloud.decoded == 1
        assert sum(len(xyz) for xyz, _ in cloud.noise_chunks(SIZE // 2)) == COUNT
        assert cloud.decoded == 2
    assert passes_equal(list(cloud.noise_chunks(SIZE)), plain)
    assert cloud.decoded == 3


def test_a_pass_left_early_is_not_taken_for_the_whole(file):
    plain = list(open_cloud(file).noise_chunks(SIZE))
    cloud = counted(file)
    with ExitStack() as until:
        cloud.keep(until)
        part = cloud.noise_chunks(SIZE)
        next(part)
        assert isinstance(part, Generator)
        part.close()
        assert passes_equal(list(cloud.noise_chunks(SIZE)), plain)
        assert passes_equal(list(cloud.noise_chunks(SIZE)), plain)
        assert cloud.decoded == 2


def test_without_room_nothing_is_kept_and_nothing_is_lost(file, monkeypatch):
    plain = list(open_cloud(file).noise_chunks(SIZE))
    cloud = counted(file)
    monkeypatch.setattr(kept, "_ROOM", 1e18)
    with ExitStack() as until:
        cloud.keep(until)
        for times in (1, 2):
            assert passes_equal(list(cloud.noise_chunks(SIZE)), plain)
            assert cloud.decoded == times


def test_a_disk_that_fills_up_costs_time_only(file):
    plain = list(open_cloud(file).noise_chunks(SIZE))
    cloud = counted(file)
    with ExitStack() as until:
        cloud.keep(until)
        chunks = cloud.noise_chunks(SIZE)
        first = next(chunks)
        assert cloud._kept is not None
        # what writing to it raises from here on is handled as what a full disk raises
        cloud._kept._file.close()
        assert passes_equal([first, *chunks], plain)
        assert passes_equal(list(cloud.noise_chunks(SIZE)), plain)
        assert cloud.decoded == 2


def test_a_scan_and_a_raster_decode_a_file_once(file):
    cloud = counted(file)
    moved = Moved(cloud, lambda xyz: xyz + 1.0, None)
    with ExitStack() as until:
        moved.keep(until)
        found = scan(moved, budget=5_000, seed=1)
        points = np.vstack(list(surface_chunks(moved, places=found.no_return_places, box=found.box)))
        assert cloud.decoded == 1
    again = np.vstack(list(surface_chunks(moved, places=found.no_return_places, box=found.box)))
    assert np.array_equal(points, again)


def test_several_files_are_kept_each(file):
    laspy.read(file).write(str(file.with_name("second.laz")))
    many = open_any(file.parent)
    plain = list(many.noise_chunks(SIZE))
    with ExitStack() as until:
        many.keep(until)
        for _ in range(2):
            assert passes_equal(list(many.noise_chunks(SIZE)), plain)
