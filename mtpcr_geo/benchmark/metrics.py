"""How far a registration is from the truth: pure functions on 4x4 transforms and points.

`T` is the result, `T_true` the truth; both take source coordinates to target coordinates in metres.
`dT = T inverse(T_true)` acts on target coordinates. The paper's ``e_t = ||dt||`` depends on where the
origin lies: a thousandth of a degree at an origin 5,000 km away is 87 m. It is therefore always taken
in a frame whose origin is a point at the target, named in the call.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mtpcr_geo.benchmark.simulator.overlap import near_shares, occupied_cells
from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats


@dataclass(frozen=True)
class PoseErrors:
    """The errors of one registration.

    Attributes:
        rotation_deg: e_r, degrees.
        translation_m: e_t, metres, in a frame centred on the target cloud.
        plan_m: distance in plan between the source's centroid as placed and as it should be, metres.
        height_m: its height as placed minus as it should be, metres (signed).
        rmsd_m: the paper's RMSD: the *mean* distance between the source as placed and as it should be.
        rms_m: the root mean square of the same distances.

    """

    rotation_deg: float
    translation_m: float
    plan_m: float
    height_m: float
    rmsd_m: float
    rms_m: float

    def within(self, rotation_deg: float = 5.0, translation_m: float = 2.0) -> bool:
        """Return whether the run counts as a success: e_r and e_t below the thresholds (the paper's SRR)."""
        return self.rotation_deg < rotation_deg and self.translation_m < translation_m


def rotation_error_deg(T: Floats, T_true: Floats) -> float:
    """Return e_r in degrees: ``arccos((trace(dR) - 1) / 2)``, by a form exact for tiny angles."""
    return float(np.rad2deg(transforms.rotation_angle(T[:3, :3] @ T_true[:3, :3].T)))


def translation_error(T: Floats, T_true: Floats, target_centre: Floats) -> float:
    """Return e_t in metres: ``||dt||`` of ``dT = T inverse(T_true)`` in a frame centred on the target.

    Args:
        T: 4x4 result.
        T_true: 4x4 truth.
        target_centre: (3,) centre of the target cloud, in target coordinates.

    """
    centre = np.asarray(target_centre, np.float64)
    # dT (centre) - centre, by way of the source, so that no far origin is ever rotated about
    in_source = T_true[:3, :3].T @ (centre - T_true[:3, 3])
    return float(np.linalg.norm(T[:3, :3] @ in_source + T[:3, 3] - centre))


def centroid_errors(T: Floats, T_true: Floats, source_centroid: Floats) -> tuple[float, float]:
    """Return the errors of the source's centroid: distance in plan, and signed height, in metres.

    Args:
        T: 4x4 result.
        T_true: 4x4 truth.
        source_centroid: (3,) in source coordinates.

    """
    step = _steps(T, T_true, np.asarray(source_centroid, np.float64)[None])[0]
    return float(np.hypot(step[0], step[1])), float(step[2])


def rmsd(T: Floats, T_true: Floats, source: Floats) -> float:
    """Return the paper's RMSD in metres: the mean distance between the source moved by T and by T_true.

    The paper names it a root mean square and defines it as a mean; this is the definition. The root
    mean square is `rms`.

    Args:
        T: 4x4 result.
        T_true: 4x4 truth.
        source: (n, 3) source coordinates, n at least 1.

    """
    return float(np.linalg.norm(_steps(T, T_true, source), axis=1).mean())


def rms(T: Floats, T_true: Floats, source: Floats) -> float:
    """Return the root mean square distance in metres between the source moved by T and by T_true.

    Args:
        T: 4x4 result.
        T_true: 4x4 truth.
        source: (n, 3) source coordinates, n at least 1.

    """
    return float(np.sqrt((_steps(T, T_true, source) ** 2).sum(axis=1).mean()))


def pose_errors(T: Floats, T_true: Floats, source: Floats, target_centre: Floats) -> PoseErrors:
    """Gather all errors of a registration.

    Args:
        T: 4x4 result.
        T_true: 4x4 truth.
        source: (n, 3) source coordinates (a sample will do), n at least 1.
        target_centre: (3,) centre of the target cloud, in target coordinates.

    """
    plan, height = centroid_errors(T, T_true, np.asarray(source, np.float64).mean(axis=0))
    return PoseErrors(
        rotation_error_deg(T, T_true),
        translation_error(T, T_true, target_centre),
        plan,
        height,
        rmsd(T, T_true, source),
        rms(T, T_true, source),
    )


def overlap_ratios(source_in_target: Floats, target: Floats, cell: float = 1.0) -> tuple[float, float]:
    """Return the share of each cloud's occupied cells that have an occupied cell of the other near them.

    Seen from above; near is the cell itself or one of its eight neighbours, so at most about 1.4 cells
    (centre to centre). Both clouds in one frame.

    Args:
        source_in_target: (n, 2 or 3) source points, moved to the target, metres.
        target: (m, 2 or 3) target points, metres.
        cell: edge of a cell, metres.

    Returns:
        The source's share and the target's share, 0..1.

    """
    return near_shares(
        occupied_cells(np.asarray(source_in_target)[:, :2], cell),
        occupied_cells(np.asarray(target)[:, :2], cell),
    )


def _steps(T: Floats, T_true: Floats, source: Floats) -> Floats:
    """Return (n, 3) metres from where each source point should be to where it was placed.

    The difference of the matrices acts about the source's centroid, so that far coordinates cancel
    before they are multiplied.
    """
    source = np.asarray(source, np.float64)
    centre = source.mean(axis=0)
    at_centre = (T[:3, :3] @ centre + T[:3, 3]) - (T_true[:3, :3] @ centre + T_true[:3, 3])
    return np.asarray((source - centre) @ (T[:3, :3] - T_true[:3, :3]).T + at_centre)
