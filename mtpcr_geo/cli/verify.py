"""The verb ``verify``."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING

import typer

from mtpcr_geo.cli.options import VerifyVerb
from mtpcr_geo.cli.parameters import command_of
from mtpcr_geo.cli.shared import json_text, note, progress_bars, say
from mtpcr_geo.core.errors import EXIT_DIFFERENT

if TYPE_CHECKING:
    from mtpcr_geo.pipeline.repeat import Repeat


def run(options: VerifyVerb) -> None:
    """Run a registration again from its record, and compare: inputs, options, versions and result.

    Nothing is written. Exit code 0: reproduced; 9: not reproduced, or an input, an option or a file of the
    run has changed; 5: the record or an input is gone. Other versions are named, and do not count alone.

    Examples:
        mtpcr-geo verify out
        mtpcr-geo verify out --json

    """
    from mtpcr_geo.pipeline.repeat import repeat

    with progress_bars(options.quiet) as progress:
        found = repeat(
            options.folder,
            allow_code=options.allow_code,
            allow_network=options.allow_network,
            progress=progress,
        )
    if options.as_json:
        whole = {"reproduced": found.reproduced, "sentence": sentence(found), **asdict(found)}
        typer.echo(json_text(whole))
    elif not options.quiet:
        say(sentence(found))
        for one in found.differences:
            say(f"  {one}")
    elif not found.reproduced:
        note(sentence(found))
    raise typer.Exit(0 if found.reproduced else EXIT_DIFFERENT)


def sentence(found: Repeat) -> str:
    """Say in a sentence whether a run was reproduced."""
    if not found.ran:
        return "Not run again: an input is not the one that was registered."
    if not found.reproduced:
        kinds = dict.fromkeys(one.kind for one in found.differences if one.decides)
        return f"Not reproduced: the run differs in {', '.join(kinds)}."
    if found.identical:
        text = "Reproduced: the same verdict, transform and metrics, bit for bit"
    else:
        text = "Reproduced: the same verdict, and the same transform and metrics but for the last digits"
    other = sum(one.kind == "version" for one in found.differences)
    return f"{text}, with {other} other version{'s' if other > 1 else ''}." if other else f"{text}."


command = command_of(VerifyVerb, run)
