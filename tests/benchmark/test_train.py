"""Training the learned matcher: samples whose pose is known, and a tiny training from views to a match."""

from __future__ import annotations

import json
import subprocess
import sys
from importlib.resources import files
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from helpers_paths import REPOSITORY

from mtpcr_geo.benchmark.train import samples
from mtpcr_geo.benchmark.train.curve import Curve, learning_rate
from mtpcr_geo.benchmark.train.recipe import Recipe, train
from mtpcr_geo.benchmark.train.sites import FIRST_SEED, Site, kind_of, site
from mtpcr_geo.benchmark.train.views import View, views_of
from mtpcr_geo.core import transforms
from mtpcr_geo.core.errors import MissingPartError, OptionError

TINY = Recipe(
    sites=1, draws=2, feature_steps=12, batch=2, size=64, width=16, matcher_pairs=6, matcher_epochs=2,
    matcher_size=96, keypoints=48, device="cpu",
)  # fmt: skip


def town_site() -> Site:
    """Two scans of a small town: what lies low counts as seen from the ground."""
    from helpers_scene import town

    rng = np.random.default_rng(4)
    clouds = {name: town(rng, 60_000).astype(np.float32) for name in ("robot", "airborne")}
    return Site("town", clouds)


@pytest.fixture(scope="module")
def town_views() -> list[View]:
    return views_of(town_site(), seed=3, draws=3)


def test_views_know_where_their_pixels_lie(town_views):
    points = town_site().clouds["airborne"]
    for view in town_views:
        px = np.rint(points[:, :2] @ view.to_pixel[:, :2].T + view.to_pixel[:, 2]).astype(int)
        height, width = view.image.shape
        inside = (px >= 0).all(axis=1) & (px < [width, height]).all(axis=1)
        assert inside.mean() > 0.97
        # both scans are of one surface: where points fall, or beside it, pixels are filled, and nowhere else
        hit = np.zeros(view.filled.shape, np.uint8)
        hit[px[inside, 1], px[inside, 0]] = 1
        hit = cv2.dilate(hit, np.ones((3, 3), np.uint8)) > 0
        assert hit[view.filled].mean() > 0.9
        assert view.filled[~hit].mean() < 0.1
        back = view.places @ view.to_pixel[:, :2].T + view.to_pixel[:, 2]
        assert np.allclose(back, np.rint(back), atol=1e-6)


def test_the_pose_of_a_sample_brings_its_patches_together(town_views):
    rng = np.random.default_rng(6)
    right = wrong = 0.0
    for _ in range(30):
        sample = samples.draw_sample(town_views, rng, 96)
        assert np.linalg.norm(sample.M[:, 0]) == pytest.approx(np.linalg.norm(sample.M[:, 1]))
        turn = np.degrees(np.arctan2(sample.M[1, 0], sample.M[0, 0]))
        assert abs(turn) <= samples.ROTATION_DEG + 1e-6
        assert np.linalg.det(sample.M[:, :2]) > 0
        for k, M in enumerate((sample.M, sample.M + [[0, 0, 9.0], [0, 0, 7.0]])):
            moved = cv2.warpAffine(
                sample.images[1], M, (96, 96), flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP, borderValue=127
            )
            there = (moved != 127) & sample.filled[0]
            alike = np.corrcoef(moved[there], sample.images[0][there])[0, 1] if there.sum() > 200 else 0.0
            right, wrong = (right + alike, wrong) if k == 0 else (right, wrong + alike)
    assert right / 30 > 0.5
    assert right > 2 * wrong


def test_labels_lie_where_both_patches_are_known(town_views):
    rng = np.random.default_rng(8)
    keypoints = 0
    for _ in range(10):
        sample = samples.draw_sample(town_views, rng, 96)
        found = samples.label(sample, rng)
        n = int(found.valid.sum())
        moved = found.points[0][:n] @ sample.M[:, :2].T + sample.M[:, 2]
        assert np.allclose(moved, found.points[1][:n], atol=1e-3)
        for cells in found.cells:
            assert cells.shape == (12, 12)
            assert ((cells >= -1) & (cells <= 64)).all()
        first, second = (int(((cells >= 0) & (cells < 64)).sum()) for cells in found.cells)
        keypoints += first
        # a keypoint of one is a keypoint of the other, but for those that share a cell
        assert abs(first - second) <= 0.5 * max(first, second) + 3
    assert keypoints > 50


def test_samples_are_the_same_for_one_seed(town_views):
    one, other = (samples.draw_sample(town_views, np.random.default_rng(2), 64) for _ in range(2))
    assert np.array_equal(one.images[0], other.images[0])
    assert np.array_equal(one.images[1], other.images[1])
    assert np.array_equal(one.M, other.M)


def test_training_sites_share_no_seed_with_others():
    # examples, tests and benchmarks simulate by seeds far below
    assert FIRST_SEED > 10_000
    assert len({kind_of(number) for number in range(7)}) == 7


