"""One run: the clouds of a case are registered, and the answer is compared with the truth."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from typing import Any

import numpy as np

from mtpcr_geo.benchmark.metrics import rotation_error_deg
from mtpcr_geo.benchmark.robustness.cases import Case, CaseClouds
from mtpcr_geo.benchmark.robustness.coverage import coverage_of
from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.errors import MtpcrError
from mtpcr_geo.core.system import peak_memory_mb, reset_peak_memory
from mtpcr_geo.export.run_json import plain
from mtpcr_geo.registration import Registration, register
from mtpcr_geo.verdict.probability import PRECISE_WITHIN

Row = dict[str, Any]
RIGHT = (5.0, 2.0)
"""Degrees and metres below which a pose is right."""
SAMPLE = 5_000
STRENGTHS = 5

LABELS = (
    "case", "suite", "site", "kind", "place", "seed", "start", "radius", "asked_overlap", "level",
    "has_truth",
)  # fmt: skip
SCENE = (
    "yaw_deg", "tilt_deg", "shift_m", "overlap", "overlap_of_target", "points_source", "points_target",
)  # fmt: skip
ANSWER = (
    "verdict", "right", "precise", "rot_err_deg", "shift_err_m", "plan_err_m", "dz_err_m", "far_err_m",
    "swap_mm", "swap_deg", "swap_verdict", "time_s", "cpu_s", "peak_mib",
)  # fmt: skip
UNCERTAINTY = (
    "sigma_plan_m", "sigma_height_m", "sigma_yaw_deg", "sigma_tilt_deg", "sigma_plan_far_m",
    "sigma_height_far_m", "truth_m", "truth_height_m", "plan_of_95", "height_of_95", "yaw_of_95",
    "tilt_of_95", "far_of_95",
)  # fmt: skip
"""Columns of the stated uncertainty, and of true errors over the half width of the region of 95 %."""
FIGURES = (
    "neg_log10_p", "hypothesis_margin", "null_ratio", "patch_support", "strength", "overlap_m2",
    "ground_agreeing", "ground_cells", "held_out_tie_points", "held_out_agreeing",
)  # fmt: skip
"""Figures of the verdict that have a column of their own; the column `metrics` holds all of them."""
MATCHER_FIGURES = (
    "extent_m", "margin", "mirrored_strengths", "neg_log10_p", "scores", "strengths", "support_next",
)  # fmt: skip
"""Figures of the matcher's own report that `metrics` keeps."""
COLUMNS = (*LABELS, *SCENE, *ANSWER, *UNCERTAINTY, *FIGURES, "reason", "middle", "T_answer_true", "metrics")
"""Columns of a row, in order; see `run_case`."""


def labels_of(case: Case) -> Row:
    """Return what a row tells of its case before it is run."""
    return {
        "case": case.name,
        "suite": case.suite,
        "site": case.site,
        "kind": case.kind,
        "place": case.place,
        "seed": case.seed,
        "start": case.start,
        "radius": case.radius,
        "asked_overlap": case.asked_overlap,
        "level": case.level,
        "has_truth": case.has_truth,
    }


def scene_of(clouds: CaseClouds) -> Row:
    """Return what a row tells of its clouds before they are registered."""
    shares = clouds.overlap or (None, None)
    return {
        **clouds.drawn,
        "overlap": shares[0],
        "overlap_of_target": shares[1],
        "points_source": len(clouds.source),
        "points_target": len(clouds.target),
        "middle": clouds.middle.tolist(),
    }


def run_case(case: Case) -> Row:
    """Make the clouds of a case and run it; see `run_clouds`. Without clouds the verdict is "failed"."""
    try:
        clouds = case.clouds()
    except MtpcrError as error:
        return labels_of(case) | failure(f"no clouds: {error}")
    return labels_of(case) | scene_of(clouds) | run_clouds(clouds, both_ways=case.both_ways)


