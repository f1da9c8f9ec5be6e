"""Transforms as files that state their frames, at full precision."""

from __future__ import annotations

import datetime
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any, get_args

import numpy as np

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.errors import InputError
from mtpcr_geo.core.frames import FrameLink, OperationReport, Vertical
from mtpcr_geo.core.paths import read_whole
from mtpcr_geo.core.scanner import Scanner
from mtpcr_geo.core.units import Axes, Unit
from mtpcr_geo.core.wording import visible
from mtpcr_geo.crs.chain import TransformChain
from mtpcr_geo.crs.facts import facts_of
from mtpcr_geo.export.uncertainty_facts import calibrated, uncertainty_facts

if TYPE_CHECKING:
    from pyproj import CRS

    from mtpcr_geo.core.types import Pair

KIND, VERSION, TURNED = "mtpcr-geo transform", 1, 2
_SHARED_SHIFT = 10_000.0  # beyond this, single precision would show in one common shift
_EARTH_RADIUS = 6_371_000.0
_RIGID = 1e-6


def write_transform_json(path: str | Path, pair: Pair, *, forced: bool = False) -> None:
    """Write ``transform.json``: the transform in every form, and all that applying it needs.

    ``T_target_source`` acts on coordinates as they stand in the files. Where no 4x4 can do that exactly
    (a map projection lies between), it is the best fit, and ``exactness`` says by how much it is off;
    ``chain`` is exact always. ``verdict`` says whether the transform may be believed.

    Args:
        path: file to write.
        pair: with a transform.
        forced: whether files of the run are written that the verdict withholds.

    """
    chain = TransformChain.of(pair)
    work = pair.frame.crs
    T = chain.T_file
    examples = _examples(pair, chain)
    moved = chain.forward(examples)
    document: dict[str, Any] = {
        "type": KIND,
        # programs that know no axes shall not take such a file for another
        "version": VERSION if chain.source.scanner.axes == chain.target.scanner.axes == "z-up" else TURNED,
        "T_target_source": T,
        "T_source_target": np.linalg.inv(T) if not _is_rigid(T) else transforms.inverse(T),
        "verdict": _verdict(pair, forced),
        "uncertainty": uncertainty_facts(pair),
        "frame": "coordinates as they stand in the files: T takes those of the source to the target's",
        "exactness": {
            "exact": chain.is_affine,
            "departure_m": chain.departure,
            "note": "T_target_source is exactly the chain"
            if chain.is_affine
            else "T_target_source is the best fit within the source's bounds; the chain is exact",
        },
        "units": {"source": units_of(chain.source), "target": units_of(chain.target)},
        "pivot": {
            "source": chain.pivot,
            "target": chain.forward(chain.pivot[None])[0],
            "linear": T[:3, :3],
            "note": "target = linear (x - source pivot) + target pivot is precise far from the origin too",
        },
        "motion": _motion(chain),
        "work": {
            "crs": _crs(work),
            "units": "metre",
            "frame": "each side's file coordinates through its chain, less its origin",
            "source_origin": chain.source.origin,
            "target_origin": chain.target.origin,
            "T_target_source": chain.T_target_source,
            "T_source_target": chain.T_source_target,
        },
        "chain": {
            "source": {**_link(chain.source), "stated_crs": _crs(chain.source_stated)},
            "target": {**_link(chain.target), "stated_crs": _crs(chain.target_stated)},
            "source_bounds": chain.bounds,
        },
        "example": {
            "source": examples[0],
            "target": moved[0],
            "source_again": chain.inverse(moved[:1])[0],
            "by_matrix": transforms.apply(T, examples[:1])[0],
        },
        "more_examples": [{"source": a, "target": b} for a, b in zip(examples[1:], moved[1:], strict=True)],
        "cloudcompare": {key: value for key, value in cloudcompare_of(chain).items() if key != "matrix"},
        "files": {"source": Path(pair.source.cloud.name).name, "target": Path(pair.target.cloud.name).name},
    }
    Path(path).write_text(dumps(document) + "\n", encoding="utf-8")


