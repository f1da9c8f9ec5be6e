"""The verb ``review``."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import typer

from mtpcr_geo.cli.options import ReviewVerb
from mtpcr_geo.cli.parameters import command_of
from mtpcr_geo.cli.shared import json_text, note
from mtpcr_geo.core.wording import visible

# the rerun that is installed beside this package: viewer and recording are of one version
VIEWER = (sys.executable, "-m", "rerun_cli")
_COLOUR = {"accepted": "bold green", "doubtful": "bold yellow", "refused": "bold red"}


def run(options: ReviewVerb) -> None:
    """Print the audit trail that a recording holds, and open it in the rerun viewer.

    The trail is read from the recording alone: verdict and checks, inputs with their hashes, every stage with
    its options, time and result, versions. The viewer is the one installed beside this command.

    Examples:
        mtpcr-geo review out
        mtpcr-geo review out --open none --json
        mtpcr-geo review out/audit.rrd --open browser

    """
    from mtpcr_geo.export.recording.trail import read_trail, recording_at

    trail = read_trail(options.recording)
    if options.as_json:
        typer.echo(json_text(trail))
    else:
        print_trail(trail, verbose=options.verbose)
    where = options.viewer
    if where == "auto":
        where = "window" if sys.stdout.isatty() and has_display(os.environ) else "none"
    if where != "none":
        open_viewer(recording_at(options.recording), browser=where == "browser")


def print_trail(trail: Mapping[str, Any], *, verbose: bool = False) -> None:
    """Print a trail on standard output, each line whole: verdict, checks, inputs, stages, versions."""
    from rich.console import Console
    from rich.text import Text

    console = Console(highlight=False)

    def line(text: str, style: str = "") -> None:
        console.print(Text(visible(text), style), soft_wrap=True)

    name = trail.get("verdict")
    line(str(trail.get("sentence") or "The run ended before a verdict."), _COLOUR.get(str(name), ""))
    for reason in trail.get("reasons", ()):
        line(f"  {reason}")
    if trail.get("checks"):
        line("Checks", "bold")
    for check in trail.get("checks", ()):
        line(f"  {check['status']:<11} {check['check']}: {check['value']}; wanted {check['wanted']}")
        if verbose:
            line(f"              {check['meaning']}", "dim")
    line("Inputs", "bold")
    for one in trail.get("inputs", ()):
        line(f"  {one['path']}, {one['bytes']:,} bytes, sha256 {one['sha256']}")
    line("Stages", "bold")
    written = {one.get("tag"): one for one in trail.get("pipeline", ())}
    for number, stage in enumerate(trail["stages"], start=1):
        line(f"  {number:>2} {stage['seconds']:8.2f} s  {stage['tag']} ({stage['type']}): {stage['made']}")
        given = stage["options"] if verbose else _as_written(written.get(stage["tag"], {}))
        for key, value in given.items():
            line(f"                 {key} = {json_line(value)}", "dim")
    if trail.get("drawn"):
        line("Recording", "bold")
        line(f"  {trail['drawn']}")
    line("Versions", "bold")
    line("  " + ", ".join(f"{library} {version}" for library, version in trail.get("versions", {}).items()))


def has_display(environment: Mapping[str, str]) -> bool:
    """Return whether a window can be opened: always on Windows and macOS, else where a display is named."""
    if sys.platform in ("win32", "darwin"):
        return True
    return bool(environment.get("DISPLAY") or environment.get("WAYLAND_DISPLAY"))


def open_viewer(file: Path, *, browser: bool) -> None:
    """Open a recording in the viewer: in a window that goes on by itself, or in a browser until Ctrl-C.

    The server for a browser takes connections from this machine alone.

    Raises:
        MissingPartError: if the viewer cannot be started.

    """
    from mtpcr_geo.core.errors import MissingPartError

    if browser:
        note(
            "the viewer is rerun's: its page sends usage data to tel.rerun.io, and asks app.rerun.io and "
            "fonts.googleapis.com; it works where they are not reached"
        )
    else:
        note(
            "the viewer is rerun's: it sends usage data, by rerun's account nothing of the recording, unless "
            f"switched off by: {' '.join(VIEWER)} analytics disable"
        )
    more = ("--web-viewer", "--bind", "127.0.0.1") if browser else ()
    command = [*VIEWER, *more, str(file)]
    try:
        if browser:
            note("serving the recording to this machine; Ctrl-C ends it")
            subprocess.run(command, stdout=sys.stderr, check=False)
            return
        subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
    except OSError as error:
        raise MissingPartError(
            f"the rerun viewer cannot be started ({error.strerror}); install rerun-sdk beside this package"
        ) from error


def json_line(value: Any) -> str:
    """Return a value as JSON in one line."""
    import json

    return json.dumps(value, ensure_ascii=False)


def _as_written(stage: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in stage.items() if key not in ("type", "tag", "inputs")}


command = command_of(ReviewVerb, run)
