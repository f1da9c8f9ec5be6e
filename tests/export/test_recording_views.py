"""What the first camera of every view looks at, how large a recording is, and what its bars say."""

from __future__ import annotations

import dataclasses
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from helpers_scene import make_pair

from mtpcr_geo.core import transforms
from mtpcr_geo.core.types import Pair
from mtpcr_geo.export.recording.bars import LONGEST, Bar, table
from mtpcr_geo.export.recording.budget import Budget, thin
from mtpcr_geo.export.recording.focus import overlap_of
from mtpcr_geo.export.recording.recorder import RerunRecorder
from mtpcr_geo.method.bev import make_bev

# what both clouds see of the site, in the target's work coordinates: a corner of it, far from its middle
LOW, HIGH = np.array([15.0, -55.0]), np.array([55.0, -15.0])
MIDDLE = (LOW + HIGH) / 2.0
FIELD_OF_VIEW_DEG = 55.0
FULL, HALF, SLIVER = "\u2588", "\u258c", "\u258f"


def corner_pair(n: int = 30_000) -> Pair:
    """A pair whose source covers the corner alone; tilted, so that levelled and work coordinates differ."""
    pair = make_pair(n, tilt=0.1)
    T = pair.T_target_source
    assert T is not None
    placed = transforms.apply(T, pair.source.sample)[:, :2]
    xyz = pair.source.sample[np.all((placed >= LOW) & (placed <= HIGH), axis=1)]
    levelled = transforms.apply(pair.source.T_level_work, xyz)
    bev = make_bev(levelled, 1.0)
    return pair.with_(source=dataclasses.replace(pair.source, sample=xyz, bev=bev))


def record(path: Path, pair: Pair, budget: Budget | None = None) -> Path:
    recorder = RerunRecorder(path, budget)
    recorder.begin({})
    recorder.after("mtpcr.assess", "assess", {}, pair, 1.5)
    recorder.close()
    return path


def blueprint(path: Path) -> dict[str, dict[str, Any]]:
    """The components of the layout by entity."""
    from rerun.chunk import RrdReader

    reader = RrdReader(str(path))
    found: dict[str, dict[str, Any]] = {}
    (store,) = reader.blueprints()
    for chunk in reader.stream(store=store).to_chunks():
        batch = chunk.to_record_batch()
        for name, column in zip(batch.schema.names, batch.columns, strict=True):
            if ":" in name and len(column) and column[-1].is_valid:
                found.setdefault(chunk.entity_path, {})[name] = column[-1].as_py()
    return found


def views(path: Path) -> list[tuple[str, dict[str, Any]]]:
    """Each view's origin, and its properties."""
    found = blueprint(path)
    made = []
    for entity, parts in found.items():
        if "ViewBlueprint:space_origin" in parts:
            more = {k: v for key, p in found.items() if key.startswith(entity + "/") for k, v in p.items()}
            made.append((str(parts["ViewBlueprint:space_origin"][0]).strip("/"), more))
    return made


@pytest.fixture(scope="module")
def pair() -> Pair:
    return corner_pair()


@pytest.fixture(scope="module")
def recording(pair, tmp_path_factory) -> Path:
    return record(tmp_path_factory.mktemp("recording") / "a.rrd", pair)


def test_the_overlap_is_the_ground_that_both_cover(pair):
    box = overlap_of(pair)
    assert box is not None
    np.testing.assert_allclose(box[:, :2], [LOW, HIGH], atol=2.0)
    assert overlap_of(pair.with_(T_target_source=None)) is None
    apart = pair.with_(T_target_source=transforms.translation((500.0, 0.0, 0.0)) @ pair.T_target_source)
    assert overlap_of(apart) is None