def write_cloudcompare_matrix(path: str | Path, pair: Pair) -> None:
    """Write the 4x4 for CloudCompare: four rows of four numbers, and behind them how to use it.

    CloudCompare holds points in single precision, less a global shift. The matrix acts on points loaded
    with the shifts that stand below it, and in ``transform.json`` under ``cloudcompare``. Of a text file
    CloudCompare reads the first four lines.
    """
    found = cloudcompare_of(TransformChain.of(pair))
    rows = [" ".join(f"{value:.17g}" for value in row) for row in found["matrix"]]
    for role in ("source", "target"):
        shift = " ".join(f"{value + 0.0:.17g}" for value in found[f"{role}_global_shift"])
        rows.append(f"# {role} global shift: {shift}")
    Path(path).write_text(visible("\n".join([*rows, f"# {found['note']}"])) + "\n", encoding="utf-8")


def read_transform(path: str | Path) -> TransformChain:
    """Read a ``transform.json``.

    Raises:
        InputError: if it is missing, or not such a file.

    """
    path = Path(path)
    try:
        document = json.loads(read_whole(path))
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}; name a transform.json") from error
    except RecursionError as error:
        raise InputError(f"{path} is nested too deeply to be a transform; name a transform.json") from error
    except ValueError as error:
        raise InputError(f"{path} is not JSON ({error}); name a transform.json") from error
    if not isinstance(document, dict) or document.get("type") != KIND:
        raise InputError(f"{path} is not a transform that this program wrote; name a transform.json")
    if document.get("version") not in (VERSION, TURNED):
        raise InputError(
            f"{path} is a transform of version {document.get('version')}, and this program reads {TURNED}; "
            "update it, or register again"
        )
    try:
        chain = document["chain"]
        result = TransformChain(
            source=_read_link(chain["source"]),
            target=_read_link(chain["target"]),
            T_target_source=_array(document["work"]["T_target_source"], (4, 4)),
            pivot=_array(document["pivot"]["source"], (3,)),
            bounds=_array(chain["source_bounds"], (2, 3)),
            # older files do not have them
            source_stated=_read_crs(chain["source"].get("stated_crs")),
            target_stated=_read_crs(chain["target"].get("stated_crs")),
        )
        _check_rigid(result.T_target_source)
    except (KeyError, TypeError, ValueError, OverflowError, IndexError) as error:
        raise InputError(
            f"{path} is damaged ({type(error).__name__}: {error}); register again to write a new one"
        ) from error
    return result


def _check_rigid(T: Floats) -> None:
    """Refuse a 4x4 that no registration gives.

    Raises:
        ValueError: if it mirrors, stretches or is not finite.

    """
    R = T[:3, :3]
    with np.errstate(all="ignore"):
        rigid = np.allclose(R @ R.T, np.eye(3), rtol=0, atol=_RIGID) and np.linalg.det(R) > 0
    if not (np.isfinite(T).all() and rigid and (T[3] == [0, 0, 0, 1]).all()):
        raise ValueError("T_target_source is no rigid transform")


def verdict_of(path: str | Path) -> dict[str, Any] | None:
    """Return what a ``transform.json`` says of its verdict, name, reasons and so on; None if nothing.

    Args:
        path: the file, which `read_transform` takes.

    """
    stated = json.loads(read_whole(path)).get("verdict")
    return stated if isinstance(stated, dict) else None


def doubts_of(path: str | Path) -> str | None:
    """Return a sentence if a ``transform.json`` says that its verdict is not accepted; None if not.

    Args:
        path: the file, which `read_transform` takes.

    """
    stated = verdict_of(path)
    if stated is None or stated.get("name") in (None, "accepted"):
        return None
    reasons = stated.get("reasons")
    why = f": {reasons[0]}" if isinstance(reasons, list) and reasons else ""
    forced = " and its files were forced" if stated.get("forced") else ""
    return f"the verdict on this transform is {stated['name']}{forced}{why}"


def frames_of(pair: Pair) -> dict[str, Any]:
    """Return the CRSs and units of source, target and result, and how each comes to the work frame."""
    links = {"source": pair.source.link, "target": pair.target.link}
    links["result"] = pair.frame.output or pair.target.link
    frames: dict[str, Any] = {
        role: {"crs": _crs(link.file_crs, wkt=False), "units": units_of(link), **link.report.as_dict()}
        for role, link in links.items()
    }
    frames["work"] = {
        "crs": _crs(pair.frame.crs, wkt=False),
        "units": ["metre"] * 3,
        "source_origin": pair.source.link.origin.tolist(),
        "target_origin": pair.target.link.origin.tolist(),
    }
    return frames


