"""What the pictures of the report show: measured on pairs whose answer is known."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest
from helpers_scene import houses, make_pair, rasterise

from mtpcr_geo.core import transforms
from mtpcr_geo.core.types import Bev
from mtpcr_geo.export import drawing
from mtpcr_geo.export.report import figures, pictures, rasters
from mtpcr_geo.export.report.pictures import Overlay, heights_of_both
from mtpcr_geo.export.report.sections import picture_of, sections_of


def shifted(pair, shift):
    """The pair under another transform, moved by (3,) metres."""
    return pair.with_(T_target_source=transforms.translation(shift) @ pair.T_target_source)


def test_gaps_close_and_outlines_stay():
    rng = np.random.default_rng(3)
    top = np.full((60, 80), np.nan, np.float32)
    top[10:50, 20:70] = 5.0 + 0.1 * np.arange(50, dtype=np.float32)
    whole = np.isfinite(top)
    holes = whole & (rng.uniform(size=top.shape) < 0.25)
    top[holes] = np.nan
    closed = rasters.closed(top)
    assert not np.isfinite(closed[~whole]).any()
    inner = np.zeros_like(whole)
    inner[12:48, 22:68] = True
    assert np.isfinite(closed[inner]).mean() > 0.99
    expected = np.broadcast_to(5.0 + 0.1 * (np.arange(80) - 20), top.shape)
    assert np.abs(closed - expected)[inner & np.isfinite(closed)].max() < 0.25
    assert np.array_equal(closed[whole & ~holes], top[whole & ~holes])
    assert not np.isfinite(rasters.closed(np.full((5, 5), np.nan, np.float32))).any()


def test_sparse_rasters_are_joined_until_they_are_filled():
    rng = np.random.default_rng(5)
    xyz = np.column_stack([rng.uniform(0, 200, (8000, 2)), np.zeros(8000)])
    sparse = rasterise(xyz, 1.0)
    assert np.isfinite(sparse.top).mean() < 0.25
    joined = rasters.readable(sparse)
    assert np.isfinite(joined.top).mean() > 0.6
    assert np.isfinite(rasters.closed(joined.top)).mean() > 0.97


def test_grey_where_they_fit_and_fringes_where_not():
    top = rasterise(houses(np.random.default_rng(1), 120_000)).top
    top = rasters.closed(top)
    same = heights_of_both(top, top)[..., :3].astype(float)
    filled = np.isfinite(top)
    assert np.ptp(same[filled], axis=1).max() <= 2.0
    moved = heights_of_both(np.roll(top, 3, axis=1), top)[..., :3].astype(float)
    assert np.mean(np.ptp(moved[filled], axis=1) > 60.0) > 0.05
    # orange where the source is higher
    source = top.copy()
    source[40:50, 40:50] += 8.0
    red, _, blue = heights_of_both(source, top)[45, 45, :3].astype(float)
    assert red > blue + 30.0


def test_sections_show_a_fit_and_a_misfit():
    pair = make_pair(60_000)
    source, target = drawing.common_rasters(pair)
    good = sections_of(pair, source, target)
    assert [one.name for one in good] == ["along", "across"]
    along, across = (one.end - one.start for one in good)
    assert abs(along @ across) < 1e-6 * one_length(along) * one_length(across)
    for section in good:
        assert section.thickness_m < 3.0
        assert section.low_m < np.median(section.target[:, 1]) < section.high_m
        assert ((section.source[:, 0] >= 0) & (section.source[:, 0] <= section.length_m)).all()
        picture = picture_of(section)
        assert picture.shape[2] == 4
        colours = picture[picture[..., 3] == 255][:, :3]
        for rgb in (drawing.SOURCE_RGB, drawing.TARGET_RGB):
            assert (colours == rgb).all(axis=1).mean() > 0.1
    low = np.median(good[0].source[:, 1]) - np.median(good[0].target[:, 1])
    raised = sections_of(
        shifted(pair, (0.0, 0.0, 2.0)), *drawing.common_rasters(shifted(pair, (0.0, 0.0, 2.0)))
    )
    higher = np.median(raised[0].source[:, 1]) - np.median(raised[0].target[:, 1])
    assert higher - low == pytest.approx(2.0, abs=0.5)


def one_length(vector) -> float:
    return float(np.linalg.norm(vector))


def test_sections_count_from_the_ends_they_name():
    pair = make_pair(60_000)
    for section in sections_of(pair, *drawing.common_rasters(pair)):
        direction = (section.end - section.start) / section.length_m
        off = pair.target.levelled_sample[:, :2] - section.start
        along, across = off @ direction, off @ [-direction[1], direction[0]]
        inside = (np.abs(across) <= section.thickness_m / 2) & (along >= 0) & (along <= section.length_m)
        assert np.allclose(np.sort(along[inside]), np.sort(section.target[:, 0]))


def test_no_sections_where_nothing_overlaps():
    pair = shifted(make_pair(3000), (5000.0, 0.0, 0.0))
    assert sections_of(pair, *drawing.common_rasters(pair)) == []


def test_the_map_of_differences_shows_an_offset():
    pair = shifted(make_pair(60_000), (0.0, 0.0, 0.8))
    overlay = Overlay(pair)
    off = overlay.difference
    assert np.nanmedian(off) == pytest.approx(0.8, abs=0.1)
    assert np.median(-overlay.ground.step) == pytest.approx(0.8, abs=0.1)
    colours = pictures.difference_colours(np.array([[-2.0, 0.0, 2.0, np.nan]], np.float32), 1.0)[0]
    assert colours[0, 2] > colours[0, 0]  # blue below
    assert colours[2, 0] > colours[2, 2]  # red above
    assert (colours[:, 3] == [255, 255, 255, 0]).all()
    found = figures.difference(overlay)
    assert found is not None
    text = "".join(part for part in found.histogram.caption if isinstance(part, str))
    assert "median +0.8" in text or "median +0.7" in text


def test_patches_are_ranked_by_how_well_heights_agree():
    pair = make_pair(60_000)
    overlay = Overlay(pair)
    best, median, worst = overlay.patches()
    assert best.off_m <= median.off_m <= worst.off_m
    for patch in (best, median, worst):
        off = np.abs(overlay.difference[patch.window.rows, patch.window.columns])
        assert np.nanmedian(off) == pytest.approx(patch.off_m)
    boxes = [patch.window for patch in (best, median, worst)]
    for a, b in combinations(boxes, 2):
        apart = [
            one.stop <= other.start or other.stop <= one.start
            for one, other in ((a.rows, b.rows), (a.columns, b.columns))
        ]
        assert any(apart)


def test_before_is_turned_and_after_lies_on_the_target():
    found = pictures.before_and_after(make_pair(60_000))
    assert found.before.shape == found.after.shape
    assert not np.array_equal(found.before, found.after)
    # the helper's source is local and its target is not
    assert not found.as_it_lay
    local = pictures.before_and_after(make_pair(60_000, crs=None))
    assert local.as_it_lay


def test_the_window_that_tells_most_lies_in_the_overlap():
    pair = make_pair(60_000)
    source, target = drawing.common_rasters(pair)
    window = rasters.telling_window(source, target)
    parts = window.of(source), window.of(target)
    assert all(isinstance(part, Bev) for part in parts)
    assert np.mean([np.isfinite(part.top).mean() for part in parts]) > 0.7
    weight = np.zeros((50, 60), np.float32)
    weight[30:34, 41:45] = 1.0
    found = rasters.best_window(weight, 10)
    assert found.rows.start <= 30
    assert found.rows.stop >= 34
    assert found.columns.start <= 41
    assert found.columns.stop >= 45
