"""The verb ``apply``."""

from __future__ import annotations

from mtpcr_geo.cli.options import ApplyVerb
from mtpcr_geo.cli.parameters import command_of
from mtpcr_geo.cli.shared import progress_bars, say, warn
from mtpcr_geo.core.wording import in_a_line


def run(options: ApplyVerb) -> None:
    """Move a cloud by the transform of a registration, streamed.

    Examples:
        mtpcr-geo apply out/transform.json another_scan.laz moved.laz
        mtpcr-geo apply out/transform.json moved.laz back.laz --inverse

    """
    from mtpcr_geo.core.system import cores
    from mtpcr_geo.export.apply import apply_transform
    from mtpcr_geo.export.transform import doubts_of

    with cores(options.threads), progress_bars(options.quiet) as progress:
        written = apply_transform(
            options.transform,
            options.cloud,
            options.out,
            inverse=options.inverse,
            text=options.text,
            scale=options.scale,
            cloud_crs=options.cloud_crs,
            overwrite=options.overwrite,
            progress=progress,
            say=warn,
        )
    doubts = doubts_of(options.transform)
    if doubts is not None:
        warn(doubts)
    if not options.quiet:
        say(f"wrote {in_a_line(written)}")


command = command_of(ApplyVerb, run)
