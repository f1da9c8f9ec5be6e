"""Where the command is, how a call of it is written, and running it; without QGIS."""

from __future__ import annotations

import json
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

NAME = "mtpcr-geo"
SETTING = "MTPCR_GEO_COMMAND"
"""The setting of the plugin, and the environment variable, that name the command's file."""

_FOLDER = os.path.dirname(__file__)
_POLL_S = 0.25


class CommandError(Exception):
    """The command is not there, or ended with an error; the text is for the user."""


@dataclass(frozen=True)
class Answer:
    """What a call of the command came to.

    Attributes:
        code: its exit code.
        output, talk: what it wrote to standard output and to standard error.

    """

    code: int
    output: str
    talk: str

    def json(self) -> dict[str, Any]:
        """Return its output as JSON.

        Raises:
            CommandError: with what the command said, if it is none.

        """
        try:
            value = json.loads(self.output)
        except ValueError:
            raise CommandError(self.talk.strip() or f"{NAME} ended with exit code {self.code}") from None
        return dict(value)


def find(setting: str = "") -> str:
    """Return the command's file.

    Looked for in this order: the setting, the environment variable, the installation that wrote the plugin,
    the PATH, and the virtual environment ``~/.mtpcr-geo``.

    Raises:
        CommandError: if it is nowhere.

    """
    for given, what in ((setting, "setting of the plugin"), (os.environ.get(SETTING, ""), "variable")):
        if given:
            if os.path.isfile(given):
                return given
            raise CommandError(f"the {what} {SETTING} names {given!r}, and there is no such file")
    folder = "Scripts" if os.name == "nt" else "bin"
    home = os.path.join(os.path.expanduser("~"), ".mtpcr-geo", folder)
    found = next((path for path in _written_by() if os.path.isfile(path)), None)
    found = found or shutil.which(NAME) or shutil.which(NAME, path=home)
    if found is None:
        raise CommandError(
            f"the command {NAME} is not installed, or not found: install it, and give its file in Settings, "
            f"Options, Processing, Providers, or in the variable {SETTING}"
        )
    return found


def arguments(parameters: Iterable[Mapping[str, Any]], values: Mapping[str, Any]) -> list[str]:
    """Return the words of a call behind the verb: options first, then what is given by its place.

    Args:
        parameters: as in ``verbs.json``.
        values: by the parameters' names: text, numbers, switches, sequences of numbers; None leaves one out.

    """
    options: list[str] = []
    placed: list[str] = []
    for one in parameters:
        value = values.get(one["name"])
        if value is None or value == "":
            continue
        if one["kind"] == "switch":
            if bool(value) != bool(one["default"]):
                options.append(one["flag"])
        elif one["flag"] is None:
            placed.append(str(value))
        elif value != one["default"]:
            words = [value] if isinstance(value, str) or not isinstance(value, Sequence) else value
            # a negative number is no option
            first = f"{one['flag']}={words[0]}" if len(words) == 1 else one["flag"]
            options += [first] if len(words) == 1 else [first, *map(str, words)]
    return [*options, "--", *placed] if placed else options


def run(words: Sequence[str], stopped: Callable[[], bool] = lambda: False) -> Answer:
    """Run the command to its end.

    Args:
        words: the whole call, the command's file first.
        stopped: asked several times a second whether to stop it.

    Raises:
        CommandError: if it cannot be started, or was stopped.

    """
    try:
        process = subprocess.Popen(
            list(words),
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            encoding="utf-8",
            errors="replace",
            env=environment(),
            creationflags=getattr(subprocess, "CREATE_NO_WINDOW", 0),
        )
    except OSError as error:
        raise CommandError(f"cannot start {words[0]}: {error.strerror}") from error
    while True:
        try:
            output, talk = process.communicate(timeout=_POLL_S)
        except subprocess.TimeoutExpired:
            if stopped():
                # it removes what it has half written
                process.terminate()
                process.communicate()
                raise CommandError("stopped") from None
        else:
            return Answer(process.returncode, output, talk)


def environment() -> dict[str, str]:
    """Return the environment for the command: QGIS's own Python is not the command's.

    Installers of QGIS for Windows and macOS point PYTHONHOME and PYTHONPATH at what they bring along.
    """
    own = dict(os.environ)
    own.pop("PYTHONHOME", None)
    if "PYTHONPATH" in own:
        brought = [os.path.normcase(os.path.abspath(path)) for path in (sys.prefix, sys.base_prefix)]
        kept = [
            path
            for path in own["PYTHONPATH"].split(os.pathsep)
            if not any(os.path.normcase(os.path.abspath(path)).startswith(prefix) for prefix in brought)
        ]
        own["PYTHONPATH"] = os.pathsep.join(kept)
    own["PYTHONIOENCODING"] = "utf-8"
    return own


def _written_by() -> list[str]:
    """Return the command of the installation that wrote this plugin, if it says so."""
    try:
        with open(os.path.join(_FOLDER, "written_by.json"), encoding="utf-8") as file:
            return [str(json.load(file)["command"])]
    except (OSError, ValueError, KeyError):
        return []