def run_clouds(clouds: CaseClouds, *, both_ways: bool = False) -> Row:
    """Register the clouds of a case, and compare the answer with the truth.

    Returns:
        verdict
            accepted, doubtful, refused, or failed where the registration raised something else.
        right, precise
            whether the pose is within `RIGHT` and `PRECISE`, whatever the verdict; None without a truth.
        rot_err_deg
            angle between the pose and the truth, degrees.
        shift_err_m, plan_err_m, dz_err_m
            how far the middle of the source's part in the overlap is off, metres: in space, in plan, and
            in height (found minus true).
        far_err_m
            how far the worst point of the source is off, metres.
        sigma_*, truth_*, *_of_95
            see `mtpcr_geo.benchmark.robustness.coverage`.
        swap_mm, swap_deg, swap_verdict
            how far the transform with source and target exchanged is from the inverse, at the same middle;
            and its verdict.
        time_s, cpu_s, peak_mib
            of the registration alone: wall time, processor time of all threads, and peak memory.
        T_answer_true
            4x4 that is the identity where the answer is right, in the frame in which both clouds were made;
            without a truth, the answer after the start.

    """
    reset_peak_memory()
    began, worked = time.perf_counter(), time.process_time()
    found = _registered(clouds.source, clouds.target, clouds.options)
    seconds = time.perf_counter() - began
    if isinstance(found, str):
        return failure(found, seconds)
    T = found.T_target_source
    row: Row = {
        "verdict": found.verdict.name,
        "reason": "; ".join(found.verdict.reasons),
        "time_s": seconds,
        "cpu_s": time.process_time() - worked,
        "peak_mib": peak_memory_mb(),
        "right": None if clouds.T_target_source is None else False,
        "precise": None if clouds.T_target_source is None else False,
        **_figures(found),
    }
    if T is not None and np.isfinite(T).all():
        row |= errors_of(T, clouds)
        row |= coverage_of(found, clouds)
        if both_ways:
            row |= _exchanged(T, clouds)
    return row


def failure(reason: str, seconds: float | None = None) -> Row:
    """Return the answer of a run that came to none."""
    return {"verdict": "failed", "reason": reason, "time_s": seconds}


def errors_of(T: Floats, clouds: CaseClouds) -> Row:
    """Return how far a pose, 4x4 from source to target, is from the truth; see `run_clouds`."""
    T_true = clouds.T_target_source
    if T_true is None:
        return {"T_answer_true": (T @ clouds.T_start).tolist()}
    back = transforms.inverse(T_true @ clouds.T_start)
    T_answer_true = back @ T @ clouds.T_start
    step = transforms.apply(T_answer_true, clouds.middle[None])[0] - clouds.middle
    sample = clouds.source[:: max(1, len(clouds.source) // SAMPLE)]
    away = transforms.apply(T, sample) - transforms.apply(T_true, sample)
    rotation = rotation_error_deg(T, T_true)
    shift = float(np.linalg.norm(step))
    return {
        "right": bool(rotation < RIGHT[0] and shift < RIGHT[1]),
        "precise": bool(rotation < PRECISE_WITHIN[0] and shift < PRECISE_WITHIN[1]),
        "rot_err_deg": rotation,
        "shift_err_m": shift,
        "plan_err_m": float(np.hypot(step[0], step[1])),
        "dz_err_m": float(step[2]),
        "far_err_m": float(np.linalg.norm(away, axis=1).max()),
        "T_answer_true": T_answer_true.tolist(),
    }


def _registered(source: Floats, target: Floats, options: Mapping[str, Any]) -> Registration | str:
    """Return the registration, or what went wrong: a benchmark tells of crashes, and goes on."""
    try:
        return register(source, target, **options)
    except Exception as error:  # noqa: BLE001
        return f"{type(error).__name__}: {error}"


def _exchanged(T: Floats, clouds: CaseClouds) -> Row:
    """Register the target to the source, and compare with the inverse of `T`."""
    roles = {"source_crs": "target_crs", "target_crs": "source_crs"}
    options = {roles.get(key, key): value for key, value in clouds.options.items()}
    found = _registered(clouds.target, clouds.source, options)
    if isinstance(found, str):
        return {"swap_verdict": f"failed: {found}"}
    row: Row = {"swap_verdict": found.verdict.name}
    if found.T_target_source is not None:
        T_round = found.T_target_source @ T
        middle = transforms.apply(clouds.T_start, clouds.middle[None])
        row["swap_mm"] = 1000.0 * float(np.linalg.norm(transforms.apply(T_round, middle) - middle))
        row["swap_deg"] = rotation_error_deg(T_round, np.eye(4))
    return row


def _figures(found: Registration) -> Row:
    metrics = {str(key): value for key, value in plain(dict(found.verdict.metrics)).items()}
    if found.pair is not None and found.pair.matches is not None:
        matches = found.pair.matches
        metrics["strength"] = matches.strength
        metrics["hypotheses"] = [
            [float(one.score), float(np.degrees(one.yaw)), *map(float, one.shift)]
            for one in matches.hypotheses[:STRENGTHS]
        ]
        metrics["cell_m"] = float(found.pair.cell)
        metrics["matcher"] = {key: matches.report.get(key) for key in MATCHER_FIGURES}
    metrics["stage_s"] = {stage.type: round(stage.seconds, 3) for stage in found.report}
    row = {name: metrics.get(name) for name in FIGURES}
    return row | {"metrics": json.loads(json.dumps(plain(metrics)))}
