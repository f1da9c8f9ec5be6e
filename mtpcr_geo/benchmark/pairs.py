"""Pairs of clouds with a known transform, as the benchmark uses them: folders on disk.

Every source of data (real surveys, the simulator, GrAco) is brought to one form: a folder with
``source.laz``, ``target.laz`` and ``pair.json``, whose ``ground_truth.T_target_from_source`` is 4x4 and
takes source file coordinates to target file coordinates. An optional ``benchmark`` object in it names the
group for the tables: ``{"group": "A-G", "source": "A03", "target": "G05"}``.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.cloud import ArrayCloud
from mtpcr_geo.core.errors import InputError
from mtpcr_geo.io.outputs import OutputSet


@dataclass(frozen=True)
class BenchmarkPair:
    """Two clouds in one local frame: metres, z up, origin at the middle of the target's bounds.

    Attributes:
        name: the folder's.
        group: which group of the tables it belongs to, such as "A-G"; "pairs" where it names none.
        source: (n, 3) where it truly lies, noise and held out points left out.
        target: (m, 3), likewise.
        origin: (3,) the frame's origin in the target's file coordinates, whole metres.
        overlap_cell_m: edge of the cells in which overlap is measured, metres.

    """

    name: str
    group: str
    source: Floats
    target: Floats
    origin: Floats
    overlap_cell_m: float


def pair_folders(data: Path, only: tuple[str, ...] = ()) -> list[Path]:
    """List the folders of pairs in a folder, by name.

    Args:
        data: folder of folders, or one pair's folder.
        only: keep those whose name contains one of these; all if empty.

    Raises:
        InputError: if there is none.

    """
    data = Path(data)
    found = [data] if (data / "pair.json").is_file() else sorted(p.parent for p in data.glob("*/pair.json"))
    if not found:
        raise InputError(f"no pair.json in {data} or its folders; name a folder of pairs")
    kept = [folder for folder in found if not only or any(word in folder.name for word in only)]
    if not kept:
        names = ", ".join(folder.name for folder in found)
        raise InputError(f"no pair in {data} is named like {', '.join(only)}; there are {names}")
    return kept


def read_facts(folder: Path) -> dict[str, Any]:
    """Read ``pair.json``.

    Raises:
        InputError: if it cannot be read or holds no transform.

    """
    path = Path(folder) / "pair.json"
    try:
        facts = json.loads(path.read_text(encoding="utf-8"))
        true_transform(facts)
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}") from error
    except (ValueError, KeyError, TypeError) as error:
        raise InputError(
            f"{path} is not a pair's description ({error!r}); it needs a 4x4 "
            "ground_truth.T_target_from_source"
        ) from error
    return dict(facts)


def true_transform(facts: dict[str, Any]) -> Floats:
    """Return the 4x4 truth in file coordinates, with a measured vertical offset between epochs put in."""
    truth = facts["ground_truth"]
    T = np.array(truth["T_target_from_source"], np.float64).reshape(4, 4)
    T[2, 3] += truth.get("measured_vertical_offset", {}).get("dz_target_minus_source_m", 0.0)
    return T


def load_pair(folder: Path) -> BenchmarkPair:
    """Read a pair, and place its source by the truth into the frame of the target.

    Raises:
        InputError: if a file is missing, damaged, empty, or not in metres.

    """
    folder = Path(folder)
    facts = read_facts(folder)
    source, target = (_points(folder / f"{role}.laz") for role in ("source", "target"))
    low, high = transforms.bounds(target)
    origin = np.floor((low + high) / 2)
    T_local_source = transforms.translation(-origin) @ true_transform(facts)
    labels = facts.get("benchmark", {})
    return BenchmarkPair(
        name=folder.name,
        group=str(labels.get("group", "pairs")),
        source=transforms.apply(T_local_source, source),
        target=target - origin,
        origin=origin,
        overlap_cell_m=float(facts.get("overlap", {}).get("cell_m", 1.0)),
    )


def write_folder(
    folder: Path, source: ArrayCloud, target: ArrayCloud, facts: dict[str, Any], *, overwrite: bool = False
) -> list[Path]:
    """Write a pair's folder: ``source.laz``, ``target.laz`` (LAS 1.4, point format 6) and ``pair.json``.

    Args:
        folder: where to; made if missing.
        source, target: the clouds.
        facts: what ``pair.json`` holds.
        overwrite: whether files there may be replaced.

    Returns:
        The paths written.

    Raises:
        OutputError: if a file exists already or the folder cannot be written.

    """
    with OutputSet(overwrite) as out:
        for name, cloud in (("source.laz", source), ("target.laz", target)):
            write_laz(out.path(folder / name), cloud)
        # the last: a folder without it is an interrupted one
        out.path(folder / "pair.json").write_text(json.dumps(facts, indent=1) + "\n", "utf-8")
        return out.commit()


def write_laz(path: Path, cloud: ArrayCloud) -> None:
    """Write a cloud held in memory as LAS 1.4 point format 6, scale 0.001, with its CRS as WKT."""
    import laspy

    header = laspy.LasHeader(point_format=6, version="1.4")
    header.scales = np.full(3, 0.001)
    header.offsets = np.floor(cloud.minimum) if cloud.count else np.zeros(3)
    header.global_encoding.wkt = True
    if cloud.crs is not None:
        header.add_crs(cloud.crs)
    las = laspy.LasData(header)
    las.xyz = cloud.xyz
    for name, field in (
        ("Intensity", "intensity"),
        ("ReturnNumber", "return_number"),
        ("NumberOfReturns", "number_of_returns"),
        ("Classification", "classification"),
        ("GpsTime", "gps_time"),
    ):
        if name in cloud.extra:
            las[field] = cloud.extra[name]
    las.write(str(path))


def _points(path: Path) -> Floats:
    from mtpcr_geo.io.las import open_cloud
    from mtpcr_geo.io.sample import surface_chunks

    cloud = open_cloud(path)
    chunks = list(surface_chunks(cloud))
    if not chunks:
        raise InputError(f"{path} holds no usable points")
    if cloud.crs is not None:
        factor = cloud.crs.axis_info[0].unit_conversion_factor if cloud.crs.axis_info else 1.0
        if cloud.crs.is_geographic or abs(factor - 1.0) > 1e-9:
            raise InputError(f"{path} is not in metres; the benchmark needs projected, metric clouds")
    return np.concatenate(chunks)
