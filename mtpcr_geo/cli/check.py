"""The verb ``check``."""

from __future__ import annotations

import typer

from mtpcr_geo.cli.options import CheckVerb
from mtpcr_geo.cli.parameters import command_of
from mtpcr_geo.cli.shared import progress_bars


def run(options: CheckVerb) -> None:
    """Report what one or two clouds are and what is wrong with them, before they are registered.

    Exit code 0: register would go on; else the code with which it would end.

    Examples:
        mtpcr-geo check ground.laz aerial.laz
        mtpcr-geo check scan.laz --json
        mtpcr-geo check scan.laz tile.laz --source-crs local --near 85000 446600 --within 50

    """
    from mtpcr_geo.check import check_clouds
    from mtpcr_geo.check.show import show

    with progress_bars(options.quiet) as progress:
        report = check_clouds(
            options.source,
            options.target,
            source_crs=options.source_crs,
            target_crs=options.target_crs,
            source_unit=options.source_unit,
            target_unit=options.target_unit,
            source_axes=options.source_axes,
            target_axes=options.target_axes,
            source_text=options.source_text,
            target_text=options.target_text,
            scale=options.scale,
            local=options.local,
            vertical=options.vertical,
            near=options.near,
            near_crs=options.near_crs,
            within=options.within,
            progress=progress,
        )
    show(report, as_json=options.as_json, quiet=options.quiet)
    raise typer.Exit(report.exit_code)


command = command_of(CheckVerb, run)
