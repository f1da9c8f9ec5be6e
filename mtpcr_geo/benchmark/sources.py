"""Where the benchmark's pairs come from: each source of data as folders of pairs, made once and kept."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mtpcr_geo.benchmark.pairs import write_folder
from mtpcr_geo.benchmark.simulator.kinds import KINDS, Kind
from mtpcr_geo.benchmark.simulator.pairs import simulate_pair, write_pair
from mtpcr_geo.core import transforms
from mtpcr_geo.core.cloud import ArrayCloud
from mtpcr_geo.core.errors import InputError, OptionError
from mtpcr_geo.core.progress import NoProgress

if TYPE_CHECKING:
    from mtpcr_geo.core.progress import Progress


def simulated(
    folder: Path,
    count: int,
    *,
    kinds: Sequence[str] = KINDS,
    overlaps: Sequence[float] = (0.18,),
    seed: int = 0,
    progress: Progress | None = None,
    **options: Any,
) -> list[Path]:
    """Simulate pairs, one after another of each kind, each at every overlap.

    Args:
        folder: where to; pairs that are there are kept.
        count: sites.
        kinds: taken in turn.
        overlaps: shares aimed at on both sides, 0.01 to 0.8; the same sites at each.
        seed: of the first site; the others count on.
        progress: where to report pairs.
        options: of `simulate_pair`.

    Raises:
        OptionError: if an option is out of its range.

    """
    if count < 1:
        raise OptionError(f"{count} pairs to simulate; there must be at least one")
    out = []
    with (progress or NoProgress()).task("simulating pairs", count * len(overlaps)) as advance:
        for number in range(count):
            kind: Kind = kinds[number % len(kinds)]  # type: ignore[assignment]
            for overlap in overlaps:
                place = Path(folder) / f"{kind}_{seed + number}_overlap{100 * overlap:g}"
                if not (place / "pair.json").exists():
                    write_pair(
                        place, simulate_pair(kind, seed + number, overlap=overlap, **options), overwrite=True
                    )
                out.append(place)
                advance(1)
    return out


def stood_in(
    folder: Path, only: Sequence[str] = (), *, density: float = 1.0, progress: Progress | None = None
) -> list[Path]:
    """Simulate the stand-ins of the paper's fourteen combinations.

    Args:
        folder: where to; those that are there are kept.
        only: such as "A03-G05"; all if empty.
        density: share of the usual number of beams.
        progress: where to report pairs.

    Raises:
        OptionError: if none is named so, or one there was made otherwise.

    """
    from mtpcr_geo.benchmark.standins import stand_ins, write_stand_in

    chosen = [one for one in stand_ins() if not only or any(word in one.name for word in only)]
    if not chosen:
        raise OptionError(f"no stand-in is named like {', '.join(only)}")
    with (progress or NoProgress()).task("simulating stand-ins", len(chosen)) as advance:
        out = []
        for one in chosen:
            out.append(write_stand_in(folder, one, density=density))
            advance(1)
    return out


def from_graco(
    folder: Path,
    root: Path,
    only: Sequence[str] = (),
    *,
    voxel_m: float = 0.1,
    progress: Progress | None = None,
) -> list[Path]:
    """Read the paper's combinations from GrAco's bags, as far as they are there.

    Args:
        folder: where the pairs go; those that are there are kept.
        root: folder of the bags and calibrations, see `mtpcr_geo.benchmark.graco`.
        only: such as "A03-G05"; all if empty.
        voxel_m: thinning of the clouds, metres.
        progress: where to report pairs.

    Raises:
        InputError: if no combination has both its bags.

    """
    from mtpcr_geo.benchmark import graco

    chosen = [c for c in graco.combinations() if not only or any(word in c.name for word in only)]
    clouds: dict[str, transforms.Points] = {}
    out: list[Path] = []
    missing: list[str] = []

    def cloud_of(name: str) -> transforms.Points:
        if name not in clouds:
            bag = graco.find_sequence(root, name)
            T_imu_lidar = graco.read_calibration(graco.find_calibration(root, name))
            clouds[name] = graco.read_sequence(bag, T_imu_lidar, voxel_m=voxel_m)
        return clouds[name]

    with (progress or NoProgress()).task("reading GrAco", len(chosen)) as advance:
        for pair in chosen:
            place = Path(folder) / f"graco_{pair.name}"
            if not (place / "pair.json").exists():
                try:
                    for name in (pair.source, pair.target):
                        graco.find_sequence(root, name)
                except InputError as error:
                    missing.append(str(error))
                    advance(1)
                    continue
                source, target = cloud_of(pair.source), cloud_of(pair.target)
                _write_common_frame(place, source, target, pair.group, (pair.source, pair.target))
            out.append(place)
            advance(1)
    if not out:
        raise InputError(f"no combination has both its bags below {root}; {missing[0] if missing else ''}")
    return out


def _write_common_frame(
    place: Path, source: transforms.Points, target: transforms.Points, group: str, names: tuple[str, str]
) -> None:
    extent = np.ptp(np.vstack([source, target]), axis=0).round(2).tolist()
    facts = {
        "id": place.name,
        "crs": "local: east, north, up about the dataset's base station (metres)",
        "ground_truth": {
            "T_target_from_source": np.eye(4).tolist(),
            "kind": "identity: both clouds are in the dataset's common frame",
        },
        "benchmark": {"group": group, "source": names[0], "target": names[1], "extent_m": extent},
    }
    clouds = ArrayCloud(source, None, "source"), ArrayCloud(target, None, "target")
    write_folder(place, *clouds, facts, overwrite=True)
