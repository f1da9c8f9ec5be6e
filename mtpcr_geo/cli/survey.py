"""The verb ``survey``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

from pydantic import Field

from mtpcr_geo.cli.options import Quiet
from mtpcr_geo.cli.parameters import command_of
from mtpcr_geo.cli.shared import progress_bars, say, warn
from mtpcr_geo.core.errors import InputError, OptionError
from mtpcr_geo.core.wording import counted, in_a_line
from mtpcr_geo.pipeline.shown import INPUTS, Shown
from mtpcr_geo.survey.options import BuildOptions, Folder

MOST_NAMED = 5


class SurveyVerb(BuildOptions):
    """Options of ``survey``."""

    action: Annotated[
        Literal["build"],
        Field(description="what to do: build, or bring up to date"),
        Shown(INPUTS, argument=True),
    ]
    tiles: tuple[str, ...] = ()
    out: Folder
    quiet: Quiet = False


def run(options: SurveyVerb) -> None:
    """Make a mosaic of height rasters of many TILES, once, to register scans against.

    TILES are files, folders, patterns, @LISTs or virtual point clouds (.vpc). A survey that is there is
    brought up to date: only new and changed tiles are read. A build that was stopped goes on where it
    stopped. The mosaic's virtual rasters (.vrt) open in QGIS.

    Examples:
        mtpcr-geo survey build tiles/*.laz -o survey
        mtpcr-geo survey build tiles -o survey --workers 2
        mtpcr-geo survey build @country.txt -o survey --scheduler tcp://10.0.0.1:8786
        mtpcr-geo register scan.laz survey -o out

    """
    from mtpcr_geo.survey.build import build_survey

    unknown = next((word for word in options.tiles if word.startswith("-")), None)
    if unknown is not None:
        raise OptionError(f"mtpcr-geo survey has no option {unknown!r}; see mtpcr-geo survey --help")
    if not options.tiles:
        raise OptionError("name the tiles: mtpcr-geo survey build TILES... -o FOLDER")
    chosen = BuildOptions(**{name: getattr(options, name) for name in BuildOptions.model_fields})
    with progress_bars(options.quiet) as progress:
        built = build_survey(options.tiles, Path(options.out), chosen, progress)
    survey = built.survey
    if not options.quiet:
        points = sum(tile.used for tile in survey.tiles)
        say(
            f"{in_a_line(options.out)}: {len(survey.tiles)} tiles, {points:,} points, cells of "
            f"{survey.frame.cell_m:g} m in {survey.frame.crs.name}; {built.read} tiles read and "
            f"{built.merged} blocks written now"
        )
    if built.gone:
        warn(
            f"of the survey {counted(len(built.gone), 'tile')} no longer to be found, such as "
            f"{built.gone[0]}: name all that it shall have, and give --prune, to leave these out"
        )
    if built.failed:
        for path, why in list(built.failed.items())[:MOST_NAMED]:
            warn(f"{path}: {why}")
        raise InputError(
            f"{counted(len(built.failed), 'tile')} could not be used and left out of the survey; mend what "
            "is wrong, and run the same command again"
        )


command = command_of(SurveyVerb, run, rest="tiles")
