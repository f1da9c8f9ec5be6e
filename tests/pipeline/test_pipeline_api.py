"""`Pipeline` from Python: what it takes, `|`, arrays, and that validating reads no point."""

from __future__ import annotations

import gc
import json
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import pytest

import mtpcr_geo as mg
from mtpcr_geo.core.cloud import ArrayCloud
from mtpcr_geo.core.errors import InputError, OptionError
from mtpcr_geo.crs.chain import TransformChain
from mtpcr_geo.io.las import LasCloud
from mtpcr_geo.pipeline.stage import Spool

LEVEL = {"type": "mtpcr.level", "method": "none", "local": True, "tag": "level"}


def cloud_at(pipeline: mg.Pipeline, tag: str) -> mg.Cloud:
    """The cloud that a stage made."""
    value = pipeline.stages[tag]
    assert isinstance(value, mg.Cloud)
    return value


def types(pipeline: mg.Pipeline) -> list[str]:
    return repr(pipeline).removeprefix("Pipeline(").removesuffix(")").split(" | ")


def test_a_path_a_text_a_list_and_a_mapping_are_one_pipeline(town_files, tmp_path):
    stages: list[Any] = [str(town_files[1]), {"type": "filters.crop", "bounds": "([0, 1], [0, 1])"}]
    text = json.dumps(stages)
    file = tmp_path / "mine.json"
    file.write_text("// a comment\n" + text, encoding="utf-8")
    specs: list[Any] = [
        stages,
        [town_files[1], stages[1]],
        text,
        f"// said\n{text}",
        text.encode(),
        file,
        str(file),
    ]
    for spec in specs:
        assert types(mg.Pipeline(spec)) == ["readers.las", "filters.crop"]
    assert types(mg.Pipeline({"pipeline": stages})) == ["readers.las", "filters.crop"]
    assert types(mg.Pipeline(stages[1])) == ["filters.crop"]
    assert len(mg.Pipeline(stages)) == 2


@pytest.mark.parametrize(
    ("spec", "said"),
    [
        (42, "not int 42"),
        (None, "not NoneType None"),
        ("town.laz", r"'town.laz' is neither JSON nor a .json file"),
        ([{"type": "readers.las", "filename": object()}], "cannot hold object"),
        ([np.zeros((3, 3)), 7], "stage 1 is an array"),
        ([], "holds no stages"),
        ({"stages": []}, 'no key "pipeline"'),
    ],
)
def test_what_is_no_pipeline_is_named(spec, said):
    with pytest.raises(OptionError, match=said):
        mg.Pipeline(spec)


def test_a_missing_file_is_an_input_error(tmp_path):
    with pytest.raises(InputError, match=r"none\.json"):
        mg.Pipeline(tmp_path / "none.json")


def test_bars_put_stages_behind_each_other(town_files, tmp_path):
    source, target = map(str, town_files)
    clouds = mg.Pipeline([target]) | mg.Pipeline([source])
    whole = clouds | {"type": "mtpcr.register"} | [{"type": "mtpcr.apply"}] | tmp_path / "moved.laz"
    assert types(whole) == ["readers.las", "readers.las", "mtpcr.register", "mtpcr.apply", "writers.las"]
    assert types(target | mg.Pipeline({"type": "mtpcr.level"})) == ["readers.las", "mtpcr.level"]
    # joining leaves both as they were
    assert types(clouds) == ["readers.las", "readers.las"]
    whole.validate()
    with pytest.raises(OptionError, match="the tag 'a' is used twice"):
        mg.Pipeline([target]) | {**LEVEL, "tag": "a"} | {"type": "mtpcr.bev", "tag": "a"}


def test_the_settings_of_the_first_hold(town_files, tmp_path):
    out = tmp_path / "out.las"
    out.write_text("in the way")
    pipeline = mg.Pipeline([str(town_files[0])], overwrite=True) | {"type": "writers.las", "filename": out}
    pipeline.execute()
    assert len(laspy.read(out)) == cloud_at(pipeline, "readers_las1").count


def test_a_filter_alone_says_that_it_has_nothing_to_take():
    with pytest.raises(OptionError, match="has nothing to take"):
        mg.Pipeline({"type": "mtpcr.level"}).validate()


