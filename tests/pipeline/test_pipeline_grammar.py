from __future__ import annotations

import contextlib
import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from mtpcr_geo.core.errors import MtpcrError, OptionError
from mtpcr_geo.core.suggestions import meant, nearest
from mtpcr_geo.io.views import parse_bounds
from mtpcr_geo.pipeline.grammar import dump, link, override, parse


def linked(stages, *changes):
    elements = parse(json.dumps(stages))
    override(elements, changes)
    return link(elements)


def test_bare_array_and_object_are_the_same():
    array = parse('["a.laz", "b.laz"]')
    assert parse('{"pipeline": ["a.laz", "b.laz"], "anything": "else"}') == array
    assert [element.type for element in array] == ["readers.las", "writers.las"]


def test_a_filename_reads_if_first_or_not_last():
    assert [e.type for e in parse('["a.laz"]')] == ["readers.las"]
    assert [e.type for e in parse('["a.laz", "b.copc.laz", "c.tif"]')] == [
        "readers.las",
        "readers.copc",
        "writers.gdal",
    ]


def test_comments_as_pdal_accepts_them():
    text = """// a pipeline
    [ /* two
         lines */ "a//b.laz", // the "reader"
      {"type": "writers.las", "filename": "http:\\/\\/c /* no comment */.laz"} /**/ ]
    """
    first, second = parse(text)
    assert first.options["filename"] == "a//b.laz"
    assert second.options["filename"] == "http://c /* no comment */.laz"


def test_an_error_behind_comments_names_its_own_line():
    with pytest.raises(OptionError, match="line 3, column 4"):
        parse("/* one\n two */\n[1 2]")


def test_a_byte_order_mark_is_no_matter():
    assert parse(b'\xef\xbb\xbf["a.laz"]') == parse('["a.laz"]')


def test_implicit_chaining():
    specs = linked(["a.laz", "b.laz", {"type": "filters.merge"}, "c.laz", {"type": "filters.merge"}, "d.laz"])
    assert [spec.inputs for spec in specs] == [
        (),
        (),
        ("readers_las1", "readers_las2"),
        (),
        ("filters_merge1", "readers_las3"),
        ("filters_merge2",),
    ]


def test_inputs_by_tag_one_or_several():
    specs = linked(
        [
            {"type": "readers.las", "filename": "a.laz", "tag": "a"},
            {"type": "readers.las", "filename": "b.laz", "tag": "b"},
            {"type": "filters.x", "inputs": "b", "tag": "x"},
            {"type": "filters.y", "inputs": ["a", "x"]},
            {"type": "filters.z", "inputs": []},
        ]
    )
    assert [spec.inputs for spec in specs] == [(), (), ("b",), ("a", "x"), ("filters_y1",)]


def test_a_made_tag_never_meets_a_written_one():
    specs = linked(["a.laz", {"type": "readers.las", "filename": "b.laz", "tag": "readers_las1"}, "c.laz"])
    assert len({spec.tag for spec in specs}) == 3


def test_a_pattern_is_one_reader_a_file(tmp_path):
    for name in "ab":
        (tmp_path / f"{name}.laz").touch()
    specs = linked(
        [{"type": "readers.las", "filename": str(tmp_path / "*.laz"), "tag": "all"},
         {"type": "filters.merge", "inputs": "all"}]
    )  # fmt: skip
    assert [spec.options.get("filename", "")[-5:] for spec in specs] == ["a.laz", "b.laz", ""]
    assert specs[2].inputs == (specs[0].tag, specs[1].tag)


def test_overrides_by_type_by_tag_and_as_pdal_writes_tags():
    stages = [
        {"type": "readers.las", "filename": "a.laz", "tag": "a"},
        {"type": "readers.las", "filename": "b.laz"},
        {"type": "mtpcr.bev", "tag": "bev"},
    ]
    specs = linked(
        stages,
        "--a.filename=tagged.laz",
        "--readers.las.filename=typed.laz",
        "--stage.bev.cell=0.5",
        "bev.x=a=b",
    )
    assert [spec.options.get("filename") for spec in specs] == ["tagged.laz", "typed.laz", None]
    assert specs[2].options == {"cell": "0.5", "x": "a=b"}


def test_a_dump_reads_back():
    stages = [{"type": "readers.las", "filename": "ä.laz"}, {"type": "mtpcr.level", "method": "none"}]
    assert [element.options for element in parse(dump(stages))] == [{"filename": "ä.laz"}, {"method": "none"}]


def test_deep_nesting_is_an_error_and_no_crash():
    with pytest.raises(OptionError):
        parse("[" * 100_000)


def test_numbers_that_json_has_not():
    with pytest.raises(OptionError, match="NaN"):
        parse('[{"type": "filters.x", "value": NaN}]')


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.text(max_size=8),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(
        st.sampled_from(["type", "tag", "inputs", "filename", "pipeline", "x"]), inner, max_size=4
    ),
    max_leaves=12,
)  # fmt: skip


@given(JSON)
def test_whatever_json_says_it_is_a_pipeline_or_an_option_error(value):
    with contextlib.suppress(MtpcrError):
        specs = link(parse(json.dumps(value)))
        assert len({spec.tag for spec in specs}) == len(specs)


@given(st.text(max_size=40))
def test_any_text_parses_or_says_why(text):
    with contextlib.suppress(MtpcrError):
        parse(text)


def test_nearest_word():
    assert nearest("limts", ["limits", "where"]) == "limits"
    assert nearest("las", ["readers.las", "filters.range"]) == "readers.las"
    assert nearest("quite different", ["limits"]) is None
    assert meant("zzz", ["b", "a"]) == " (there are: a, b)"


@pytest.mark.parametrize(
    ("text", "box"),
    [
        ("([0, 1], [2, 3])", ((0, 1), (2, 3))),
        ("([-1.5e2,1],[2,3.],[4,5])", ((-150, 1), (2, 3), (4, 5))),
    ],
)
def test_bounds(text, box):
    assert parse_bounds(text) == box


@pytest.mark.parametrize("text", ["", "([0, 1])", "([1, 0], [0, 1])", "([0, 1], [0, 1]) / EPSG:4326"])
def test_bounds_that_are_none(text):
    with pytest.raises(ValueError):
        parse_bounds(text)