def test_every_camera_looks_at_the_overlap_and_takes_it_in(pair, recording):
    box = overlap_of(pair)
    assert box is not None
    z = float(box[:, 2].mean())
    middle = np.array([[*MIDDLE, z]])
    back = transforms.inverse(pair.T_target_source)
    expected = {
        "aligned": middle,
        "input/target": middle,
        "input/source": transforms.apply(back, middle),
    }
    seen = set()
    for origin, parts in views(recording):
        if "EyeControls3D:position" not in parts or origin not in expected:
            continue
        eye, target = (np.array(parts[f"EyeControls3D:{name}"][0]) for name in ("position", "look_target"))
        axis = (target - eye) / np.linalg.norm(target - eye)
        to_middle = expected[origin][0] - eye
        off = np.degrees(np.arccos(axis @ to_middle / np.linalg.norm(to_middle)))
        # the middle third of the view
        assert off < FIELD_OF_VIEW_DEG / 6.0
        across = np.linalg.norm(HIGH - LOW)
        seen_across = 2.0 * np.linalg.norm(to_middle) * np.tan(np.radians(FIELD_OF_VIEW_DEG / 2.0))
        assert 0.7 * across < seen_across < 2.0 * across
        seen.add(origin)
    assert seen == set(expected)


def test_every_picture_has_the_overlap_in_its_middle_third(pair, recording):
    levelled = transforms.apply(
        pair.source.T_level_work @ transforms.inverse(pair.T_target_source), np.array([[*MIDDLE, 0.0]])
    )
    expected = {
        "target": pair.target.bev.grid.to_pixel(MIDDLE[None])[0] + 0.5,
        "source": pair.source.bev.grid.to_pixel(levelled[:, :2])[0] + 0.5,
    }
    seen = set()
    for origin, parts in views(recording):
        if not origin.startswith("bev/"):
            continue
        (left, right), (top, bottom) = [
            (low, high) for low, high in zip(*_corners(parts), strict=True)
        ]  # fmt: skip
        x, y = expected[origin.split("/")[1]]
        assert left + (right - left) / 3.0 < x < right - (right - left) / 3.0
        assert top + (bottom - top) / 3.0 < y < bottom - (bottom - top) / 3.0
        seen.add(origin)
    assert len(seen) == 6


def test_both_overlaps_are_in_the_picture_of_matches(recording, pair):
    shown = [parts for origin, parts in views(recording) if origin == "matches"]
    assert shown
    wide = pair.source.bev.grid.width + 12
    x, y = pair.target.bev.grid.to_pixel(MIDDLE[None])[0]
    for parts in shown:
        low, high = _corners(parts)
        assert np.all(low <= [wide + x, y])
        assert np.all([wide + x, y] <= high)
        assert low[0] <= pair.source.bev.grid.width / 2.0
        # two overlaps beside each other: as wide as both, as high as one, so that they are seen large
        assert (high - low)[0] > 1.5 * (high - low)[1]


def _corners(parts: dict[str, Any]) -> tuple[np.ndarray, np.ndarray]:
    """The lowest and highest (x, y) of a view's bounds."""
    bounds = parts["VisualBounds2D:range"][0]
    if isinstance(bounds, dict):
        x, y = bounds["x_range"], bounds["y_range"]
        return np.array([x[0], y[0]]), np.array([x[1], y[1]])
    return np.array(bounds[0]), np.array(bounds[1])


@pytest.mark.parametrize("verdict", ["accepted", "refused"])
def test_without_a_transform_everything_is_shown(tmp_path, verdict):
    pair = make_pair(3000, state="levelled")
    assert pair.target.bev is not None
    for origin, parts in views(record(tmp_path / "a.rrd", pair)):
        if origin == "bev/target/relief":
            low, high = _corners(parts)
            assert low.tolist() == [0.0, 0.0]
            assert high.tolist() == [pair.target.bev.grid.width, pair.target.bev.grid.height]


def texts(path: Path) -> dict[str, str]:
    """The last text of each entity that is one."""
    from rerun.chunk import RrdReader

    found = {}
    for chunk in RrdReader(str(path)).stream().to_chunks():
        for row in chunk.to_record_batch().to_pylist():
            if row.get("TextDocument:text"):
                found[chunk.entity_path] = row["TextDocument:text"][0]
    return found


