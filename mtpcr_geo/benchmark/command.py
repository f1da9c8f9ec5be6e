"""The verbs ``benchmark`` and ``simulate`` of the command, loaded by name when they are called."""

from __future__ import annotations

import inspect
from pathlib import Path
from typing import Annotated, Any

import typer

from mtpcr_geo.benchmark.simulator.options import PairOptions, pair_options
from mtpcr_geo.cli.shared import Overwrite, Quiet, progress_bars
from mtpcr_geo.core.errors import OptionError


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


def _simulate(
    out: Path, *, count: int = 1, overwrite: bool = False, quiet: bool = False, **options: Any
) -> None:
    """Simulate pairs of a ground and an aerial cloud, and write each into a folder of its own in OUT.

    A folder such as town_0 holds source.laz (ground), target.laz (aerial) and pair.json with the known
    transform: what `mtpcr-geo benchmark --data OUT` runs on. Needs the extra `benchmark`.
    """
    from mtpcr_geo.benchmark.simulator.pairs import simulate_from, write_pair

    if count < 1:
        raise OptionError(f"--count is {count}; there must be at least one pair")
    first = pair_options(**options)
    with progress_bars(quiet) as progress, progress.task("simulating pairs", count) as advance:
        for seed in range(first.seed, first.seed + count):
            pair = simulate_from(first.model_copy(update={"seed": seed}))
            write_pair(out / pair.name, pair, overwrite=overwrite)
            if not quiet:
                typer.echo(
                    f"{out / pair.name}: {pair.source.count:,} ground and {pair.target.count:,} aerial "
                    f"points; {pair.overlap_source:.0%} of the ground cloud's cells and "
                    f"{pair.overlap_target:.0%} of the aerial one's are shared"
                )
            advance(1)


def _with_options_of_pairs() -> Any:
    """Return `_simulate` with one parameter for each field of `PairOptions`, for typer to read.

    The fields' limits are judged by the model alone.
    """

    def simulate(**given: Any) -> None:
        _simulate(**given)

    declared: dict[str, tuple[Any, Any]] = {
        "out": (
            Annotated[Path, typer.Argument(help="Folder for the pairs' folders.", show_default=False)],
            inspect.Parameter.empty,
        )
    }
    for name, field in PairOptions.model_fields.items():
        description = field.description or name
        shown = typer.Option(help=f"{description[:1].upper()}{description[1:]}.")
        kind = tuple[float, float] if name == "leafiness" else field.annotation
        declared[name] = (Annotated[kind, shown], field.default)
    declared["count"] = (Annotated[int, typer.Option(help="Number of pairs; each has the next seed.")], 1)
    declared["overwrite"] = (Overwrite, False)
    declared["quiet"] = (Quiet, False)
    parameters = [
        inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, annotation=kind, default=default)
        for name, (kind, default) in declared.items()
    ]
    # typer takes a function's parameters from its signature
    simulate.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    simulate.__annotations__ = {name: kind for name, (kind, _) in declared.items()}
    simulate.__doc__ = _simulate.__doc__
    return simulate


simulate = _with_options_of_pairs()
