"""What the options of a prior say about a pair: read, brought to work coordinates, checked."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.errors import CrsError, OptionError
from mtpcr_geo.core.frames import fit_affine
from mtpcr_geo.core.prior import KnownPlace, PriorSource
from mtpcr_geo.core.types import Pair
from mtpcr_geo.crs.chain import TransformChain
from mtpcr_geo.crs.facts import same_place
from mtpcr_geo.crs.near import check_reach, distance_to_box, place_in_work, rim_of
from mtpcr_geo.pipeline.options import PriorOptions
from mtpcr_geo.pipeline.stages.pairs import georeference

if TYPE_CHECKING:
    from mtpcr_geo.match.prior import Prior

SCALE_TOLERANCE = 0.01
"""Departure from a rigid transform that a map's scale, rounding or a fit to other points explain."""
FOOT_M = 0.3048
MOST_TILT_DEG = 30.0
HEIGHT_POINTS = 50


def known_place(options: PriorOptions, pair: Pair, label: str) -> KnownPlace | None:
    """Return what the options say of the source's place and yaw, in work coordinates; None if nothing.

    Args:
        options: checked to go together.
        pair: both clouds, with samples and levelling.
        label: the stage, for messages.

    Raises:
        OptionError: if they cannot be true of these clouds.
        InputError: if a file cannot be read.
        CrsError: if a CRS does not allow it.

    """
    middle = pair.source.sample.mean(axis=0)
    if options.knows_pose:
        return _posed(options, pair, label, middle)
    yaw = None if options.yaw is None else float(np.radians(options.yaw))
    yaw_within = None if yaw is None else float(np.radians(options.yaw_within_deg))
    if options.near is None:
        return None if yaw is None else KnownPlace("yaw", middle, yaw=yaw, yaw_within=yaw_within)
    link = pair.target.link
    place = place_in_work(options.near, options.near_crs, link)
    place[2] = _height_at(place, pair.target.sample)
    rim = rim_of(pair.source.sample, middle)
    within = rim if options.within_m is None else options.within_m
    check_reach(place, within, rim, _bounds(pair), options.near, link, options.near_crs is not None)
    return KnownPlace("near", middle, place, within, yaw, yaw_within)


def prior_of(known: KnownPlace, pair: Pair) -> Prior:
    """Return what is known as the search takes it: between levelled clouds."""
    from mtpcr_geo.match.prior import Prior

    pivot = transforms.apply(pair.source.T_level_work, known.middle[None])[0]
    yaw, place = None, None
    if known.T is not None:
        yaw = transforms.yaw_of(pair.levelled(known.T)[:3, :3])
    elif known.yaw is not None:
        yaw = _levelled_yaw(known.yaw, pair)
    if known.place is not None:
        east, north, _ = transforms.apply(pair.target.T_level_work, known.place[None])[0]
        place = (float(east), float(north))
    return Prior(
        (float(pivot[0]), float(pivot[1])),
        place,
        np.inf if known.within_m is None else known.within_m,
        yaw,
        np.pi if known.yaw_within is None else known.yaw_within,
    )


def audit_of(known: KnownPlace, pair: Pair) -> dict[str, object]:
    """Return what is known for the report: places in the coordinates of the files, angles in degrees."""
    source, target = pair.source.link, pair.target.link
    facts: dict[str, object] = {
        "given_by": known.given_by,
        "middle_of_source": source.to_file(known.middle[None])[0].tolist(),
    }
    if known.place is not None:
        facts["place"] = target.to_file(known.place[None])[0, :2].tolist()
        facts["within_m"] = known.within_m
    if known.yaw is not None and known.yaw_within is not None:
        facts["yaw_deg"] = float(np.degrees(known.yaw))
        facts["yaw_tolerance_deg"] = float(np.degrees(known.yaw_within))
    return facts


def _posed(options: PriorOptions, pair: Pair, label: str, middle: Floats) -> KnownPlace:
    """Return a whole pose, with its uncertainty."""
    kind: PriorSource
    if options.prior == "georef":
        kind, name, hint = "georef", "--prior georef", "search without it"
        T = georeference(pair, label)
    else:
        kind = "file" if options.prior_file is not None else "matrix"
        name = f"--prior {options.prior_file or 'matrix'}"
        hint = "see that it takes coordinates of the source's file to those of the target's"
        T = _T_of(options, pair, name, middle)
    place = transforms.apply(T, middle[None])[0]
    within, rim = options.within_m, rim_of(pair.source.sample, middle)
    assert within is not None
    gap = distance_to_box(place, _bounds(pair))
    if gap > within + rim:
        far = f"{gap / 1000:,.1f} km" if gap >= 1000 else f"{gap:.0f} m"
        raise OptionError(
            f"{name} puts the middle of the source {far} outside the target, and the source reaches only "
            f"{within + rim:.0f} m from there; {hint}"
        )
    R = pair.levelled(T)[:3, :3]
    tilt = float(np.degrees(np.arccos(np.clip(R[2, 2], -1.0, 1.0))))
    if tilt > MOST_TILT_DEG:
        raise OptionError(
            f"{name} tilts the source by {tilt:.0f} degrees against its vertical, and clouds are compared "
            "from above; turn the source upright first (z up), and give the prior for that"
        )
    yaw_within = float(np.radians(options.yaw_within_deg))
    return KnownPlace(kind, middle, place, within, transforms.yaw_of(T[:3, :3]), yaw_within, T)


