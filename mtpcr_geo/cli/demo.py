"""The demonstration: a small simulated town, scanned from a street and from the air, and registered.

The ground cloud is turned by any yaw, tilted and shifted, so the truth is known and the result can be
judged by it.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mtpcr_geo.benchmark.metrics import PoseErrors, pose_errors
from mtpcr_geo.benchmark.simulator.pairs import SimulatedPair, describe, simulate_pair, write_laz
from mtpcr_geo.core.progress import NoProgress
from mtpcr_geo.io.outputs import OutputSet

if TYPE_CHECKING:
    from mtpcr_geo.core.progress import Progress
    from mtpcr_geo.registration import Registration

GROUND, AERIAL, TRUTH, RESULT = "ground.laz", "aerial.laz", "truth.json", "result"


@dataclass(frozen=True)
class Demo:
    """What a demonstration came to.

    Attributes:
        registration: the run.
        errors: its errors against the truth, or None where no transform was found.
        summary: the errors and what to open, in a few lines.
        files: the simulated files, by what they are.

    """

    registration: Registration
    errors: PoseErrors | None
    summary: str
    files: dict[str, Path]


def run_demo(
    out: str | Path,
    *,
    seed: int = 0,
    overwrite: bool = False,
    progress: Progress | None = None,
    **options: Any,
) -> Demo:
    """Simulate, write ``ground.laz``, ``aerial.laz`` and ``truth.json`` into `out`, and register them.

    The registration's own files go into the folder ``result`` in `out`.

    Args:
        out: folder; made if it is not there.
        seed: of the town, its scanners and the transform.
        overwrite: whether files that are there may be replaced.
        progress: where long work reports.
        options: further options of the registration.

    Raises:
        MtpcrError: if a file exists already, the folder cannot be written, or Open3D is missing.

    """
    from mtpcr_geo.registration import register

    progress = progress or NoProgress()
    folder = Path(out)
    with OutputSet(overwrite) as outputs:
        files = {name: folder / name for name in (GROUND, AERIAL, TRUTH)}
        parts = {name: outputs.path(path) for name, path in files.items()}
        with progress.task("simulating a town", 4) as advance:
            pair = simulate_town(seed)
            advance(2)
            write_laz(parts[GROUND], pair.source)
            advance(1)
            write_laz(parts[AERIAL], pair.target)
            advance(1)
        truth = describe(pair, (GROUND, AERIAL))
        parts[TRUTH].write_text(json.dumps(truth, indent=1) + "\n", "utf-8")
        outputs.commit()
    # the ground cloud is in a frame of its own: nothing of the truth is told to the registration
    registration = register(
        files[GROUND],
        files[AERIAL],
        folder / RESULT,
        progress=progress,
        **{"source_crs": "local", "overwrite": overwrite, **options},
    )
    errors = None
    if registration.T_target_source is not None:
        sample = pair.source.xyz[:: max(1, pair.source.count // 20_000)]
        centre = (pair.target.minimum + pair.target.maximum) / 2
        errors = pose_errors(registration.T_target_source, pair.T_target_source, sample, centre)
    return Demo(registration, errors, _summary(pair, registration, errors, folder), files)


def simulate_town(seed: int) -> SimulatedPair:
    """Make the demonstration's two clouds: a few blocks of a town, with about a quarter of each shared."""
    tilt = float(np.random.default_rng([seed, 3]).uniform(2.0, 6.0))
    return simulate_pair(
        "town",
        seed,
        extent_m=240.0,
        overlap=0.25,
        tilt_deg=tilt,
        air_density=6.0,
        ground_beams=1_000_000,
        voxel_m=0.15,
    )


def _summary(pair: SimulatedPair, registration: Registration, errors: PoseErrors | None, folder: Path) -> str:
    lines = [
        f"{pair.description.capitalize()}.",
        f"The clouds share {pair.overlap_source:.0%} of the ground cloud's cells and "
        f"{pair.overlap_target:.0%} of the aerial one's; the ground cloud is tilted by "
        f"{pair.options['tilt_deg']:.1f} degrees, turned and shifted.",
    ]
    if errors is None:
        lines.append("No transform was found.")
    else:
        lines.append(
            f"Against the known truth: rotation {errors.rotation_deg:.3f} degrees; the ground cloud's "
            f"centroid {errors.plan_m:.2f} m in plan and {errors.height_m:+.2f} m in height."
        )
    written = registration.outputs
    if "registered" in written:
        lines.append(f"Open in QGIS: {written['registered']} over {folder / AERIAL}")
    if "recording" in written:
        lines.append(f"Replay the run: rerun {written['recording']}")
    if "report" in written:
        lines.append(f"Read: {written['report']}")
    return "\n".join(lines)
