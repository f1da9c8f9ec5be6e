"""The command: one thin function a verb. Everything heavy is imported where it is used."""

from __future__ import annotations

import signal
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer.core import TyperGroup

import mtpcr_geo
from mtpcr_geo.cli.shared import AsJson, Overwrite, Quiet, Verbose, progress_bars
from mtpcr_geo.core.errors import EXIT_DOUBTFUL, EXIT_REFUSED, MtpcrError, OptionError

if TYPE_CHECKING:
    from mtpcr_geo.registration import Registration

EXIT_BY_VERDICT = {"accepted": 0, "doubtful": EXIT_DOUBTFUL, "refused": EXIT_REFUSED}
EXIT_INTERRUPTED = 130


class _Group(TyperGroup):
    """Turns whatever a user can cause into one line on standard error and an exit code."""

    def invoke(self, ctx: Any) -> Any:
        try:
            return super().invoke(ctx)
        except MtpcrError as error:
            typer.echo(f"mtpcr-geo: error: {' '.join(str(error).split())}", err=True)
            raise typer.Exit(error.exit_code) from None
        except KeyboardInterrupt:
            typer.echo("mtpcr-geo: interrupted; no half-written file is left", err=True)
            raise typer.Exit(EXIT_INTERRUPTED) from None


app = typer.Typer(
    name="mtpcr-geo",
    cls=_Group,
    help="Register ground and aerial lidar clouds through bird's-eye-view height images.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)


class Level(StrEnum):
    """How to make clouds upright."""

    auto = "auto"
    ransac = "ransac"
    none = "none"


class Vertical(StrEnum):
    """What to do with different vertical datums."""

    refuse = "refuse"
    assume_same = "assume-same"
    estimate = "estimate"


class Prior(StrEnum):
    """Where the search starts."""

    none = "none"
    georef = "georef"


class Motion(StrEnum):
    """Degrees of freedom of the result."""

    rigid = "rigid"
    yaw = "yaw"
    translation = "translation"


def _version(wanted: bool) -> None:
    if wanted:
        typer.echo(f"mtpcr-geo {mtpcr_geo.__version__}")
        raise typer.Exit


@app.callback()
def _root(
    version: Annotated[
        bool, typer.Option("--version", callback=_version, is_eager=True, help="Show the version and exit.")
    ] = False,
) -> None:
    pass


@app.command()
def register(
    source: Annotated[Path, typer.Argument(help="Cloud that moves: LAS, LAZ or COPC.", show_default=False)],
    target: Annotated[Path, typer.Argument(help="Cloud that stays: LAS, LAZ or COPC.", show_default=False)],
    out: Annotated[
        Path, typer.Option("--out", "-o", help="Folder for the result and its evidence.", show_default=False)
    ],
    source_crs: Annotated[
        str | None,
        typer.Option(help="CRS of the source, instead of what its file states; such as EPSG:2154."),
    ] = None,
    target_crs: Annotated[
        str | None, typer.Option(help="CRS of the target, instead of what its file states.")
    ] = None,
    local: Annotated[bool, typer.Option("--local", help="Both clouds are local, in metres.")] = False,
    level: Annotated[Level, typer.Option(help="How to make the clouds upright.")] = Level.auto,
    cell: Annotated[
        float | None, typer.Option(help="Cell of the height rasters in metres; chosen if not given.")
    ] = None,
    vertical: Annotated[
        Vertical, typer.Option(help="What to do with different or unknown vertical datums.")
    ] = Vertical.refuse,
    out_crs: Annotated[
        str | None, typer.Option(help="CRS of the result, where it shall not be the target's.")
    ] = None,
    prior: Annotated[
        Prior, typer.Option(help="georef: search only near where both clouds' CRSs put them.")
    ] = Prior.none,
    no_prior: Annotated[
        bool, typer.Option("--no-prior", help="Do not use the clouds' shared georeference (the default).")
    ] = False,
    prior_sigma: Annotated[
        float, typer.Option(help="With --prior: standard deviation of the source's place, metres.")
    ] = 5.0,
    prior_yaw: Annotated[float, typer.Option(help="With --prior: largest turn considered, degrees.")] = 5.0,
    motion: Annotated[Motion, typer.Option(help="Degrees of freedom of the result.")] = Motion.rigid,
    profile: Annotated[
        str, typer.Option(help="Which steps and settings to run: default, or paper (MT-PCR as published).")
    ] = "default",
    matcher: Annotated[
        str | None,
        typer.Option(help="Matcher: correlation, rootsift, orb, or a learned one (see: mtpcr-geo models)."),
    ] = None,
    models_folder: Annotated[
        Path | None,
        typer.Option("--models", help="Folder of model files, instead of $MTPCR_GEO_MODELS."),
    ] = None,
    no_res: Annotated[
        bool, typer.Option("--no-res", help="Paper's profile: no resolution by density (Eq. 1).")
    ] = False,
    no_focus: Annotated[
        bool, typer.Option("--no-focus", help="Paper's profile: do not match again where overlap is small.")
    ] = False,
    no_enhance: Annotated[
        bool, typer.Option("--no-enhance", help="Paper's profile: do not sharpen the images (Eq. 4).")
    ] = False,
    seed: Annotated[int, typer.Option(help="Seed of everything random.")] = 0,
    overwrite: Overwrite = False,
    force: Annotated[
        bool, typer.Option("--force", help="Write the registered cloud though the verdict refuses it.")
    ] = False,
    no_recording: Annotated[bool, typer.Option("--no-recording", help="Keep no recording.")] = False,
    dump_pipeline: Annotated[
        bool, typer.Option("--dump-pipeline", help="Print the run as pipeline JSON, and do not run it.")
    ] = False,
    as_json: AsJson = False,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Bring SOURCE to TARGET; write the registered cloud, its transform and the evidence to a folder.

    Exit code 0: accepted; 3: doubtful; 4: refused (evidence only); others: see the manual.
    """
    from mtpcr_geo.pipeline.grammar import dump
    from mtpcr_geo.registration import build_pipeline, read_options
    from mtpcr_geo.registration import register as run

    words = {
        "source_crs": source_crs, "target_crs": target_crs, "local": local, "level": level.value,
        "cell": cell, "profile": profile, "matcher": matcher, "models": models_folder,
        "res": not no_res, "focus": not no_focus, "enhance": not no_enhance,
        "seed": seed, "vertical": vertical.value, "out_crs": out_crs,
        "prior": "none" if no_prior else prior.value, "prior_sigma": prior_sigma, "prior_yaw": prior_yaw,
        "motion": motion.value,
        "recording": not no_recording, "force": force, "overwrite": overwrite,
    }  # fmt: skip
    if dump_pipeline:
        typer.echo(dump(build_pipeline(source, target, out, read_options(words))))
        return
    with progress_bars(quiet) as progress:
        result = run(source, target, out, progress=progress, **words)
    _report(result, as_json=as_json, verbose=verbose, quiet=quiet)
    raise typer.Exit(EXIT_BY_VERDICT[result.verdict.name])


@app.command(context_settings={"allow_extra_args": True, "ignore_unknown_options": True})
def pipeline(
    context: typer.Context,
    file: Annotated[
        Path | None, typer.Argument(help="Pipeline JSON; - reads standard input.", show_default=False)
    ] = None,
    check: Annotated[
        bool, typer.Option("--validate", help="Check grammar, options, files and CRS; run nothing.")
    ] = False,
    metadata: Annotated[
        Path | None, typer.Option(help="Write what the stages noted to this JSON file.", show_default=False)
    ] = None,
    progress: Annotated[
        bool, typer.Option("--progress", help="Show bars even where standard error is no terminal.")
    ] = False,
    schema: Annotated[
        bool, typer.Option("--schema", help="Print the JSON Schema of pipelines, for editors.")
    ] = False,
    allow_code: Annotated[
        bool, typer.Option("--allow-code", help="Let stages such as filters.python run code.")
    ] = False,
    allow_network: Annotated[
        bool, typer.Option("--allow-network", help="Let stages read remote or virtual (/vsi) files.")
    ] = False,
    overwrite: Overwrite = False,
    as_json: AsJson = False,
    verbose: Verbose = False,
    quiet: Quiet = False,
) -> None:
    """Run a pipeline of our stages and PDAL's, written as PDAL's JSON.

    Options of stages are changed by --TYPE.OPTION=VALUE, such as --readers.las.filename=a.laz, or by
    --TAG.OPTION=VALUE. Relative filenames are relative to the current folder.
    """
    from mtpcr_geo.cli import pipeline_verb

    if schema:
        pipeline_verb.print_schema()
        return
    if file is None:
        raise OptionError("name a pipeline file, or - for standard input")
    with progress_bars(quiet, always=progress) as bars:
        outcome = pipeline_verb.run_pipeline(
            file,
            context.args,
            check=check,
            metadata=metadata,
            overwrite=overwrite,
            allow_code=allow_code,
            allow_network=allow_network,
            progress=bars,
        )
    pipeline_verb.print_outcome(outcome, as_json=as_json, verbose=verbose, quiet=quiet)
    verdict = outcome.verdict if outcome is not None else None
    raise typer.Exit(EXIT_BY_VERDICT[verdict.name] if verdict is not None else 0)


@app.command()
def apply(
    transform: Annotated[Path, typer.Argument(help="A transform.json of a run.", show_default=False)],
    cloud: Annotated[Path, typer.Argument(help="Cloud to move: LAS, LAZ or COPC.", show_default=False)],
    out: Annotated[Path, typer.Argument(help="File to write: .las or .laz.", show_default=False)],
    inverse: Annotated[bool, typer.Option("--inverse", help="From target to source instead.")] = False,
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """Stream any cloud through the transform of a run."""
    from mtpcr_geo.export.apply import apply_transform

    with progress_bars(quiet) as progress:
        written = apply_transform(
            transform, cloud, out, inverse=inverse, overwrite=overwrite, progress=progress
        )
    if not quiet:
        typer.echo(f"wrote {written}")


@app.command()
def check(
    source: Annotated[
        Path, typer.Argument(help="Cloud that would move, or the only one.", show_default=False)
    ],
    target: Annotated[
        Path | None, typer.Argument(help="Cloud that would stay; one cloud may do.", show_default=False)
    ] = None,
    source_crs: Annotated[
        str | None, typer.Option(help="CRS of the source, instead of what its file states.")
    ] = None,
    target_crs: Annotated[
        str | None, typer.Option(help="CRS of the target, instead of what its file states.")
    ] = None,
    local: Annotated[bool, typer.Option("--local", help="Both clouds are local, in metres.")] = False,
    vertical: Annotated[
        Vertical, typer.Option(help="What to do with different or unknown vertical datums.")
    ] = Vertical.refuse,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON on standard output.")] = False,
    quiet: Quiet = False,
) -> None:
    """Say what two clouds are and what is wrong with them, before they are registered.

    Exit code 0: register would go on; else the code with which it would end.
    """
    from mtpcr_geo.check import check_clouds
    from mtpcr_geo.check.show import show

    with progress_bars(quiet) as progress:
        report = check_clouds(
            source,
            target,
            source_crs=source_crs,
            target_crs=target_crs,
            local=local,
            vertical=vertical.value,
            progress=progress,
        )
    show(report, as_json=as_json, quiet=quiet)
    raise typer.Exit(report.exit_code)


@app.command()
def models(
    folder: Annotated[
        Path | None,
        typer.Option("--models", help="Folder of model files, instead of $MTPCR_GEO_MODELS."),
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="Print JSON on standard output.")] = False,
) -> None:
    """List the learned matchers: which files are there, their licences, and who publishes those missing."""
    from mtpcr_geo.cli.pipeline_verb import print_models

    print_models(folder, as_json=as_json)


@app.command()
def demo(
    out: Annotated[Path, typer.Option("--out", "-o", help="Folder for the demo's files.")] = Path(
        "mtpcr-demo"
    ),
    overwrite: Overwrite = False,
    quiet: Quiet = False,
) -> None:
    """Register a simulated town, scanned from a street and from the air, and compare with the truth."""
    from mtpcr_geo.cli.demo import run_demo

    with progress_bars(quiet) as progress:
        result = run_demo(out, overwrite=overwrite, progress=progress)
    _report(result.registration, as_json=False, verbose=False, quiet=quiet)
    if not quiet:
        typer.echo(result.summary)
    raise typer.Exit(EXIT_BY_VERDICT[result.registration.verdict.name])


_PASSED_ON = {"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []}


@app.command(context_settings=_PASSED_ON)
def benchmark(context: typer.Context) -> None:
    """Run methods on pairs with a known transform, from random starts; write tables and plots."""
    _benchmark_room("benchmark", context.args)


@app.command(context_settings=_PASSED_ON)
def simulate(context: typer.Context) -> None:
    """Simulate pairs of ground and aerial clouds with a known transform (extra: benchmark)."""
    _benchmark_room("simulate", context.args)


def _benchmark_room(name: str, arguments: list[str]) -> None:
    """Run a verb whose module is loaded only when it is called."""
    from importlib import import_module

    alone = typer.Typer(add_completion=False, rich_markup_mode=None)
    alone.command(name)(getattr(import_module("mtpcr_geo.benchmark.command"), name))
    typer.main.get_command(alone)(arguments, prog_name=f"mtpcr-geo {name}", standalone_mode=False)


def main() -> None:
    """Run the command."""
    signal.signal(signal.SIGTERM, _interrupt)
    app()


def _interrupt(signum: int, frame: object) -> None:
    # a kill must leave as little behind as Ctrl-C does
    raise KeyboardInterrupt


def _report(result: Registration, *, as_json: bool, verbose: bool, quiet: bool) -> None:
    if as_json:
        typer.echo(result.outputs["run"].read_text(encoding="utf-8"), nl=False)
    elif not quiet:
        from rich.console import Console

        from mtpcr_geo.cli.summary import print_registration

        print_registration(Console(highlight=False), result, verbose=verbose)


if __name__ == "__main__":
    main()
