"""How probable it is that a pose is right: a model of the evidence, fitted to runs of known answer.

A pose is right where the clouds fit under it, and where it is not one that merely looks alike: a symmetrical
site turned by half a turn fits as well as it does in its place. The probability is the product of both, each
a logistic model, fitted together. Each piece of evidence may only speak for a pose: weights are not negative.
What the model was fitted to, and how it does on sites that it was not fitted to, stands in
``calibration.json`` beside this module, and the runs themselves in ``calibration.csv``; ``mtpcr-geo benchmark
--calibrate`` makes both from the rows of robustness benchmarks.
"""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache
from importlib import resources
from typing import Any

import numpy as np

from mtpcr_geo.core.arrays import Floats

FILE, DATA = "calibration.json", "calibration.csv"
RATIOS = (0.2, 20.0)
"""Ratios of strengths to the next distinct pose's beyond which they say no more."""
RELIEF_NOISE_M = 0.05
"""Added to spread and relief of the ground: what is below it is noise."""
GROUND_CLEAR = (-1.0, 2.5)
GROUND_EXPECTED = 0.7
MOST_MISSING, MISSING_UNIT = 0.5, 0.1
"""Share of missing objects beyond which more says no more, and the unit that it counts in."""
CLEAR_OF_MIRROR = 3.0
"""Ratio of strengths to the mirrored source's beyond which a site does not fit its own mirror image."""
TIE_POINTS_PER_PATCH = 4
"""Patches overlap by half, so about four tie points tell what one independent tie would."""

FIT = ("margin", "agreement", "ground_shape", "ground_agreement", "refinement")
"""What says that the clouds fit, as numbers that grow with what speaks for a pose:

- margin: logarithm of the strength over that of the next distinct pose;
- agreement: logarithm of the significance of the held-out tie points, overlapping ones counted once;
- ground_shape: logarithm of the ground's relief over the spread of the height differences;
- ground_agreement: share of the common ground that agrees, over what flat ground of any place reaches;
- refinement: -1 where surfaces fit better where the tie points do not agree.
"""

UNIQUE = ("mirror", "objects", "rows")
"""What says that no other pose looks alike, likewise:

- mirror: logarithm of the strength over the best of the mirrored source, up to where it is clear of it: a
  scene without a right pose reaches as much, and most sites that fit themselves after half a turn do;
- objects: minus the share of one cloud's objects at whose place the other sees bare ground;
- rows: where the scene repeats itself, or may, minus the logarithm of the ground's spread over its noise,
  from `ROWS_OVER_NOISE` on: of many places with the same rows the terrain of one fits by chance, not to the
  noise.
"""

ROWS_OVER_NOISE, LEAST_GROUND_NOISE_M, MOST_OF_ROWS = 10.0, 0.0025, 1.5
"""Spread of the ground over its noise that right poses among rows hardly exceed (11 at most), the least noise
that is believed, and logarithm of that ratio over the first beyond which more says no more."""


MAY_REPEAT = 0.3
"""Correlation of a scene with itself, moved, from which it may be rows. It is below
`mtpcr_geo.match.repetition.REPEATS`, since young and missing trees make an orchard less like itself, and
right poses of any site fit to a few times the noise."""

PRECISE = ("plan", "rotation")
"""What says that a right pose is precise: logarithms of the tolerance over what 95 % of the errors in plan
stay below, and over twice the standard deviation of the rotation."""
PRECISE_WITHIN = (0.2, 0.5)
"""Degrees, and metres in plan in the middle of the overlap, within which a pose is precise."""
_FINEST = (0.005, 0.01)
"""Degrees and metres below which a stated accuracy says no more."""


def features_of(metrics: Mapping[str, Any]) -> Floats | None:
    """Return the evidence of a verdict's metrics as numbers.

    Args:
        metrics: as `mtpcr_geo.verdict.decision.assess` gives them.

    Returns:
        (f,) in the order of `FIT`, then `UNIQUE`; None where the matcher gives no margin, or no mirrored
        source was searched.

    """
    margin, null = metrics.get("hypothesis_margin"), metrics.get("null_ratio")
    significance = metrics.get("neg_log10_p")
    if margin is None or null is None or significance is None:
        return None
    if metrics.get("narrow_prior"):
        # among the few poses about a prior the next one may be weak by chance, or there is none
        margin = min(margin, null)
    spread, relief = metrics.get("ground_spread_m"), metrics.get("ground_relief_m")
    shape = 0.0
    if spread is not None and relief is not None:
        shape = float(np.clip(np.log((relief + RELIEF_NOISE_M) / (spread + RELIEF_NOISE_M)), *GROUND_CLEAR))
    rows = may_repeat(bool(metrics.get("repeats")), metrics.get("self_likeness"))
    over_noise = rows_over_noise(rows, spread, metrics.get("ground_noise_m"))
    of_rows = 0.0 if over_noise is None else float(np.log(over_noise / ROWS_OVER_NOISE))
    cells = metrics.get("ground_cells") or 0
    share = (metrics.get("ground_agreeing") or 0) / max(cells, 1) - GROUND_EXPECTED
    return np.array(
        [
            np.log(np.clip(margin, *RATIOS)),
            np.log1p(significance / TIE_POINTS_PER_PATCH),
            shape,
            share if metrics.get("ground_checked") else 0.0,
            -1.0 if metrics.get("refinement_lost") else 0.0,
            np.log(np.clip(null, RATIOS[0], CLEAR_OF_MIRROR)),
            -min(metrics.get("objects_missing") or 0.0, MOST_MISSING) / MISSING_UNIT,
            -min(max(of_rows, 0.0), MOST_OF_ROWS),
        ]
    )


