"""Mutated files and texts: an error of the package itself, or the data read. `helpers_fuzz` runs longer."""

from __future__ import annotations

import helpers_fuzz as fuzz
import pytest

SHORT = {"files": 60, "pipelines": 80, "transforms": 60, "models": 60, "bags": 60, "named": 40, "folders": 12}
LONG = {
    "files": 1000, "pipelines": 2000, "transforms": 1000, "models": 1000, "bags": 1000, "named": 1000,
    "folders": 300,
}  # fmt: skip


def drill(kind: str, count: int, first: int, folder) -> None:
    if kind == "bags":
        pytest.importorskip("rosbags", reason="rosbags is not installed (extra graco)")
    bad = [
        f"seed {seed}: {why}"
        for seed, _, why in fuzz.tries(fuzz.DRILLS[kind](folder), range(first, first + count))
        if why
    ]
    assert not bad, "\n".join(bad[:5])


@pytest.mark.parametrize("kind", SHORT)
def test_short(kind, tmp_path):
    drill(kind, SHORT[kind], 1, tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("kind", LONG)
def test_long(kind, tmp_path):
    drill(kind, LONG[kind], 100_000, tmp_path)


FOUND = {
    "an array's header that ends too soon": ("files", 1446),
    "a PTX scan of endless numbers": ("files", 2717),
    "a file name of 400 letters": ("models", 1479),
    "bounds whose difference overflows": ("files", 184),
    "layers larger than their chunk": ("files", 21442),
    "bounds whose norm overflows": ("files", 30040),
    "points of which the check leaves out all": ("files", 40204),
    "points that a transform moves to infinity": ("files", 459),
    "a floor of cells without number": ("files", 2_001_061),
    "poses that are no places on earth": ("bags", 2_000_972),
    "a global shift too large for a pose": ("named", 100126),
    "options of a recorded stage that are none": ("folders", 100228),
    "a recorded transform that is no 4x4": ("folders", 100267),
    "inputs of a recorded stage that are no tags": ("folders", 300103),
    "a CRS of a survey that PROJ does not work with": ("folders", 601289),
    "a CRS in a batch that PROJ does not work with": ("folders", 300688),
}


@pytest.mark.parametrize("name", FOUND)
def test_what_was_found_stays_mended(name, tmp_path):
    kind, seed = FOUND[name]
    drill(kind, 1, seed, tmp_path)
