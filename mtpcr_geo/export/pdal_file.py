"""A registration's result as a PDAL pipeline, which writes what ``registered.laz`` holds."""

from __future__ import annotations

import os
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.cloud import Cloud
from mtpcr_geo.core.paths import real
from mtpcr_geo.crs.chain import TransformChain
from mtpcr_geo.export.transform import dumps
from mtpcr_geo.io.file_cloud import FileCloud
from mtpcr_geo.io.las import LasCloud
from mtpcr_geo.io.layout import MODERN_FORMAT
from mtpcr_geo.io.write import scales_of

if TYPE_CHECKING:
    from mtpcr_geo.core.frames import FrameLink
    from mtpcr_geo.core.types import Pair
_PDAL_TYPES = {"i": "int", "u": "uint", "f": "float"}


def write_pdal_pipeline(path: str | Path, pair: Pair, folder: str | Path | None = None) -> None:
    """Write a PDAL pipeline that moves the source as the chain does, and writes LAS 1.4.

    The point format is that of ``registered.laz``, so that every dimension keeps its values. Of the point
    formats 0-5, class 12 (overlap) does not set the flag of that name, and PDAL before 2.6 leaves the other
    flags in the class. The source is named as seen from the folder in which the pipeline lies: run it there.

    Args:
        path: file to write.
        pair: with a transform.
        folder: where the pipeline will lie; that of `path` if not given.

    """
    chain = TransformChain.of(pair)
    cloud = pair.source.cloud
    stages: list[dict[str, Any]] = [_reader(cloud, Path(path).parent if folder is None else Path(folder))]
    if chain.is_affine:
        stages.append(_moving(chain.T_file))
    else:
        inner = transforms.translation(chain.target.origin) @ chain.T_target_source
        stages += _through(chain.source, inverse=False)
        stages.append(_moving(inner @ transforms.translation(-chain.source.origin)))
        stages += _through(chain.target, inverse=True)
    stages.append(_writer(cloud, chain))
    Path(path).write_text(dumps({"pipeline": stages}) + "\n", encoding="utf-8")


def _reader(cloud: Cloud, folder: Path) -> dict[str, Any]:
    if not isinstance(cloud, LasCloud):
        # PDAL finds the reader of another format by the file's ending
        if isinstance(cloud, FileCloud):
            return {"filename": _seen_from(folder, cloud.path)}
        return {"type": "readers.las", "filename": cloud.name}
    reader: dict[str, Any] = {"type": "readers.las", "filename": _seen_from(folder, cloud.path)}
    if cloud.extra.descriptors:
        reader["use_eb_vlr"] = True  # without it PDAL leaves extra bytes out
    return reader


def _seen_from(folder: Path, path: Path) -> str:
    try:
        return Path(os.path.relpath(real(path), real(folder))).as_posix()
    except ValueError:  # on another drive
        return real(path).as_posix()


def _writer(cloud: Cloud, chain: TransformChain) -> dict[str, Any]:
    crs = chain.target.file_crs
    scales = scales_of(cloud, crs)
    # whole units, as in registered.laz, so that both round to the same steps
    offsets = np.rint(chain.forward(chain.pivot[None])[0])
    point_format = cloud.header.point_format.id if isinstance(cloud, LasCloud) else 6
    # PDAL before 2.5 cannot compress classes from 32 on, which only the point formats from 6 on have
    suffix = "las" if isinstance(cloud, LasCloud) and point_format >= 6 else "laz"
    writer: dict[str, Any] = {
        "type": "writers.las",
        "filename": f"{Path(cloud.name).stem}_registered.{suffix}",
        "minor_version": 4,
        "dataformat_id": MODERN_FORMAT.get(point_format, point_format),
        "forward": "vlr,global_encoding,filesource_id",
        **{f"scale_{axis}": float(step) for axis, step in zip("xyz", scales, strict=True)},
        **{f"offset_{axis}": float(offset) for axis, offset in zip("xyz", offsets, strict=True)},
    }
    extra = _extra_dims(cloud)
    if extra:
        writer["extra_dims"] = extra
    if suffix == "laz":
        writer["compression"] = True
    if crs is not None:
        writer["a_srs"] = crs.to_wkt()
    return writer


def _extra_dims(cloud: Cloud) -> str:
    """Return the extra dimensions as PDAL's writer takes them; "" if there are none.

    Named one by one, since by "all" PDAL before 2.6 makes the flags of the points an extra dimension too.
    """
    if not isinstance(cloud, LasCloud):
        return "all"
    described = [one for one in cloud.point_format.extra_dimensions if one.num_elements == 1]
    if len(described) < len(list(cloud.point_format.extra_dimensions)):
        return "all" if cloud.extra.descriptors else ""
    named = []
    for dimension in described:
        kind = np.dtype(np.float64) if dimension.is_scaled else np.dtype(dimension.dtype)
        named.append(f"{dimension.name}={_PDAL_TYPES[kind.kind]}{8 * kind.itemsize}")
    return ",".join(named).replace("float32", "float").replace("float64", "double")


def _through(link: FrameLink, inverse: bool) -> Sequence[dict[str, Any]]:
    """Return the stages from file to unshifted work coordinates, or back."""
    stages: list[dict[str, Any]] = []
    if link.pipeline is not None:
        stages.append({"type": "filters.projpipeline", "coord_op": link.pipeline})
        if inverse:
            stages[0]["reverse_transfo"] = True
    A = np.eye(4)
    A[:3, :3] = link.metric(np.eye(3)).T
    if not np.array_equal(A, np.eye(4)):
        stages.insert(0 if inverse else len(stages), _moving(np.asarray(np.linalg.inv(A) if inverse else A)))
    return stages


def _moving(T: Floats) -> dict[str, Any]:
    matrix = " ".join(f"{value:.17g}" for value in T.ravel())
    return {"type": "filters.transformation", "matrix": matrix}
