"""Simulated plots as foresters and surveyors scan them: a few tripod set-ups, a flight over all around."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mtpcr_geo.benchmark.simulator import instruments, scanners
from mtpcr_geo.benchmark.simulator.kinds import STYLES, Kind, SiteStyle
from mtpcr_geo.benchmark.simulator.raycast import Caster
from mtpcr_geo.benchmark.simulator.site import Site, make_site
from mtpcr_geo.core.arrays import Floats, Mask
from mtpcr_geo.core.errors import OptionError
from mtpcr_geo.core.voxels import first_in_voxels

BEAMS_PER_SCAN = 600_000
VOXEL_M = 0.05
MAST_M = 1.7
HILLS_M = 1.0
"""Standard deviation of the relief of a site on which the even slope is given."""
ROOM_M = 1.0
"""Nothing stands nearer to a scanner."""
_TRIES = 4000


@dataclass(frozen=True)
class PlotOptions:
    """What a plot is and how it is scanned.

    Attributes:
        kind: of the site.
        seed: of the site, the scanners and their noise.
        radius_m: of the plot, metres; what is scanned beyond is cut off.
        scans: set-ups in the plot; one stands about its middle.
        slope: even slope of the land, metres per metre, on top of its relief.
        air_density: aerial pulses per square metre.
        extent_m: edge of the square that is flown over, metres.
        air_leaves: share of leaves on the day of the flight.

    """

    kind: Kind
    seed: int
    radius_m: float
    scans: int
    slope: float
    air_density: float
    extent_m: float
    air_leaves: float


def plot_options(kind: Kind, seed: int) -> PlotOptions:
    """Draw a plot: radius 15 to 40 m, 1 to 5 set-ups, slopes to 30 %, 2 to 30 pulses per square metre.

    Towns and farmland keep slopes below 8 %.
    """
    rng = np.random.default_rng([seed, 41, *kind.encode()])
    steepest = 0.3 if kind == "forest" else 0.08
    return PlotOptions(
        kind,
        seed,
        radius_m=round(float(rng.uniform(15.0, 40.0)), 1),
        scans=int(rng.integers(1, 6)),
        slope=round(float(rng.uniform(0.0, steepest)), 3),
        air_density=round(float(np.exp(rng.uniform(np.log(2.0), np.log(30.0)))), 1),
        extent_m=round(float(rng.uniform(140.0, 240.0))),
        air_leaves=round(float(rng.uniform(0.4, 1.0)), 2),
    )


def simulate_plot(options: PlotOptions) -> tuple[Floats, Floats]:
    """Scan a plot from the ground and, in another epoch, all around it from the air.

    Returns:
        (n, 3) ground and (m, 3) aerial points in the site's frame, metres.

    Raises:
        OptionError: if the site has no place for the scanners.
        MissingPartError: if ``embreex`` is not installed.

    """
    rng = np.random.default_rng([options.seed, 43, *options.kind.encode()])
    site = make_site(options.kind, options.seed, options.extent_m, style=_style(options))
    caster = Caster(site.mesh(0))
    # a plot lies anywhere, but all of it in what is flown over
    reach = max(site.half - options.radius_m, 0.0)
    centre, places = _set_up(site, caster, reach, options, rng)
    beams = scanners.tripod_beams(
        places, site.ground.height, BEAMS_PER_SCAN * options.scans, rng, mast_m=MAST_M
    )
    low = instruments.measure(caster, beams, instruments.TRIPOD, rng).xyz
    low = low[np.hypot(*(low[:, :2] - centre).T) < options.radius_m]
    low = low[first_in_voxels(low, VOXEL_M)]
    block = scanners.Block(np.full(2, -site.half), np.full(2, site.half), 0.0)
    flight = scanners.airborne_beams(block, site.ground.height, options.air_density, rng)
    above = Caster(site.mesh(1, options.air_leaves))
    high = instruments.measure(above, flight, instruments.AIRBORNE, rng).xyz
    return low, high[block.contains(high[:, :2])]


def _style(options: PlotOptions) -> SiteStyle:
    style = STYLES[options.kind]
    hills = min(HILLS_M, style.ground.hills_m)
    return replace(style, ground=replace(style.ground, hills_m=hills, slope=options.slope))


def _set_up(
    site: Site, caster: Caster, reach: float, options: PlotOptions, rng: np.random.Generator
) -> tuple[Floats, Floats]:
    """Choose the plot's centre (2,) and the scanners' places (scans, 2), metres."""
    tries = rng.uniform(-reach, reach, (_TRIES, 2))
    good = tries[_free(site, caster, tries) & _worth(site, tries, options)]
    if not len(good):
        raise OptionError(f"{options.kind} {options.seed} has no place for a plot; take another seed")
    centre = good[0]
    # the others stand about half way out, apart from one another
    ring = centre + options.radius_m * _in_disc(_TRIES, rng, 0.35, 0.75)
    ring = ring[_free(site, caster, ring)]
    chosen = [centre]
    while len(chosen) < options.scans and len(ring):
        away = np.min([np.hypot(*(ring - one).T) for one in chosen], axis=0)
        far = np.flatnonzero(away >= 0.7 * away.max())
        chosen.append(ring[far[rng.integers(len(far))]])
    return centre, np.array(chosen)


def _in_disc(count: int, rng: np.random.Generator, inner: float, outer: float) -> Floats:
    angle, out = rng.uniform(0, 2 * np.pi, count), rng.uniform(inner, outer, count)
    return np.asarray(out[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1))


def _free(site: Site, caster: Caster, xy: Floats) -> Mask:
    """Return which (n, 2) places a tripod may stand at: on open ground, nothing close to it."""
    z = site.ground.height(xy)
    count = len(xy)
    down = np.tile([0.0, 0.0, -1.0], (count, 1))
    fall = caster.cast(np.c_[xy, z + MAST_M], down).distance
    free = np.abs(fall - MAST_M) < 0.4
    azimuth = np.linspace(0.0, 2 * np.pi, 12, endpoint=False)
    for angle in azimuth:
        way = np.tile([np.cos(angle), np.sin(angle), 0.0], (count, 1))
        free &= caster.cast(np.c_[xy, z + MAST_M], way).distance > ROOM_M
    if _built(site):
        # surveyors of a built site stand on its roads, and never in a house
        free &= _road_distance(site, xy) < 6.0
    return np.asarray(free)


def _built(site: Site) -> bool:
    """Return whether a site is built up, so that scanners stand on its roads."""
    return site.style.lots in ("terraced", "detached", "halls", "identical")


def _road_distance(site: Site, xy: Floats) -> Floats:
    g = site.ground
    column, row = np.rint((xy - [g.west, g.south]).T / g.cell).astype(int)
    last = np.array(g.z.shape) - 1
    return np.asarray(g.road_distance[np.clip(row, 0, last[0]), np.clip(column, 0, last[1])])


def _worth(site: Site, xy: Floats, options: PlotOptions) -> Mask:
    """Return which (n, 2) places a plot is worth scanning at: a bare field shows nothing to anybody."""
    if options.kind != "farmland":
        return np.ones(len(xy), bool)
    near = [np.hypot(*(site.plants.xy - one).T) < 0.8 * options.radius_m for one in xy]
    return np.array([(site.plants.height[mask] > 1.0).sum() >= 4 for mask in near])
