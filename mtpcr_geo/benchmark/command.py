"""The verbs ``benchmark`` and ``simulate`` of the command, loaded by name when they are called."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from pydantic import Field

from mtpcr_geo.benchmark.simulator.options import PairOptions
from mtpcr_geo.cli.options import Quiet as QuietOption
from mtpcr_geo.cli.parameters import command_of
from mtpcr_geo.cli.shared import Quiet, progress_bars
from mtpcr_geo.core.errors import OptionError
from mtpcr_geo.pipeline.options import Overwrite
from mtpcr_geo.pipeline.shown import RUN, Shown

if TYPE_CHECKING:
    from mtpcr_geo.benchmark.robustness.suites import SuiteOptions


_OF_THE_SUITE = {
    "level", "local", "recording", "recording_mb", "prior", "near", "near_crs", "within", "yaw", "force",
    "overwrite", "also", "scale",
}  # fmt: skip
"""Options of register that the suites set, or that their runs have no use for."""


def benchmark(
    out: Annotated[
        Path,
        typer.Option("--out", "-o", help="Folder of the results; what is there is kept.", show_default=False),
    ],
    data: Annotated[
        list[Path] | None, typer.Option(help="Folder of pairs (source.laz, target.laz, pair.json each).")
    ] = None,
    simulated: Annotated[int, typer.Option(help="Number of sites to simulate.")] = 0,
    standins: Annotated[
        bool, typer.Option("--standins", help="Simulate the paper's fourteen combinations.")
    ] = False,
    graco: Annotated[Path | None, typer.Option(help="Folder of GrAco's bags and calibrations.")] = None,
    methods: Annotated[
        list[str],
        typer.Option("--methods", "-m", help="Methods, with options: 'mtpcr-geo kiss-matcher:voxel=1'."),
    ] = ["mtpcr-geo"],  # noqa: B006 - typer copies it
    robustness: Annotated[
        list[str] | None,
        typer.Option(
            help="Run suites of the robustness benchmark instead, such as 'pairs discs', or all; --data is "
            "then the folder of real pairs, and --methods takes mtpcr-geo alone, with or without options."
        ),
    ] = None,
    calibrate: Annotated[
        list[Path] | None,
        typer.Option(
            help="Fit the verdict's probability to these files of rows (robustness.csv) instead, and show it "
            "on the sites that it was not fitted to."
        ),
    ] = None,
    scale: Annotated[
        str,
        typer.Option(
            help="Register one pair of --data densified to so many million points a cloud instead, such as "
            "'1 3 10', beside laspy and PDAL; draws time and memory."
        ),
    ] = "",
    survey: Annotated[
        float,
        typer.Option(
            min=0.0,
            help="Make a region of so many kilometres a side instead, build a survey of it, and register "
            "scans of 200 m from as many places as --starts says, with and without a rough place.",
        ),
    ] = 0.0,
    batch: Annotated[int, typer.Option(min=0, help="With --survey: jobs of a batch; 0 for none.")] = 0,
    threads: Annotated[int, typer.Option(min=0, help="With --scale: processor cores; 0 takes all.")] = 0,
    starts: Annotated[int, typer.Option(min=1, help="Random starts of each pair.")] = 10,
    jobs: Annotated[int, typer.Option(min=1, help="Runs at a time.")] = 1,
    yaw: Annotated[float, typer.Option(help="Starts are turned by 0 to this, degrees.")] = 360.0,
    tilt: Annotated[float, typer.Option(help="Starts are tilted by 0 to this, degrees.")] = 0.0,
    shift: Annotated[float, typer.Option(help="Starts are moved by 0 to this, metres.")] = 100.0,
    seed: Annotated[int, typer.Option(help="Seed of the starts.")] = 0,
    only: Annotated[list[str] | None, typer.Option(help="Pairs whose names contain this.")] = None,
    kinds: Annotated[
        str, typer.Option(help="Kinds of simulated sites, such as 'town forest'; else all.")
    ] = "",
    overlaps: Annotated[str, typer.Option(help="Overlaps of simulated sites, such as '0.4 0.1'.")] = "0.18",
    pairs: Annotated[
        Path | None, typer.Option(help="Folder for pairs that are made; else OUT/pairs.")
    ] = None,
    time_limit: Annotated[float, typer.Option(help="Longest a run may take, seconds.")] = 600.0,
    quiet: Quiet = False,
) -> None:
    """Run methods on pairs with a known transform, from random starts; write tables and plots.

    An interrupted benchmark goes on where it stopped when the same command is given again.
    """
    if calibrate:
        from mtpcr_geo.benchmark.robustness.calibrate import calibrate as fit_probability

        report = fit_probability(calibrate, out)
        if not quiet:
            typer.echo(report)
        return
    if scale:
        _scale(scale, data or [], tuple(only or ()), out, threads, quiet)
        return
    if survey:
        from mtpcr_geo.benchmark.survey import run_survey

        with progress_bars(quiet) as progress:
            told = run_survey(survey, starts, out, seed=seed, batch=batch, progress=progress)
        if not quiet:
            typer.echo(f"{told}\nTables: {out}")
        return
    if robustness:
        from mtpcr_geo.benchmark.robustness.suites import SuiteOptions

        if data and len(data) > 1:
            raise OptionError("--robustness takes one folder of pairs")
        chosen = SuiteOptions(
            data=data[0] if data else None,
            cache=pairs or out / "pairs",
            starts=starts,
            seed=seed,
            only=tuple(only or ()),
            shift_m=shift,
            register_options=_options_of_register(methods),
        )
        _robustness(
            [word for text in robustness for word in text.split()], chosen, out, jobs, time_limit, quiet
        )
        return
    from mtpcr_geo.benchmark.runs import PairSelection, numbers_of, run_benchmark, shown
    from mtpcr_geo.benchmark.worker import StartRange

    selection = PairSelection(
        tuple(data or ()),
        simulated,
        standins,
        graco,
        tuple(only or ()),
        tuple(kinds.split()),
        numbers_of(overlaps),
    )
    with progress_bars(quiet) as progress:
        rows = run_benchmark(
            selection,
            [word for text in methods for word in text.split()],
            out,
            pairs=pairs,
            starts=starts,
            ranges=StartRange(yaw, tilt, shift, seed),
            jobs=jobs,
            time_limit_s=time_limit,
            progress=progress,
        )
    if not quiet:
        typer.echo(shown(rows) + f"\nTables and plots: {out}")


def _scale(sizes: str, data: list[Path], only: tuple[str, ...], out: Path, threads: int, quiet: bool) -> None:
    from mtpcr_geo.benchmark.pairs import pair_folders
    from mtpcr_geo.benchmark.runs import numbers_of
    from mtpcr_geo.benchmark.scale import run_scale

    found = [folder for one in data for folder in pair_folders(one, only)]
    if len(found) != 1:
        names = ", ".join(folder.name for folder in found) or "none"
        raise OptionError(f"--scale takes one pair: name it by --data and --only; there are {names}")
    with progress_bars(quiet) as progress:
        rows = run_scale(found[0], numbers_of(sizes), out, threads=threads, progress=progress)
    if not quiet:
        for row in rows:
            typer.echo(
                f"{row['million_points']:7g} million  {row['wall_s']:8.2f} s  {row['cpu_s']:8.2f} s of "
                f"processors  {row['peak_mib'] or 0:6.0f} MiB  {row['job']}"
            )
        typer.echo(f"Tables and plot: {out}")


def _options_of_register(methods: list[str]) -> tuple[tuple[str, Any], ...]:
    """Return the options of the method mtpcr-geo, which the robustness benchmark runs alone."""
    from mtpcr_geo.benchmark.methods import make_method, options_of
    from mtpcr_geo.registration import read_options

    words = [word for text in methods for word in text.split()]
    if len(words) != 1 or words[0].partition(":")[0] != "mtpcr-geo":
        raise OptionError("--robustness takes one method, mtpcr-geo, with or without options")
    given = options_of(words[0])
    chosen = read_options(given)
    for name in given:
        if name in _OF_THE_SUITE or name.startswith(("source_", "target_")):
            raise OptionError(f"the suites of --robustness set {name!r} themselves; leave it out")
    make_method(words[0])
    # one spelling for one run: its name tells it from others
    kept = chosen.model_dump(mode="json", exclude_defaults=True)
    return tuple(sorted(kept.items()))


def _robustness(
    names: list[str], chosen: SuiteOptions, out: Path, jobs: int, time_limit_s: float, quiet: bool
) -> None:
    from mtpcr_geo.benchmark.robustness.verb import run_suites

    with progress_bars(quiet) as progress:
        rows, report = run_suites(names, chosen, out, jobs=jobs, time_limit_s=time_limit_s, progress=progress)
    if not quiet:
        typer.echo(f"{report}\n{len(rows)} rows: {out}")


class SimulateVerb(PairOptions):
    """Options of ``simulate``."""

    out: Annotated[
        Path,
        Field(description="folder in which each pair gets a folder of its own"),
        Shown(RUN, argument=True),
    ]
    count: Annotated[int, Field(ge=1, description="number of pairs; each has the next seed"), Shown(RUN)] = 1
    overwrite: Overwrite = False
    quiet: QuietOption = False


def _simulate(given: SimulateVerb) -> None:
    """Simulate pairs of a ground and an aerial cloud with a known transform (extra: benchmark).

    A pair's folder, such as town_0, holds source.laz (ground), target.laz (aerial) and pair.json with the
    transform: what `mtpcr-geo benchmark --data` runs on. Needs the extra benchmark.

    Examples:
        mtpcr-geo simulate pairs
        mtpcr-geo simulate pairs --kind forest --seed 3 --count 2 --overlap 0.1

    """
    from mtpcr_geo.benchmark.simulator.pairs import simulate_from, write_pair

    first = PairOptions(**{name: getattr(given, name) for name in PairOptions.model_fields})
    with progress_bars(given.quiet) as progress, progress.task("simulating pairs", given.count) as advance:
        for seed in range(first.seed, first.seed + given.count):
            pair = simulate_from(first.model_copy(update={"seed": seed}))
            folder = given.out / pair.name
            write_pair(folder, pair, overwrite=given.overwrite)
            if not given.quiet:
                typer.echo(
                    f"{folder}: {pair.source.count:,} ground and {pair.target.count:,} aerial points; "
                    f"{pair.overlap_source:.0%} of the ground cloud's cells and {pair.overlap_target:.0%} of "
                    "the aerial one's are shared"
                )
            advance(1)


simulate = command_of(SimulateVerb, _simulate)