def dumps(value: Any, indent: int = 0) -> str:
    """Return JSON with 17 significant digits, and the rows of a matrix in a line each."""
    pad = "  " * (indent + 1)
    if isinstance(value, np.ndarray):
        value = value.tolist()
    if isinstance(value, Mapping):
        if not value:
            return "{}"
        items = [f"{pad}{json.dumps(str(key))}: {dumps(item, indent + 1)}" for key, item in value.items()]
        return "{\n" + ",\n".join(items) + "\n" + "  " * indent + "}"
    if isinstance(value, Sequence) and not isinstance(value, str):
        if all(item is None or isinstance(item, str | int | float) for item in value):
            return "[" + ", ".join(dumps(item) for item in value) + "]"
        return (
            "[\n" + ",\n".join(pad + dumps(item, indent + 1) for item in value) + "\n" + "  " * indent + "]"
        )
    if isinstance(value, float):
        if not np.isfinite(value):
            return "null"
        text = f"{value:.17g}"
        # a number that looks like an integer would be read back as one
        return text if any(mark in text for mark in ".e") else text + ".0"
    return json.dumps(value)


def _verdict(pair: Pair, forced: bool) -> dict[str, Any] | None:
    if pair.verdict is None:
        return None
    names = ("sigma_plan_m", "sigma_height_m", "sigma_yaw_deg", "sigma_tilt_deg", "sigma_plan_far_m",
             "sigma_height_far_m")  # fmt: skip
    return {
        "name": pair.verdict.name,
        "sentence": pair.verdict.headline,
        "probability": pair.verdict.metrics.get("probability"),
        "probability_precise": pair.verdict.metrics.get("probability_precise"),
        "sigmas": {name: pair.verdict.metrics.get(name) for name in names},
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "calibrated": calibrated(pair.verdict),
        "reasons": list(pair.verdict.reasons),
        "rivals": [asdict(rival) for rival in pair.verdict.rivals],
        "forced": forced,
    }


def _is_rigid(T: Floats) -> bool:
    return bool(np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), rtol=0, atol=1e-12))


def _examples(pair: Pair, chain: TransformChain) -> Floats:
    """Return up to four points of the source, (n, 3) file coordinates, as worked examples."""
    sample = pair.source.sample
    if not len(sample):
        return chain.pivot[None]
    return chain.source.to_file(sample[np.unique(np.linspace(0, len(sample) - 1, 4).astype(int))])


def _motion(chain: TransformChain) -> dict[str, Any]:
    R = chain.T_target_source[:3, :3]
    motion: dict[str, Any] = {
        "rotation_deg": float(np.degrees(transforms.rotation_angle(R))),
        "yaw_deg": float(np.degrees(transforms.yaw_of(R))),
        "tilt_deg": float(np.degrees(np.arctan2(np.hypot(R[0, 2], R[1, 2]), R[2, 2]))),
        "note": "in the work frame; yaw counter-clockwise seen from above",
    }
    shift = chain.shift_m
    if shift is not None:
        motion["shift_of_pivot_m"] = shift
        motion["vertical"] = chain.source.report.vertical
        if chain.vertical_offset_m is not None:
            motion["vertical_offset_m"] = chain.vertical_offset_m
    return motion


def units_of(link: FrameLink) -> list[str]:
    """Return the units of x, y and z in a file."""
    facts = facts_of(link.file_crs, link.scanner)
    return [facts.unit_name, facts.unit_name, facts.height_unit_name]


def _crs(crs: CRS | None, wkt: bool = True) -> dict[str, Any] | None:
    if crs is None:
        return None
    authority = crs.to_authority()
    named = {"name": crs.name, "authority": ":".join(authority) if authority else None}
    return named | {"wkt": crs.to_wkt("WKT2_2019")} if wkt else named


def _link(link: FrameLink) -> dict[str, Any]:
    return {
        "crs": _crs(link.file_crs),
        "steps": "work = factor * turned(pipeline(file)) - origin, element by element; no pipeline means "
        "file itself, turned takes the axes to z up: of y-up (x, -z, y), of z-down (x, -y, -z)",
        "pipeline": link.pipeline,
        "axes": link.scanner.axes,
        "unit": link.scanner.unit,
        "factor": link.factor,
        "origin": link.origin,
        "bounds": link.bounds,
        "report": link.report.as_dict(),
    }


