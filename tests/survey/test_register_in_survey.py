from __future__ import annotations

import json
import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers_survey import ETRS, tiles_of, town_source, town_target, write_tile

from mtpcr_geo.core import transforms
from mtpcr_geo.core.cloud import ArrayCloud
from mtpcr_geo.core.errors import InputError, OptionError, RegistrationError
from mtpcr_geo.core.system import usable_cores
from mtpcr_geo.core.types import Matches
from mtpcr_geo.export import run_json
from mtpcr_geo.match.candidates import Candidate, Pool
from mtpcr_geo.match.patches import PatchMatches
from mtpcr_geo.match.pose import Pose
from mtpcr_geo.method.scales import scales_for
from mtpcr_geo.registration import Registration
from mtpcr_geo.survey import register
from mtpcr_geo.survey.build import build_survey
from mtpcr_geo.survey.cut import cut_out
from mtpcr_geo.survey.index import Survey
from mtpcr_geo.survey.options import BuildOptions
from mtpcr_geo.survey.register import in_survey, register_in_survey
from mtpcr_geo.survey.search import FoundPlace

HERE = BuildOptions(workers=1, cell=1.0)
FAR = np.array([700.0, 300.0, 4.0])


@pytest.fixture(scope="module")
def source(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, np.ndarray]:
    xyz, T = town_source()
    return write_tile(tmp_path_factory.mktemp("source") / "scan.laz", xyz, None), T


def other_land() -> np.ndarray:
    """Ground and boxes that the town does not have, far from it."""
    rng = np.random.default_rng(11)
    xy = rng.uniform(-60.0, 60.0, (60_000, 2))
    z = 0.02 * xy[:, 1] + 0.8 * np.sin(xy[:, 0] / 11.0)
    for middle, half, height in zip(
        rng.uniform(-55, 55, (30, 2)), rng.uniform(2, 8, (30, 2)), rng.uniform(3, 12, 30), strict=True
    ):
        z[(np.abs(xy - middle) < half).all(axis=1)] += height
    return np.column_stack([xy, z]) + town_target()[:, :3].mean(axis=0) + FAR


@pytest.fixture(scope="module")
def survey(tmp_path_factory: pytest.TempPathFactory) -> Survey:
    folder = tmp_path_factory.mktemp("survey")
    tiles = tiles_of(folder / "tiles", town_target())
    tiles.append(write_tile(folder / "tiles" / "other.laz", other_land()))
    return build_survey(tiles, folder / "survey", HERE).survey


@pytest.fixture(scope="module")
def found(
    survey: Survey, source: tuple[Path, np.ndarray], tmp_path_factory: pytest.TempPathFactory
) -> Registration:
    out = tmp_path_factory.mktemp("out")
    return register_in_survey(source[0], survey.folder, out, source_crs="local", recording=False)


def off(result: Registration, T: np.ndarray) -> tuple[float, float]:
    """How far the result is from the truth at the middle of the source, metres, and in yaw, degrees."""
    assert result.T_target_source is not None
    assert result.pair is not None
    middle = result.pair.source.link.to_file(result.pair.source.sample).mean(axis=0)[None]
    gap = transforms.apply(result.T_target_source, middle) - transforms.apply(T, middle)
    return float(np.linalg.norm(gap)), float(
        np.degrees(transforms.rotation_angle(T[:3, :3].T @ result.T_target_source[:3, :3]))
    )


def test_a_scan_is_found_and_registered_to_the_points(
    found: Registration, source: tuple[Path, np.ndarray], survey: Survey
) -> None:
    metres, degrees = off(found, source[1])
    assert metres < 0.1
    assert degrees < 0.3
    assert found.verdict.name == "accepted", found.verdict.reasons
    record = next(one for one in found.report if one.type == "mtpcr.match")
    read = {Path(tile["path"]).name for tile in record.metadata["survey"]["tiles"]}
    assert read == {"tile0.laz", "tile1.laz", "tile2.laz", "tile3.laz"}
    assert record.metadata["margin"] <= record.metadata["survey"]["margin"]
    assert record.metadata["null_ratio"] <= record.metadata["survey"]["null_ratio"]


