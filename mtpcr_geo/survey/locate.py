"""Where in a survey a cloud lies: the cloud levelled and rasterised, and the survey searched for it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mtpcr_geo.core.arrays import ComparesArrays, Floats
from mtpcr_geo.core.cloud import ArrayCloud, Cloud
from mtpcr_geo.core.errors import OptionError
from mtpcr_geo.core.progress import Progress
from mtpcr_geo.core.scanner import Scanner
from mtpcr_geo.core.types import Pair, Side
from mtpcr_geo.crs.resolve import resolve_frames
from mtpcr_geo.io.outputs import OutputSet
from mtpcr_geo.io.sample import Scan, scan
from mtpcr_geo.match.correlation import CorrelationSettings
from mtpcr_geo.match.pose import centre_of
from mtpcr_geo.match.prior import Prior
from mtpcr_geo.method.bev import MAX_CELLS
from mtpcr_geo.method.levelling import level
from mtpcr_geo.pipeline.options import RegisterOptions
from mtpcr_geo.pipeline.stage import RunContext
from mtpcr_geo.pipeline.stages.priors import known_place, prior_of
from mtpcr_geo.pipeline.stages.rasters import in_work_frame, rasterised, side_of
from mtpcr_geo.survey.index import Survey
from mtpcr_geo.survey.levels import Ground
from mtpcr_geo.survey.search import FoundPlace, search

CUT_SHARE, LEAST_CUT_M = 0.1, 16.0
"""What is cut out beyond the source's raster on each side: a share of it, and metres at least."""


@dataclass(frozen=True, eq=False)
class Located(ComparesArrays):
    """A cloud found in a survey.

    Attributes:
        found: the search's result.
        place: (2,) where the middle of the cloud's raster lies, in units of the survey's CRS.
        pivot: (2,) that middle in the levelled source's frame, metres.
        box: (2, 2) what to cut out of the survey, in units of its CRS.
        scan: what one pass over the cloud gave.
        source: the cloud as it was levelled.

    """

    found: FoundPlace
    place: Floats
    pivot: Floats
    box: Floats
    scan: Scan
    source: Side


def locate(source: Cloud, survey: Survey, options: RegisterOptions, progress: Progress) -> Located:
    """Find a cloud in a survey.

    Args:
        source: the cloud.
        survey: where it is sought.
        options: of the registration, as far as they concern frames, levelling and what is known beforehand.
        progress: where long work reports.

    Raises:
        RegistrationError: if nowhere in the survey is anything to compare.
        CrsError: if the CRSs do not go together.
        OptionError: if what is known beforehand cannot be true.
        InputError: if the cloud or the survey cannot be used.

    """
    scanned = scan(source, seed=options.seed, progress=progress)
    pair = _pair(source, scanned, survey, options)
    # nothing is written by what only searches
    with OutputSet() as outputs:
        bev = rasterised(pair.source, survey.frame.cell_m, "centre", RunContext(outputs, progress))
    if bev.grid.width * bev.grid.height > MAX_CELLS:
        raise OptionError(
            f"{source.name} has too many cells of {survey.frame.cell_m:g} m for a search; cut it into parts"
        )
    low, high = survey.bounds[:, :2] * survey.frame.unit_m
    ground = Ground.around(survey.mosaic, np.stack([low, high]))
    known = known_place(options, pair, "register")
    prior = None if known is None else _from(prior_of(known, pair), pair, ground)
    settings = CorrelationSettings(trust_vertical=pair.source.levelling.trusted)
    with progress.task("searching the survey", None) as advance:
        found = search(bev, ground, settings, options.seed, prior, advance)
    pivot = centre_of(bev.grid)
    place, box = found.place / survey.frame.unit_m, _box(bev.grid.shape, found, survey)
    return Located(found, place, pivot, box, scanned, pair.source)


def _pair(source: Cloud, scanned: Scan, survey: Survey, options: RegisterOptions) -> Pair:
    """Return the source levelled, beside a target that is no more than the survey's extent."""
    box = survey.bounds
    corners = np.array([[x, y, z] for x in box[:, 0] for y in box[:, 1] for z in box[:, 2]])
    extent = ArrayCloud(corners, survey.frame.crs, str(survey.folder))
    frame, target_link, source_link = resolve_frames(
        extent,
        source,
        target_crs=options.target_crs,
        source_crs=options.source_crs,
        local=False,
        vertical=options.vertical,
        out_crs=options.out_crs,
        target_bounds=box,
        source_bounds=scanned.bounds,
        source_scanner=Scanner(options.source_unit, options.source_axes),
    )
    sample = in_work_frame(source_link, scanned.sample)
    levelling = level(sample, options.level, source_link.georeferenced, options.seed)
    side = side_of("source", source, source_link, scanned, sample, levelling)
    return Pair(Side("target", extent, target_link, target_link.to_work(corners)), side, frame)


def _from(prior: Prior, pair: Pair, ground: Ground) -> Prior:
    """Return a prior in metres from the ground's origin instead of the work frame's."""
    from dataclasses import replace

    if prior.place is None:
        return prior
    east, north = np.asarray(prior.place) + pair.target.link.origin[:2] - ground.origin
    return replace(prior, place=(float(east), float(north)))


def _box(shape: tuple[int, int], found: FoundPlace, survey: Survey) -> Floats:
    """Return what the posed raster covers, and a little more, in units of the CRS."""
    height, width = (n * survey.frame.cell_m for n in shape)
    c, s = abs(np.cos(found.best.pose.yaw)), abs(np.sin(found.best.pose.yaw))
    half = np.array([c * width + s * height, s * width + c * height]) / 2
    half = half + np.maximum(2 * CUT_SHARE * half, LEAST_CUT_M)
    return np.stack([found.place - half, found.place + half]) / survey.frame.unit_m
