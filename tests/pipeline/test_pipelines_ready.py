"""Every ready pipeline, on real data: with PDAL, and without it those that need none."""

from __future__ import annotations

import numpy as np
import pytest
from conftest import REPOSITORY

import mtpcr_geo

READY = sorted(path.stem for path in (REPOSITORY / "pipelines").glob("*.json"))
NEEDS_PDAL = {"clean_then_register"}


def run(name: str, folder):
    text = (REPOSITORY / "pipelines" / f"{name}.json").read_bytes()
    if name == "bev_only":
        changes = [f"--cloud.filename={folder / 'target.laz'}"]
    else:
        changes = [f"--target.filename={folder / 'target.laz'}", f"--source.filename={folder / 'source.laz'}"]
    if name == "paper":
        # its own matcher needs files that nobody may pass on
        changes.append("--match.method=rootsift")
    pipeline = mtpcr_geo.Pipeline(text, changes)
    pipeline.validate()
    pipeline.execute()
    return pipeline


def test_every_ready_pipeline_begins_by_saying_what_it_does_and_how_to_run_it():
    assert READY
    for name in READY:
        text = (REPOSITORY / "pipelines" / f"{name}.json").read_text(encoding="utf-8")
        assert text.startswith("// ")
        assert f"mtpcr-geo pipeline pipelines/{name}.json" in text


@pytest.mark.slow
@pytest.mark.parametrize("pdal_there", [True, False])
@pytest.mark.parametrize("name", READY)
def test_on_real_data(name, pdal_there, shared_data, tmp_path, monkeypatch, request):
    monkeypatch.chdir(tmp_path)
    if pdal_there:
        request.getfixturevalue("pdal")
    elif name in NEEDS_PDAL:
        pytest.skip("this pipeline needs PDAL, and says so")
    else:
        monkeypatch.setattr("mtpcr_geo.pipeline.pdal.bindings.available", lambda: False)
    pipeline = run(name, shared_data / "coast_town_sparse_ign382")
    assert all(path.exists() for path in pipeline.outputs)
    if name == "bev_only":
        assert (tmp_path / "out" / "bev.tif").exists()
        return
    if name == "paper":
        # what the paper's images show is not enough here; the run is whole all the same
        assert pipeline.verdict is not None
        return
    assert pipeline.verdict.name == "accepted"
    # the clouds share their frame, so the true transform changes nothing
    xyz = next(iter(pipeline.pair.source.cloud.xyz_chunks()))
    work = pipeline.pair.source.link.to_work(xyz)
    moved = work @ pipeline.pair.T_target_source[:3, :3].T + pipeline.pair.T_target_source[:3, 3]
    error = pipeline.pair.target.link.to_file(moved) - xyz
    assert np.linalg.norm(error.mean(axis=0)) < 0.3