def test_bars_stand_behind_their_texts(recording):
    found = texts(recording)
    assert found["/hypotheses"].splitlines()[2].startswith("| 1 | +33.0° | +12.5, -7.2 m |")
    assert found["/hypotheses"].splitlines()[2].endswith(f"| 41.2 | {LONGEST * FULL} |")
    for line in found["/residuals"].splitlines()[2:]:
        assert " cm | " in line
    assert found["/time"].splitlines()[2:] == [f"| assess | 1.50 | {LONGEST * FULL} |"]
    assert found["/stage_list"].startswith("1. **assess** (mtpcr.assess), 1.50 s: ")


@pytest.mark.parametrize(
    ("values", "wanted"),
    [
        ((2.0, 1.0, 0.0), (14 * FULL, 7 * FULL, "")),
        ((28.0, 1.0, 3.0), (14 * FULL, HALF, FULL + HALF)),
        ((100.0, 0.1, -1.0), (14 * FULL, SLIVER, "")),
        ((np.nan, 0.0), ("", "")),
        ((np.inf, 3.0), (14 * FULL, 14 * FULL)),
    ],
)
def test_bars_are_as_long_as_their_values(values, wanted):
    lines = table(("what",), [Bar(("a|b",), value) for value in values]).splitlines()
    assert lines[:2] == ["| what |  |", "|---|---|"]
    assert lines[2:] == [f"| a/b | {bar} |" for bar in wanted]


def test_a_recording_keeps_to_its_size_however_many_points(tmp_path):
    pair = make_pair(3000)
    rng = np.random.default_rng(3)
    sides = {}
    for side in (pair.source, pair.target):
        some = side.sample[rng.integers(0, len(side.sample), 600_000)]
        xyz = some + rng.normal(0.0, 0.3, some.shape)
        levelled = transforms.apply(side.T_level_work, xyz)
        sides[side.role] = dataclasses.replace(side, sample=xyz, bev=make_bev(levelled, 0.1))
    pair = pair.with_(**sides)
    sizes = []
    for size_mb in (5.0, 1.0):
        path = record(tmp_path / f"{size_mb}.rrd", pair, Budget(size_mb))
        sizes.append(path.stat().st_size)
        assert sizes[-1] < size_mb * 1e6
    assert sizes[1] < sizes[0]


def test_thinning_is_seeded_keeps_order_and_prefers_a_region():
    xyz = np.random.default_rng(1).uniform(0.0, 100.0, (50_000, 3))
    box = np.array([[0.0, 0.0, 0.0], [10.0, 10.0, 0.0]])
    kept = thin(xyz, 1000, 4, box)
    assert len(kept) == 1000
    inside = np.all((kept[:, :2] >= box[0, :2]) & (kept[:, :2] <= box[1, :2]), axis=1)
    assert 480 <= inside.sum() <= 520
    np.testing.assert_array_equal(kept, thin(xyz, 1000, 4, box))
    assert not np.array_equal(kept, thin(xyz, 1000, 5, box))
    place = {tuple(row): i for i, row in enumerate(xyz.tolist())}
    order = [place[tuple(row)] for row in kept.tolist()]
    assert order == sorted(set(order))
    assert len(thin(xyz[:10], 1000, 4, box)) == 10
    # a region with too few points is filled from the rest, and the other way round
    nearly_all = np.array([[0.0, 0.0, 0.0], [100.0, 100.0, 0.0]])
    assert len(thin(xyz, 1000, 4, nearly_all)) == 1000


def test_what_was_thinned_is_said(pair):
    facts = Budget(1.0).facts(600_000, 50)
    assert facts["points_source_shown"] < facts["points_source"] == 600_000
    assert facts["points_target_shown"] == 50
    assert f"{facts['points_source_shown']:,} of 600,000 points" in Budget(1.0).sentence(600_000, 50)
