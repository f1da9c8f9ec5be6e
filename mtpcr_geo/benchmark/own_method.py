"""The registration as the benchmark runs it: the stages that `register` builds, on clouds in memory."""

from __future__ import annotations

from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np

from mtpcr_geo.benchmark.estimate import Estimate
from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.cloud import ArrayCloud
from mtpcr_geo.core.errors import RegistrationError
from mtpcr_geo.core.progress import NoProgress
from mtpcr_geo.core.types import Pair
from mtpcr_geo.crs.chain import TransformChain
from mtpcr_geo.io.outputs import OutputSet
from mtpcr_geo.pipeline.registry import make_options, stage_types
from mtpcr_geo.pipeline.stage import RunContext, Stage, Value
from mtpcr_geo.registration import build_pipeline, read_options

_FIRST, _LAST = "mtpcr.level", "mtpcr.assess"


class RegistrationMethod:
    """The registration from levelling to verdict, without reading and writing files.

    Args:
        options: fields of `RegisterOptions`; both clouds are taken as local.

    """

    def __init__(self, **options: Any) -> None:
        self._options = options
        self._stages(0)

    def estimate(self, source: Floats, target: Floats, *, seed: int) -> Estimate:
        """Register the source to the target; a refusal is returned as one."""
        value: list[Value] = [ArrayCloud(target, None, "target"), ArrayCloud(source, None, "source")]
        with OutputSet() as outputs:
            context = RunContext(outputs, NoProgress())
            with closing(context):
                try:
                    for stage in self._stages(seed):
                        made = stage.run(value, context)
                        value = [] if made is None else [made]
                except RegistrationError as error:
                    return Estimate(None, "refused", str(error))
        pair = value[0]
        assert isinstance(pair, Pair)
        assert pair.verdict is not None
        T = TransformChain.of(pair).T_file if pair.T_target_source is not None else None
        numbers = {
            key: float(number)
            for key, number in pair.verdict.metrics.items()
            if isinstance(number, int | float | np.number) and np.isfinite(number)
        }
        return Estimate(T, pair.verdict.name, "; ".join(pair.verdict.reasons), numbers)

    def _stages(self, seed: int) -> list[Stage]:
        options = read_options({"local": True, "recording": False, "seed": seed, **self._options})
        # the files are never touched: readers and writers are left out
        nowhere = Path("nowhere")
        specs = build_pipeline(nowhere / "source.las", nowhere / "target.las", nowhere, options)
        types = [spec["type"] for spec in specs]
        chain = specs[types.index(_FIRST) : types.index(_LAST) + 1]
        known = stage_types()
        stages = []
        for spec in chain:
            given = {key: value for key, value in spec.items() if key not in ("type", "tag", "inputs")}
            kind = known[spec["type"]]
            stages.append(kind(make_options(spec["type"], kind.Options, given), str(spec.get("tag", ""))))
        return stages
