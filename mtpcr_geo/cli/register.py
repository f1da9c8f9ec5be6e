"""The verb ``register``."""

from __future__ import annotations

import os

import typer

from mtpcr_geo.cli.options import RegisterVerb
from mtpcr_geo.cli.parameters import command_of
from mtpcr_geo.cli.shared import end_with, progress_bars
from mtpcr_geo.core.errors import OptionError
from mtpcr_geo.core.imports import import_ahead
from mtpcr_geo.pipeline.options import PriorOptions, RegisterOptions


def run(options: RegisterVerb) -> None:
    """Bring SOURCE to TARGET; write the registered cloud, its transform and the evidence to a folder.

    Exit code 0: accepted; 3: doubtful; 4: refused, evidence only; 2: an option is wrong; 5: an input cannot
    be used; 6: the CRSs do not allow it; 7: an output cannot be written; 8: an optional part is missing.

    Examples:
        mtpcr-geo register ground.laz aerial.laz -o out
        mtpcr-geo register scan.laz tile.laz -o out --source-crs local --overwrite
        mtpcr-geo register scan.laz tile.laz -o out --source-crs local --near 4.895 52.37 --near-crs EPSG:4326
        mtpcr-geo register scan.laz survey -o out --near 4.895 52.37 --near-crs EPSG:4326 --within 100
        mtpcr-geo register ground.laz aerial.laz -o out --dump-pipeline > mine.json

    """
    from mtpcr_geo.export.recording.process import start_ahead

    # not Path.exists, which raises for names that no system allows
    readable = os.path.exists(options.source) and os.path.exists(options.target)
    if options.recording and readable and not options.dump_pipeline:
        start_ahead(options.threads)
    from mtpcr_geo.cli.summary import SUMMARY_NEEDS, print_registration
    from mtpcr_geo.pipeline.grammar import dump
    from mtpcr_geo.registration import build_pipeline, read_options, register
    from mtpcr_geo.survey import is_survey

    given = {name: getattr(options, name) for name in RegisterOptions.model_fields}
    if options.no_prior:
        given |= PriorOptions().model_dump()
    in_survey = is_survey(options.target)
    if options.dump_pipeline and in_survey:
        raise OptionError(
            "--dump-pipeline does not go with a survey as the target: where to cut it is found by a search"
        )
    if options.dump_pipeline:
        typer.echo(dump(build_pipeline(options.source, options.target, options.out, read_options(given))))
        return
    with progress_bars(options.quiet) as progress:
        if not (options.quiet or options.as_json):
            import_ahead(SUMMARY_NEEDS)
        if in_survey:
            from mtpcr_geo.survey.register import register_in_survey

            result = register_in_survey(
                options.source, options.target, options.out, progress=progress, **given
            )
        else:
            result = register(options.source, options.target, options.out, progress=progress, **given)
    if options.as_json:
        typer.echo(result.outputs["run"].read_text(encoding="utf-8"), nl=False)
    elif not options.quiet:
        print_registration(result, verbose=options.verbose)
    raise end_with(result.verdict, quiet=options.quiet)


command = command_of(RegisterVerb, run)
