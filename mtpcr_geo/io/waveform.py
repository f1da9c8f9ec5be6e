"""Waveform packets that stand inside a LAS file, carried over to another one."""

from __future__ import annotations

import struct
from pathlib import Path

from mtpcr_geo.core.errors import InputError
from mtpcr_geo.io.las import LasCloud

_ENCODING, _WAVEFORM_START, _FIRST_EVLR = 6, 227, 235
_EVLR_HEAD = 60
_INTERNAL = 0b10
_BLOCK = 1 << 20


def append_waveforms(path: Path, cloud: LasCloud) -> None:
    """Copy a cloud's internal waveform record behind the points of the LAS 1.4 file just written.

    The points' offsets count from the start of that record, so they stay right. Does nothing where there
    are no waveforms, or where they stand in a ``.wdp`` file of their own.

    Raises:
        InputError: if the cloud's file ends within them.

    """
    start = int(cloud.header.start_of_waveform_data_packet_record)
    if not (cloud.header.global_encoding.waveform_data_packets_internal and start):
        return
    with cloud.path.open("rb") as source, path.open("r+b") as output:
        source.seek(start)
        head = source.read(_EVLR_HEAD)
        if len(head) < _EVLR_HEAD:
            raise _truncated(cloud)
        (left,) = struct.unpack_from("<Q", head, 20)
        place = output.seek(0, 2)
        output.write(head)
        while left > 0:
            block = source.read(min(left, _BLOCK))
            if not block:
                raise _truncated(cloud)
            output.write(block)
            left -= len(block)
        output.seek(_ENCODING)
        (encoding,) = struct.unpack("<H", output.read(2))
        output.seek(_ENCODING)
        output.write(struct.pack("<H", encoding | _INTERNAL))
        output.seek(_FIRST_EVLR)
        first, count = struct.unpack("<QI", output.read(12))
        output.seek(_WAVEFORM_START)
        output.write(struct.pack("<QQI", place, first or place, count + 1))


def _truncated(cloud: LasCloud) -> InputError:
    return InputError(f"{cloud.name} ends within its waveforms; copy or download it again")
