"""Keypoint matchers: their parts with numbers worked out by hand, learned graphs, and bad input."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import laspy
import numpy as np
import pytest
from helpers_scene import YAW, make_pair
from typer.testing import CliRunner

from mtpcr_geo.cli.app import app
from mtpcr_geo.core import transforms
from mtpcr_geo.core.errors import InputError, MissingPartError, MtpcrError, OptionError, RegistrationError
from mtpcr_geo.core.grid import Grid
from mtpcr_geo.core.types import Bev, Look, Matches, TiePoints
from mtpcr_geo.match.base import Features, PixelMatches, View, margin_of, one_to_one
from mtpcr_geo.match.correlation import CorrelationSettings
from mtpcr_geo.match.descriptors import NearestNeighbours, Orb, RootSift
from mtpcr_geo.match.learned.lightglue import LightGlue, normalised
from mtpcr_geo.match.learned.model_cards import ExtractorFile, MatcherFile, descriptions
from mtpcr_geo.match.learned.onnx import OnnxExtractor, Running, filled, tiles
from mtpcr_geo.match.registry import KeypointSettings, make_matcher
from mtpcr_geo.match.turning import magnified, reduced, shrunk, turn_image
from mtpcr_geo.method.focus import FocusSettings, Subject, focus, neighbourhood, overlap_share
from mtpcr_geo.method.images import image_of
from mtpcr_geo.registration import build_pipeline, read_options, register

onnx = pytest.importorskip("onnx", reason="onnx builds the graphs of these tests")

DIM_LINE = "descriptor_dim = 256"


@pytest.fixture(scope="module")
def small_models(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A models folder with SuperPoint and LightGlue by contract, of random weights."""
    from helpers_onnx import DIM, fused, lightglue, superpoint

    folder = tmp_path_factory.mktemp("models")
    superpoint(folder / "superpoint.onnx")
    lightglue(folder / "superpoint_lightglue.onnx")
    fused(folder / "superpoint_lightglue_pipeline.onnx")
    # the trained one has 256 numbers a descriptor, and nothing else differs
    import mtpcr_geo.match as match

    own = (Path(match.__file__).parent / "learned" / "cards" / "superpoint.toml").read_text(encoding="utf-8")
    assert DIM_LINE in own
    (folder / "superpoint.toml").write_text(
        own.replace(DIM_LINE, f"descriptor_dim = {DIM}"), encoding="utf-8"
    )
    return folder


def views(pair, look: Look = "band_pass") -> tuple[View, View]:
    source, target = (View(side.bev, image_of(side.bev, look)) for side in (pair.source, pair.target))
    return source, target


def quarter_turned(cell: float = 0.5) -> tuple[View, View]:
    """One scan of a town, and the same turned by 90 degrees: random descriptors bear no more."""
    from helpers_scene import rasterise, town

    rng = np.random.default_rng(1)
    back = transforms.compose(transforms.yaw_matrix(-np.pi / 2), np.zeros(3))
    target = town(rng, 200_000)
    source = transforms.apply(back, target)
    turned, still = (rasterise(xyz, cell) for xyz in (source, target))
    return View(turned, image_of(turned, "band_pass")), View(still, image_of(still, "band_pass"))


def settings(folder: Path | None = None, **changes) -> KeypointSettings:
    return KeypointSettings(models=folder, threads=1, **changes)


def matcher(name: str, folder: Path | None = None, **changes):
    return make_matcher(name, CorrelationSettings(), settings(folder, **changes))


# parts


def test_nearest_neighbours_ratio_and_cross_check():
    # on the unit circle: the first source is nearest to target 0, at 10 degrees: 0.174; the next is 0.684 off
    def at(*degrees: float) -> Features:
        a = np.radians(degrees)
        unit = np.column_stack([np.cos(a), np.sin(a)]).astype(np.float32)
        return Features(np.zeros((len(a), 2)), np.ones(len(a), np.float32), unit)

    source, target = at(0.0, 22.0), at(10.0, 40.0)
    shapes = ((9, 9), (9, 9))
    index, score = NearestNeighbours(0.9).pair(source, target, shapes)
    # the second: 12 and 18 degrees, 0.2091 and 0.3129, ratio 0.668
    assert index.tolist() == [[0, 0], [1, 0]]
    np.testing.assert_allclose(score, [1 - 0.17431 / 0.68404, 1 - 0.20906 / 0.31287], atol=1e-4)
    assert NearestNeighbours(0.6).pair(source, target, shapes)[0].tolist() == [[0, 0]]
    assert NearestNeighbours(1.0, cross_check=True).pair(source, target, shapes)[0].tolist() == [[0, 0]]
    assert NearestNeighbours(1.0, least=0.98).pair(source, target, shapes)[0].tolist() == [[0, 0]]


