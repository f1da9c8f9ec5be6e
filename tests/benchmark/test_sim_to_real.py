from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest
from helpers_paths import REPOSITORY

from mtpcr_geo.benchmark.pairs import write_laz
from mtpcr_geo.benchmark.sim_to_real import cloud_figures, compare, margins
from mtpcr_geo.core.cloud import ArrayCloud


def block(n: int = 8) -> np.ndarray:
    """Four points in each cell of a level field, with a wall-less block 5 m high on its right half."""
    x, y = np.meshgrid(np.arange(2 * n) / 2 + 0.25, np.arange(2 * n) / 2 + 0.25)
    return np.c_[x.ravel(), y.ravel(), np.where(x.ravel() > n / 2, 5.0, 0.0)]


def test_figures_by_hand():
    figures = cloud_figures(block())
    assert figures["points_per_m2"] == 4.0
    assert figures["points_per_cell_p95_over_median"] == 1.0
    assert figures["occupied_share"] == 1.0
    assert figures["relief_m"] == 5.0
    assert figures["edge_share"] == pytest.approx(2 / 8)
    assert figures["thickness_m_p95"] == 0.0
    wall = np.vstack([block(), [[1.5, 1.5, 3.0]]])
    assert cloud_figures(wall)["edge_share"] == pytest.approx((16 + 4 + 1) / 64)
    half = block()[block()[:, 0] < 4.0]
    assert cloud_figures(half)["relief_m"] == 0.0
    assert cloud_figures(np.vstack([half, [[7.9, 7.9, 0.0]]]))["occupied_share"] == pytest.approx(33 / 64)


def test_comparison_marks_what_lies_outside():
    lines = compare(
        [{"a": 1.0, "b": 5.0}, {"a": 3.0, "b": 9.0}], [{"a": 1.5, "b": 1.0}, {"a": 2.5, "b": 2.0}]
    )
    assert [line["simulated_median"] for line in lines] == ["within", "above"]
    assert (lines[1]["simulated_mid"], lines[1]["real_max"]) == (7.0, 2.0)


def test_margins_by_pair():
    rows = [
        {"pair": p, "details": {"hypothesis_margin": m} if m else {}}
        for p, m in (("a", 2.0), ("a", 4.0), ("b", 0))
    ]
    assert margins(rows) == [{"pair": "a", "mid": 3.0, "runs": 2, "min": 2.0, "max": 4.0}]


def test_example_compares_two_folders(tmp_path):
    for name, n in (("simulated", 8), ("real", 12)):
        folder = tmp_path / name / "pair"
        folder.mkdir(parents=True)
        for role in ("source", "target"):
            write_laz(folder / f"{role}.laz", ArrayCloud(block(n), None, role))
        facts = {"ground_truth": {"T_target_from_source": np.eye(4).tolist()}}
        (folder / "pair.json").write_text(json.dumps(facts))
    (tmp_path / "runs.jsonl").write_text(
        json.dumps({"pair": "x", "details": {"hypothesis_margin": 7.5}}) + "\n"
    )
    script = REPOSITORY / "examples" / "sim_to_real.py"
    folders = [str(tmp_path / name) for name in ("simulated", "real")]
    command = [sys.executable, str(script), *folders, "--runs", str(tmp_path), str(tmp_path)]
    said = subprocess.run(command, capture_output=True, text=True, check=True).stdout
    assert "## Sources" in said
    assert "| edge_share |" in said
    assert "| x | 7.5" in said
