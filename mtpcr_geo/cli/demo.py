"""The demonstration: a small simulated town, scanned from a street and from the air, and registered.

The clouds ship with the package (``demo_clouds``). The ground cloud is turned, tilted and shifted, so the
truth is known and the result is compared with it.
"""

from __future__ import annotations

import json
import shutil
from dataclasses import dataclass
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.progress import NoProgress
from mtpcr_geo.io.outputs import OutputSet

if TYPE_CHECKING:
    from mtpcr_geo.core.progress import Progress
    from mtpcr_geo.registration import Registration

GROUND, AERIAL, TRUTH, RESULT = "ground.laz", "aerial.laz", "truth.json", "result"


@dataclass(frozen=True)
class Truth:
    """What is known of the demonstration's clouds.

    Attributes:
        T_target_source: 4x4, ground file coordinates to aerial file coordinates, metres.
        source_centroid: (3,) in ground file coordinates, metres.
        overlap_source, overlap_target: share of each cloud's 1 m cells that lie within a cell of the other.
        tilt_deg: of the ground cloud, degrees.
        description: of the site and the scanners.

    """

    T_target_source: Floats
    source_centroid: Floats
    overlap_source: float
    overlap_target: float
    tilt_deg: float
    description: str


@dataclass(frozen=True)
class Errors:
    """How far a transform is from the truth.

    Attributes:
        rotation_deg: angle between the two rotations, degrees.
        plan_m: distance in plan between the ground cloud's centroid as placed and as it should be, metres.
        height_m: its height as placed minus as it should be, metres.

    """

    rotation_deg: float
    plan_m: float
    height_m: float


@dataclass(frozen=True)
class Demo:
    """What a demonstration came to.

    Attributes:
        registration: the run.
        errors: its errors against the truth, or None where no transform was found.
        summary: the errors and what to open, in a few lines.
        files: the clouds and the truth, by file name.

    """

    registration: Registration
    errors: Errors | None
    summary: str
    files: dict[str, Path]


def run_demo(
    out: str | Path, *, overwrite: bool = False, progress: Progress | None = None, **options: Any
) -> Demo:
    """Write ``ground.laz``, ``aerial.laz`` and ``truth.json`` into `out`, and register the two clouds.

    The registration's own files go into the folder ``result`` in `out`.

    Args:
        out: folder; made if it is not there.
        overwrite: whether files that are there may be replaced.
        progress: where long work reports.
        options: further options of the registration.

    Raises:
        MtpcrError: if a file exists already, or the folder cannot be written.

    """
    from mtpcr_geo.registration import register

    progress = progress or NoProgress()
    folder = Path(out)
    shipped = resources.files("mtpcr_geo.cli") / "demo_clouds"
    files = {name: folder / name for name in (GROUND, AERIAL, TRUTH)}
    with OutputSet(overwrite) as outputs:
        for name, path in files.items():
            with (shipped / name).open("rb") as source, outputs.path(path).open("wb") as copy:
                shutil.copyfileobj(source, copy)
        outputs.commit()
    # the ground cloud is in a frame of its own: nothing of the truth is given to the registration
    registration = register(
        files[GROUND],
        files[AERIAL],
        folder / RESULT,
        progress=progress,
        **{"source_crs": "local", "overwrite": overwrite, **options},
    )
    truth = read_truth(files[TRUTH])
    errors = None
    if registration.T_target_source is not None:
        errors = errors_of(registration.T_target_source, truth)
    return Demo(registration, errors, _summary(truth, registration, errors, folder), files)


def read_truth(path: Path) -> Truth:
    """Read ``truth.json``, as the simulator writes it."""
    facts = json.loads(path.read_text(encoding="utf-8"))
    return Truth(
        T_target_source=np.array(facts["ground_truth"]["T_target_from_source"], np.float64),
        source_centroid=np.array(facts["source"]["centroid"], np.float64),
        overlap_source=float(facts["overlap"]["source_cells_near_target"]),
        overlap_target=float(facts["overlap"]["target_cells_near_source"]),
        tilt_deg=float(facts["simulation"]["tilt_deg"]),
        description=str(facts["kind"]),
    )


def errors_of(T_target_source: Floats, truth: Truth) -> Errors:
    """Return the errors of a 4x4 transform, ground file coordinates to aerial file coordinates, metres."""
    R, R_true = T_target_source[:3, :3], truth.T_target_source[:3, :3]
    placed, expected = (
        transforms.apply(T, truth.source_centroid) for T in (T_target_source, truth.T_target_source)
    )
    x, y, z = placed - expected
    rotation = np.degrees(transforms.rotation_angle(R @ R_true.T))
    return Errors(float(rotation), float(np.hypot(x, y)), float(z))


def _summary(truth: Truth, registration: Registration, errors: Errors | None, folder: Path) -> str:
    lines = [
        f"{truth.description.capitalize()}.",
        f"The clouds share {truth.overlap_source:.0%} of the ground cloud's cells and "
        f"{truth.overlap_target:.0%} of the aerial one's; the ground cloud is tilted by "
        f"{truth.tilt_deg:.1f} degrees, turned and shifted.",
    ]
    if errors is None:
        lines.append("No transform was found.")
    else:
        lines.append(
            f"Against the known truth: rotation {errors.rotation_deg:.3f} degrees; the ground cloud's "
            f"centroid {errors.plan_m:.2f} m in plan and {errors.height_m:+.2f} m in height."
        )
    written = registration.outputs
    if "project" in written:
        lines.append(f"Open in QGIS: {written['project']}")
    if "recording" in written:
        lines.append(f"Replay the run: mtpcr-geo review {folder / RESULT}")
    if "report" in written:
        lines.append(f"Read: {written['report']}")
    return "\n".join(lines)
