"""Cloud optimised point clouds: a LAZ file whose chunks are the nodes of an octree.

Layout as in the COPC 1.0 specification (https://copc.io). Points are sorted out of core, through
temporary files beside the output, so memory does not grow with their number.
"""

from __future__ import annotations

import struct
from collections.abc import Iterable, Iterator
from contextlib import ExitStack
from pathlib import Path
from tempfile import TemporaryFile
from typing import Any, BinaryIO

import laspy
import lazrs
import numpy as np
from laspy.vlrs.vlrlist import VLRList
from numpy.typing import NDArray

from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.errors import OutputError
from mtpcr_geo.io.octree import Key, OctreeSorter, Spool, quantise

_BATCH = 16  # nodes handed to the compressor at once, which works on them in parallel
_INFO_SIZE = 160
_EVLR_HEAD = 60
_SPACING_CELLS = 128


def write_copc(path: Path, header: laspy.LasHeader, chunks: Iterable[NDArray[Any]]) -> None:
    """Write packed records as COPC.

    Degrees and metres share one cube here, as the format wants it: for geographic coordinates the octree
    is valid, but poor. Write a projected CRS for good ones.

    Args:
        path: where to write.
        header: scales, offsets and variable length records; set at the latest when the first chunk comes.
        chunks: records in the header's point format, X, Y, Z filled in.

    Raises:
        OutputError: if the point format has waveforms, which COPC does not know, or there is no point.

    """
    if header.point_format.id > 8:
        raise OutputError("COPC cannot hold waveforms; name the output .laz")
    with ExitStack() as stack:
        spool = stack.enter_context(TemporaryFile(dir=path.parent))
        count = _spool(spool, header, chunks)
        if count == 0:
            raise OutputError("COPC cannot hold a cloud of no points; name the output .laz")
        records = Spool(spool, header.point_format.dtype(), count)
        low = np.asarray(header.mins)
        side = float((np.asarray(header.maxs) - low).max()) or 1.0
        side *= 1 + 1e-9  # the highest point lies within the cube, not on its far side

        def cells(part: NDArray[Any]) -> NDArray[np.int32]:
            integers = np.column_stack([part[axis] for axis in "XYZ"])
            return quantise(integers * header.scales + header.offsets - low, side)

        sorter = OctreeSorter(records, cells, lambda: stack.enter_context(TemporaryFile(dir=path.parent)))
        with path.open("w+b") as output:
            _write(output, header, sorter.nodes(), low, side)


def _spool(spool: BinaryIO, header: laspy.LasHeader, chunks: Iterable[NDArray[Any]]) -> int:
    header.partial_reset()
    for chunk in chunks:
        header.grow(laspy.PackedPointRecord(chunk, header.point_format))
        spool.write(chunk.tobytes())
    spool.flush()
    return int(header.point_count)


def _write(
    output: BinaryIO,
    header: laspy.LasHeader,
    nodes: Iterator[tuple[Key, NDArray[Any]]],
    low: Floats,
    side: float,
) -> None:
    laz = lazrs.LazVlr.new_for_compression(
        header.point_format.id, header.point_format.num_extra_bytes, use_variable_size_chunks=True
    )
    info = laspy.VLR("copc", 1, "COPC info", bytes(_INFO_SIZE))
    # the specification wants the info record first
    header.vlrs.insert(0, info)
    header.vlrs.append(laspy.vlrs.known.LasZipVlr(laz.record_data()))
    header.are_points_compressed = True
    header.write_to(output)
    compressor = lazrs.ParLasZipCompressor(output, laz)
    compressor.reserve_offset_to_chunk_table()
    keys: list[Key] = []
    batch: list[NDArray[np.uint8]] = []
    for key, points in nodes:
        keys.append(key)
        batch.append(np.frombuffer(points.tobytes(), np.uint8))
        if len(batch) == _BATCH:
            compressor.compress_chunks(batch)
            batch = []
    if batch:
        compressor.compress_chunks(batch)
    compressor.done()

    output.seek(header.offset_to_point_data)
    table = lazrs.read_chunk_table(output, laz)
    hierarchy = b""
    place = header.offset_to_point_data + 8
    for key, (points, size) in zip(keys, table, strict=True):
        hierarchy += struct.pack("<4iQii", *key, place, size, points)
        place += size
    evlrs = VLRList([laspy.VLR("copc", 1000, "EPT hierarchy", hierarchy), *(header.evlrs or [])])
    header.start_of_first_evlr = output.seek(0, 2)
    header.number_of_evlrs = len(evlrs)
    evlrs.write_to(output, as_extended=True)

    half = side / 2
    info.record_data = struct.pack(
        "<5d2Q2d88x",
        *(low + half),
        half,
        side / _SPACING_CELLS,
        header.start_of_first_evlr + _EVLR_HEAD,
        len(hierarchy),
        header.min_gps_time,
        header.max_gps_time,
    )
    output.seek(0)
    header.write_to(output, ensure_same_size=True)
