"""The whole path on real airborne pairs whose truth is known, and on pairs that share nothing."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest

from mtpcr_geo.benchmark.metrics import centroid_errors, rotation_error_deg
from mtpcr_geo.core import transforms
from mtpcr_geo.registration import Registration, register

pytestmark = pytest.mark.slow

# rotation in degrees and plan in metres within which each pair's truth is known, and its true height shift
PAIRS = {
    "autzen_line_in_block": (0.1, 0.3, 0.0),
    "coast_town_sparse_ign382": (0.1, 0.3, 0.0),
    "delft_urban_ahn3": (0.1, 0.3, 0.0),
    "park_two_epochs_ttp": (0.3, 0.8, -0.41),
    "suburb_sparse_ign292": (0.1, 0.3, 0.0),
}
FAST = ["delft_urban_ahn3", "park_two_epochs_ttp"]


def crs_of(name: str) -> dict[str, Any]:
    return {"source_crs": "EPSG:28992", "target_crs": "EPSG:28992"} if name.startswith("delft") else {}


def moved(source: Path, T: np.ndarray, out: Path) -> np.ndarray:
    """Write the source moved by T, and give its centroid there."""
    las = laspy.read(source)
    xyz = transforms.apply(T, np.column_stack([las.x, las.y, las.z]))
    las.change_scaling(scales=np.minimum(las.header.scales, 0.001), offsets=np.floor(xyz.min(axis=0)))
    las.x, las.y, las.z = xyz.T
    las.write(out)
    return xyz.mean(axis=0)


def check(name: str, data: Path, seed: int, tmp_path: Path) -> Registration:
    rotation, plan, rise = PAIRS[name]
    source = data / name / "source.laz"
    rng = np.random.default_rng([seed, len(name)])
    with laspy.open(source) as file:
        middle = (file.header.mins + file.header.maxs) / 2
    shift = rng.uniform(-60.0, 60.0, 3)
    turn = transforms.about(middle, transforms.yaw_matrix(rng.uniform(0, 2 * np.pi)))
    T_moved = transforms.translation(shift) @ turn
    centroid = moved(source, T_moved, tmp_path / "source.laz")
    found = register(
        tmp_path / "source.laz", data / name / "target.laz", tmp_path / "out", recording=False, **crs_of(name)
    )
    truth = transforms.translation((0.0, 0.0, rise)) @ transforms.inverse(T_moved)
    assert found.verdict.name == "accepted", found.verdict.reasons
    assert found.T_target_source is not None
    assert rotation_error_deg(found.T_target_source, truth) < rotation
    off, height = centroid_errors(found.T_target_source, truth, centroid)
    assert off < plan
    assert abs(height) < 0.25
    assert (tmp_path / "out" / "registered.laz").exists()
    return found


@pytest.mark.parametrize("name", FAST)
def test_a_moved_source_comes_back(name: str, shared_data: Path, tmp_path: Path) -> None:
    check(name, shared_data, 1, tmp_path)


@pytest.mark.parametrize("seed", [2, 3])
@pytest.mark.parametrize("name", PAIRS)
def test_every_pair_comes_back_from_any_yaw(name: str, seed: int, shared_data: Path, tmp_path: Path) -> None:
    check(name, shared_data, seed, tmp_path)


@pytest.mark.parametrize("name", ["delft_urban_ahn3", "bcts_forest_strips"])
def test_two_local_clouds_that_both_lean_come_together(name: str, shared_data: Path) -> None:
    """Nothing tells either vertical: their grounds differ by the slope that only one sees."""
    rng = np.random.default_rng(1)
    clouds, moves = [], []
    for role, lean in (("source", 5.0), ("target", 7.0)):
        las = laspy.read(shared_data / name / f"{role}.laz")
        xyz = np.column_stack([las.x, las.y, las.z])
        direction = rng.uniform(0, 2 * np.pi)
        tilt = transforms.tilt_matrix(direction, np.radians(lean))
        turn = transforms.about(xyz.mean(axis=0), tilt @ transforms.yaw_matrix(rng.uniform(0, 2 * np.pi)))
        clouds.append(transforms.apply(turn, xyz))
        moves.append(turn)
    found = register(clouds[0], clouds[1], local=True)
    truth = moves[1] @ transforms.inverse(moves[0])
    assert found.verdict.name == "accepted", found.verdict.reasons
    assert found.T_target_source is not None
    assert rotation_error_deg(found.T_target_source, truth) < 0.1
    off, height = centroid_errors(found.T_target_source, truth, clouds[0].mean(axis=0))
    assert off < 0.3
    assert abs(height) < 0.25


def refuse(a: str, b: str, data: Path, tmp_path: Path) -> None:
    found = register(
        data / a / "source.laz", data / b / "target.laz", tmp_path, local=True, level="none", recording=False
    )
    assert found.verdict.name != "accepted", found.verdict.metrics
    if found.verdict.name == "refused":
        assert not (tmp_path / "registered.laz").exists()
        assert (tmp_path / "run.json").exists()


def test_clouds_of_different_places_are_not_accepted(shared_data: Path, tmp_path: Path) -> None:
    refuse("delft_urban_ahn3", "park_two_epochs_ttp", shared_data, tmp_path)


# each source on two targets, each target under two sources; the benchmark's suite "unrelated" has them all
NAMES = list(PAIRS)
UNRELATED = [(a, NAMES[(n + step) % len(NAMES)]) for n, a in enumerate(NAMES) for step in (1, 3)]


@pytest.mark.parametrize(("a", "b"), UNRELATED)
def test_no_unrelated_pair_is_accepted(a: str, b: str, shared_data: Path, tmp_path: Path) -> None:
    refuse(a, b, shared_data, tmp_path)


def test_a_far_shift_of_both_changes_nothing(shared_data: Path, tmp_path: Path) -> None:
    far = np.array([5_000_000.0, 5_000_000.0, 0.0])
    folder = shared_data / "park_two_epochs_ttp"
    results = []
    for k, shift in enumerate((np.zeros(3), far)):
        for role in ("source", "target"):
            las = laspy.read(folder / f"{role}.laz")
            las.header.offsets = las.header.offsets + shift
            las.points.offsets = las.header.offsets
            las.write(tmp_path / f"{role}{k}.laz")
        found = register(
            tmp_path / f"source{k}.laz", tmp_path / f"target{k}.laz", tmp_path / f"out{k}",
            local=True, level="none", recording=False,
        )  # fmt: skip
        assert found.pair is not None
        assert found.pair.T_target_source is not None
        results.append(found.pair.T_target_source)
    assert np.abs(results[0] - results[1]).max() < 1e-6
