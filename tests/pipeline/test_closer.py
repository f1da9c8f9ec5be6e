"""Of clouds too large to be held the points about the other one are read again, and nothing else."""

from __future__ import annotations

from pathlib import Path

import laspy
import numpy as np
import pytest
from helpers_scene import ORIGIN, TOWN_TURNED

from mtpcr_geo.core import transforms
from mtpcr_geo.core.types import Pair
from mtpcr_geo.pipeline.api import Pipeline


def registered(files: tuple[Path, Path], budget: int) -> Pair:
    """Register two files of which so many points each are held."""
    source, target = files
    stages = [
        {"type": "readers.las", "filename": str(target), "tag": "t"},
        {"type": "readers.las", "filename": str(source), "tag": "s"},
        {"type": "mtpcr.level", "inputs": ["t", "s"], "budget": budget},
        {"type": "mtpcr.bev", "cell": 1.0},
        {"type": "mtpcr.match"},
        {"type": "mtpcr.inverse_mapping"},
        {"type": "mtpcr.solve"},
        {"type": "mtpcr.refine"},
        {"type": "mtpcr.assess"},
    ]
    pipeline = Pipeline(stages)
    pipeline.execute()
    assert pipeline.pair is not None
    return pipeline.pair


def off_m(pair: Pair, source: Path) -> float:
    """How far corners of the source lie from the truth, metres."""
    about = transforms.translation(ORIGIN) @ TOWN_TURNED @ transforms.translation(-ORIGIN)
    xyz = laspy.read(source).xyz
    corners = np.array([xyz.min(axis=0), xyz.max(axis=0)])
    assert pair.T_target_source is not None
    placed = pair.target.link.to_file(
        transforms.apply(pair.T_target_source, pair.source.link.to_work(corners))
    )
    return float(np.linalg.norm(placed - transforms.apply(transforms.inverse(about), corners), axis=1).max())


def test_what_is_refined_and_judged_does_not_thin_out_with_the_cloud(town_files, decoded):
    whole = registered(town_files, 4_000_000)
    assert whole.target.near is None
    assert whole.source.near is None
    decoded.clear()
    sampled = registered(town_files, 4000)
    # the coordinates were kept by the first pass: nothing is decoded again
    assert sorted(decoded) == sorted(str(file) for file in town_files)
    near = sampled.target.near
    assert near is not None
    # every point of the target about the source
    assert sampled.T_target_source is not None
    placed = transforms.apply(sampled.T_target_source, sampled.source.sample)
    low, high = transforms.bounds(placed)
    xyz = whole.target.sample
    inside = ((xyz >= low) & (xyz <= high)).all(axis=1)
    rows = {tuple(row) for row in np.round(near, 4)}
    assert all(tuple(row) in rows for row in np.round(xyz[inside], 4))
    assert len(near) == len(rows)
    of_whole, of_sampled = (one.verdict.metrics for one in (whole, sampled) if one.verdict is not None)
    assert of_sampled["ground_cells"] == pytest.approx(of_whole["ground_cells"], rel=0.02)
    assert off_m(sampled, town_files[0]) < off_m(whole, town_files[0]) + 0.02
    assert of_sampled["overlap_target"] == pytest.approx(of_whole["overlap_target"], abs=0.03)
