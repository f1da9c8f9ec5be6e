"""The report and the pictures in it."""

from __future__ import annotations

import base64
import hashlib
import re
from dataclasses import replace
from html.parser import HTMLParser

import cv2
import numpy as np
import pytest
from helpers_scene import ICP_RESULT, make_pair, rasterise

from mtpcr_geo.core.errors import OutputError
from mtpcr_geo.core.progress import NoProgress
from mtpcr_geo.core.types import Check, Verdict
from mtpcr_geo.crs.chain import TransformChain
from mtpcr_geo.export import charts, descriptions, drawing
from mtpcr_geo.export.report.page import write_report
from mtpcr_geo.export.report.shown import ticks
from mtpcr_geo.io.outputs import OutputSet
from mtpcr_geo.pipeline.stage import RunContext
from mtpcr_geo.pipeline.stages.export import FileOptions, WriteReport

DONE = [
    {"type": "mtpcr.level", "tag": "level", "options": {"method": "auto"}, "seconds": 0.5, "metadata": {}},
    {
        "type": "mtpcr.match",
        "tag": "match",
        "options": {},
        "seconds": 1.25,
        "failed": "no <match>",
        "metadata": {},
    },
]
FACTS = {
    "versions": {"numpy": "2.0"},
    "inputs": [{"path": "some/where/source.laz", "bytes": 1234, "sha256": "cd" * 32}],
}


class Links(HTMLParser):
    """Collects whatever a browser would fetch, and checks that tags are closed in order."""

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.scripts = 0
        self.fetched: list[str] = []

    def handle_starttag(self, tag, attrs):
        self.scripts += tag == "script"
        # nothing of a page runs by itself, whatever stands in its texts
        assert not any(name.startswith("on") for name, _ in attrs)
        self.fetched += [value for name, value in attrs if name in {"src", "href"}]
        if tag not in {"meta", "img", "br", "link", "input"}:
            self.open.append(tag)

    def handle_startendtag(self, tag, attrs):
        pass

    def handle_endtag(self, tag):
        assert self.open.pop() == tag


def report(tmp_path, pair, done=DONE, facts=FACTS) -> str:
    write_report(tmp_path / ".report.part-1.html", pair, done, facts)
    return (tmp_path / ".report.part-1.html").read_text(encoding="utf-8")


@pytest.mark.parametrize("verdict", ["accepted", "doubtful", "refused"])
def test_one_whole_file_without_a_network(tmp_path, verdict):
    html = report(tmp_path, make_pair(3000, verdict=verdict))
    assert [file.name for file in tmp_path.iterdir()] == [".report.part-1.html"]
    parser = Links()
    parser.feed(html)
    assert parser.open == []
    assert parser.fetched.pop(0) == "data:,"  # no icon is asked for
    assert len(parser.fetched) == 10
    assert all(re.match("data:image/(webp|png|jpeg);base64,", source) for source in parser.fetched)
    for source in parser.fetched:
        picture = cv2.imdecode(np.frombuffer(base64.b64decode(source.split(",")[1]), np.uint8), -1)
        assert picture is not None
        assert picture.std() > 5.0
    assert len(html) < 3e6
    assert f'class="verdict {verdict}"' in html
    assert not re.search("https?:", html)
    assert "url(" not in html
    (policy,) = re.findall(r'Content-Security-Policy" content="([^"]*)"', html)
    assert policy.startswith("default-src 'none'; img-src data:;")
    (script,) = re.findall("<script>(.*?)</script>", html, re.DOTALL)
    digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
    assert f"script-src 'sha256-{digest}'" in policy


def test_it_tells_what_where_and_how_sure(tmp_path):
    pair = make_pair(3000)
    html = report(tmp_path, pair)
    for text in (
        "16 held-out tie points agree to 0.11 m", "ETRS89 / UTM zone 33N", "+33.0000°", "held out inlier "
        "share",
        "81.0 %", "cd" * 32, "source.laz", "1,234 bytes", "method auto", "no &lt;match&gt;", "numpy",
    ):  # fmt: skip
        assert text in html
    assert "some/where" not in html
    (printed,) = re.findall(r"<pre>(.*?)</pre>", html, re.DOTALL)[:1]
    numbers = printed.split()
    assert np.array_equal(np.array(numbers, float).reshape(4, 4), TransformChain.of(pair).T_file)


def test_the_worked_example_agrees_with_the_matrix():
    pair = make_pair(1000)
    example = descriptions.worked_example(pair)
    assert example is not None
    before, after = example
    assert np.allclose((TransformChain.of(pair).T_file @ [*before, 1.0])[:3], after, atol=1e-6)


@pytest.mark.parametrize("state", ["levelled", "matched", "tied", "solved"])
def test_a_run_that_ended_early_is_reported_too(tmp_path, state):
    html = report(tmp_path, make_pair(500, state=state, crs=None), [], {})
    assert "Not judged" in html
    assert ("No transform was found" in html) == (state != "solved")
    assert ("What was matched" in html) == (state != "levelled")


