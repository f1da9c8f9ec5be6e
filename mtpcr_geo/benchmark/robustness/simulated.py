"""Recipes for the clouds of simulated cases."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from mtpcr_geo.benchmark import sources
from mtpcr_geo.benchmark.pairs import load_pair
from mtpcr_geo.benchmark.robustness.cases import CommonFrame
from mtpcr_geo.benchmark.simulator.kinds import Kind
from mtpcr_geo.benchmark.simulator.repeating import RepeatingKind, repeating_pair
from mtpcr_geo.benchmark.simulator.scan_plots import PlotOptions, simulate_plot
from mtpcr_geo.benchmark.simulator.symmetric import SymmetricKind, symmetric_pair
from mtpcr_geo.benchmark.standins import StandIn, write_stand_in


@dataclass(frozen=True)
class PlotClouds:
    """A simulated plot scanned from the ground, against an airborne scan of its surroundings.

    Attributes:
        options: of the plot.

    """

    options: PlotOptions

    def make(self) -> CommonFrame:
        """Simulate both scans."""
        return CommonFrame(*simulate_plot(self.options))


@dataclass(frozen=True)
class RepeatingClouds:
    """Two scans of a site that repeats itself.

    Attributes:
        kind, seed, apart: of `repeating_pair`.

    """

    kind: RepeatingKind
    seed: int
    apart: bool = False

    def make(self) -> CommonFrame:
        """Sample both clouds."""
        return CommonFrame(*repeating_pair(self.kind, self.seed, apart=self.apart))


@dataclass(frozen=True)
class SymmetricClouds:
    """Two scans of a site that looks the same when turned by 180 degrees.

    Attributes:
        kind, seed, apart: of `symmetric_pair`.

    """

    kind: SymmetricKind
    seed: int
    apart: bool = False

    def make(self) -> CommonFrame:
        """Sample both clouds."""
        return CommonFrame(*symmetric_pair(self.kind, self.seed, apart=self.apart))


@dataclass(frozen=True)
class StandInClouds:
    """A stand-in for one of the paper's combinations.

    Attributes:
        cache: folder in which stand-ins are kept once they are made.
        stand_in: which.

    """

    cache: Path
    stand_in: StandIn

    def make(self) -> CommonFrame:
        """Simulate it, or read it."""
        return _placed(write_stand_in(self.cache / f"standins_{self.stand_in.seed}", self.stand_in))


@dataclass(frozen=True)
class SiteClouds:
    """A simulated ground and aerial pair, as ``mtpcr-geo benchmark --simulated`` has them.

    Attributes:
        cache: folder in which pairs are kept once they are made.
        kind, seed, overlap: of `simulate_pair`.

    """

    cache: Path
    kind: Kind
    seed: int
    overlap: float

    def make(self) -> CommonFrame:
        """Simulate it, or read it."""
        (folder,) = sources.simulated(
            self.cache, 1, kinds=(self.kind,), overlaps=(self.overlap,), seed=self.seed
        )
        return _placed(folder)


def _placed(folder: Path) -> CommonFrame:
    pair = load_pair(folder)
    return CommonFrame(pair.source, pair.target, pair.overlap_cell_m)
