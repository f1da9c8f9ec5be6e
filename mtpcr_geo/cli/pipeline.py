"""The verb ``pipeline``."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from mtpcr_geo.cli.options import PipelineVerb
from mtpcr_geo.cli.parameters import command_of, shown_fields, spelling
from mtpcr_geo.cli.shared import end_with, json_text, progress_bars
from mtpcr_geo.core.advice import advising
from mtpcr_geo.core.errors import OptionError
from mtpcr_geo.core.suggestions import meant, suggestions

if TYPE_CHECKING:
    from mtpcr_geo.core.progress import Progress
    from mtpcr_geo.pipeline.runner import RunResult


def run(options: PipelineVerb) -> None:
    """Run a pipeline of this package's stages and PDAL's, written as PDAL's JSON.

    Options of stages are changed by --TYPE.OPTION=VALUE, or by --TAG.OPTION=VALUE. Relative filenames are
    relative to the current folder.

    Examples:
        mtpcr-geo pipeline pipelines/ground_to_aerial.json --validate
        mtpcr-geo pipeline mine.json --readers.las.filename=a.laz --overwrite
        mtpcr-geo register a.laz b.laz -o out --dump-pipeline | mtpcr-geo pipeline -

    """
    if options.print_schema:
        from mtpcr_geo.pipeline.schema import pipeline_schema

        typer.echo(json_text(pipeline_schema()))
        return
    with progress_bars(options.quiet, always=options.progress) as progress:
        result = run_pipeline(options, progress)
    if result is None:
        if options.as_json:
            typer.echo(json_text({"valid": True}))
        elif not options.quiet:
            typer.echo("the pipeline is valid")
        return
    if options.as_json:
        typer.echo(result_json(result))
    elif not options.quiet:
        from mtpcr_geo.cli.summary import print_run

        print_run(result, verbose=options.verbose)
    raise end_with(result.verdict, quiet=options.quiet)


def run_pipeline(options: PipelineVerb, progress: Progress) -> RunResult | None:
    """Read a pipeline, change it as the overrides say, and run it; or only validate it, and return None.

    Raises:
        MtpcrError: for whatever a user can cause.

    """
    # an unknown option may stand where the file is expected
    named = [str(one) for one in (options.input, options.file) if one is not None]
    file, overrides = split_arguments([*named, *options.more])
    if file is None:
        raise OptionError("name a pipeline file, or - for standard input")
    from mtpcr_geo.io.outputs import OutputSet
    from mtpcr_geo.pipeline import grammar
    from mtpcr_geo.pipeline.advice import for_command
    from mtpcr_geo.pipeline.api import metadata_of, read_text
    from mtpcr_geo.pipeline.runner import Settings, execute, validate

    elements = grammar.parse(read_text(file), "standard input" if file == "-" else file)
    grammar.override(elements, overrides)
    specs = grammar.link(elements)
    settings = Settings(
        overwrite=options.overwrite, allow_code=options.allow_code, allow_network=options.allow_network
    )
    advised = advising(for_command(elements), command=True)
    if options.only_validate:
        with advised:
            validate(specs, settings)
        return None
    with advised, OutputSet(options.overwrite) as outputs:
        read = [grammar.file_of(spec.options) for spec in specs if spec.type.startswith("readers.")]
        outputs.keep(Path(name) for name in (file, *read) if name)
        part = outputs.path(options.metadata) if options.metadata else None
        result = execute(specs, settings, progress)
        if part is not None:
            part.write_text(json_text(metadata_of(result)), encoding="utf-8")
        outputs.commit()
    return result


def split_arguments(arguments: Sequence[str]) -> tuple[str | None, list[str]]:
    """Tell the pipeline's file from overrides, ``--name.option=value`` or with a space, in any order.

    Raises:
        OptionError: if something else is among them; a misspelt option of the verb names the nearest.

    """
    file: str | None = None
    overrides: list[str] = []
    left = list(arguments)
    while left:
        word = left.pop(0)
        name = word.partition("=")[0]
        if word.startswith("--") and "." in name:
            if "=" not in word:
                if not left:
                    raise OptionError(f"the override {word} has no value; write {word}=value")
                word = f"{word}={left.pop(0)}"
            overrides.append(word)
        elif word == "-" or not word.startswith("-"):
            if file is not None:
                raise OptionError(f"unexpected argument {word!r}; the pipeline is {file}")
            file = word
        else:
            near = meant(name, _long_names()) if suggestions(name, _long_names()) else ""
            hint = near or "; overrides are written --stage.option=value"
            raise OptionError(f"mtpcr-geo pipeline has no option {name!r}{hint}")
    return file, overrides


def _long_names() -> list[str]:
    return [
        text
        for name, field in shown_fields(PipelineVerb).items()
        for text in spelling(name, field)
        if text.startswith("--")
    ]


def result_json(result: RunResult) -> str:
    """Return what a pipeline came to as JSON: verdict, reasons, outputs, metadata."""
    from mtpcr_geo.pipeline.api import metadata_of

    verdict = result.verdict
    return json_text(
        {
            "verdict": verdict.name if verdict else None,
            "reasons": list(verdict.reasons) if verdict else [],
            "outputs": [str(path) for path in result.outputs],
            **metadata_of(result),
        }
    )


command = command_of(PipelineVerb, run, rest="more")