def test_the_number_of_threads_holds_for_the_search_too(
    source: tuple[Path, np.ndarray], survey: Survey, monkeypatch: pytest.MonkeyPatch
) -> None:
    seen = []

    def spy(*arguments: Any) -> Any:
        seen.append(usable_cores())
        raise RegistrationError("that is all")

    monkeypatch.setattr(register, "locate", spy)
    with pytest.raises(RegistrationError, match="that is all"):
        register_in_survey(source[0], survey.folder, source_crs="local", threads=1)
    assert seen == [1]


def test_the_run_is_on_record(found: Registration, survey: Survey) -> None:
    data = json.loads(found.outputs["run"].read_text(encoding="utf-8"))
    match = next(stage for stage in data["stages"] if stage["type"] == "mtpcr.match")
    survey_facts = match["metadata"]["survey"]
    assert survey_facts["cell_m"] == 1.0
    listed = re.findall(r"``mtpcr\.match survey\.([\w.\[\]]+)``", run_json.__doc__ or "")
    assert {key.partition("[")[0] for key in listed} == set(survey_facts)
    for inner in ("searched", "tiles"):
        named = {key.partition(".")[2] for key in listed if key.startswith(f"{inner}[]")}
        assert named == set(survey_facts[inner][0])
    assert {"margin_at_the_place", "null_ratio_at_the_place"} <= set(match["metadata"])
    assert data["metrics"]["hypothesis_margin"] == found.verdict.metrics["hypothesis_margin"]
    assert found.outputs["registered"].is_file()


@pytest.mark.slow
def test_what_is_known_beforehand_narrows_the_search(source: tuple[Path, np.ndarray], survey: Survey) -> None:
    place = transforms.apply(source[1], town_source()[0]).mean(axis=0)
    near: dict[str, Any] = {"near": (place[0] + 20.0, place[1] - 20.0), "within": 40.0, "source_crs": "local"}
    result = register_in_survey(source[0], survey, **near)
    assert off(result, source[1])[0] < 0.1
    record = next(one for one in result.report if one.type == "mtpcr.match")
    assert record.metadata["prior"]["within_m"] == 40.0
    with pytest.raises(OptionError, match="near"):
        register_in_survey(source[0], survey, near=(0.0, 0.0), within=40.0, source_crs="local")


def candidate(pose: Pose, agreeing: int = 20) -> Candidate:
    px = np.zeros((20, 2))
    return Candidate(pose, PatchMatches(px, px, np.ones(20), px, 20), np.arange(20) < agreeing)


def test_rivals_and_the_mirrored_world_of_the_whole_survey_count() -> None:
    best, rival = candidate(Pose(0.3, 10.0, 20.0, 40.0)), candidate(Pose(0.3, 900.0, 20.0, 32.0))
    again = candidate(Pose(0.3, 10.5, 20.0, 30.0))
    mirrored = Pool((candidate(Pose(1.0, 0.0, 0.0, 25.0)),), (22.5,))
    scales = scales_for(1.0, 10_000.0)
    pivot = np.zeros(2)
    pool = Pool((best, rival, again), (36.0, 28.8, 27.0))
    place = FoundPlace(pool, mirrored, pivot, pivot, 50.0, scales, ((8.0, 1),), 3)
    hypotheses = [one.pose.hypothesis(pivot) for one in pool.candidates]
    px = np.zeros((4, 2))
    # at the place nothing rivals it, and strengths are those of finer cells
    here = replace(best.pose.hypothesis(pivot), strength=72.0)
    matches = Matches(
        px,
        px,
        np.ones(4),
        (here,),
        margin=1000.0,
        strength=72.0,
        null_ratio=9.0,
        mirrored_strengths=(8.0,),
    )
    found = in_survey(matches, place, hypotheses)
    assert found.margin == pool.margin == 36.0 / 28.8
    assert found.null_ratio == pytest.approx(40.0 / 25.0)
    # the same place found twice is no rival; the other one is, at the strength it has beside the best
    assert [one.strength for one in found.hypotheses] == pytest.approx([72.0, 72.0 * 28.8 / 36.0])
    assert found.mirrored_strengths == pytest.approx((72.0 * 25.0 / 40.0, 8.0))