def test_text_from_files_cannot_become_markup(tmp_path):
    pair = make_pair(500)
    hostile = "<script>alert(1)<x y='\"'>{{ 7 * 7 }}"
    pair.source.cloud.name = f"{hostile}.laz"
    check = Check(hostile, hostile, hostile, False, hostile)
    verdict = Verdict("doubtful", ("<b>&", hostile), {"x": "<i>", hostile: hostile}, (), hostile, (check,))
    stage = {
        "type": hostile,
        "tag": hostile,
        "options": {hostile: hostile},
        "seconds": 1.0,
        "failed": hostile,
    }
    written = {"files": [hostile], "withheld": [{"path": hostile, "why": hostile}], "forced": True}
    facts = {
        "versions": {hostile: hostile},
        "inputs": [{"path": hostile}],
        "command": hostile,
        "written": written,
    }
    html = report(tmp_path, pair.with_(verdict=verdict), [stage], facts)
    parser = Links()
    parser.feed(html)
    assert parser.open == []
    assert parser.scripts == 1
    assert "<script>alert" not in html
    assert html.count("&lt;script&gt;alert(1)&lt;x y=") > 15
    assert "<x" not in html
    # and no template runs what they say
    assert html.count("{{ 7 * 7 }}") == html.count("alert(1)")
    assert "&lt;b&gt;&amp;" in html
    assert "&lt;i&gt;" in html
    assert "<i>" not in html


def test_one_cloud_alone(tmp_path):
    target = make_pair(500).target
    html = report(tmp_path, make_pair(500, state="levelled").with_(source=target, target=target))
    assert "the cloud that moves" not in html


def test_unwritable_place_is_our_error(tmp_path):
    with pytest.raises(OutputError, match="cannot write the report"):
        write_report(tmp_path / "no" / "r.html", make_pair(500, state="levelled"), [], {})


def test_band_grey_by_hand():
    top = np.zeros((40, 40), np.float32)
    top[:, 20:] = 1.0
    grey = drawing.band_grey(top, 1.0)
    assert grey[20, 5] == 127
    assert grey[20, 35] == 127
    # the mean over 13 cells centred on the cell right of the step is 7/13; its smoothed height 0.76
    smooth = cv2.GaussianBlur(top, (0, 0), 0.7)[20, 20]
    assert abs(int(grey[20, 20]) - (127 + 20 * (smooth - 7 / 13))) <= 1
    top[3, 3] = np.nan
    assert drawing.band_grey(top, 1.0)[3, 3] == 127


def test_light_comes_from_north_west():
    rows, columns = np.indices((30, 30)).astype(np.float32)
    to_light = drawing.hillshade(columns + rows, 1.0)[15, 15]
    from_light = drawing.hillshade(-columns - rows, 1.0)[15, 15]
    assert to_light > 200 > 60 > from_light
    assert drawing.hillshade(np.full((3, 3), np.nan, np.float32), 1.0).max() == 0


def test_lines_end_at_the_pixels_that_match():
    pair = make_pair(2000, state="matched")
    picture, ends, _, kind = drawing.match_lines(pair, gap=10)
    source, target = pair.source.bev, pair.target.bev
    assert source is not None
    assert target is not None
    assert pair.matches is not None
    assert picture.shape[1] == source.grid.width + 10 + target.grid.width
    below = (picture.shape[0] - source.grid.height) // 2
    assert np.allclose(ends[:, 0], pair.matches.source_px + np.array([0, below]))
    assert np.allclose(ends[:, 1, 0], pair.matches.target_px[:, 0] + source.grid.width + 10)
    assert set(kind) == {3}
    _, _, _, kind = drawing.match_lines(make_pair(2000))
    assert {0, 1, 2} == set(kind)
    assert (kind == 0).sum() == 12


def test_common_rasters_agree_and_show_the_overlap():
    source, target = drawing.common_rasters(make_pair(60_000))
    assert source.grid == target.grid
    both = np.isfinite(source.top) & np.isfinite(target.top)
    assert both.mean() > 0.5
    assert np.median(np.abs(source.top - target.top)[both]) < 0.15


def test_step_edges_by_hand():
    top = np.zeros((5, 6), np.float32)
    top[:, 3:] = 5.0
    edges = drawing.step_edges(top)
    assert np.all(edges[:, 3] == 1.0)
    assert np.all(np.delete(edges, 3, axis=1) == 0.0)


def test_empty_rasters_can_be_drawn():
    empty = np.full((4, 5), np.nan, np.float32)
    assert np.all(drawing.band_grey(empty, 1.0) == 127)
    assert drawing.shaded_relief(empty, 1.0).shape == (4, 5, 3)
    assert drawing.fit(np.zeros((10, 40, 3), np.uint8), 20).shape == (5, 20, 3)
    bev = rasterise(np.array([[0.2, 0.2, 1.0]]))
    assert drawing.shaded_relief(bev.top, 1.0).shape == (1, 1, 3)


