"""The method step by step on clouds in memory, so that variants can share what they have in common."""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping
from contextlib import closing
from dataclasses import dataclass
from typing import Any

import numpy as np

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.cloud import ArrayCloud
from mtpcr_geo.core.errors import RegistrationError
from mtpcr_geo.core.progress import NoProgress
from mtpcr_geo.core.system import peak_memory_mb, reset_peak_memory
from mtpcr_geo.core.types import Pair
from mtpcr_geo.io.outputs import OutputSet
from mtpcr_geo.pipeline.registry import make_options, stage_types
from mtpcr_geo.pipeline.stage import RunContext, Stage, Value
from mtpcr_geo.registration import build_pipeline, read_options


@dataclass(frozen=True)
class Outcome:
    """What some steps came to.

    Attributes:
        pair: as far as it came.
        failure: why it came no further, or None.
        seconds: time of each step, by type.
        memory_mib: most resident memory meanwhile, everything included; None where it is unknown.

    """

    pair: Pair
    failure: str | None
    seconds: dict[str, float]
    memory_mib: float | None

    @property
    def verdict(self) -> str:
        """The verdict's name; refused where it did not come to one."""
        return self.pair.verdict.name if self.pair.verdict is not None and not self.failure else "refused"


def level_pair(source: Floats, target: Floats, level: str, seed: int = 0) -> Pair:
    """Make a pair of two local clouds, (n, 3) and (m, 3) metres, levelled by mtpcr.level's method."""
    clouds: list[Value] = [ArrayCloud(target, None, "target"), ArrayCloud(source, None, "source")]
    step = {"type": "mtpcr.level", "tag": "level", "method": level, "local": True, "seed": seed}
    with OutputSet() as outputs, closing(RunContext(outputs, NoProgress())) as context:
        made = _stage(step).run(clouds, context)
    assert isinstance(made, Pair)
    return made


def steps_of(**options: Any) -> list[dict[str, Any]]:
    """Return the steps from mtpcr.bev to mtpcr.assess that `register` takes with these options."""
    stages = build_pipeline("source.laz", "target.laz", "out", read_options(options))
    names = [stage["type"] for stage in stages]
    return stages[names.index("mtpcr.bev") : names.index("mtpcr.assess") + 1]


def follow(pair: Pair, steps: Iterable[Mapping[str, Any]]) -> Outcome:
    """Take a pair through steps, as written in a pipeline JSON; a refusal ends them.

    Raises:
        MtpcrError: if an option is wrong or a part is missing.

    """
    reset_peak_memory()
    seconds: dict[str, float] = {}
    failure = None
    with OutputSet() as outputs, closing(RunContext(outputs, NoProgress())) as context:
        stages = [_stage(step) for step in steps]
        for stage in stages:
            stage.check(context)
        for stage in stages:
            began = time.perf_counter()
            try:
                made = stage.run([pair], context)
            except RegistrationError as error:
                failure = str(error)
                break
            finally:
                seconds[stage.type] = time.perf_counter() - began
            assert isinstance(made, Pair)
            pair = made
    return Outcome(pair, failure, seconds, peak_memory_mb())


def random_start(
    rng: np.random.Generator,
    centre: Floats,
    *,
    yaw_deg: float = 360.0,
    shift_m: float = 100.0,
    tilt_deg: float = 0.0,
) -> Floats:
    """Draw a 4x4 start: any yaw below one, a tilt up to one, about a centre, and a shift in any direction.

    Args:
        rng: of the draw.
        centre: (3,) about which is turned, metres.
        yaw_deg, shift_m, tilt_deg: the largest of each.

    """
    direction = rng.normal(size=3)
    shift = direction / np.linalg.norm(direction) * rng.uniform(0.0, shift_m)
    R = transforms.yaw_matrix(np.radians(rng.uniform(0.0, yaw_deg)))
    if tilt_deg > 0.0:
        R = transforms.tilt_matrix(rng.uniform(0.0, 2 * np.pi), np.radians(rng.uniform(0.0, tilt_deg))) @ R
    return transforms.translation(shift) @ transforms.about(centre, R)


def _stage(step: Mapping[str, Any]) -> Stage:
    kind = stage_types()[step["type"]]
    own = {key: value for key, value in step.items() if key not in ("type", "tag", "inputs")}
    return kind(make_options(str(step["type"]), kind.Options, own), str(step["tag"]))
