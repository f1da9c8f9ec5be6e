"""Fits the probability of the verdict to rows of the robustness benchmark, and shows it on other sites.

The sites are halved by name: the model is fitted to the runs of one half, and its reliability is that of the
other. Runs without an answer have no evidence to weigh and are left out; so are those of other matchers. What
the fit needs of each run is written beside the coefficients, and can be fitted again without the rows.
"""

from __future__ import annotations

import csv
import datetime
import io
import json
import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, NamedTuple

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
    DATA,
    FILE,
    FIT,
    PRECISE,
    UNIQUE,
    Calibration,
    Logistic,
    features_of,
    precise_features_of,
)

RIDGE, RIDGE_UNIQUE, RIDGE_PRECISE = 0.1, 0.02, 3.0
"""Weight of the squared coefficients in the fit: without it a separable set would make them infinite. The
evidence that a pose is unique spans a smaller range, and wants larger coefficients."""
NORMAL_WEIGHT = 2.0
"""Coefficients that the model of precise poses is drawn to: about those of errors of normal distribution."""
DIGITS = 4
"""Decimals of the features that are fitted to, as they are written."""
_COLUMNS = ("suite", "site", "right", "precise", *FIT, *UNIQUE, *PRECISE)
_LEAST = 1e-12
BINS = (0.0, 0.05, 0.2, 0.5, 0.8, 0.95, 1.0)
FEWEST = 10
_LEAST = 1e-12
REPORT, DIAGRAM = "calibration.md", "reliability.png"


class Run(NamedTuple):
    """What the fit needs of a run.

    Attributes:
        suite, site: of the benchmark.
        right: whether the pose is right; that of a run without a right answer is wrong.
        precise: whether it is precise too.
        features: of `FIT` and `UNIQUE`.
        accuracy: of `PRECISE`; NaN where the accuracy is not known.

    """

    suite: str
    site: str
    right: bool
    precise: bool
    features: tuple[float, ...]
    accuracy: tuple[float, ...]


@dataclass(frozen=True)
class Runs:
    """Runs with evidence.

    Attributes:
        rows: the runs.
        features: (n, f) see `mtpcr_geo.verdict.probability.features_of`.
        accuracy: (n, 2) see `mtpcr_geo.verdict.probability.precise_features_of`; NaN where not known.
        right, precise: (n,) see `Run`.
        fitted: (n,) whether the site is of the half that is fitted to.

    """

    rows: tuple[Run, ...]
    features: Floats
    accuracy: Floats
    right: Mask
    precise: Mask
    fitted: Mask


def run_of(row: Row) -> Run | None:
    """Return what the fit needs of a row of the benchmark; None where it has no evidence."""
    metrics = row["metrics"] or {}
    features, accuracy = features_of(metrics), precise_features_of(metrics)
    if features is None:
        return None
    right = bool(row["has_truth"] and row["right"])
    return Run(
        str(row["suite"]),
        str(row["site"]),
        right,
        right and bool(row.get("precise")),
        tuple(float(one) for one in features.round(DIGITS)),
        (math.nan,) * len(PRECISE)
        if accuracy is None
        else tuple(float(one) for one in accuracy.round(DIGITS)),
    )


def read_runs(path: Path) -> list[Run]:
    """Read runs: rows of the benchmark (``robustness.csv``), or what was kept of them (`DATA`).

    Raises:
        InputError: if the file cannot be read.

    """
    try:
        with Path(path).open(encoding="utf-8", newline="") as file:
            lines = csv.reader(file)
            if tuple(next(lines, ())) == _COLUMNS:
                return [_kept(line) for line in lines]
    except (OSError, ValueError) as error:
        raise InputError(f"cannot read the runs in {path}: {error}") from error
    return [run for row in read_rows(path) if (run := run_of(row)) is not None]


def _kept(line: Sequence[str]) -> Run:
    suite, site, right, precise, *figures = line
    numbers = tuple(float(one) for one in figures)
    split = len(FIT) + len(UNIQUE)
    return Run(suite, site, right == "true", precise == "true", numbers[:split], numbers[split:])


def _written(runs: Runs) -> str:
    """Return the runs as `read_runs` reads them."""
    text = io.StringIO()
    lines = csv.writer(text, lineterminator="\n")
    lines.writerow(_COLUMNS)
    for run in runs.rows:
        answers = [str(one).lower() for one in (run.right, run.precise)]
        figures = [f"{one:.{DIGITS}f}" for one in (*run.features, *run.accuracy)]
        lines.writerow([run.suite, run.site, *answers, *figures])
    return text.getvalue()


