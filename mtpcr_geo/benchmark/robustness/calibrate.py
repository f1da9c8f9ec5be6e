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
from mtpcr_geo.verdict.probability import (
    FILE,
    FIT,
    PRECISE,
    Calibration,
    Logistic,
    features_of,
    precise_features_of,
)

RIDGE, RIDGE_UNIQUE = 0.1, 0.02
"""Weight of the squared coefficients in the fit: without it a separable set would make them infinite. The
evidence that a pose is unique spans a smaller range, and wants larger coefficients."""
RIDGE_PRECISE, NORMAL_WEIGHT = 3.0, 2.0
FIRST = (-2.0, 1.0)
"""Intercepts that the fit starts from: most poses do not fit, and few of those that do look alike."""
BINS = (0.0, 0.05, 0.2, 0.5, 0.8, 0.95, 1.0)
FEWEST = 10
_LEAST = 1e-12
REPORT, DIAGRAM = "calibration.md", "reliability.png"


@dataclass(frozen=True)
class Runs:
    """Runs with evidence.

    Attributes:
        features: (n, f) see `mtpcr_geo.verdict.probability.features_of`.
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


def fit(features: Floats, right: Mask, split: int = len(FIT)) -> tuple[Logistic, Logistic]:
    """Fit the product of two logistic models whose weights are not negative.

    Args:
        features: (n, f).
        right: (n,).
        split: the first so many features are the first model's, the others the second's.

    Returns:
        Both models.

    """
    groups = (features[:, :split], features[:, split:])
    designs = [np.column_stack([np.ones(len(one)), one]) for one in groups]
    ridges = [
        ridge * np.r_[0.0, np.ones(one.shape[1])]
        for ridge, one in zip((RIDGE, RIDGE_UNIQUE), groups, strict=True)
    ]
    cut = split + 1

    def loss(w: Floats) -> tuple[float, Floats]:
        parts = (w[:cut], w[cut:])
        odds = [A @ part for A, part in zip(designs, parts, strict=True)]
        log_p = -sum(np.logaddexp(0.0, -one) for one in odds)
        wrong = np.maximum(-np.expm1(log_p), _LEAST)
        value = -np.where(right, log_p, np.log(wrong)).sum()
        # of log p by the odds of one model: the probability that this one says no
        outer = np.where(right, -1.0, np.exp(log_p) / wrong)
        slopes = []
        for A, part, ridge, one in zip(designs, parts, ridges, odds, strict=True):
            value += (ridge * part**2).sum()
            slopes.append(A.T @ (outer / (1.0 + np.exp(one))) + 2 * ridge * part)
        return float(value), np.concatenate(slopes)

    starts, bounds = [], []
    for first, one in zip(FIRST, groups, strict=True):
        starts += [first, *np.ones(one.shape[1])]
        bounds += [(None, None), *[(0.0, None)] * one.shape[1]]
    w = minimize(loss, np.array(starts), jac=True, method="L-BFGS-B", bounds=bounds).x
    return Logistic(float(w[0]), tuple(w[1:cut])), Logistic(float(w[cut]), tuple(w[cut + 1 :]))


def fit_precise(runs: Runs) -> Logistic:
    """Fit the model that a right pose is precise, to the right runs of the half that is fitted to.

    Its weights are drawn to what an error of normal distribution has.
    """
    known = [
        (features, bool(row["precise"]))
        for row, right, fitted in zip(runs.rows, runs.right, runs.fitted, strict=True)
        if right and fitted and (features := precise_features_of(row["metrics"])) is not None
    ]
    features = np.array([one for one, _ in known]).reshape(-1, len(PRECISE))
    sign = np.array([1.0 if precise else -1.0 for _, precise in known])
    A = np.column_stack([np.ones(len(features)), features])

    def loss(w: Floats) -> tuple[float, Floats]:
        odds, off = sign * (A @ w), w[1:] - NORMAL_WEIGHT
        slope = -(A * (sign / (1.0 + np.exp(odds)))[:, None]).sum(axis=0)
        slope[1:] += 2 * RIDGE_PRECISE * off
        return float(np.logaddexp(0.0, -odds).sum() + RIDGE_PRECISE * (off**2).sum()), slope

    start = np.r_[0.0, np.full(len(PRECISE), NORMAL_WEIGHT)]
    bounds = [(None, None), *[(0.0, None)] * len(PRECISE)]
    w = minimize(loss, start, jac=True, method="L-BFGS-B", bounds=bounds).x
    return Logistic(float(w[0]), tuple(w[1:]))


def shown_precise(runs: Runs, model: Calibration) -> list[dict[str, Any]]:
    """Return the reliability of the probability of being precise on the half that was not fitted to."""
    known = [
        (row, features, precise)
        for row, features, fitted in zip(runs.rows, runs.features, runs.fitted, strict=True)
        if not fitted and (precise := precise_features_of(row["metrics"])) is not None
    ]
    said = np.array(
        [model.probability(features) * model.precise.probability(precise) for _, features, precise in known]
    )
    found = np.array([bool(row["has_truth"] and row["precise"]) for row, _, _ in known], bool)
    return reliability(said, found) if known else []


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
    models = (*fit(runs.features[runs.fitted], runs.right[runs.fitted]), fit_precise(runs))
    model = Calibration(*models, {})
    shown = ~runs.fitted
    probability = model.probability(runs.features)
    lines = reliability(probability[shown], runs.right[shown])
    precise = shown_precise(runs, model)
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
        "shown_precise_calibration_error": round(calibration_error(precise), 4) if precise else None,
        "suites": sorted({str(row["suite"]) for row in runs.rows}),
    }
    data = Calibration(*models, about).as_json()
    text = f"# Calibration of the verdict's probability\n\n{_sentence(about)}\n\n{to_markdown(lines)}\n"
    if precise:
        error = calibration_error(precise)
        text += (
            "\n## Of being within 0.2 degrees and 0.5 m\n\nOn the same half: expected calibration error "
            f"{error:.4f}.\n\n{to_markdown(precise)}\n"
        )
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
