"""The stage that writes a QGIS project of what a run leaves."""

from __future__ import annotations

import os
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from pydantic import Field

from mtpcr_geo.core.types import Pair
from mtpcr_geo.core.wording import visible
from mtpcr_geo.pipeline.options import OUTPUT_NAMES
from mtpcr_geo.pipeline.stage import OptionsModel, RunContext
from mtpcr_geo.pipeline.stages.export import DERIVED_ROLES, EvidenceWriter, FileOptions

if TYPE_CHECKING:
    from mtpcr_geo.export.qgis.layers import LayerFile


class ProjectFileOptions(FileOptions):
    """Options of mtpcr.write_project."""

    filename: Path = Field(description="QGIS project to write, .qgz")
    rasters: Path | None = Field(
        None,
        description="the files of mtpcr.write_bev, with their #; bev/#.tif beside the project if not given",
    )
    tie_points: Path | None = Field(
        None,
        description="the file of mtpcr.write_tie_points; ties.gpkg beside the project if not given",
    )


class WriteProject(EvidenceWriter):
    """Write a QGIS project of the rasters and tie points that the run leaves, whatever this stage's place."""

    type = "mtpcr.write_project"
    late = True
    Options: ClassVar[OptionsModel] = ProjectFileOptions
    options: ProjectFileOptions

    def write(self, pair: Pair, context: RunContext) -> None:
        """Write the project, or say that there is nothing to show."""
        from mtpcr_geo.export.qgis.project import About, write_project

        folder = self.options.filename.parent
        named = self.options.rasters or folder / OUTPUT_NAMES["bev"]
        roles = ("source", "target", *DERIVED_ROLES) if "#" in named.name else ("target",)
        rasters = {
            role: self._file(named.with_name(named.name.replace("#", role)), context) for role in roles
        }
        ties = self._file(self.options.tie_points or folder / OUTPUT_NAMES["tie_points"], context)
        found = {role: file for role, file in rasters.items() if file is not None}
        if not found and ties is None:
            self._skip("the run leaves neither rasters nor tie points")
            return
        sentence = pair.verdict.headline if pair.verdict is not None else "The pair was not judged."
        about = About(Path(pair.source.cloud.name).name, Path(pair.target.cloud.name).name, sentence)
        write_project(context.outputs.path(self.options.filename), found, ties, about)

    def _file(self, final: Path, context: RunContext) -> LayerFile | None:
        from mtpcr_geo.export.qgis.layers import LayerFile

        part = context.outputs.part_of(final)
        if part is None:
            return None
        try:
            where = Path(os.path.relpath(final, self.options.filename.parent)).as_posix()
        except ValueError:  # another drive
            where = final.resolve().as_posix()
        here = "" if where.startswith("..") or Path(where).is_absolute() else "./"
        return LayerFile(visible(here + where), part)
