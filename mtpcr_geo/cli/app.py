"""The command: a table of verbs, and one place where errors become a line and an exit code.

Nothing of a verb is imported before it is called or its help is asked for.
"""

from __future__ import annotations

import atexit
import importlib
import inspect
import os
import signal
import sys
import traceback
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

import mtpcr_geo
from mtpcr_geo.core.advice import in_command
from mtpcr_geo.core.errors import EXIT_DEFECT, EXIT_INTERRUPTED, MtpcrError, OptionError, one_line
from mtpcr_geo.core.suggestions import meant

NAME = "mtpcr-geo"
TRACEBACK = "MTPCR_GEO_TRACEBACK"


@dataclass(frozen=True)
class Verb:
    """A verb of the command.

    Attributes:
        function: "module:function" of what typer makes a command of.
        help: what it does, in a line; the first line of the function's docstring.
        more: it takes arguments beside its own options.

    """

    function: str
    help: str
    more: bool = False


VERBS = {
    "register": Verb(
        "mtpcr_geo.cli.register:command",
        "Bring SOURCE to TARGET; write the registered cloud, its transform and the evidence to a folder.",
    ),
    "check": Verb(
        "mtpcr_geo.cli.check:command",
        "Report what one or two clouds are and what is wrong with them, before they are registered.",
    ),
    "survey": Verb(
        "mtpcr_geo.cli.survey:command",
        "Make a mosaic of height rasters of many TILES, once, to register scans against.",
        more=True,
    ),
    "batch": Verb(
        "mtpcr_geo.cli.batch:command",
        "Register many sources, each to its target or to a survey; write a table and a map of all.",
    ),
    "apply": Verb(
        "mtpcr_geo.cli.apply:command", "Move a cloud by the transform of a registration, streamed."
    ),
    "pipeline": Verb(
        "mtpcr_geo.cli.pipeline:command",
        "Run a pipeline of this package's stages and PDAL's, written as PDAL's JSON.",
        more=True,
    ),
    "review": Verb(
        "mtpcr_geo.cli.review:command",
        "Print the audit trail that a recording holds, and open it in the rerun viewer.",
    ),
    "verify": Verb(
        "mtpcr_geo.cli.verify:command",
        "Run a registration again from its record, and compare: inputs, options, versions and result.",
    ),
    "models": Verb(
        "mtpcr_geo.cli.models:command",
        "List the learned matchers: which files are there, their licences, and who publishes those missing.",
    ),
    "demo": Verb(
        "mtpcr_geo.cli.demo_verb:command",
        "Register a simulated town, scanned from a street and from the air, and compare with the truth.",
    ),
    "qgis-plugin": Verb(
        "mtpcr_geo.cli.qgis_plugin:command",
        "Write a plugin for QGIS that offers register, apply and check in its Processing toolbox.",
    ),
    "benchmark": Verb(
        "mtpcr_geo.benchmark.command:benchmark",
        "Run methods on pairs with a known transform, from random starts; write tables and plots.",
    ),
    "simulate": Verb(
        "mtpcr_geo.benchmark.command:simulate",
        "Simulate pairs of a ground and an aerial cloud with a known transform (extra: benchmark).",
    ),
}
# typer offers this exception alone, whose base is every fault of a command line
_UsageError: type[Exception] = typer.BadParameter.__bases__[0]
# what typer itself raises to end a command, or for a command line, passes
_FROM_TYPER: tuple[type[BaseException], ...] = (typer.Exit, typer.Abort, *_UsageError.__mro__[:2])
_CONTEXT = {"help_option_names": ["-h", "--help"], "max_content_width": 100}


class Command(TyperCommand):
    """A verb's command: its options stand in groups, its examples at the end of the help."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Read the arguments; an error names the verb, and the nearest option for a misspelt one."""
        try:
            return super().parse_args(ctx, args)
        except _UsageError as error:
            if "extra argument" in str(error):
                raise OptionError(
                    f"{NAME} {self.name}: {str(error).rstrip('.').lower()}; several files as one cloud are a "
                    "folder, a pattern in quotes ('tiles/*.laz'), a .vpc, or @ and a text file with a path a "
                    f"line; see {NAME} {self.name} --help"
                ) from None
            known = [name for one in self.get_params(ctx) for name in (*one.opts, *one.secondary_opts)]
            raise _option_error(
                error, f"{NAME} {self.name}", [name for name in known if name.startswith("--")]
            ) from None

    def format_options(self, ctx: Any, formatter: Any) -> None:
        """Write arguments, then options by group, in the order of their declaration."""
        groups: dict[str, list[tuple[str, str]]] = {}
        for one in self.get_params(ctx):
            record = one.get_help_record(ctx)
            if record is not None:
                by_place = one.param_type_name == "argument"
                group = "Arguments" if by_place else getattr(one, "rich_help_panel", None) or "Options"
                groups.setdefault(group, []).append(record)
        for group, records in groups.items():
            with formatter.section(group):
                formatter.write_dl(records)

    def format_epilog(self, ctx: Any, formatter: Any) -> None:
        """Write the examples as they stand."""
        if self.epilog:
            formatter.write(f"\nExamples:\n{self.epilog}\n")


