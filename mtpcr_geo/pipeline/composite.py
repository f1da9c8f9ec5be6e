"""The common case in one stage: two clouds in, a judged registration out."""

from __future__ import annotations

import time
from collections.abc import Sequence
from typing import ClassVar, Literal

from pydantic import Field

from mtpcr_geo.pipeline.stage import OptionsModel, RunContext, Stage, StageOptions, Value

_HANDED_ON = {
    "level": ("method", "target_crs", "source_crs", "local", "vertical", "out_crs", "seed"),
    "bev": ("cell",),
    "match": ("prior", "prior_sigma", "prior_yaw", "seed"),
    "lift": ("seed",),
    "solve": ("seed",),
    "refine": ("motion",),
}
METHOD = ("level", "bev", "match", "lift", "solve", "refine", "assess")


class RegisterStageOptions(StageOptions):
    """Options of mtpcr.register."""

    level: Literal["auto", "ransac", "none"] = Field(
        "auto", description="how to make the clouds upright; auto trusts georeferenced clouds"
    )
    cell: float | None = Field(
        None, gt=0, allow_inf_nan=False, description="cell of the height rasters, metres; chosen if not given"
    )
    target_crs: str | None = Field(None, description="CRS of the first cloud, instead of what it states")
    source_crs: str | None = Field(None, description="CRS of the second cloud, instead of what it states")
    local: bool = Field(False, description="both clouds are local, in metres, whatever they state")
    vertical: Literal["refuse", "assume-same", "estimate"] = Field(
        "refuse", description="what to do with different or unknown vertical datums"
    )
    out_crs: str | None = Field(
        None, description="CRS of the result, where it shall not be the first cloud's"
    )
    prior: Literal["none", "georef"] = Field(
        "none", description="georef starts from where both clouds' CRSs put them, and searches only near it"
    )
    prior_sigma: float = Field(5.0, gt=0, description="standard deviation of the source's place, metres")
    prior_yaw: float = Field(5.0, gt=0, le=180, description="largest turn from the prior considered, degrees")
    motion: Literal["rigid", "yaw", "translation"] = Field(
        "rigid", description="degrees of freedom of the result: all six, yaw and shift, or the shift alone"
    )
    seed: int = Field(0, ge=0, description="seed of everything random")


class Register(Stage):
    """Register the second cloud to the first, as in PDAL's filters.icp: the fixed one comes first.

    Does what mtpcr.level to mtpcr.assess do one by one; mtpcr.apply behind it gives the moved cloud.
    """

    type = "mtpcr.register"
    Options: ClassVar[OptionsModel] = RegisterStageOptions
    options: RegisterStageOptions

    def __init__(self, options: StageOptions, tag: str) -> None:
        super().__init__(options, tag)
        self.steps = [self._step(name) for name in METHOD]

    def check(self, context: RunContext) -> None:
        """Check every step."""
        for step in self.steps:
            step.check(context)

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

    def _step(self, name: str) -> Stage:
        from mtpcr_geo.pipeline.registry import make_options, stage_types

        kind = stage_types()[f"mtpcr.{name}"]
        words = {**self.options.model_dump(), "method": self.options.level}
        given = {key: words[key] for key in _HANDED_ON.get(name, ())}
        return kind(make_options(self.label, kind.Options, given), f"{self.tag}_{name}")
