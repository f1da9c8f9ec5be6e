"""Fits the probability of the verdict to rows of the robustness benchmark, and shows it on other sites.

The sites are halved by name: the model is fitted to the runs of one half, and its reliability is that of the
other. Runs without an answer have no evidence to weigh and are left out; so are those of other matchers.
"""

from __future__ import annotations

import datetime
import json
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from scipy.optimize import minimize

from mtpcr_geo.benchmark.robustness.results import read_rows
from mtpcr_geo.benchmark.robustness.runner import Row
from mtpcr_geo.benchmark.tables import to_markdown
from mtpcr_geo.core.arrays import Floats, Mask
from mtpcr_geo.core.errors import InputError
from mtpcr_geo.core.version import __version__
from mtpcr_geo.io.outputs import OutputSet
from mtpcr_geo.verdict.probability import FEATURES, FILE, Calibration, features_of

RIDGE = 0.3
"""Weight of the squared coefficients in the fit: without it a separable set would make them infinite."""
BINS = (0.0, 0.05, 0.2, 0.5, 0.8, 0.95, 1.0)
FEWEST = 10
REPORT, DIAGRAM = "calibration.md", "reliability.png"


@dataclass(frozen=True)
class Runs:
    """Runs with evidence.

    Attributes:
        features: (n, f) see `FEATURES`.
        right: (n,) whether the pose is right; a run without a right answer is wrong.
        fitted: (n,) whether the site is of the half that is fitted to.
        rows: the rows.

    """

    features: Floats
    right: Mask
    fitted: Mask
    rows: tuple[Row, ...]


def runs_of(rows: Sequence[Row]) -> Runs:
    """Collect the runs that have evidence, and halve their sites.

    Raises:
        InputError: if there are too few, or no right or no wrong ones in the half that is fitted to.

    """
    known = [(row, features_of(row["metrics"] or {})) for row in rows]
    kept = [(row, features) for row, features in known if features is not None]
    names = sorted({str(row["site"]) for row, _ in kept})
    half = {name: number % 2 == 0 for number, name in enumerate(names)}
    right = np.array([bool(row["has_truth"] and row["right"]) for row, _ in kept])
    fitted = np.array([half[str(row["site"])] for row, _ in kept])
    if min(int((right & fitted).sum()), int((~right & fitted).sum()), int((~fitted).sum())) < FEWEST:
        raise InputError(
            f"{len(kept)} runs with evidence are too few to calibrate by: at least {FEWEST} right and "
            f"{FEWEST} wrong ones are wanted in each half of the sites"
        )
    return Runs(np.array([features for _, features in kept]), right, fitted, tuple(row for row, _ in kept))


def fit(features: Floats, right: Mask) -> tuple[float, Floats]:
    """Fit a logistic model whose weights are not negative.

    Args:
        features: (n, f).
        right: (n,).

    Returns:
        The intercept, and (f,) weights.

    """
    sign = np.where(right, 1.0, -1.0)
    A = np.column_stack([np.ones(len(features)), features])

    def loss(w: Floats) -> tuple[float, Floats]:
        odds = sign * (A @ w)
        value = float(np.logaddexp(0.0, -odds).sum() + RIDGE * (w[1:] ** 2).sum())
        slope = -(A * (sign / (1.0 + np.exp(odds)))[:, None]).sum(axis=0)
        slope[1:] += 2 * RIDGE * w[1:]
        return value, slope

    bounds = [(None, None), *[(0.0, None)] * features.shape[1]]
    found = minimize(loss, np.zeros(A.shape[1]), jac=True, method="L-BFGS-B", bounds=bounds)
    return float(found.x[0]), np.asarray(found.x[1:])


def reliability(probability: Floats, right: Mask) -> list[dict[str, Any]]:
    """Return for each bin of probability its runs, their mean probability, and the share that is right."""
    lines = []
    for low, high in pairwise(BINS):
        inside = (probability >= low) & ((probability < high) | (high == 1.0))
        if inside.any():
            lines.append(
                {
                    "from": low,
                    "to": high,
                    "runs": int(inside.sum()),
                    "said": float(probability[inside].mean()),
                    "right": float(right[inside].mean()),
                }
            )
    return lines


def calibration_error(lines: Sequence[dict[str, Any]]) -> float:
    """Return the expected calibration error of reliability lines: mean |said - right|, weighed by runs."""
    runs = np.array([line["runs"] for line in lines], float)
    gap = np.array([abs(line["said"] - line["right"]) for line in lines])
    return float((runs * gap).sum() / max(runs.sum(), 1.0))


def calibrate(paths: Sequence[Path], out: Path) -> str:
    """Fit the model to one half of the sites, and write it with its reliability on the other.

    Args:
        paths: ``robustness.csv`` files.
        out: folder for ``calibration.json``, ``calibration.md`` and, where matplotlib is installed,
            ``reliability.png``.

    Returns:
        The reliability on the half that was not fitted to, as Markdown.

    Raises:
        InputError: if a file cannot be read, or the runs are too few.

    """
    runs = runs_of([row for path in paths for row in read_rows(path)])
    intercept, weights = fit(runs.features[runs.fitted], runs.right[runs.fitted])
    model = Calibration(intercept, tuple(weights), {})
    shown = ~runs.fitted
    probability = model.probability(runs.features)
    lines = reliability(probability[shown], runs.right[shown])
    about = {
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "version": __version__,
        "right": "within 5 degrees, and 2 m in the middle of the overlap",
        "fitted_runs": int(runs.fitted.sum()),
        "fitted_right": int((runs.right & runs.fitted).sum()),
        "shown_runs": int(shown.sum()),
        "shown_right": int((runs.right & shown).sum()),
        "shown_calibration_error": round(calibration_error(lines), 4),
        "shown_brier": round(float(((probability - runs.right)[shown] ** 2).mean()), 4),
        "suites": sorted({str(row["suite"]) for row in runs.rows}),
    }
    data = {
        "about": about,
        "intercept": round(intercept, 4),
        "weights": {name: round(float(w), 4) for name, w in zip(FEATURES, weights, strict=True)},
    }
    table = to_markdown(lines)
    text = f"# Calibration of the verdict's probability\n\n{_sentence(about)}\n\n{table}\n"
    with OutputSet(overwrite=True) as files:
        files.path(Path(out) / FILE).write_text(json.dumps(data, indent=2) + "\n", "utf-8")
        files.path(Path(out) / REPORT).write_text(text, "utf-8")
        _draw(lines, files, Path(out) / DIAGRAM)
        files.commit()
    return text


def _sentence(about: dict[str, Any]) -> str:
    return (
        f"Fitted to {about['fitted_runs']} runs ({about['fitted_right']} right) on one half of the sites, "
        f"shown on {about['shown_runs']} runs ({about['shown_right']} right) on the other: expected "
        f"calibration error {about['shown_calibration_error']}, Brier score {about['shown_brier']}."
    )


def _draw(lines: Sequence[dict[str, Any]], files: OutputSet, path: Path) -> None:
    import importlib.util

    if importlib.util.find_spec("matplotlib") is None:
        return
    from mtpcr_geo.benchmark.plots import draw_reliability

    draw_reliability(lines, files.path(path))