def test_nearest_neighbours_count_differing_bits():
    bits = np.zeros((3, 32), np.uint8)
    bits[1, 0] = 0b111
    bits[2, :4] = 255
    features = Features(np.zeros((3, 2)), np.ones(3, np.float32), bits)
    index, score = NearestNeighbours(0.9).pair(features.take(np.array([0])), features, ((9, 9), (9, 9)))
    assert index.tolist() == [[0, 0]]
    assert score.tolist() == [1.0]  # 0 of the nearest, 3 of the next
    index, score = NearestNeighbours(0.9).pair(
        features.take(np.array([0])), features.take(np.array([1, 2])), ((9, 9),) * 2
    )
    assert score[0] == pytest.approx(1 - 3 / 32)


def test_one_to_one_keeps_the_best_of_a_place():
    px = np.array([[0.0, 0.0], [0.2, 0.1], [5.0, 5.0], [9.0, 9.0]])
    other = np.array([[1.0, 1.0], [7.0, 7.0], [1.1, 0.9], [3.0, 3.0]])
    kept = one_to_one(PixelMatches(px, other, np.array([0.5, 0.9, 0.4, 0.1])))
    # the second takes the place of the first in the source; the third then has its target for itself
    assert kept.score.tolist() == [0.9, 0.4, 0.1]


@pytest.mark.parametrize("degrees", [0.0, 45.0, 90.0, 137.0])
def test_turned_images_know_their_way_back(degrees):
    image = np.zeros((41, 61), np.uint8)
    image[30:33, 12:15] = 255
    turned, back = turn_image(image, np.radians(degrees), 0)
    row, column = (float(np.average(axis, weights=turned)) for axis in np.indices(turned.shape))
    np.testing.assert_allclose(back[:, :2] @ [column, row] + back[:, 2], [13.0, 31.0], atol=0.05)


def test_turn_is_counter_clockwise_with_north_up():
    # what lies east lies north after a quarter turn
    image = np.zeros((41, 41), np.uint8)
    image[19:22, 36:39] = 255
    turned, _ = turn_image(image, np.pi / 2, 0)
    assert turned[3, 20] > 200


def test_magnified_pixels():
    image = np.zeros((20, 30), np.uint8)
    image[8:11, 20:23] = 200
    bigger = magnified(image, 1.5)
    assert bigger.shape == (30, 45)
    row, column = (float(np.average(axis, weights=bigger)) for axis in np.indices(bigger.shape))
    assert [(column + 0.5) / 1.5 - 0.5, (row + 0.5) / 1.5 - 0.5] == pytest.approx([21.0, 9.0], abs=0.1)