FACTOR_LIMIT, ORIGIN_LIMIT = 1e9, 1e15
"""Metres a unit, or units a metre, and coordinates beyond which a transform file is damaged."""


def _read_crs(data: Mapping[str, Any] | None) -> CRS | None:
    from pyproj import CRS
    from pyproj.exceptions import CRSError

    if data is None:
        return None
    try:
        return CRS.from_wkt(data["wkt"])
    except CRSError as error:
        raise ValueError(f"its CRS cannot be read ({error})") from error


def _read_link(data: Mapping[str, Any]) -> FrameLink:
    crs = _read_crs(data["crs"])
    pipeline = data["pipeline"]
    if pipeline is not None and not isinstance(pipeline, str):
        raise TypeError("pipeline is not text")
    origin, factor = _array(data["origin"], (3,)), _array(data["factor"], (3,))
    if not ((factor > 1.0 / FACTOR_LIMIT) & (factor < FACTOR_LIMIT)).all():
        raise ValueError(f"its factor {factor.tolist()} is that of no unit")
    if (np.abs(origin) > ORIGIN_LIMIT).any():
        raise ValueError(f"its origin {origin.tolist()} is no place")
    return FrameLink(
        file_crs=crs,
        origin=origin,
        factor=factor,
        pipeline=pipeline,
        bounds=None if data["bounds"] is None else _array(data["bounds"], (2, 3)),
        report=_read_report(data["report"]),
        georeferenced=facts_of(crs).georeferenced,
        scanner=_read_scanner(data),
    )


def _read_scanner(data: Mapping[str, Any]) -> Scanner:
    # older files have neither
    axes: Axes | None = next((one for one in get_args(Axes) if one == data.get("axes", "z-up")), None)
    unit: Unit | None = next((one for one in get_args(Unit) if one == data.get("unit")), None)
    if axes is None:
        raise ValueError(f"axes are {data.get('axes')!r}")
    return Scanner(unit, axes)


def _read_report(data: Mapping[str, Any]) -> OperationReport:
    vertical: Vertical | None = next((one for one in get_args(Vertical) if one == data["vertical"]), None)
    if vertical is None:
        raise ValueError(f"vertical is {data['vertical']!r}")
    scale = data.get("grid_scale")
    return OperationReport(
        operation=str(data["operation"]),
        accuracy_m=None if data["accuracy_m"] is None else float(data["accuracy_m"]),
        grids=tuple(str(grid) for grid in data["grids"]),
        heights=str(data["heights"]),
        vertical=vertical,
        unit_notes=tuple(str(note) for note in data["notes"]),
        grid_scale=None if scale is None else (float(scale[0]), float(scale[1])),
    )


def _array(value: Any, shape: tuple[int, ...]) -> Floats:
    array = np.asarray(value, np.float64)
    if array.shape != shape or not np.isfinite(array).all():
        raise ValueError(f"expected {shape} finite numbers")
    return array


def cloudcompare_of(chain: TransformChain) -> dict[str, Any]:
    """Return the matrix for CloudCompare, on shifted coordinates, and the shifts with which it holds."""
    source, target = _file_origin(chain.source), _file_origin(chain.target)
    if np.abs(source - target).max() < _SHARED_SHIFT:
        source = target
    T = transforms.translation(-target) @ chain.T_file @ transforms.translation(source)
    # the sums above cancel at far origins; the pivot's image is known to full precision
    T[:3, 3] = (chain.forward(chain.pivot[None])[0] - target) - T[:3, :3] @ (chain.pivot - source)
    same = bool((source == target).all())
    note = "load the source with source_global_shift and apply the matrix to it"
    if not same:
        note += "; then set its global shift to target_global_shift, keeping the local coordinates"
    return {
        "matrix": T,
        "source_global_shift": -source,
        "target_global_shift": -target,
        "note": note,
    }


def _file_origin(link: FrameLink) -> Floats:
    """Return whole file units near the link's origin."""
    return np.asarray(np.rint(link.to_file(np.zeros((1, 3)))[0]))
