"""The verb ``demo``."""

from __future__ import annotations

from mtpcr_geo.cli.options import DemoVerb
from mtpcr_geo.cli.parameters import command_of
from mtpcr_geo.cli.shared import end_with, progress_bars, say


def run(options: DemoVerb) -> None:
    """Register a simulated town, scanned from a street and from the air, and compare with the truth.

    Examples:
        mtpcr-geo demo
        mtpcr-geo demo -o folder --overwrite

    """
    from mtpcr_geo.cli.demo import run_demo
    from mtpcr_geo.cli.summary import print_registration

    with progress_bars(options.quiet) as progress:
        result = run_demo(options.out, overwrite=options.overwrite, progress=progress)
    if not options.quiet:
        # the summary names the files
        print_registration(result.registration, files=False)
        say(result.summary)
    raise end_with(result.registration.verdict, quiet=options.quiet)


command = command_of(DemoVerb, run)