@pytest.mark.slow
def test_a_rival_elsewhere_in_the_survey_counts(source: tuple[Path, np.ndarray], tmp_path: Path) -> None:
    town = town_target()
    tiles = tiles_of(tmp_path / "tiles", town)
    # another survey of the same town, put elsewhere: nothing tells which of both it is
    tiles.append(write_tile(tmp_path / "tiles" / "twin.laz", town_target(seed=9) + FAR))
    twins = build_survey(tiles, tmp_path / "survey", HERE).survey
    result = register_in_survey(source[0], twins, source_crs="local")
    assert result.verdict.name != "accepted"
    assert result.verdict.metrics["hypothesis_margin"] < 1.3
    rival = result.verdict.rivals[0]
    assert rival.far
    assert rival.apart_m == pytest.approx(np.hypot(*FAR[:2]), abs=2.0)


@pytest.mark.slow
def test_a_scan_of_another_place_is_not_accepted(survey: Survey) -> None:
    rng = np.random.default_rng(12)
    xy = rng.uniform(-40.0, 40.0, (30_000, 2))
    z = 0.3 * np.sin(xy[:, 0] / 5.0) * np.cos(xy[:, 1] / 7.0)
    for middle, half in zip(rng.uniform(-35, 35, (12, 2)), rng.uniform(2, 6, (12, 2)), strict=True):
        z[(np.abs(xy - middle) < half).all(axis=1)] += rng.uniform(3, 9)
    cloud = ArrayCloud(np.column_stack([xy, z]))
    result = register_in_survey(cloud, survey, source_crs="local")
    assert result.verdict.name == "refused"


def test_what_does_not_go_with_a_survey_is_refused(
    source: tuple[Path, np.ndarray], survey: Survey, tmp_path: Path
) -> None:
    for options in ({"profile": "paper"}, {"matcher": "orb"}, {"local": True}, {"target_crs": "local"}):
        with pytest.raises(OptionError, match="survey"):
            register_in_survey(source[0], survey, source_crs="local", **options)
    with pytest.raises(InputError, match="is a tile of the survey"):
        register_in_survey(survey.tiles[0].path, survey)
    with pytest.raises(InputError, match="is no survey"):
        register_in_survey(source[0], tmp_path)


def test_the_points_at_a_place_are_those_that_the_survey_was_built_of(tmp_path: Path) -> None:
    tile = write_tile(tmp_path / "tile.laz", town_target(points=20_000))
    survey = build_survey([tile], tmp_path / "survey", HERE).survey
    box = survey.bounds[:, :2]
    assert cut_out(survey, box).count == 20_000
    west = cut_out(survey, np.stack([box[0], [box[0, 0] + 50.0, box[1, 1]]]))
    assert 0 < west.count < 20_000
    assert west.maximum[0] <= box[0, 0] + 50.0
    with pytest.raises(InputError, match="hold no points"):
        cut_out(survey, box + 10_000.0)
    write_tile(tile, town_target(points=19_000))
    with pytest.raises(InputError, match="run survey build again"):
        cut_out(survey, box)


def test_nothing_to_compare_is_said(survey: Survey) -> None:
    flat = np.random.default_rng(0).uniform([0, 0, 0], [4, 4, 0.01], (500, 3))
    with pytest.raises(RegistrationError, match="no place of the survey"):
        register_in_survey(
            ArrayCloud(flat, ETRS), survey, near=tuple(survey.bounds[0, :2]), within=1.0, source_crs="local"
        )