@pytest.mark.parametrize("by", [1, 2, 3])
def test_reduced_pixels(by):
    image = np.full((20, 31), 7, np.uint8)
    image[8:11, 20:23] = 207
    smaller = reduced(image, by, 7)
    assert smaller.shape == (-(-20 // by), -(-31 // by))
    row, column = (float(np.average(axis, weights=smaller - 7.0)) for axis in np.indices(smaller.shape))
    # a pixel that is filled in part has its place in its middle
    assert shrunk(np.array([[column, row]]), 1 / by)[0] == pytest.approx([21.0, 9.0], abs=0.2)


@pytest.mark.parametrize("shape", [(40, 100), (1000, 513), (512, 512), (1300, 2049)])
def test_tiles_cover_every_pixel_once(shape):
    seen = np.zeros(shape, int)
    for column, row, (west, north, east, south) in tiles(shape, 512):
        seen[north:south, west:east] += 1
        assert column <= west
        assert row <= north
        assert east <= min(column + 512, shape[1])
        assert south <= min(row + 512, shape[0])
    assert (seen == 1).all()


def test_filled_keeps_a_margin_and_stays_inside():
    image = np.full((60, 90), 127, np.uint8)
    image[20:25, 3:10] = 200
    assert filled(image, 127, 8) == (12, 0, 33, 18)
    assert filled(image, 127, 0) == (20, 3, 25, 10)
    assert filled(image, 0, 8) == (0, 0, 60, 90)


def test_orientations_are_compared_by_few_keypoints_and_matched_by_all():
    source, target = quarter_turned()
    whole = matcher("rootsift")
    images = replace(whole.images, any_yaw=False)
    every = replace(whole, images=images).match(source, target)
    quick = replace(whole, images=images, sweep_keypoints=100).match(source, target)
    assert quick.report["turn_deg"] == every.report["turn_deg"]
    assert max(quick.report["turn_matches"]) <= 100 < len(quick.score)
    np.testing.assert_array_equal(quick.source_px, every.source_px)
    np.testing.assert_array_equal(quick.target_px, every.target_px)


def test_lightglue_normalises_by_the_longer_edge():
    # 100 x 200: the middle is (100, 50), half the longer edge 100
    np.testing.assert_allclose(
        normalised(np.array([[0.0, 0.0], [150.0, 75.0]]), (100, 200)), [[-1, -0.5], [0.5, 0.25]]
    )


def test_margin_compares_the_best_with_the_next_distinct_hypothesis():
    assert margin_of([]) == 1.0
    assert margin_of([0.0, 0.0]) == 1.0
    assert margin_of([6.0], floor=1.0) == 6.0
    assert margin_of([6.0, 4.0], floor=1.0) == 1.5
    assert margin_of([6.0]) == 1000.0
    assert margin_of([6.0, 0.001]) == 1000.0


# whole matchers


@pytest.mark.parametrize("name", ["rootsift", "orb"])
def test_descriptors_find_the_yaw_of_a_town(name):
    pair = make_pair(60_000, state="levelled")
    found = matcher(name).match(*views(pair))
    assert found.hypotheses[0].yaw == pytest.approx(YAW, abs=np.radians(2.0))
    assert found.margin > 1.3
    again = matcher(name).match(*views(pair))
    np.testing.assert_array_equal(found.source_px, again.source_px)


def test_rasters_of_different_cells_match():
    from helpers_scene import rasterise, town

    rng = np.random.default_rng(1)
    source, target = (rasterise(town(rng, 80_000), cell) for cell in (0.8, 1.2))
    found = matcher("rootsift").match(*(View(bev, image_of(bev, "band_pass")) for bev in (source, target)))
    best = found.hypotheses[0]
    assert abs(best.yaw) < np.radians(2.0)
    assert np.hypot(*best.shift) < 1.5


def test_superpoint_and_lightglue_of_random_weights_run_the_whole_path(town_files, small_models, tmp_path):
    # random weights tell places apart only where both images show the same points, and bear no turn: most of
    # the target again, turned by one of the orientations tried
    target = town_files[1]
    las = laspy.read(target)
    rng = np.random.default_rng(3)
    las.points = las.points[rng.random(len(las.points)) < 0.9]
    xyz = np.asarray(las.xyz) + rng.normal(0.0, 0.004, (len(las.points), 3))
    turn = transforms.about(xyz.mean(axis=0).round(), transforms.yaw_matrix(-np.pi / 2))
    las.xyz = transforms.apply(turn, xyz) + [21.0, -14.0, 3.0]
    las.write(tmp_path / "turned.laz")
    result = register(
        tmp_path / "turned.laz", target, tmp_path / "out", matcher="superpoint", models=small_models, cell=0.5
    )
    match = next(record for record in result.report if record.type == "mtpcr.match").metadata
    assert match["method"] == "superpoint"
    assert len(match["turns_deg"]) == 8
    # random projections of patches tell places apart: the yaw is found, and not by ICP alone
    assert match["turn_deg"] == pytest.approx(90.0, abs=0.5)
    assert max(match["turn_agreeing"]) > 10
    assert result.T_target_source is not None
    assert np.degrees(transforms.yaw_of(result.T_target_source[:3, :3])) == pytest.approx(90.0, abs=0.5)
    from rerun.chunk import RrdReader

    chunks = RrdReader(str(tmp_path / "out" / "audit.rrd")).stream().to_chunks()
    assert {
        "/keypoints/source/image", "/keypoints/source/all", "/keypoints/target/matched", "/sweep/agreeing",
        "/sweep/matches", "/enhancement/source/before", "/enhancement/target/after",
    } <= {chunk.entity_path for chunk in chunks}  # fmt: skip
    # arrays stay out of what is written as JSON
    assert len(json.dumps(match)) < 2000


def test_orientations_are_compared_on_small_images_and_the_best_is_matched_whole(small_models, tmp_path):
    for path in small_models.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    card = tmp_path / "superpoint.toml"
    text = card.read_text(encoding="utf-8")
    text = text.replace("[extractor]", "turns = 4\n[extractor]\nsweep_to = 180", 1)
    card.write_text(text, encoding="utf-8")
    views = quarter_turned(0.25)
    whole, swept = (matcher("superpoint", folder).match(*views) for folder in (small_models, tmp_path))
    assert len(swept.report["turns_deg"]) == 4
    assert len(whole.report["turns_deg"]) == 8
    for found in (whole, swept):
        assert found.report["turn_deg"] == pytest.approx(90.0, abs=0.5)
        assert found.hypotheses[0].yaw == pytest.approx(np.pi / 2, abs=0.01)
        # of all keypoints, at the pixels of the whole images
        assert found.report["agreeing"] >= max(found.report["turn_agreeing"])
    assert np.hypot(*np.subtract(*(one.hypotheses[0].shift for one in (whole, swept)))) < 0.3


def test_paper_profile_runs_the_whole_path(town_files, small_models, tmp_path):
    result = register(
        town_files[0],
        town_files[1],
        tmp_path / "out",
        profile="paper",
        matcher="superpoint",
        models=small_models,
    )
    types = [record.type for record in result.report]
    steps = ["mtpcr.enhance", "mtpcr.match", "mtpcr.focus", "mtpcr.inverse_mapping"]
    assert [t for t in types if t in steps] == steps
    assert result.verdict.name in ("accepted", "doubtful", "refused")


def test_fused_graph_finds_the_yaw(small_models):
    found = matcher("superpoint_lightglue_fused", small_models).match(*quarter_turned())
    assert found.hypotheses[0].yaw == pytest.approx(np.pi / 2, abs=np.radians(2.0))


def test_fused_graph_shrinks_large_images(small_models):
    image = make_pair(60_000, state="levelled", cell=0.5).target.bev
    assert image is not None
    shown = image_of(image, "band_pass")
    small = matcher("superpoint_lightglue_fused", small_models).images
    object.__setattr__(small, "model", small.model.model_copy(update={"tile": 160}))
    found = small.match(small.prepare(shown, 127), small.prepare(shown, 127))
    assert len(found) > 20
    np.testing.assert_allclose(found.source_px, found.target_px)
    assert found.source_px.max() > 200


def test_tiled_extraction_finds_what_the_whole_image_shows(small_models):
    from helpers_onnx import DIM

    bev = make_pair(120_000, state="levelled", cell=0.25).target.bev
    assert bev is not None
    image = image_of(bev, "band_pass")
    model = ExtractorFile(file="superpoint.onnx", size_multiple=8, score_threshold=0.0005, descriptor_dim=DIM)
    path = small_models / "superpoint.onnx"
    whole, tiled = (
        OnnxExtractor(model, path, Running("cpu", 1), tile=tile, max_keypoints=20_000).extract(image, 127)
        for tile in (1024, 192)
    )
    assert min(image.shape) > 400
    places = [set(map(tuple, found.px.astype(int).tolist())) for found in (whole, tiled)]
    assert len(places[0] ^ places[1]) <= 0.02 * len(places[0])


def test_focus_matches_again_where_overlap_is_small():
    pair = make_pair(200_000, state="levelled")
    own = matcher("rootsift")
    first = own.match(*views(pair))
    subjects = subjects_of(pair)

    def again(source: Bev, target: Bev, yaw: float | None) -> Matches:
        return own.match(*(View(bev, image_of(bev, "band_pass")) for bev in (source, target)), yaw=yaw)

    kept = focus(again, first, subjects[0], subjects[1], FocusSettings(theta=0.5))
    assert kept.report["focus"]["overlap"] == pytest.approx(0.8, abs=0.05)
    assert not kept.report["focus"]["applied"]
    np.testing.assert_array_equal(kept.source_px, first.source_px)
    forced = focus(again, first, subjects[0], subjects[1], FocusSettings(theta=1.0, finer=1.5, radius_m=40.0))
    reported = forced.report["focus"]
    assert reported["applied"]
    assert reported["agreeing_after"] > reported["agreeing_before"]
    assert forced.before_focus is first
    from mtpcr_geo.export.recording.budget import Budget
    from mtpcr_geo.export.recording.matching import Pen, log_focus

    logged: list[str] = []

    def note(path: str, what: object) -> float:
        logged.append(path)
        return 1.0

    pen = Pen(lambda path, what: logged.append(path), note, lambda path, head, shown: None, Budget())
    log_focus(pen, pair.with_(matches=forced))
    assert logged == ["focus/before/image", "focus/before/lines", "focus/after/image", "focus/after/lines"]
    # still on the pixels of the rasters given
    assert pair.source.bev is not None
    assert pair.target.bev is not None
    s = pair.source.bev.grid.to_metres(forced.source_px)
    t = pair.target.bev.grid.to_metres(forced.target_px)
    T = transforms.compose(
        transforms.yaw_matrix(forced.hypotheses[0].yaw), np.array([*forced.hypotheses[0].shift, 0.0])
    )
    gap = transforms.apply(T, np.column_stack([s, np.zeros(len(s))]))[:, :2] - t
    assert np.median(np.hypot(*gap.T)) < 1.5


def test_focus_goes_round_correlation_too():
    pair = make_pair(60_000, state="levelled")
    own = matcher("correlation")
    assert pair.source.bev is not None
    assert pair.target.bev is not None
    first = own.match(View(pair.source.bev), View(pair.target.bev))
    subjects = subjects_of(pair)
    again = focus(
        lambda s, t, yaw: own.match(View(s), View(t), yaw=yaw),
        first,
        subjects[0],
        subjects[1],
        FocusSettings(theta=1.0),
    )
    assert again.report["focus"]["cells_m"] == [0.5, 0.5]


def test_overlap_and_neighbourhood():
    x, y = np.meshgrid(np.arange(0.5, 100.0), np.arange(0.5, 40.0))
    flat = np.column_stack([x.ravel(), y.ravel(), np.zeros(x.size)])
    # shifted by 50 of 100 m: half of either is covered, and the margin of a cell of 2 m
    share = overlap_share(transforms.translation((50.0, 0.0, 0.0)), flat, flat)
    assert share == pytest.approx(0.52, abs=0.03)
    near = neighbourhood(flat, np.array([[20.5, 20.5]]), 10.0)
    assert np.hypot(near[:, 0] - 20.5, near[:, 1] - 20.5).max() < 12.5
    assert len(near) == pytest.approx(np.pi * 100, rel=0.2)


def subjects_of(pair) -> list[Subject]:
    """What FOCUS may look at: the target's western fifth is missing."""
    source, target = pair.source.levelled_sample, pair.target.levelled_sample
    return [
        Subject(source, pair.source.bev.grid),
        Subject(target[target[:, 0] > -36.0], pair.target.bev.grid),
    ]


# options and models


def test_paper_profile_and_its_switches_in_the_pipeline():
    def types(**options) -> dict[str, dict]:
        stages = build_pipeline("a.laz", "b.laz", "out", read_options({"profile": "paper", **options}))
        return {stage["tag"]: stage for stage in stages}

    full = types()
    assert full["level"]["method"] == "ransac"
    # the weights of the package want one cell and a robust start; others get the paper's steps
    assert full["bev"].get("resolution", "common") == "common"
    assert full["solve"].get("robust_start", True)
    published = types(matcher="superpoint")
    assert published["bev"]["resolution"] == "eq1"
    assert published["solve"] == {
        "type": "mtpcr.solve", "tag": "solve", "upright": False, "robust_start": False
    }  # fmt: skip
    # nor do Eq. 5's corners of cells suit them
    assert full["inverse_mapping"]["surface"] == "top"
    assert full["inverse_mapping"].get("pixel", "centre") == "centre"
    assert published["inverse_mapping"]["surface"] == "grey"
    assert published["inverse_mapping"]["pixel"] == "ceil"
    # the weights of the package see what they were trained on, others the paper's image
    assert full["enhance"].get("look", "band_pass") == "band_pass"
    assert full["match"]["method"] == "bev"
    for matcher in ("superpoint", "rootsift"):
        assert types(matcher=matcher)["enhance"]["look"] == "paper"
    assert types(enhance=False)["enhance"]["look"] == "grey"
    # point-to-point ICP left the woodland 2 m off, and took its own spread for 0.2 m
    assert full["refine"].get("method", "gicp") == "gicp"
    assert full["refine"].get("ground", True)
    assert full["refine"].get("keep_tie_points", 0.5) > 0
    assert published["refine"]["method"] == "point_to_point"
    assert published["refine"]["ground"] is False
    bare = types(res=False, focus=False, enhance=False, matcher="rootsift")
    assert bare["bev"] == {"type": "mtpcr.bev", "tag": "bev", "cell": 1.0, "pixel": "ceil"}
    assert bare["enhance"]["look"] == "grey"
    assert "focus" not in bare
    with pytest.raises(OptionError, match="--no-res belongs to --profile paper"):
        build_pipeline("a.laz", "b.laz", "out", read_options({"res": False}))


def test_ready_pipeline_of_the_paper_is_that_of_the_profile():
    from helpers_paths import REPOSITORY

    from mtpcr_geo.pipeline import grammar
    from mtpcr_geo.pipeline.registry import stage_types

    text = (REPOSITORY / "pipelines" / "paper.json").read_bytes()
    ready = {spec.type: spec.options for spec in grammar.link(grammar.parse(text))}
    stages = build_pipeline("a.laz", "b.laz", "out", read_options({"profile": "paper"}))
    compared = 0
    for stage in stages[2:]:
        if stage["type"].startswith("mtpcr.") and "filename" not in stage:
            own = {key: value for key, value in stage.items() if key not in ("type", "tag", "inputs")}
            model = stage_types()[stage["type"]].Options
            assert model(**own) == model(**ready[stage["type"]]), stage["type"]
            compared += 1
    assert compared >= 9


def test_models_command_lists_files_licences_and_terms(small_models):
    reported = CliRunner().invoke(app, ["models", "--models", str(small_models)])
    assert reported.exit_code == 0
    assert "non-commercial research only" in reported.output
    assert "xfeat.onnx: missing" in reported.output
    listed = json.loads(CliRunner().invoke(app, ["models", "--models", str(small_models), "--json"]).output)
    superpoint = next(model for model in listed["models"] if model["name"] == "superpoint")
    assert superpoint["usable"]
    assert len(superpoint["files"]["superpoint.onnx"]["sha256"]) == 64


def test_models_command_without_a_folder(monkeypatch):
    monkeypatch.delenv("MTPCR_GEO_MODELS", raising=False)
    reported = CliRunner().invoke(app, ["models"])
    assert reported.exit_code == 0
    assert "MTPCR_GEO_MODELS" in reported.output


def test_a_user_adds_a_model_without_code(small_models, tmp_path):
    from helpers_onnx import DIM, superpoint

    superpoint(tmp_path / "mine.onnx", image="picture", keypoints="corners")
    (tmp_path / "mine.toml").write_text(
        f"""
        title = "Mine"
        kind = "keypoints"
        [extractor]
        file = "mine.onnx"
        size_multiple = 8
        descriptor_dim = {DIM}
        names = {{image = "picture", keypoints = "corners"}}
        [nearest_neighbours]
        cross_check = true
        [origin]
        project = "mine"
        licence = "MIT"
        """,
        encoding="utf-8",
    )
    found = matcher("mine", tmp_path).match(*quarter_turned())
    assert found.hypotheses[0].yaw == pytest.approx(np.pi / 2, abs=np.radians(2.0))


# bad input


def test_missing_folder_and_missing_file(tmp_path, monkeypatch):
    monkeypatch.delenv("MTPCR_GEO_MODELS", raising=False)
    with pytest.raises(MissingPartError, match=r"superpoint.onnx.*MTPCR_GEO_MODELS"):
        matcher("superpoint")
    with pytest.raises(MissingPartError, match=r"xfeat.onnx, which is not there.*VeRLab"):
        matcher("xfeat", tmp_path)
    with pytest.raises(MissingPartError, match="is not there; name another"):
        matcher("xfeat", tmp_path / "nowhere")


def test_unknown_matcher_names_the_nearest():
    with pytest.raises(OptionError, match="did you mean 'rootsift'"):
        matcher("rootsfit")


def test_options_of_the_other_kind_are_refused(town_files, tmp_path):
    from mtpcr_geo.core.progress import NoProgress
    from mtpcr_geo.io.outputs import OutputSet
    from mtpcr_geo.pipeline.registry import make_options, stage_types
    from mtpcr_geo.pipeline.stage import RunContext

    kind = stage_types()["mtpcr.match"]
    for words, wrong in (({"method": "rootsift", "patch": 9}, "patch"), ({"turns": 4}, "turns")):
        stage = kind(make_options("match", kind.Options, words), "match")
        with pytest.raises(OptionError, match=f"option '{wrong}' is one of"):
            stage.check(RunContext(OutputSet(), NoProgress()))


def test_correlation_wants_one_cell_size(town_files, tmp_path):
    with pytest.raises(OptionError, match="one cell size"):
        register(town_files[0], town_files[1], tmp_path / "out", profile="paper", matcher="correlation")


def test_not_a_graph(small_models, tmp_path):
    (tmp_path / "superpoint.onnx").write_bytes(b"no graph")
    (tmp_path / "superpoint_lightglue.onnx").write_bytes(b"")
    with pytest.raises(InputError, match=r"superpoint.onnx is no ONNX graph"):
        matcher("superpoint", tmp_path)


def test_graph_with_other_names(small_models, tmp_path):
    from helpers_onnx import DIM, superpoint

    model = ExtractorFile(file="x.onnx", size_multiple=8, descriptor_dim=DIM)
    with pytest.raises(InputError, match=r"has no input 'image' \(it has picture, max_keypoints\)"):
        OnnxExtractor(model, superpoint(tmp_path / "x.onnx", image="picture"), Running("cpu"))
    with pytest.raises(InputError, match="has no output 'scores'"):
        OnnxExtractor(model, superpoint(tmp_path / "y.onnx", scores="s"), Running("cpu"))
    with pytest.raises(InputError, match="has no input 'kpts0'"):
        LightGlue(MatcherFile(file="x.onnx"), tmp_path / "x.onnx", Running("cpu"))


def test_wrong_descriptor_length(small_models):
    model = ExtractorFile(file="superpoint.onnx", size_multiple=8, descriptor_dim=99)
    assert model is not None
    extractor = OnnxExtractor(model, small_models / "superpoint.onnx", Running("cpu"))
    noise = np.random.default_rng(1).integers(0, 255, (64, 64)).astype(np.uint8)
    with pytest.raises(InputError, match="wanted are"):
        extractor.extract(noise)


@pytest.mark.parametrize("shape", [(3, 3), (1, 40), (5, 7), (33, 31)])
@pytest.mark.parametrize("name", ["rootsift", "orb", "superpoint", "superpoint_lightglue_fused"])
def test_tiny_images_are_refused_or_matched(name, shape, small_models):
    rng = np.random.default_rng(2)
    top = rng.uniform(0, 9, shape).astype(np.float32)
    bev = Bev(Grid(0.0, float(shape[0]), 1.0, shape[1], shape[0]), top, top, np.ones(shape, np.uint32))
    view = View(bev, image_of(bev, "band_pass"))
    try:
        found = matcher(name, small_models).match(view, view)
    except RegistrationError:
        return
    assert found.source_px.shape == found.target_px.shape


@pytest.mark.parametrize("name", ["rootsift", "orb", "superpoint", "superpoint_lightglue_fused"])
def test_blank_image_is_refused(name, small_models):
    pair = make_pair(20_000, state="levelled")
    source, target = views(pair)
    blank = View(source.bev, np.full_like(source.image, 127))
    for pair_of_views in ((blank, target), (source, blank)):
        with pytest.raises(RegistrationError, match="no match"):
            matcher(name, small_models).match(*pair_of_views)


def test_lightglue_is_not_asked_about_no_keypoints(small_models):
    from helpers_onnx import DIM

    glue = LightGlue(MatcherFile(file="x"), small_models / "superpoint_lightglue.onnx", Running("cpu"))
    none = Features(np.empty((0, 2)), np.empty(0, np.float32), np.empty((0, DIM), np.float32))
    some = Features(np.ones((1, 2)), np.ones(1, np.float32), np.ones((1, DIM), np.float32))
    for a, b in ((none, some), (some, none), (none, none)):
        index, score = glue.pair(a, b, ((9, 9), (9, 9)))
        assert index.shape == (0, 2)
        assert score.shape == (0,)
    assert glue.pair(some, some, ((9, 9), (9, 9)))[0].tolist() == [[0, 0]]


def test_one_match_is_refused_by_the_solver():
    from mtpcr_geo.method.solve import solve_tie_points

    one, no = np.zeros((1, 3)), np.zeros(1, bool)
    with pytest.raises(RegistrationError, match="only 1 tie point found"):
        solve_tie_points(TiePoints(one, one, np.ones(1), np.ones(1, np.int64), no, ~no), 1.0)


ELSEWHERE = """
title = "x"
kind = "keypoints"
[origin]
project = "p"
licence = "l"
[extractor]
file = "{}"
"""


@pytest.mark.parametrize(
    ("text", "reported"),
    [
        ("title = ", "not TOML"),
        ('title = "x"\nkind = "keypoints"\n[origin]\nproject="p"\nlicence="l"', "takes an .extractor. table"),
        ('title = "x"\nkind = "fuzed"\n[origin]\nproject="p"\nlicence="l"', "kind"),
        ('title = "x"\nkind = "fused"\nfilename = 3', "filename|fused|origin"),
        (ELSEWHERE.format("../other.onnx"), "plain name"),
        (ELSEWHERE.format("/etc/hostname"), "plain name"),
        (ELSEWHERE.format("sub/mine.onnx"), "plain name"),
    ],
)
def test_wrong_descriptions_are_named(tmp_path, text, reported):
    (tmp_path / "mine.toml").write_text(text, encoding="utf-8")
    with pytest.raises(OptionError, match=reported) as caught:
        descriptions(tmp_path)
    assert "mine.toml" in str(caught.value)


def test_cuda_is_refused_where_it_is_not_offered(small_models):
    import onnxruntime

    if "CUDAExecutionProvider" in onnxruntime.get_available_providers():
        pytest.skip("CUDA is offered here")
    with pytest.raises(MissingPartError, match="CUDA"):
        matcher("superpoint", small_models, device="cuda")


@pytest.mark.parametrize("extractor", [RootSift(), Orb()])
def test_extractors_are_deterministic_and_empty_on_nothing(extractor):
    assert len(extractor.extract(np.full((64, 64), 9, np.uint8))) == 0
    bev = make_pair(20_000, state="levelled").target.bev
    assert bev is not None
    image = image_of(bev, "band_pass")
    first, second = extractor.extract(image), extractor.extract(image)
    np.testing.assert_array_equal(first.px, second.px)
    np.testing.assert_array_equal(first.descriptors, second.descriptors)


def test_errors_reach_the_command_in_one_line(town_files, tmp_path):
    words = ["register", *map(str, town_files), "-o", str(tmp_path / "o"), "--matcher", "xfeat"]
    reported = CliRunner().invoke(app, [*words, "--models", str(tmp_path)])
    assert reported.exit_code == MissingPartError.exit_code
    assert issubclass(MissingPartError, MtpcrError)
    assert not (tmp_path / "o").exists()


# real models


@pytest.mark.slow
@pytest.mark.parametrize("name", ["xfeat", "aliked"])
def test_learned_matchers_on_a_real_pair(name, shared_models, shared_data, tmp_path):
    folder = shared_data / "autzen_line_in_block"
    result = register(
        folder / "source.laz",
        folder / "target.laz",
        tmp_path,
        matcher=name,
        models=shared_models,
        recording=False,
    )
    assert result.T_target_source is not None
    assert np.degrees(transforms.rotation_angle(result.T_target_source[:3, :3])) < 0.5
    # ALIKED finds the pose by few tie points in one corner: it may be doubted, and says why, but not refused
    assert result.verdict.name in ("accepted", "doubtful")
    assert result.verdict.reasons


@pytest.mark.slow
def test_aliked_takes_a_large_raster_in_tiles(shared_models):
    model = descriptions(None)["aliked"].extractor
    assert model is not None
    extractor = OnnxExtractor(model, shared_models / model.file, Running("cpu", 2), tile=256)
    rng = np.random.default_rng(3)
    image = np.full((1100, 700), 127, np.uint8)
    image[:600, :500] = np.kron(rng.integers(0, 255, (60, 50)), np.ones((10, 10))).astype(np.uint8)
    found = extractor.extract(image, 127)
    assert len(found) > 200
    assert found.px[:, 0].max() < 505