def _T_of(options: PriorOptions, pair: Pair, name: str, middle: Floats) -> Floats:
    """Return the rigid 4x4 between work coordinates of a file or a matrix, about the source's middle.

    Raises:
        OptionError: if it is not rigid, or leads elsewhere.
        InputError: if it cannot be read.

    """
    from mtpcr_geo.export.prior_file import matrix_of, read_pose

    file = options.prior_file
    pose = matrix_of(options.prior, "the matrix") if file is None else read_pose(file)
    if isinstance(pose, TransformChain):
        _check_crs(pose, pair, name)
        move = pose.forward
    else:
        T_file = pose

        def move(xyz: Floats) -> Floats:
            return transforms.apply(T_file, xyz)

    source, target = pair.source.link, pair.target.link
    half = np.maximum(np.ptp(pair.source.sample, axis=0) / 2, 1.0)

    def in_work(xyz: Floats) -> Floats:
        return target.to_work(move(source.to_file(xyz)))

    try:
        A = fit_affine(in_work, np.stack([middle - half, middle + half]))[0][:3, :3]
        moved = in_work(middle[None])[0]
    except CrsError as error:
        raise OptionError(
            f"{name} leads out of the area of the target's CRS; see that it takes coordinates of the "
            "source's file to those of the target's"
        ) from error
    R = _rotation(A, name)
    return transforms.compose(R, moved - R @ middle)


def _rotation(A: Floats, name: str) -> Floats:
    """Return the rotation of a (3, 3) linear part between metric frames.

    Raises:
        OptionError: if it is no rotation, with what it is.

    """
    scales = np.linalg.svd(A, compute_uv=False)
    low, high = float(scales[-1]), float(scales[0])
    if low < 1e-6 * max(high, 1e-300):
        raise OptionError(
            f"{name} is no rigid transform: it flattens the source; give a rotation and a shift"
        )
    if np.linalg.det(A) < 0:
        raise OptionError(
            f"{name} is no rigid transform: it mirrors the source; exchange its axes back, or mirror the "
            "source first"
        )
    if max(high - 1.0, 1.0 - low) > SCALE_TOLERANCE:
        if high / low > 1.0 + 2.0 * SCALE_TOLERANCE:
            raise OptionError(
                f"{name} is no rigid transform: it stretches the source by {low:.4g} to {high:.4g} by "
                "direction; give a rotation and a shift"
            )
        scale = float(np.sqrt(low * high))
        feet = min(abs(scale / one - 1.0) for one in (FOOT_M, 1.0 / FOOT_M)) < SCALE_TOLERANCE
        what = (
            "one of the clouds seems to be in feet: name its CRS"
            if feet
            else "give a rotation and a shift, and scale the source first if its unit is another"
        )
        raise OptionError(f"{name} is no rigid transform: it scales the source by {scale:.5g}; {what}")
    return transforms.orthonormal(A)


def _check_crs(chain: TransformChain, pair: Pair, name: str) -> None:
    for role, known, link in (
        ("source", chain.source.file_crs, pair.source.link),
        ("target", chain.target.file_crs, pair.target.link),
    ):
        crs = link.file_crs
        if known is not None and crs is not None and not same_place(known, crs):
            raise OptionError(
                f"{name} was found for a {role} in {known.name}, and this one is in {crs.name}; give a 4x4 "
                "between the coordinates of these files"
            )


def _levelled_yaw(yaw: float, pair: Pair) -> float:
    """Return the yaw between levelled clouds for which that between work coordinates is ``yaw``."""
    R_source, R_target = pair.source.T_level_work[:3, :3], pair.target.T_level_work[:3, :3]
    found = yaw
    for _ in range(10):
        gap = yaw - transforms.yaw_of(R_target.T @ transforms.yaw_matrix(found) @ R_source)
        found += float(np.arctan2(np.sin(gap), np.cos(gap)))
    return found


def _height_at(place: Floats, target: Floats) -> float:
    """Return the height of the target's sample at a place in plan: the median of the points nearest to it."""
    squared = (target[:, 0] - place[0]) ** 2 + (target[:, 1] - place[1]) ** 2
    count = min(HEIGHT_POINTS, len(target))
    return float(np.median(target[np.argpartition(squared, count - 1)[:count], 2]))


def _bounds(pair: Pair) -> Floats:
    return np.stack(transforms.bounds(pair.target.sample))
