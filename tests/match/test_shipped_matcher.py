"""The learned matcher whose weights come with the package: there without a folder, and right."""

from __future__ import annotations

import json
from importlib.resources import files
from pathlib import Path

import numpy as np
import pytest
from helpers_paths import REPOSITORY
from typer.testing import CliRunner

from mtpcr_geo.cli.app import app
from mtpcr_geo.core import transforms
from mtpcr_geo.core.system import sha256
from mtpcr_geo.match.base import View
from mtpcr_geo.match.correlation import CorrelationSettings
from mtpcr_geo.match.learned.model_cards import descriptions as described
from mtpcr_geo.match.learned.model_cards import look_of, path_of
from mtpcr_geo.match.registry import KeypointSettings, make_matcher
from mtpcr_geo.method.images import band_image
from mtpcr_geo.registration import register

WEIGHTS = Path(str(files("mtpcr_geo.match.learned").joinpath("weights")))
NAMES = ("bev_point.onnx", "bev_glue.onnx")


@pytest.fixture(autouse=True)
def no_folder(monkeypatch):
    monkeypatch.delenv("MTPCR_GEO_MODELS", raising=False)


def matcher(**changes):
    return make_matcher("bev", CorrelationSettings(), KeypointSettings(threads=1, **changes))


def test_weights_are_small_and_described():
    assert sum((WEIGHTS / name).stat().st_size for name in NAMES) < 5e6
    page = (REPOSITORY / "docs" / "learned.md").read_text(encoding="utf-8")
    for name in NAMES:
        assert sha256(WEIGHTS / name) in page, f"{name} is not the file that docs/learned.md describes"


def test_models_lists_them_as_usable_without_a_folder():
    listed = json.loads(CliRunner().invoke(app, ["models", "--json"]).output)
    assert listed["folder"] is None
    usable = {model["name"]: model["usable"] for model in listed["models"]}
    assert usable["bev"]
    assert not usable["disk_lightglue"]
    assert not usable["aliked_lightglue"]
    assert not usable["superpoint"]


def test_a_file_in_the_folder_goes_before_the_package(tmp_path):
    model = described(None)["bev"]
    assert path_of(NAMES[0], model, None) == WEIGHTS / NAMES[0]
    assert path_of(NAMES[0], model, tmp_path) == WEIGHTS / NAMES[0]
    (tmp_path / NAMES[0]).write_bytes(b"another")
    assert path_of(NAMES[0], model, tmp_path) == tmp_path / NAMES[0]


def test_the_image_a_model_was_trained_on(tmp_path):
    assert look_of("bev", None) == "band_pass"
    assert look_of("superpoint", None) is None
    assert look_of("correlation", tmp_path / "nowhere") is None


@pytest.mark.parametrize("yaw_deg", [17.0, 111.0, 290.0])
def test_two_scans_of_a_town_at_any_yaw(yaw_deg):
    from helpers_scene import rasterise, town

    rng = np.random.default_rng(5)
    T = transforms.compose(transforms.yaw_matrix(np.radians(yaw_deg)), np.array([12.0, -7.0, 0.0]))
    target = town(rng, 60_000)
    source = transforms.apply(transforms.inverse(T), town(rng, 60_000))
    bevs = [rasterise(xyz, 0.8) for xyz in (source, target)]
    found = matcher().match(*(View(bev, band_image(bev)) for bev in bevs))
    best = found.hypotheses[0]
    assert abs((best.yaw - np.radians(yaw_deg) + np.pi) % (2 * np.pi) - np.pi) < np.radians(2.0)
    assert np.hypot(best.shift[0] - 12.0, best.shift[1] + 7.0) < 1.5


def test_the_same_matches_each_time():
    from helpers_scene import rasterise, town

    bev = rasterise(town(np.random.default_rng(7), 30_000), 1.2)
    view = View(bev, band_image(bev))
    one, other = (matcher().match(view, view) for _ in range(2))
    assert np.array_equal(one.source_px, other.source_px)
    assert np.array_equal(one.score, other.score)


@pytest.mark.slow
def test_paper_profile_needs_no_option_and_no_file(town_files, tmp_path):
    from helpers_scene import ORIGIN

    result = register(town_files[0], town_files[1], tmp_path / "out", profile="paper")
    match = next(record for record in result.report if record.type == "mtpcr.match").metadata
    assert match["method"] == "bev"
    T = transforms.compose(transforms.yaw_matrix(np.deg2rad(-61.0)), np.array([14.0, -9.0, 2.5]))
    true = transforms.translation(ORIGIN) @ transforms.inverse(T) @ transforms.translation(-ORIGIN)
    assert result.T_target_source is not None
    off = transforms.apply(result.T_target_source, ORIGIN[None]) - transforms.apply(true, ORIGIN[None])
    assert np.linalg.norm(off[0, :2]) < 2.0


@pytest.mark.slow
def test_paper_profile_is_right_on_the_demonstration(tmp_path):
    from mtpcr_geo.benchmark.metrics import rotation_error_deg

    clouds = Path(str(files("mtpcr_geo.cli").joinpath("demo_clouds")))
    truth = json.loads((clouds / "truth.json").read_text(encoding="utf-8"))["ground_truth"]
    true = np.array(truth["T_target_from_source"])
    result = register(
        clouds / "ground.laz", clouds / "aerial.laz", tmp_path / "out", profile="paper", source_crs="local"
    )
    assert result.T_target_source is not None
    assert rotation_error_deg(result.T_target_source, true) < 5.0
    # the middle of the ground cloud
    middle = np.array([[-47.0, 171.0, 5.0]])
    off = transforms.apply(result.T_target_source, middle) - transforms.apply(true, middle)
    assert np.linalg.norm(off[0, :2]) < 2.0
    match = next(record for record in result.report if record.type == "mtpcr.match").metadata
    assert match["strengths"][0] > 1.3 * max(match["mirrored_strengths"])


def test_blank_images_are_refused():
    from helpers_scene import rasterise

    from mtpcr_geo.core.errors import RegistrationError

    rng = np.random.default_rng(3)
    flat = rasterise(np.column_stack([rng.uniform(0.0, 60.0, (4000, 2)), np.zeros(4000)]), 1.0)
    view = View(flat, np.full(flat.grid.shape, 127, np.uint8))
    with pytest.raises(RegistrationError, match="finds no match between the images"):
        matcher().match(view, view)
