"""PDAL's stages in our pipelines: composed while contiguous, handed to real PDAL together."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from pydantic import ConfigDict

from mtpcr_geo.core.cloud import Cloud
from mtpcr_geo.core.errors import InputError, OptionError
from mtpcr_geo.core.suggestions import meant
from mtpcr_geo.pipeline.grammar import StageSpec, file_of
from mtpcr_geo.pipeline.pdal import bindings, process
from mtpcr_geo.pipeline.pdal.cloud import PdalCloud
from mtpcr_geo.pipeline.pdal.process import PdalCrashError
from mtpcr_geo.pipeline.pdal.step import Step, crash, failure, file_written, is_reader, stage_json
from mtpcr_geo.pipeline.pdal.switches import Access
from mtpcr_geo.pipeline.stage import RunContext, Stage, StageOptions, Value

_NO_POINTS = {"type": "readers.faux", "count": 1, "mode": "constant", "bounds": "([0, 1], [0, 1], [0, 1])"}


class PdalOptions(StageOptions):
    """Options of a PDAL stage: PDAL itself checks them."""

    model_config = ConfigDict(extra="allow", frozen=True)


class PdalStage(Stage):
    """A stage that PDAL serves.

    Attributes:
        boundary: whether PDAL must run once this stage is reached: a stage of ours takes from it, or none.
        for_us: whether a stage of ours takes from it.
        upstream: the stages it takes from.
        stand_in: a file whose dimensions the clouds have that our stages hand to PDAL, or None.

    """

    type = "pdal"
    Options = PdalOptions

    def __init__(self, options: StageOptions, spec: StageSpec, access: Access) -> None:
        super().__init__(options, spec.tag)
        self.spec = spec
        self.access = access
        self.boundary = True
        self.for_us = False
        self.upstream: Sequence[Stage] = ()
        self.stand_in: Path | None = None

    def reads(self) -> list[Path]:
        """Name the file of a reader."""
        name = file_of(self.spec.options)
        return [Path(name)] if is_reader(self.spec) and name and "://" not in name else []

    def writes(self) -> list[Path]:
        """Name the file of a writer; one with a # becomes one file a view, known only when written."""
        file = file_written(self.spec)
        return [file] if file is not None else []

    def check(self, context: RunContext) -> None:
        """Let PDAL prepare everything up to this stage, without running it."""
        for path in self.reads():
            if os.path.isdir(path):
                hint = "; name the ept.json in it" if self.spec.type == "readers.ept" else "; name a file"
                raise InputError(f"{self.label}: {path} is a folder{hint}")
            if os.path.exists(path) and not os.path.isfile(path):
                raise InputError(f"{self.label}: {path} is no regular file; save it as one")
        chain: dict[str, dict[str, Any]] = {}
        guessed = self._prepared(chain)
        # processes of PDAL's wait for the next stage as long as the run
        context.at_end.callback(process.end_waiting)
        try:
            problem = bindings.problem_of(list(chain.values()), self.access)
        except PdalCrashError as error:
            raise crash([self.spec], error) from error
        # without the true cloud, PDAL cannot know which dimensions there will be
        if problem and not (guessed and "dimension" in problem.lower()):
            raise failure(self.spec, problem, preparing=True)

    def run(self, inputs: Sequence[Value], context: RunContext) -> Value | None:
        """Join the chain; at its end, run it all in PDAL."""
        clouds = [given for given in inputs if isinstance(given, Cloud)]
        if len(clouds) < len(inputs):
            raise OptionError(f"{self.label} needs clouds; put mtpcr.apply before it, which moves the source")
        cloud = PdalCloud(self._step(clouds))
        if self.boundary:
            cloud.evaluate(context, need_crs=self.for_us)
        return cloud

    def _step(self, inputs: Sequence[Cloud]) -> Step:
        before = tuple(given.step if isinstance(given, PdalCloud) else given for given in inputs)
        return Step(self.spec, before, self.metadata, access=self.access)

    def _prepared(self, chain: dict[str, dict[str, Any]]) -> bool:
        """Add this stage and all before it to a chain for PDAL; say whether a cloud had to be guessed."""
        guessed = False
        inputs = []
        for stage in self.upstream:
            if isinstance(stage, PdalStage):
                if stage.tag not in chain:
                    guessed |= stage._prepared(chain)
            elif self.stand_in is not None:
                chain[stage.tag] = {"type": "readers.las", "filename": str(self.stand_in), "tag": stage.tag}
            else:
                guessed = True
                chain[stage.tag] = {**_NO_POINTS, "tag": stage.tag}
            inputs.append(stage.tag)
        chain[self.tag] = stage_json(self.spec, inputs)
        return guessed


def make_pdal_stage(spec: StageSpec, access: Access) -> PdalStage:
    """Make a stage that PDAL serves.

    Args:
        spec: the stage as written.
        access: what it may do.

    Raises:
        OptionError: if this PDAL does not know the stage, or an option of it.

    """
    drivers = bindings.drivers()
    if spec.type not in drivers:
        raise OptionError(f"{spec.label}: this PDAL has no stage {spec.type!r}{meant(spec.type, drivers)}")
    known = drivers[spec.type].options
    for name in spec.options:
        if known and name not in known:
            raise OptionError(f"{spec.label}: no option {name!r}{meant(name, known)}")
    options: Mapping[str, Any] = {key: value for key, value in spec.options.items() if key != "user_data"}
    # every PDAL stage has a class of its own, so that its type is a class attribute as everywhere
    kind = type("PdalStage", (PdalStage,), {"type": spec.type, "__doc__": drivers[spec.type].description})
    stage: PdalStage = kind(PdalOptions.model_validate(options), spec, access)
    return stage
