from __future__ import annotations

import json
from importlib import resources
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from mtpcr_geo.benchmark.robustness.calibrate import (
    Part,
    calibrate,
    calibration_error,
    fit,
    reliability,
)
from mtpcr_geo.benchmark.robustness.results import RowFile
from mtpcr_geo.core.errors import InputError
from mtpcr_geo.verdict.probability import DATA, FILE, FIT, PRECISE, UNIQUE


def drawn(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    features = 2.0 * rng.normal(size=(count, 3))
    odds = -0.5 + features[:, :2] @ np.array([2.0, 1.0]), 1.0 + features[:, 2:] @ np.array([1.5])
    chance = [1.0 / (1.0 + np.exp(-one)) for one in odds]
    return features, rng.uniform(size=count) < chance[0] * chance[1]


def parts(features: np.ndarray) -> list[Part]:
    return [Part(features[:, :2], 0.1), Part(features[:, 2:], 0.1, first=1.0)]


def test_the_fit_recovers_the_model_that_runs_were_drawn_from() -> None:
    features, right = drawn(20_000, 1)
    fits, unique = fit(parts(features), right)
    assert fits.intercept == pytest.approx(-0.5, abs=0.15)
    assert fits.weights == pytest.approx([2.0, 1.0], abs=0.15)
    assert unique.intercept == pytest.approx(1.0, abs=0.15)
    assert unique.weights == pytest.approx([1.5], abs=0.15)


def test_no_weight_is_negative() -> None:
    features, right = drawn(2_000, 2)
    for model in fit(parts(-features), right):
        assert min(model.weights) >= 0.0


def test_probabilities_that_are_true_have_no_calibration_error() -> None:
    rng = np.random.default_rng(3)
    said = rng.uniform(size=50_000)
    lines = reliability(said, rng.uniform(size=len(said)) < said)
    assert sum(line["runs"] for line in lines) == len(said)
    assert calibration_error(lines) < 0.01
    assert calibration_error(reliability(said, np.ones(len(said), bool))) > 0.4


def rows_into(path: Path, count: int) -> Path:
    rng = np.random.default_rng(4)
    with RowFile(path) as file:
        for number in range(count):
            right = bool(rng.uniform() < 0.5)
            strength = float(rng.lognormal(1.5 if right else 0.2, 0.4))
            metrics: dict[str, Any] = {
                "hypothesis_margin": strength, "null_ratio": strength, "neg_log10_p": 20.0 if right else 2.0,
                "ground_cells": 100, "ground_checked": True, "ground_agreeing": 95 if right else 60,
            }  # fmt: skip
            plan = float(rng.lognormal(-1.0, 1.0))
            precise = bool(rng.uniform() < 1.0 / (1.0 + (plan / 0.5) ** 2))
            metrics |= {"within_95_plan_m": plan, "sigma_yaw_deg": 0.05, "sigma_tilt_deg": 0.05}
            file.append(
                {
                    "case": str(number), "suite": "s", "site": f"site_{number % 8}", "has_truth": True,
                    "right": right, "precise": right and precise, "metrics": metrics,
                }
            )  # fmt: skip
    return path


def test_calibration_is_written_and_shown_on_other_sites(tmp_path: Path) -> None:
    text = calibrate([rows_into(tmp_path / "robustness.csv", 400)], tmp_path / "out")
    data = json.loads((tmp_path / "out" / "calibration.json").read_text("utf-8"))
    assert set(data["fit"]["weights"]) == set(FIT)
    assert set(data["unique"]["weights"]) == set(UNIQUE)
    assert set(data["precise"]["weights"]) == set(PRECISE)
    assert data["about"]["fitted_runs"] + data["about"]["shown_runs"] == 400
    assert data["about"]["shown_calibration_error"] < 0.1
    assert "expected calibration error" in text
    assert "within 0.2 degrees and 0.5 m" in text
    assert data["precise"]["weights"]["plan"] == pytest.approx(2.0, abs=0.5)


def test_too_few_runs_are_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="too few to calibrate"):
        calibrate([rows_into(tmp_path / "robustness.csv", 20)], tmp_path / "out")


def test_the_runs_in_the_package_give_the_coefficients_in_the_package(tmp_path: Path) -> None:
    package = resources.files("mtpcr_geo.verdict")
    with resources.as_file(package / DATA) as runs:
        calibrate([runs], tmp_path)
        assert (tmp_path / DATA).read_bytes() == runs.read_bytes()
    found, shipped = (json.loads(file.read_text("utf-8")) for file in (tmp_path / FILE, package / FILE))
    for model in ("fit", "unique", "precise"):
        assert found[model]["intercept"] == pytest.approx(shipped[model]["intercept"], abs=0.01)
        assert found[model]["weights"] == pytest.approx(shipped[model]["weights"], abs=0.01)
    same = ("fitted_runs", "fitted_right", "shown_runs", "shown_right", "suites")
    assert [found["about"][name] for name in same] == [shipped["about"][name] for name in same]
    assert shipped["about"]["shown_calibration_error"] < 0.05
