"""The suites: which runs each of them makes.

for case in cases(["pairs", "unrelated"], SuiteOptions(data=Path("data"), cache=Path("cache"))):
    ...
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from mtpcr_geo.benchmark.pairs import pair_folders
from mtpcr_geo.benchmark.robustness.cases import (
    PLACES,
    Case,
    DegradedClouds,
    DiscClouds,
    ElsewhereClouds,
    FolderClouds,
    MirroredClouds,
    UnrelatedClouds,
)
from mtpcr_geo.benchmark.robustness.degrade import WAYS
from mtpcr_geo.benchmark.robustness.simulated import (
    PlotClouds,
    RepeatingClouds,
    SiteClouds,
    StandInClouds,
    SymmetricClouds,
)
from mtpcr_geo.benchmark.simulator import repeating, symmetric
from mtpcr_geo.benchmark.simulator.kinds import KINDS, Kind
from mtpcr_geo.benchmark.simulator.scan_plots import plot_options
from mtpcr_geo.benchmark.standins import stand_ins
from mtpcr_geo.benchmark.worker import StartRange
from mtpcr_geo.core.errors import OptionError
from mtpcr_geo.core.suggestions import meant

RADII_M = (15.0, 20.0, 25.0, 35.0, 50.0, 75.0)
UNRELATED_RADIUS_M = 25.0
UNCUT = ("forest_plot_mls_uas", "robot_scans")
"""Pairs too small to cut discs from."""
TILT_DEG = 10.0
PLOTS: dict[Kind, int] = {"forest": 60, "town": 20, "farmland": 20}
REPEATING_SEEDS = 10
SYMMETRIC_SEEDS = 5
ELSEWHERE_RADII_M = (25.0, 50.0)
OVERLAPS = (0.4, 0.25, 0.15, 0.1, 0.07, 0.05, 0.03)


@dataclass(frozen=True)
class SuiteOptions:
    """What suites are made from.

    Attributes:
        data: folder of real pairs; only suites of real pairs need it.
        cache: folder for simulated pairs that take long to make.
        starts: random starts of each pair in pairs, tilts and standins.
        seed: of all starts, places and simulated sites.
        only: keep cases whose site, kind or place contains one of these; all if empty.
        shift_m: starts are moved by up to this, metres.
        register_options: further options of `register`, as names and values.

    """

    data: Path | None = None
    cache: Path = Path("pairs")
    starts: int = 10
    seed: int = 0
    only: tuple[str, ...] = ()
    shift_m: float = 100.0
    register_options: tuple[tuple[str, Any], ...] = ()

    @property
    def ranges(self) -> StartRange:
        """Any yaw, and a shift: what starts are drawn from unless a suite tilts them."""
        return StartRange(shift_m=self.shift_m, seed=self.seed)

    def folders(self) -> list[Path]:
        """List the folders of real pairs.

        Raises:
            OptionError: if no data was given.
            InputError: if there is none.

        """
        if self.data is None:
            raise OptionError("this suite is of real pairs; give --data")
        return pair_folders(self.data)


def cases(names: Sequence[str], options: SuiteOptions) -> Iterator[Case]:
    """Yield the runs of suites, in order.

    Args:
        names: of suites, or "all".
        options: what they are made from.

    Raises:
        OptionError: if a suite is unknown, or lacks what it is made from.

    """
    for name in suite_names(names):
        for case in SUITES[name](options):
            words = (case.site, case.kind, case.place)
            if not options.only or any(part in word for part in options.only for word in words):
                yield replace(case, options=options.register_options)


def suite_names(names: Sequence[str]) -> list[str]:
    """Return the suites asked for, each once; "all" and "starts" (spread over the starts of pairs) are known.

    Raises:
        OptionError: if there is no such suite.

    """
    found: list[str] = []
    for name in names:
        if name == "all":
            found += SUITES
        elif name == "starts":
            found.append("pairs")
        elif name in SUITES:
            found.append(name)
        else:
            known = [*SUITES, "starts", "all"]
            hint = meant(name, known) or f"; choose from {', '.join(known)}"
            raise OptionError(f"there is no suite {name!r}{hint}")
    return list(dict.fromkeys(found))


def _pairs(options: SuiteOptions) -> Iterator[Case]:
    for folder in options.folders():
        case = Case("pairs", folder.name, "whole", FolderClouds(folder), options.seed, ranges=options.ranges)
        yield from (replace(case, start=start) for start in range(options.starts))


def _tilts(options: SuiteOptions) -> Iterator[Case]:
    ranges = replace(options.ranges, tilt_deg=TILT_DEG)
    for case in _pairs(options):
        yield replace(case, suite="tilts", level="auto", ranges=ranges)


def _swap(options: SuiteOptions) -> Iterator[Case]:
    for case in _pairs(replace(options, starts=1)):
        yield replace(case, suite="swap", both_ways=True)


def _discs(options: SuiteOptions) -> Iterator[Case]:
    for folder in options.folders():
        if folder.name in UNCUT:
            continue
        for radius in RADII_M:
            for place in range(PLACES):
                recipe = DiscClouds(folder, radius, place, options.seed)
                yield Case(
                    "discs", folder.name, "disc", recipe, options.seed,
                    ranges=options.ranges, radius=radius, place=f"place{place}",
                )  # fmt: skip


def _degraded(options: SuiteOptions) -> Iterator[Case]:
    for folder in options.folders():
        for way in WAYS:
            yield Case(
                "degraded", folder.name, way, DegradedClouds(folder, way, options.seed), options.seed,
                ranges=options.ranges,
            )  # fmt: skip


def _unrelated(options: SuiteOptions) -> Iterator[Case]:
    folders = options.folders()
    for source in folders:
        for target in folders:
            if source == target:
                continue
            for kind, radius in (("whole", None), ("disc", UNRELATED_RADIUS_M)):
                recipe = UnrelatedClouds(source, target, radius, options.seed)
                yield Case(
                    "unrelated", source.name, kind, recipe, options.seed,
                    ranges=options.ranges, has_truth=False, radius=radius, place=target.name,
                )  # fmt: skip


def _plots(options: SuiteOptions) -> Iterator[Case]:
    for kind, count in PLOTS.items():
        for number in range(count):
            seed = 1000 * options.seed + number
            plot = plot_options(kind, seed)
            yield Case(
                "plots", f"{kind}_plot_{seed}", kind, PlotClouds(plot), seed,
                ranges=options.ranges, radius=plot.radius_m,
            )  # fmt: skip


def _repeating(options: SuiteOptions, apart: bool = False) -> Iterator[Case]:
    for kind in repeating.KINDS:
        for number in range(REPEATING_SEEDS):
            seed = 1000 * options.seed + number
            yield Case(
                "repeating-apart" if apart else "repeating", f"{kind}_{seed}", kind,
                RepeatingClouds(kind, seed, apart), seed,
                ranges=options.ranges, has_truth=not apart,
                asked_overlap=0.0 if apart else repeating.OVERLAP,
            )  # fmt: skip


def _repeating_apart(options: SuiteOptions) -> Iterator[Case]:
    return _repeating(options, apart=True)


def _symmetric(options: SuiteOptions) -> Iterator[Case]:
    for kind in symmetric.KINDS:
        for number in range(SYMMETRIC_SEEDS):
            for apart in (False, True):
                seed = 1000 * options.seed + number
                yield Case(
                    "symmetric", f"{kind}_{seed}", kind, SymmetricClouds(kind, seed, apart), seed,
                    ranges=options.ranges, has_truth=not apart, place="apart" if apart else "",
                )  # fmt: skip


def _mirrored(options: SuiteOptions) -> Iterator[Case]:
    for folder in options.folders():
        cuts: list[tuple[float | None, int]] = [(None, 0)]
        if folder.name not in UNCUT:
            cuts += [(radius, place) for radius in ELSEWHERE_RADII_M for place in range(PLACES)]
        for radius, place in cuts:
            yield Case(
                "mirrored", folder.name, "whole" if radius is None else "disc",
                MirroredClouds(folder, radius, place, options.seed), options.seed,
                ranges=options.ranges, has_truth=False, radius=radius,
                place="" if radius is None else f"place{place}",
            )  # fmt: skip


def _elsewhere(options: SuiteOptions) -> Iterator[Case]:
    for folder in options.folders():
        if folder.name in UNCUT:
            continue
        for radius in ELSEWHERE_RADII_M:
            for place in range(PLACES):
                yield Case(
                    "elsewhere", folder.name, "disc",
                    ElsewhereClouds(folder, radius, place, options.seed), options.seed,
                    ranges=options.ranges, has_truth=False, radius=radius, place=f"place{place}",
                )  # fmt: skip


def _standins(options: SuiteOptions) -> Iterator[Case]:
    for one in stand_ins(options.seed):
        case = Case(
            "standins", one.name, one.combination.group, StandInClouds(options.cache, one), options.seed,
            ranges=options.ranges, level="auto",
        )  # fmt: skip
        yield from (replace(case, start=start) for start in range(options.starts))


def _overlap(options: SuiteOptions) -> Iterator[Case]:
    for number, kind in enumerate(KINDS):
        for overlap in OVERLAPS:
            recipe = SiteClouds(options.cache, kind, options.seed + number, overlap)
            yield Case(
                "overlap", f"{kind}_{options.seed + number}", kind, recipe, options.seed + number,
                ranges=options.ranges, level="auto", asked_overlap=overlap,
            )  # fmt: skip


SUITES: dict[str, Callable[[SuiteOptions], Iterator[Case]]] = {
    "pairs": _pairs,
    "tilts": _tilts,
    "discs": _discs,
    "degraded": _degraded,
    "plots": _plots,
    "swap": _swap,
    "repeating": _repeating,
    "repeating-apart": _repeating_apart,
    "symmetric": _symmetric,
    "unrelated": _unrelated,
    "mirrored": _mirrored,
    "elsewhere": _elsewhere,
    "standins": _standins,
    "overlap": _overlap,
}
"""The suites: pairs (real pairs, upright), tilts (the same, local and tilted), discs (cut from them),
degraded (as other instruments and seasons would have them), plots (simulated ground plots), swap (both ways),
repeating (sites that repeat themselves), repeating-apart (without overlap), symmetric (sites that look the
same when turned by half), unrelated (other sites), mirrored (the source reflected), elsewhere (discs against
the target without their surroundings), standins and overlap (simulated, as `mtpcr-geo benchmark` has them).
"""