class Group(TyperGroup):
    """The group of verbs, each imported when it is wanted."""

    def list_commands(self, ctx: Any) -> list[str]:
        """Return the names of the verbs."""
        return list(VERBS)

    def get_command(self, ctx: Any, cmd_name: str) -> Any:
        """Return a verb's command, or None."""
        return load(cmd_name) if cmd_name in VERBS else None

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """Write each verb with its line, from the table."""
        with formatter.section("Verbs"):
            formatter.write_dl([(name, verb.help) for name, verb in VERBS.items()])

    def resolve_command(self, ctx: Any, args: list[str]) -> Any:
        """Find the verb; a misspelt one names the nearest."""
        if args[0] not in VERBS:
            raise OptionError(f"there is no verb {args[0]!r}{meant(args[0], VERBS)}")
        return super().resolve_command(ctx, args)

    def make_context(self, *args: Any, **kwargs: Any) -> Any:
        """Read what stands before the verb."""
        with _errors_in_one_line():
            return super().make_context(*args, **kwargs)

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        """Read the options of the command itself; without any argument, show the help."""
        if not args:
            typer.echo(ctx.get_help(), err=True)
            raise typer.Exit(OptionError.exit_code)
        try:
            return super().parse_args(ctx, args)
        except _UsageError as error:
            raise _option_error(error, NAME, ["--help", "--version"]) from None

    def invoke(self, ctx: Any) -> Any:
        """Run the verb."""
        with _errors_in_one_line(), in_command():
            return super().invoke(ctx)


def load(name: str) -> Any:
    """Import a verb, and make its command; the docstring of its function is the help."""
    verb = VERBS[name]
    module, _, attribute = verb.function.partition(":")
    function = getattr(importlib.import_module(module), attribute)
    text, _, examples = (inspect.getdoc(function) or "").partition("\nExamples:\n")
    more = {"allow_extra_args": True, "ignore_unknown_options": True} if verb.more else {}
    alone = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
    alone.command(
        name, cls=Command, help=text, epilog=examples.rstrip(), context_settings={**_CONTEXT, **more}
    )(function)
    return typer.main.get_command(alone)


@contextmanager
def _errors_in_one_line() -> Iterator[None]:
    """Turn whatever a user can cause into one line on standard error and an exit code.

    Behind it stands a wall: what nobody foresaw is a defect and said to be one. The outputs are not kept, as
    with any other error.
    """
    try:
        yield
    except MtpcrError as error:
        typer.echo(f"{NAME}: error: {one_line(str(error))}", err=True)
        raise typer.Exit(error.exit_code) from None
    except KeyboardInterrupt:
        typer.echo(f"{NAME}: interrupted; no half-written file is left", err=True)
        raise typer.Exit(EXIT_INTERRUPTED) from None
    except _FROM_TYPER:
        raise
    except BrokenPipeError:
        raise
    except Exception as error:
        # the wall behind all others
        if os.environ.get(TRACEBACK):
            raise
        typer.echo(f"{NAME}: {one_line(_defect(error))}", err=True)
        raise typer.Exit(EXIT_DEFECT) from None


def _defect(error: Exception) -> str:
    """Say that an error is a defect of the program, where it came from, and what to do."""
    frames = traceback.extract_tb(error.__traceback__)
    own = [frame for frame in frames if "mtpcr_geo" in Path(frame.filename).parts]
    place = f" in {Path(own[-1].filename).name}:{own[-1].lineno}" if own else ""
    detail = f": {error}"[:200] if str(error) else ""
    return (
        f"this is a defect of {NAME} {mtpcr_geo.__version__}, and nothing was kept: "
        f"{type(error).__name__}{place}{detail}; please report it with what gave it "
        f"(with {TRACEBACK}=1 set, the same command prints where it comes from)"
    )


def _option_error(error: Any, what: str, valid: list[str]) -> OptionError:
    """Say what is wrong with a command line, in a line."""
    unknown = getattr(error, "option_name", None) if hasattr(error, "possibilities") else None
    if unknown is not None:
        return OptionError(
            f"{what} has no option {unknown!r}{meant(unknown, valid) or f'; see {what} --help'}"
        )
    message = error.format_message().rstrip(".")
    return OptionError(f"{message[:1].lower()}{message[1:]}; see {what} --help")


app = typer.Typer(
    name=NAME,
    cls=Group,
    help="Register ground and aerial lidar clouds through bird's-eye-view height images.",
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings=_CONTEXT,
)


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"{NAME} {mtpcr_geo.__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    pass


def main() -> None:
    """Run the command."""
    # what fails in rerun's threads, as on a full disk, is an error of ours, told in one line
    os.environ.setdefault("RUST_LOG", "off")
    # pydantic would read the metadata of every package installed, to look for plugins
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    signal.signal(signal.SIGTERM, _interrupt)
    app(prog_name=NAME)


def command() -> None:
    """Run the command in a process that is there for nothing else.

    It is left to the system to give back that process's memory at its end: Python would take down every
    module and array first, a fifth of a second after the last file is written. What threads still do, and
    what was registered meanwhile to be done at exit, is done before.
    """
    status: list[int] = []

    def end() -> None:
        if status:
            try:
                for stream in (sys.stdout, sys.stderr):
                    if stream is not None:  # closed before this process began
                        stream.flush()
            except (OSError, ValueError):
                return  # Python tells of it
            os._exit(status[0])

    # called last: what is registered later is called earlier
    atexit.register(end)
    try:
        main()
    except SystemExit as error:
        if error.code is None or isinstance(error.code, int):
            status.append(error.code or 0)
        raise


def _interrupt(signum: int, frame: object) -> None:
    # a kill must leave as little behind as Ctrl-C does
    raise KeyboardInterrupt


if __name__ == "__main__":
    main()
