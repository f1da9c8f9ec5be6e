"""Which stages a registration is made of, from levelling to verdict: ours, or MT-PCR's as published."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from mtpcr_geo.core.errors import OptionError
from mtpcr_geo.pipeline.options import MethodOptions

MANY_TRIES = 20_000
"""Pairs of tie points tried for the robust start with keypoint matchers: few matches may be right."""
SWITCHES = ("force", "local")
"""Options that are off unless named."""


def steps_of(options: MethodOptions, inputs: Sequence[str] | None = None) -> list[dict[str, Any]]:
    """Name the stages, as pipeline JSON, each tagged by its step.

    Args:
        options: of the method.
        inputs: tags of the target's and the source's reader; the stages before, if None.

    Raises:
        OptionError: if options do not go together.

    """
    seed = {"seed": options.seed} if options.seed else {}
    paper = options.profile == "paper"
    level = {
        "type": "mtpcr.level",
        "tag": "level",
        "inputs": None if inputs is None else list(inputs),
        "method": "ransac" if paper and options.level == "auto" else options.level,
        "target_crs": options.target_crs,
        "source_crs": options.source_crs,
        "local": options.local,
        "vertical": None if options.vertical == "refuse" else options.vertical,
        "out_crs": options.out_crs,
        **seed,
    }
    steps = [level, *(_paper_method(options, seed) if paper else _method(options, seed))]
    return [without_defaults(step) for step in steps]


def without_defaults(stage: dict[str, Any]) -> dict[str, Any]:
    """Leave out what says nothing: None, and switches that are off."""
    return {
        key: value
        for key, value in stage.items()
        if value is not None and not (key in SWITCHES and value is False)
    }


def _method(options: MethodOptions, seed: dict[str, int]) -> list[dict[str, Any]]:
    """Name the steps from raster to verdict."""
    for name in ("res", "focus", "enhance"):
        if not getattr(options, name):
            raise OptionError(f"--no-{name} belongs to --profile paper")
    correlation = options.matcher in (None, "correlation")
    match = {} if correlation else {"method": options.matcher, "models": _models(options)}
    # learned keypoints like fine detail, where the points are dense enough to show it
    finest = None if correlation or options.matcher in ("rootsift", "orb") else 0.5
    return [
        {"type": "mtpcr.bev", "tag": "bev", "cell": options.cell, "finest": finest},
        {"type": "mtpcr.match", "tag": "match", **match, **_prior(options), **seed},
        {"type": "mtpcr.inverse_mapping", "tag": "inverse_mapping", **seed},
        {"type": "mtpcr.solve", "tag": "solve", "tries": None if correlation else MANY_TRIES, **seed},
        {
            "type": "mtpcr.refine",
            "tag": "refine",
            "motion": None if options.motion == "rigid" else options.motion,
        },
        {"type": "mtpcr.assess", "tag": "assess"},
    ]


def _paper_method(options: MethodOptions, seed: dict[str, int]) -> list[dict[str, Any]]:
    """Name the steps from raster to verdict as MT-PCR has them."""
    if options.prior != "none" or options.motion != "rigid":
        raise OptionError("--prior and --motion are not of the paper; leave them out, or --profile paper")
    # without RES coordinates stay metres, and Eq. 2 makes pixels of one
    res = {"cell": options.cell, "resolution": "eq1"} if options.res else {"cell": options.cell or 1.0}
    matcher = options.matcher or "superpoint"
    steps: list[dict[str, Any]] = [
        {"type": "mtpcr.bev", "tag": "bev", **res, "pixel": "ceil"},
        {"type": "mtpcr.enhance", "tag": "enhance", "look": "paper" if options.enhance else "grey"},
        {"type": "mtpcr.match", "tag": "match", "method": matcher, "models": _models(options), **seed},
    ]
    if options.focus:
        steps.append({"type": "mtpcr.focus", "tag": "focus", **seed})
    return [
        *steps,
        {
            "type": "mtpcr.inverse_mapping",
            "tag": "inverse_mapping",
            "surface": "grey",
            "pixel": "ceil",
            **seed,
        },
        {"type": "mtpcr.solve", "tag": "solve", "upright": False, "robust_start": False, **seed},
        {
            "type": "mtpcr.refine",
            "tag": "refine",
            "method": "point_to_point",
            "ground": False,
            "max_correspondence_distance": [3.0, 1.5, 0.75],
            "keep_tie_points": 0,
        },
        {"type": "mtpcr.assess", "tag": "assess"},
    ]


def _models(options: MethodOptions) -> str | None:
    return None if options.models is None else str(options.models)


def _prior(options: MethodOptions) -> dict[str, Any]:
    if options.prior == "none":
        return {}
    return {"prior": options.prior, "prior_sigma": options.prior_sigma, "prior_yaw": options.prior_yaw}
