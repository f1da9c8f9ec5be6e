from __future__ import annotations

import json
import subprocess
import sys

import numpy as np
import pytest
from typer.testing import CliRunner

from mtpcr_geo.cli.app import app
from mtpcr_geo.cli.demo import AERIAL, GROUND, TRUTH, Errors, Truth, errors_of, read_truth, run_demo
from mtpcr_geo.core import transforms
from mtpcr_geo.core.errors import OutputError


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    return run_demo(tmp_path_factory.mktemp("demo") / "out", recording=False)


def test_demo_is_accepted_and_right(demo):
    assert demo.registration.verdict.name == "accepted"
    assert demo.errors.rotation_deg < 0.2
    assert demo.errors.plan_m < 0.2
    assert abs(demo.errors.height_m) < 0.2
    assert f"rotation {demo.errors.rotation_deg:.3f} degrees" in demo.summary


def test_demo_leaves_its_clouds_truth_and_result(demo):
    folder = demo.files[GROUND].parent
    assert {path.name for path in folder.iterdir()} == {GROUND, AERIAL, TRUTH, "result"}
    assert (folder / "result" / "registered.laz").exists()
    facts = json.loads((folder / TRUTH).read_text())
    assert (facts["source"]["file"], facts["target"]["file"]) == (GROUND, AERIAL)


def test_demo_clouds_are_small(demo):
    assert sum(path.stat().st_size for path in demo.files.values()) < 1_800_000


def test_demo_replaces_only_when_asked(demo):
    folder = demo.files[GROUND].parent
    before = demo.files[GROUND].stat().st_mtime_ns
    with pytest.raises(OutputError, match="exists already"):
        run_demo(folder, recording=False)
    assert demo.files[GROUND].stat().st_mtime_ns == before


def test_errors_are_those_of_the_centroid_and_of_the_rotation():
    T_true = transforms.compose(transforms.yaw_matrix(0.4), np.array([5e5, 5e6, 80.0]))
    truth = Truth(T_true, np.array([10.0, 20.0, 3.0]), 0.2, 0.2, 0.0, "a town")
    assert errors_of(T_true, truth) == Errors(0.0, 0.0, 0.0)
    turned = transforms.about(
        transforms.apply(T_true, truth.source_centroid), transforms.yaw_matrix(np.deg2rad(0.5))
    )
    shifted = transforms.translation((0.3, -0.4, -0.2)) @ turned @ T_true
    errors = errors_of(shifted, truth)
    assert errors.rotation_deg == pytest.approx(0.5)
    assert errors.plan_m == pytest.approx(0.5, abs=1e-6)
    assert errors.height_m == pytest.approx(-0.2)


def test_truth_is_a_rigid_transform(demo):
    truth = read_truth(demo.files[TRUTH])
    R = truth.T_target_source[:3, :3]
    assert np.allclose(R @ R.T, np.eye(3), atol=1e-12)
    assert np.rad2deg(np.arccos(R[2, 2])) == pytest.approx(truth.tilt_deg)


def test_demo_needs_no_extra(tmp_path):
    code = (
        "import sys\n"
        "extras = ('open3d', 'embreex', 'kiss_matcher', 'matplotlib', 'rosbags')\n"
        "sys.modules.update(dict.fromkeys(extras))\n"
        "from mtpcr_geo.cli.demo import run_demo\n"
        f"run_demo({str(tmp_path / 'out')!r}, recording=False)\n"
        "print([name for name in sys.modules if name.startswith('mtpcr_geo.benchmark.')])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    # the command's own functions may be looked up there; the rest of the room is not needed
    assert set(json.loads(done.stdout.replace("'", '"'))) <= {"mtpcr_geo.benchmark.command"}


def test_verb_prints_verdict_and_errors(tmp_path):
    result = CliRunner().invoke(app, ["demo", "-o", str(tmp_path / "out")])
    assert result.exit_code == 0, result.output
    assert "Accepted: " in result.stdout
    assert "Against the known truth: rotation 0.0" in result.stdout
