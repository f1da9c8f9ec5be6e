"""Writing clouds as LAS 1.4, LAZ or COPC, streamed, with every dimension and extra byte kept."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path
from typing import TYPE_CHECKING, Any

import laspy
import lazrs
import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.cloud import Cloud
from mtpcr_geo.core.errors import OutputError
from mtpcr_geo.io.directions import turned_columns
from mtpcr_geo.io.foreign import append_large, restore_texts
from mtpcr_geo.io.layout import layout
from mtpcr_geo.io.storage import MOST_STEPS, MisfitError, Move, Storage, settled
from mtpcr_geo.io.views import las_below
from mtpcr_geo.io.waveform import append_waveforms

if TYPE_CHECKING:
    from pyproj import CRS

    from mtpcr_geo.core.progress import Progress

STEP, FINEST_STEP = 0.001, 0.0001  # metres or feet
DEGREE_STEP = 1e-9  # a tenth of a millimetre, and 32 bits still span four degrees
COARSEST_DEGREE_STEP = 1e-8  # a millimetre, as STEP is
_METRES_A_DEGREE = 1e5


def write_cloud(
    path: Path,
    cloud: Cloud,
    move: Move | None,
    crs: CRS | None,
    scale: float | tuple[float, float, float] | None = None,
    progress: Progress | None = None,
    advance: Callable[[int], object] | None = None,
    *,
    returning: bool = False,
) -> int:
    """Write a cloud, its coordinates moved on the way.

    LAS 1.4 in the point format from 6 up that holds all there is; the CRS as WKT; records that are
    neither about the CRS nor about the file's layout are kept. Memory does not grow with the number
    of points; COPC, which has to be sorted, spools to a temporary file beside the output.

    Where the points do not fit the 32 bit integers of a LAS file, a pass over them settles scale and offset
    so that they do, and it is written again. A few points too far from all others for that are left out.

    Args:
        path: where to write; ``.las``, ``.laz`` or ``.copc.laz`` is the format.
        cloud: what to write.
        move: takes (n, 3) file coordinates of `cloud` to those to be written; None leaves them. By a `Motion`
            normals and directions of waveforms turn with the points.
        crs: CRS of the written coordinates; None states none.
        scale: storage step of coordinates, in units of `crs`, or in metres where those are degrees; a tuple
            is in units of each axis, degrees too. None takes 0.001, or the input's own if that is finer, down
            to 0.0001. For geographic coordinates 1e-9 degrees.
        progress: where to report the points written.
        advance: called with the number of points of each chunk written.
        returning: choose a scale so fine that the cloud can be moved back onto its coordinates.

    Returns:
        The number of points left out.

    Raises:
        OutputError: if the file cannot be written, or too many coordinates do not fit the scale.
        InputError: if the cloud cannot be read.

    """
    task: Any = nullcontext(lambda n: None)
    if progress is not None:
        task = progress.task(f"writing {path.name}", cloud.count)
    with task as report:
        written, left = 0, 0

        def reported(count: int) -> None:
            nonlocal written, left
            again = min(count, left)  # counted already by a try that ended
            left -= again
            written += count
            report(count - again)
            if advance is not None:
                advance(count - again)

        scales = returning_scales(cloud, crs) if returning else scales_of(cloud, crs, scale)
        storage = Storage(scales, None)
        try:
            _write(path, cloud, move, crs, storage, reported)
        except MisfitError:
            left = written
            coarsest = None if scale is not None else _coarsest(crs)
            storage = settled(cloud, move, scales, coarsest)
            _write(path, cloud, move, crs, storage, reported)
    return storage.left_out


def _write(
    path: Path,
    cloud: Cloud,
    move: Move | None,
    crs: CRS | None,
    storage: Storage,
    advance: Callable[[int], object],
) -> None:
    header, chunks = layout(cloud, crs)
    las = las_below(cloud)
    placed = _placed(header, chunks, move, storage, advance)
    try:
        if is_copc(path):
            from mtpcr_geo.io.copc import write_copc

            write_copc(path, header, placed)
        else:
            _write_las(path, header, placed)
            if las is not None:
                append_waveforms(path, las)
        if las is not None:
            append_large(path, las)
            restore_texts(path, las)
    except (OSError, lazrs.LazrsError) as error:
        reason = getattr(error, "strerror", None) or error
        raise OutputError(f"cannot write in {path.parent}: {reason}; check rights and free space") from error


def is_copc(path: Path) -> bool:
    """Return by its name whether a file shall be COPC: ``.copc.laz``, also under its temporary name."""
    suffixes = [suffix.lower() for suffix in path.suffixes]
    return suffixes[-1:] == [".laz"] and ".copc" in suffixes


def returning_scales(cloud: Cloud, crs: CRS | None) -> Floats:
    """Return scales (3,) so fine that a cloud can be moved, written, and moved back onto its coordinates.

    A rotation puts up to 1.4 steps of error on a coordinate by there and back, so the step is a tenth of
    the input's, within 0.00001 and 0.001 metres (or feet), as long as the cloud's extent allows it.
    """
    scales = np.full(3, STEP)
    las = las_below(cloud)
    if las is not None:
        scales = np.asarray(las.header.scales, np.float64) / 10
        if cloud.crs is not None and cloud.crs.is_geographic:
            scales[:2] *= _METRES_A_DEGREE
        scales = np.clip(scales, FINEST_STEP / 10, STEP)
    # headers may state bounds of any size
    with np.errstate(over="ignore"):
        extent = cloud.maximum - cloud.minimum
        if cloud.crs is None or not cloud.crs.is_geographic:
            # from the middle to the sides; what a turn or a tilt adds is for `settled`
            half = 0.5 * np.array([*(extent[:2].max(),) * 2, extent[2]])
            while np.isfinite(half).all() and ((scales < STEP) & (half / scales > MOST_STEPS)).any():
                scales = np.where(half / scales > MOST_STEPS, np.minimum(scales * 10, STEP), scales)
    if crs is not None and crs.is_geographic:
        scales[:2] = np.minimum(scales[:2] / _METRES_A_DEGREE, DEGREE_STEP)
    return scales


def _write_las(path: Path, header: laspy.LasHeader, chunks: Iterator[NDArray[Any]]) -> None:
    compress = path.suffix.lower() == ".laz"
    if compress and header.point_format.has_waveform_packet:
        chunks = _of_one_channel(chunks)
    # the first chunk settles the offsets, which the header needs before anything is written
    first = next(chunks, None)
    with laspy.open(path, mode="w", header=header, do_compress=compress) as writer:
        if first is not None:
            writer.write_points(laspy.PackedPointRecord(first, header.point_format))
        for chunk in chunks:
            writer.write_points(laspy.PackedPointRecord(chunk, header.point_format))
        if header.evlrs:
            writer.write_evlrs(header.evlrs)
        # the writer has a copy of the header, which it writes again when it closes
        writer.header.global_encoding.gps_time_type = header.global_encoding.gps_time_type


def _of_one_channel(chunks: Iterator[NDArray[Any]]) -> Iterator[NDArray[Any]]:
    """Pass on points with waveforms, unless their scanner channels are mixed.

    lazrs up to 0.8 garbles the wave packets of such points without an error.
    """
    seen: set[int] = set()
    for chunk in chunks:
        seen |= set(np.unique(chunk["classification_flags"] >> 4 & 3).tolist())
        if len(seen) > 1:
            raise OutputError(
                "waveforms of several scanner channels cannot be compressed reliably; name the output .las"
            )
        yield chunk


def _coarsest(crs: CRS | None) -> Floats:
    """Return the coarsest scales that are taken without being asked for: a millimetre."""
    if crs is not None and crs.is_geographic:
        return np.array([COARSEST_DEGREE_STEP, COARSEST_DEGREE_STEP, STEP])
    return np.full(3, STEP)


def scales_of(
    cloud: Cloud, crs: CRS | None, given: float | tuple[float, float, float] | None = None
) -> Floats:
    """Return the scales (3,) at which a cloud is written: those given, or its own within limits.

    Args:
        cloud: what is written.
        crs: of the written coordinates.
        given: scale asked for: a length, which in geographic coordinates is turned to degrees; or one for
            each axis in its own unit.

    """
    if given is not None:
        scales = np.broadcast_to(np.asarray(given, np.float64), 3).copy()
        if np.ndim(given) == 0 and crs is not None and crs.is_geographic:
            scales[:2] /= _METRES_A_DEGREE
        return scales
    scales, las = np.full(3, STEP), las_below(cloud)
    if las is not None and not (cloud.crs is not None and cloud.crs.is_geographic):
        scales = np.clip(las.header.scales, FINEST_STEP, STEP)
    if crs is not None and crs.is_geographic:
        scales = np.array([DEGREE_STEP, DEGREE_STEP, min(scales[2], STEP)])
    return np.asarray(scales, np.float64)


def _placed(
    header: laspy.LasHeader,
    chunks: Iterator[tuple[Floats, NDArray[Any]]],
    move: Move | None,
    storage: Storage,
    advance: Callable[[int], object],
) -> Iterator[NDArray[Any]]:
    """Fill X, Y, Z into the packed records; the first chunk settles what the storage leaves open.

    Raises:
        MisfitError: if a point does not fit, and the storage does not leave such points out.

    """
    header.scales = storage.scales
    offsets = storage.offsets
    for xyz, packed in chunks:
        # of a broken file a point may lie anywhere; what does not fit is found below
        with np.errstate(over="ignore", invalid="ignore"):
            moved = xyz if move is None else move(xyz)
            if offsets is None:
                offsets = np.rint((moved.min(axis=0) + moved.max(axis=0)) / 2)
            header.offsets = offsets
            steps = np.empty((3, len(moved)))
            for axis, of_axis in enumerate(steps):
                np.subtract(moved[:, axis], offsets[axis], out=of_axis)
                of_axis /= storage.scales[axis]
                np.rint(of_axis, out=of_axis)
        for name, vectors in turned_columns(packed, move).items():
            packed[name] = vectors
        # a NaN makes it one
        worst = float(np.maximum(steps.max(), -steps.min()))
        kept = packed
        if not worst <= MOST_STEPS:
            if storage.offsets is None:
                raise MisfitError
            fits = (np.abs(steps) <= MOST_STEPS).all(axis=0)
            storage.left_out += int((~fits).sum())
            kept, steps = packed[fits], steps[:, fits]
        for name, of_axis in zip("XYZ", steps, strict=True):
            kept[name] = of_axis
        if len(kept):
            yield kept
        advance(len(packed))