def test_arrays_are_read_first_and_in_their_order(town_files):
    source, target = (mg.read(path).to_array() for path in town_files)
    steps = {"type": "mtpcr.register", "local": True}
    pipeline = mg.Pipeline([steps, {"type": "mtpcr.apply"}], arrays=[target, source])
    pipeline.validate()
    assert pipeline.execute() == len(source)
    expected = mg.register(source, target).T_target_source
    assert pipeline.pair is not None
    np.testing.assert_array_equal(TransformChain.of(pipeline.pair).T_file, expected)
    assert cloud_at(pipeline, "array1").count == len(target)
    assert pipeline.metadata["metadata"]["readers.memory"][1]["count"] == len(source)


def test_arrays_of_joined_pipelines_keep_their_names_apart():
    rng = np.random.default_rng(3)
    first, second = (rng.uniform(0.0, 50.0, (500, 3)) for _ in range(2))
    one = {"type": "filters.crop", "bounds": "([0, 50], [0, 50])"}
    joined = mg.Pipeline({**one, "inputs": "array1", "tag": "a"}, arrays=[first]) | mg.Pipeline(
        {**one, "inputs": "array1", "tag": "b"}, arrays=[second]
    )
    joined.execute()
    np.testing.assert_array_equal(cloud_at(joined, "a").to_array(), first)
    np.testing.assert_array_equal(cloud_at(joined, "b").to_array(), second)


def test_structured_arrays_keep_their_dimensions(tmp_path):
    records = np.zeros(200, [("X", float), ("Y", float), ("Z", float), ("Intensity", np.uint16)])
    rng = np.random.default_rng(5)
    for axis in "XYZ":
        records[axis] = rng.uniform(0.0, 10.0, 200).round(3)
    records["Intensity"] = np.arange(200)
    pipeline = mg.Pipeline([{"type": "writers.las", "filename": tmp_path / "a.las"}], arrays=[records])
    assert pipeline.execute() == 200
    written = laspy.read(tmp_path / "a.las")
    np.testing.assert_array_equal(written.intensity, records["Intensity"])
    (array,) = pipeline.arrays
    np.testing.assert_array_equal(array["Z"], records["Z"])


def test_arrays_reach_pdal(pdal):
    xyz = np.random.default_rng(6).uniform(0.0, 10.0, (300, 3)).round(3)
    pipeline = mg.Pipeline([{"type": "filters.range", "limits": "Z[5:]"}], arrays=[xyz])
    assert pipeline.execute() == int((xyz[:, 2] >= 5.0).sum())


def test_the_points_of_a_file_alone_are_its_arrays(town_files):
    pipeline = mg.Pipeline([str(town_files[0])])
    pipeline.execute()
    (array,) = pipeline.arrays
    np.testing.assert_array_equal(array["X"], mg.read(town_files[0]).to_array()[:, 0])


def test_validating_reads_no_point(town_files, monkeypatch):
    def read(*args, **kwargs):
        raise AssertionError("a point was read")

    monkeypatch.setattr(LasCloud, "record_chunks", read)
    monkeypatch.setattr("mtpcr_geo.pipeline.pdal.bindings.available", lambda: False)
    source, target = map(str, town_files)
    bounds = "([0, 1], [0, 1])"
    mg.Pipeline(
        [
            {"type": "readers.las", "filename": target, "count": 10},
            {"type": "readers.copc", "filename": source, "bounds": bounds},
            {"type": "mtpcr.register"},
        ]
    ).validate()


def test_an_executed_pipeline_is_needed_for_results(town_files):
    with pytest.raises(RuntimeError, match="not been executed"):
        mg.Pipeline([str(town_files[0])]).result  # noqa: B018


def test_a_spool_knows_clouds_by_themselves_and_keeps_them():
    spool = Spool()
    cloud = ArrayCloud(np.zeros((1, 3)))
    spool.add(cloud, Path("first.las"))
    identity = id(cloud)
    del cloud
    gc.collect()
    others = [ArrayCloud(np.zeros((1, 3))) for _ in range(50)]
    assert identity not in map(id, others)
    assert all(spool.path_of(other) is None for other in others)