def may_repeat(repeats: bool, self_likeness: float | None) -> bool:
    """Return whether a scene repeats itself, or so nearly that it may be rows."""
    return repeats or (self_likeness is not None and self_likeness >= MAY_REPEAT)


def rows_over_noise(rows: bool, spread_m: float | None, noise_m: float | None) -> float | None:
    """Return the ground's spread over its noise; None if that is unknown, or there can be no rows."""
    if not rows or spread_m is None or noise_m is None or spread_m <= 0.0:
        return None
    return spread_m / max(noise_m, LEAST_GROUND_NOISE_M)


def precise_features_of(metrics: Mapping[str, Any]) -> Floats | None:
    """Return how the stated accuracy compares with what is called precise.

    Args:
        metrics: of a verdict, with those of its uncertainty.

    Returns:
        (2,) in the order of `PRECISE`; None where the accuracy is not known.

    """
    plan, yaw, tilt = (metrics.get(name) for name in ("within_95_plan_m", "sigma_yaw_deg", "sigma_tilt_deg"))
    if plan is None or yaw is None or tilt is None:
        return None
    rotation = max(2.0 * float(np.hypot(yaw, tilt)), _FINEST[0])
    return np.log([PRECISE_WITHIN[1] / max(plan, _FINEST[1]), PRECISE_WITHIN[0] / rotation])


@dataclass(frozen=True)
class Logistic:
    """A logistic model.

    Attributes:
        intercept: log odds where nothing is known.
        weights: (f,) by which the features add to the log odds.

    """

    intercept: float
    weights: tuple[float, ...]

    def probability(self, features: Floats) -> Floats:
        """Return the probability, (...,), of (..., f) features."""
        odds = self.intercept + np.asarray(features) @ np.array(self.weights)
        return np.asarray(1.0 / (1.0 + np.exp(-odds)))


@dataclass(frozen=True)
class Calibration:
    """A fitted model.

    Attributes:
        fit: that the clouds fit, of the features of `FIT`.
        unique: that no other pose looks alike, of those of `UNIQUE`.
        precise: that a right pose is precise, of those of `PRECISE`.
        about: what it was fitted to, when, and how it does on other sites.

    """

    fit: Logistic
    unique: Logistic
    precise: Logistic
    about: Mapping[str, Any]

    def probability(self, features: Floats) -> Floats:
        """Return the probability of being right, (...,), of (..., f) features, see `features_of`."""
        features = np.asarray(features)
        split = len(self.fit.weights)
        fits, unique = features[..., :split], features[..., split:]
        return self.fit.probability(fits) * self.unique.probability(unique)

    def as_json(self) -> dict[str, Any]:
        """Return what `FILE` holds."""
        models = {
            "fit": (FIT, self.fit),
            "unique": (UNIQUE, self.unique),
            "precise": (PRECISE, self.precise),
        }
        return {"about": dict(self.about)} | {
            key: {
                "intercept": round(model.intercept, 4),
                "weights": {name: round(float(w), 4) for name, w in zip(names, model.weights, strict=True)},
            }
            for key, (names, model) in models.items()
        }


@cache
def shipped() -> Calibration:
    """Return the calibration that comes with the package."""
    data = json.loads((resources.files(__package__) / FILE).read_text(encoding="utf-8"))
    fit, unique, precise = (
        Logistic(float(one["intercept"]), tuple(float(one["weights"][name]) for name in names))
        for one, names in (
            (data["fit"], FIT),
            (data["unique"], UNIQUE),
            (data["precise"], PRECISE),
        )
    )
    return Calibration(fit, unique, precise, data["about"])


def probability_of(metrics: Mapping[str, Any]) -> float | None:
    """Return how probable it is that a pose is within 5 degrees and 2 m of the truth.

    Args:
        metrics: see `features_of`.

    Returns:
        0 to 1; None where the evidence is not of the kind that the model knows.

    """
    features = features_of(metrics)
    return None if features is None else float(shipped().probability(features))


def probability_of_precise(metrics: Mapping[str, Any]) -> float | None:
    """Return how probable it is that a pose is precise: as near the truth as `PRECISE_WITHIN`.

    Args:
        metrics: of a verdict, with those of its uncertainty.

    Returns:
        0 to 1: that it is right, times that a right one is precise; None where either is not known.

    """
    right, features = probability_of(metrics), precise_features_of(metrics)
    if right is None or features is None:
        return None
    return right * float(shipped().precise.probability(features))
