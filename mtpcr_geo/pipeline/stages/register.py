"""The common case in one stage: two clouds in, a judged registration out."""

from __future__ import annotations

import time
from collections.abc import Sequence
from pathlib import Path
from typing import ClassVar

from mtpcr_geo.pipeline.options import MethodOptions
from mtpcr_geo.pipeline.stage import OptionsModel, RunContext, Stage, StageOptions, Value
from mtpcr_geo.pipeline.stages.matching import Match
from mtpcr_geo.pipeline.stages.rasters import Level
from mtpcr_geo.pipeline.stages.solving import Assess, Refine
from mtpcr_geo.pipeline.stages.steps import steps_of


class RegisterStageOptions(MethodOptions, StageOptions):
    """Options of mtpcr.register: those of the method, from levelling to verdict."""


class Register(Stage):
    """Register the second cloud to the first, as in PDAL's filters.icp: the fixed one comes first.

    Does what mtpcr.level to mtpcr.assess do one by one; mtpcr.apply behind it gives the moved cloud.
    """

    type = "mtpcr.register"
    needs = (*Level.needs, *Match.needs, *Refine.needs, *Assess.needs)
    Options: ClassVar[OptionsModel] = RegisterStageOptions
    options: RegisterStageOptions

    def __init__(self, options: StageOptions, tag: str) -> None:
        super().__init__(options, tag)
        self.steps = steps_of(self.options, f"{tag}_")

    def check(self, context: RunContext) -> None:
        """Check every step."""
        for step in self.steps:
            step.check(context)

    def reads(self) -> list[Path]:
        """Return the files that any step reads."""
        return [path for step in self.steps for path in step.reads()]

    def check_inputs(self, inputs: Sequence[Value], context: RunContext) -> None:
        """Check the clouds as the first step does."""
        self.steps[0].check_inputs(inputs, context)

    def run(self, inputs: Sequence[Value], context: RunContext) -> Value | None:
        """Run the steps in turn."""
        value: Value | None = None
        seconds: dict[str, float] = {}
        for step in self.steps:
            start = time.perf_counter()
            value = step.run(inputs, context)
            seconds[step.type] = time.perf_counter() - start
            self.metadata[step.type] = step.metadata
            inputs = [] if value is None else [value]
            # the recording shows each step; this stage as a whole comes after
            context.recorder.after(
                step.type, self.tag, step.options.model_dump(mode="json"), value, seconds[step.type]
            )
        self.metadata["time_s"] = seconds
        return value