def runs_of(found: Sequence[Run]) -> Runs:
    """Halve the sites of runs.

    Raises:
        InputError: if there are too few, or no right or no wrong ones in the half that is fitted to.

    """
    half = {name: number % 2 == 0 for number, name in enumerate(sorted({run.site for run in found}))}
    right = np.array([run.right for run in found], bool)
    fitted = np.array([half[run.site] for run in found], bool)
    if min(int((right & fitted).sum()), int((~right & fitted).sum()), int((~fitted).sum())) < FEWEST:
        raise InputError(
            f"{len(found)} runs with evidence are too few to calibrate by: at least {FEWEST} right and "
            f"{FEWEST} wrong ones are wanted in each half of the sites"
        )
    features, accuracy = (
        np.array([getattr(run, name) for run in found]) for name in ("features", "accuracy")
    )
    precise = np.array([run.precise for run in found], bool)
    return Runs(tuple(found), features, accuracy, right, precise, fitted)


@dataclass(frozen=True)
class Part:
    """One factor of a probability, to be fitted.

    Attributes:
        features: (n, f).
        ridge: weight of the squared distance of its coefficients from ``toward``.
        toward: what they are drawn to.
        first: intercept that the fit starts from.

    """

    features: Floats
    ridge: float
    toward: float = 0.0
    first: float = 0.0


def fit(parts: Sequence[Part], yes: Mask) -> list[Logistic]:
    """Fit a product of logistic models whose weights are not negative.

    Args:
        parts: the factors.
        yes: (n,) the answers.

    Returns:
        A model for each.

    """
    designs = [np.column_stack([np.ones(len(yes)), part.features]) for part in parts]
    cuts = np.cumsum([design.shape[1] for design in designs])[:-1]

    def loss(w: Floats) -> tuple[float, Floats]:
        pieces = np.split(w, cuts)
        odds = [A @ piece for A, piece in zip(designs, pieces, strict=True)]
        log_p = -np.sum([np.logaddexp(0.0, -one) for one in odds], axis=0)
        log_q = np.log(np.maximum(-np.expm1(log_p), _LEAST))
        value = -np.where(yes, log_p, log_q).sum()
        # of the loss by log p; log p by the odds of a factor is the probability that this one says no
        outer = np.where(yes, -1.0, np.exp(log_p - log_q))
        slopes = []
        for A, piece, part, one in zip(designs, pieces, parts, odds, strict=True):
            off = np.r_[0.0, piece[1:] - part.toward]
            value += part.ridge * (off**2).sum()
            slopes.append(A.T @ (outer / (1.0 + np.exp(one))) + 2 * part.ridge * off)
        return float(value), np.concatenate(slopes)

    starts: list[float] = []
    bounds: list[tuple[float | None, None]] = []
    for part, design in zip(parts, designs, strict=True):
        count = design.shape[1] - 1
        starts += [part.first, *[part.toward or 1.0] * count]
        bounds += [(None, None), *[(0.0, None)] * count]
    w = minimize(loss, np.array(starts), jac=True, method="L-BFGS-B", bounds=bounds).x
    return [Logistic(float(piece[0]), tuple(map(float, piece[1:]))) for piece in np.split(w, cuts)]


def fitted_to(runs: Runs) -> tuple[Logistic, Logistic, Logistic]:
    """Fit the models of a `Calibration` to the half of the sites that is for it."""
    half, split = runs.fitted, len(FIT)
    # most poses do not fit, and few of those that do look alike
    fits, unique = fit(
        [
            Part(runs.features[half, :split], RIDGE, first=-2.0),
            Part(runs.features[half, split:], RIDGE_UNIQUE, first=1.0),
        ],
        runs.right[half],
    )
    known = half & runs.right & np.isfinite(runs.accuracy).all(axis=1)
    (precise,) = fit([Part(runs.accuracy[known], RIDGE_PRECISE, NORMAL_WEIGHT)], runs.precise[known])
    return fits, unique, precise


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
        paths: ``robustness.csv`` files, or a ``calibration.csv`` of an earlier fit.
        out: folder for ``calibration.json``, ``calibration.csv`` (the runs it was fitted to and shown on),
            ``calibration.md`` and, where matplotlib is installed, ``reliability.png``.

    Returns:
        The reliability on the half that was not fitted to, as Markdown.

    Raises:
        InputError: if a file cannot be read, or the runs are too few.

    """
    runs = runs_of([run for path in paths for run in read_runs(path)])
    models = fitted_to(runs)
    model = Calibration(*models, {})
    shown, known = ~runs.fitted, np.isfinite(runs.accuracy).all(axis=1)
    probability = model.probability(runs.features)
    lines = reliability(probability[shown], runs.right[shown])
    said = probability * model.precise.probability(runs.accuracy)
    precise = reliability(said[shown & known], runs.precise[shown & known])
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
        "suites": sorted({run.suite for run in runs.rows}),
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
        files.path(Path(out) / DATA).write_text(_written(runs), "utf-8")
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