def test_rate_rises_and_falls():
    rates = [learning_rate(1.0, step, 100) for step in range(100)]
    assert rates[0] < rates[4] == max(rates) == 1.0
    assert rates[-1] == pytest.approx(0.01, abs=0.01)


def test_curve_averages(tmp_path):
    curve = Curve(every=2)
    for step in range(4):
        curve.add("part", step, {"loss": float(step)})
    curve.write(tmp_path / "curve.csv")
    lines = (tmp_path / "curve.csv").read_text().split()
    assert lines == ["part,step,name,mean", "part,2,loss,0.5", "part,4,loss,2.5"]


def test_training_without_torch_says_what_is_missing(tmp_path, town_views, monkeypatch):
    monkeypatch.setitem(sys.modules, "torch", None)
    with pytest.raises(MissingPartError, match=r"pip install 'mtpcr-geo\[train\]'"):
        train(TINY, tmp_path, sites=[town_views])


def test_a_tiny_training_gives_files_that_match(tmp_path, town_views):
    pytest.importorskip("torch", reason="training needs PyTorch (extra train)")
    pytest.importorskip("onnx", reason="PyTorch exports through onnx")
    facts = train(TINY, tmp_path / "a", sites=[town_views])
    assert {"bev_point.onnx", "bev_glue.onnx", "curve.csv", "run.json"} <= {
        path.name for path in (tmp_path / "a").iterdir()
    }
    assert json.loads((tmp_path / "a" / "run.json").read_text()) == facts
    assert facts["recipe"]["precision"] == "auto"
    assert facts["precision"] in ("float32", "bfloat16")
    curve = (tmp_path / "a" / "curve.csv").read_text().splitlines()
    losses = [float(line.split(",")[3]) for line in curve if ",descriptor," in line]
    assert losses[-1] < losses[0]
    # the same recipe gives the same files
    again = train(TINY, tmp_path / "b", sites=[town_views])
    assert again["files"] == facts["files"]
    # and they are what the matcher takes: an image and itself, shifted
    from mtpcr_geo.match.correlation import CorrelationSettings
    from mtpcr_geo.match.keypoints import KeypointMatcher
    from mtpcr_geo.match.registry import KeypointSettings, make_matcher

    card = files("mtpcr_geo.match.learned").joinpath("cards", "bev.toml").read_text(encoding="utf-8")
    # so few steps make nobody sure of anything
    assert "score_threshold = 0.1" in card
    unsure = card.replace("score_threshold = 0.1", "score_threshold = 0.0")
    (tmp_path / "a" / "tiny.toml").write_text(unsure, encoding="utf-8")
    matcher = make_matcher("tiny", CorrelationSettings(), KeypointSettings(models=tmp_path / "a", threads=1))
    assert isinstance(matcher, KeypointMatcher)
    image = max(town_views, key=lambda view: view.image.size).image
    first, second = (matcher.images.prepare(part, 127) for part in (image[8:, 16:], image[:-8, :-16]))
    found = matcher.images.match(first, second)
    assert len(found) > 20
    shift = np.median(found.target_px - found.source_px, axis=0)
    assert np.abs(shift - [16.0, 8.0]).max() <= 1.0


@pytest.mark.slow
def test_a_site_is_simulated_once_and_kept(tmp_path):
    pytest.importorskip("embreex", reason="the simulator casts rays by embreex")
    made = site(0, tmp_path, beams=20_000, extent_m=120.0)
    assert set(made.clouds) == {"robot", "tripod", "airborne", "uav"}
    kept = site(0, tmp_path)
    assert kept.name == made.name
    for name, points in made.clouds.items():
        assert np.array_equal(points, kept.clouds[name])
        assert np.abs(points[:, :2]).max() < 300.0
    # ground and air lie on one another: the middle of the shared cells agrees
    cells = [{tuple(cell) for cell in (points[:, :2] // 2).astype(int)} for points in made.clouds.values()]
    assert all(len(cells[0] & other) > 0.2 * min(len(cells[0]), len(other)) for other in cells[1:])
    assert transforms.bounds(made.clouds["uav"].astype(float))[1][2] < 100.0


@pytest.mark.parametrize(("name", "word"), [("precision", "float16"), ("device", "gpu")])
def test_words_that_a_recipe_does_not_know_are_refused(name: str, word: str):
    given: dict[str, Any] = {name: word}
    with pytest.raises(OptionError, match=f"{name} is '{word}'; it is one of auto"):
        Recipe(**given)


def test_command_names_its_options():
    done = subprocess.run(
        [sys.executable, "-m", "mtpcr_geo.benchmark.train", "--help"],
        capture_output=True, text=True, check=False, cwd=REPOSITORY,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    for name in Recipe.ABOUT:
        assert f"--{name.replace('_', '-')}" in done.stdout
    assert Path(REPOSITORY, "docs", "learned.md").is_file()