def test_thinned_lines_still_end_at_what_they_mean():
    pair = make_pair(2000, state="matched")
    picture, ends, _, _ = drawing.match_lines(pair, gap=0, max_side=50)
    source, target = pair.source.bev, pair.target.bev
    assert source is not None
    assert target is not None
    assert pair.matches is not None
    assert max(drawing.thinned(source, 50)[0].shape) <= 50
    step = drawing.thinned(target, 50)[2]
    left = picture.shape[1] - -(-target.grid.width // step)
    assert np.allclose((ends[:, 1, 0] - left) * step, pair.matches.target_px[:, 0])


def test_residual_colours_run_from_green_to_red():
    colours = drawing.residual_colours(np.array([0.0, 0.1, 0.3, 0.5, 9.0]), 0.1, 0.5)
    assert colours[0].tolist() == list(drawing.GOOD_RGB)
    assert colours[2].tolist() == list(drawing.FAIR_RGB)
    assert colours[4].tolist() == list(drawing.BAD_RGB)


def test_charts_count_every_tie():
    residual = np.array([0.0, 0.01, 0.5, 7.0])
    agrees = residual < 0.3
    chart = charts.histogram(residual, [(agrees, "green"), (~agrees, "red")], 0.0, 1.0, "tie points")
    assert sum(int(number) for number in re.findall(r"<title>(\d+) tie points", chart.svg)) == 4
    assert chart.svg.count('fill="red"') == 2
    assert chart.top == 2


def test_arrows_go_from_the_target_to_the_source():
    target = np.array([[0.0, 0.0, 0.0], [100.0, 50.0, 0.0]])
    residual = np.array([[1.0, 0.0], [0.0, -1.0]])
    colours = np.full((2, 3), 9, np.uint8)
    found = charts.residual_map(target, residual, colours, {})
    (x, y, u, v), (p, q, r, s) = (
        [float(number) for number in line]
        for line in re.findall(r"M(\d+) (\d+)L(\d+) (\d+)\"", found.chart.svg)
    )
    scale = found.bar * 10.0 / found.bar_m  # pixels of the drawing a metre
    assert u - x == pytest.approx(found.enlarged * scale, abs=1.0)
    assert v == y
    assert s - q == pytest.approx(found.enlarged * scale, abs=1.0)  # north is up, so south is down
    assert r == p
    assert p - x == pytest.approx(100.0 * scale, abs=1.0)
    assert y - q == pytest.approx(50.0 * scale, abs=1.0)
    assert found.shortened == 0


@pytest.mark.parametrize(
    ("low", "high"), [(0.0, 1.0), (-0.5, 0.5), (-3.1, 4.7), (1234.5, 1301.0), (0, 47.2), (0, 3.99e-3)]
)
def test_ticks_are_round_and_few(low, high):
    found = ticks(low, high, 6, "m")
    assert 2 <= len(found) <= 7
    values = [float(one.text.removesuffix(" m")) for one in found]
    assert np.allclose([low + one.at / 100 * (high - low) for one in found], values, atol=1e-3 * (high - low))
    assert np.allclose(np.diff(values), values[1] - values[0])
    assert [one.text.endswith(" m") for one in found] == [False] * (len(found) - 1) + [True]


def test_metrics_have_labels_and_units():
    rows = dict(
        descriptions.metric_rows(
            {
                "overlap_m2": 4728.0,
                "sigma_yaw_deg": 0.02,
                "inlier_share": 0.5,
                "unknown": None,
                "n": np.int64(3),
            }
            | {"shift_m": [1.0, 2.0, 3.0], "good": True, "folds": {"plan_m": 0.123456}}
        )
    )
    assert rows == {
        "ground that both see": "4,728 m²", "standard deviation of yaw": "0.02°",
        "inlier share": "50.0 %", "unknown": "not known",
        "n": "3", "shift": "1.000, 2.000, 3.000 m", "good": "yes", "folds: plan": "0.123 m",
    }  # fmt: skip


def test_report_says_which_refinement_was_taken_and_why() -> None:
    followed = descriptions.refinement_text(ICP_RESULT)
    assert "gicp" in followed
    assert "correspondences up to 1, 0.5 m" in followed
    assert "0.31" in followed
    kept = replace(ICP_RESULT, chosen="ground", followed=False)
    assert "surfaces met worse" in descriptions.refinement_text(kept)
    assert "lost the tie points" in descriptions.refinement_text(replace(kept, lost_tie_points=True))
    assert ("refined by", followed) in descriptions.transform_rows(make_pair(500))


def test_pictures_begun_ahead_are_those_of_the_pair_that_is_written(tmp_path):
    first, other = make_pair(20_000), make_pair(30_000)
    pages: list[list[str]] = []
    for begun_with in (other, first, None):
        path = tmp_path / f"{len(pages)}.html"
        with OutputSet(overwrite=True) as outputs:
            context = RunContext(outputs, NoProgress())
            stage = WriteReport(FileOptions(filename=path), "report")
            if begun_with is not None:
                stage.prepare([begun_with], context)
            stage.write(other, context)
            context.close()
            outputs.commit()
        pages.append(re.findall(r'src="data:[^"]+"', path.read_text()))
    assert pages[0]
    assert pages[0] == pages[1] == pages[2]
