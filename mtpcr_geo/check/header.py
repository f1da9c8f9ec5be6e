"""The header and the records of a LAS file, compared with the format's rules."""

from __future__ import annotations

import struct
from collections.abc import Iterator
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from mtpcr_geo.check.findings import Finding, Role, rewrite
from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.io.vlr import GEOKEYS, WKT_RECORD, crs_of_records

if TYPE_CHECKING:
    from mtpcr_geo.crs import CrsFacts
    from mtpcr_geo.io.las import LasCloud

METRES_A_DEGREE = 111_320.0
FINEST_SCALE_M = 0.0001
COARSEST_SCALE_M = 0.1
FULLEST_RANGE = 0.5  # share of the 32 bit integers that coordinates may use before a shift can overflow
FAR_OFFSET_M = 10_000.0
ROOMY_RANGE = 0.4  # below this share an offset far away does no harm
SECONDS_A_WEEK = 604_800.0
_WKT_BIT, _STANDARD_TIME_BIT = 16, 1


@dataclass(frozen=True)
class RawHeader:
    """Fields of the public header as they stand in the file.

    Attributes:
        encoding: the global encoding bits.
        legacy_count: the 32 bit number of points.
        count: the 64 bit number of points of LAS 1.4; None before.
        first_evlr: byte at which extended records begin, 0 if there are none.

    """

    encoding: int
    legacy_count: int
    count: int | None
    first_evlr: int

    @property
    def states_wkt(self) -> bool:
        """Return whether the WKT bit of the global encoding is set."""
        return bool(self.encoding & _WKT_BIT)


def read_raw(cloud: LasCloud) -> RawHeader:
    """Read the fields of the header that laspy corrects or hides."""
    with cloud.path.open("rb") as stream:
        data = stream.read(375)
    (encoding,) = struct.unpack_from("<H", data, 6)
    (legacy,) = struct.unpack_from("<I", data, 107)
    if data[25] < 4 or len(data) < 255:
        return RawHeader(encoding, legacy, None, 0)
    first_evlr, evlrs, count = struct.unpack_from("<QIQ", data, 235)
    return RawHeader(encoding, legacy, count, first_evlr if evlrs else 0)


def header_findings(cloud: LasCloud, facts: CrsFacts | None, role: Role, whole: Floats) -> Iterator[Finding]:
    """Yield where a file's header departs from the LAS specification, or from what programs can read.

    Args:
        cloud: the file, opened.
        facts: its CRS taken apart, None where it is not known.
        role: which cloud it is, for the findings.
        whole: (2, 3) bounds of all its points, or those stated where they cannot be read.

    """
    raw = read_raw(cloud)
    yield from _crs_records(cloud, raw, role)
    yield from _counts(cloud, raw, role)
    yield from _scales(cloud, facts, role, whole)
    yield from _times(cloud, raw, role)
    yield from _extra_dimensions(cloud, role)


def _crs_records(cloud: LasCloud, raw: RawHeader, role: Role) -> Iterator[Finding]:
    wkt = [
        r
        for r in cloud.records
        if (r.user_id, r.record_id) == ("LASF_Projection", WKT_RECORD) and r.data.strip(b"\0 \r\n\t")
    ]
    keys = [r for r in cloud.records if r.states_crs and r.record_id == GEOKEYS]
    point_format = cloud.header.point_format.id
    again = rewrite(cloud.path)
    if wkt and keys:
        stated = [r for r in cloud.records if r.states_crs]
        by_wkt = crs_of_records(wkt)[0]
        by_keys = crs_of_records([r for r in stated if r.record_id != WKT_RECORD])[0]
        if by_wkt is not None and by_keys is not None and not _agree(by_wkt, by_keys):
            yield Finding(
                "warning",
                "crs-twice",
                role,
                f"its WKT states {by_wkt.name}, its GeoTIFF keys {by_keys.name}; the WKT is used",
                f"find out which is right, then {again}",
            )
    if point_format >= 6 and keys and not wkt:
        yield Finding(
            "warning",
            "wkt-missing",
            role,
            f"point format {point_format} wants its CRS as WKT and the file has GeoTIFF keys only: "
            "other programs may see none",
            again,
        )
    if wkt and not raw.states_wkt:
        yield Finding(
            "warning",
            "wkt-bit-unset",
            role,
            "it has WKT but the global encoding's WKT bit is unset: other programs may not read it",
            again,
        )
    elif raw.states_wkt and not wkt and point_format < 6:
        yield Finding(
            "warning",
            "wkt-bit-wrong",
            role,
            "the global encoding's WKT bit is set but the file holds no WKT",
            again if keys else "",
        )
    elif point_format >= 6 and not raw.states_wkt:
        yield Finding(
            "note",
            "wkt-bit-unset",
            role,
            f"the global encoding's WKT bit is not set, which point format {point_format} asks for",
            again if cloud.crs is not None else "",
        )


def _extra_dimensions(cloud: LasCloud, role: Role) -> Iterator[Finding]:
    for remark in cloud.extra.remarks:
        yield Finding("note", "extra-dimensions", role, remark)


def _agree(one: object, other: object) -> bool:
    """Return whether two CRSs agree in what GeoTIFF keys can state: the horizontal part."""
    from mtpcr_geo.core.errors import CrsError
    from mtpcr_geo.crs import facts_of, same_place

    try:
        first, second = facts_of(one).horizontal, facts_of(other).horizontal  # type: ignore[arg-type]
    except CrsError:
        return True
    return first is None or second is None or same_place(first, second)


def _counts(cloud: LasCloud, raw: RawHeader, role: Role) -> Iterator[Finding]:
    header, count = cloud.header, cloud.count
    again = rewrite(cloud.path)
    if raw.count is not None and raw.legacy_count and raw.legacy_count != raw.count:
        yield Finding(
            "warning",
            "legacy-count",
            role,
            f"the header counts {raw.count:,} points, its field for older programs {raw.legacy_count:,}",
            again,
        )
    if raw.count is not None and not raw.legacy_count and header.point_format.id < 6 and 0 < count < 2**32:
        yield Finding(
            "note",
            "legacy-count",
            role,
            "the point count for older programs is 0, though this point format is theirs",
            again,
        )
    by_return = int(np.sum(header.number_of_points_by_return))
    if by_return not in (0, count):
        yield Finding(
            "note",
            "return-counts",
            role,
            f"the header's points by return add up to {by_return:,}, not to {count:,}",
            again,
        )
    if cloud.stated_count != count:
        yield Finding(
            "warning",
            "count-mismatch",
            role,
            f"the header counts {cloud.stated_count:,} points, and there are {count:,}: all are read here, "
            "and other programs may miss some",
            again,
        )
    elif not header.are_points_compressed:
        end = raw.first_evlr or cloud.path.stat().st_size
        room = (end - header.offset_to_point_data) // header.point_format.size
        # waveforms may stand behind the points
        if room > count and not header.point_format.has_waveform_packet:
            yield Finding(
                "warning",
                "count-mismatch",
                role,
                f"the header counts {count:,} points, but the file has room for {room:,}: "
                "the rest will not be read",
                "copy or export it again",
            )


def scales_in_metres(scales: Floats, facts: CrsFacts) -> Floats:
    """Return the storage steps of a file's coordinates in metres, (3,)."""
    plan = facts.unit * (METRES_A_DEGREE if facts.kind == "geographic" else 1.0)
    return np.asarray(scales, np.float64) * [plan, plan, facts.height_unit]


def _scales(cloud: LasCloud, facts: CrsFacts | None, role: Role, bounds: Floats) -> Iterator[Finding]:
    scales, offsets = np.asarray(cloud.header.scales), np.asarray(cloud.header.offsets)
    with np.errstate(all="ignore"):
        used = np.abs((bounds - offsets) / scales).max(axis=0) / 2**31
        distance = np.abs(bounds - offsets).min(axis=0)
        distance[(bounds[0] <= offsets) & (offsets <= bounds[1])] = 0.0
    if not (np.isfinite(used).all() and (scales > 0).all()):
        yield Finding(
            "warning",
            "scale-senseless",
            role,
            f"scales {_triple(scales)} and offsets {_triple(offsets)} are not valid",
            "export it again",
        )
        return
    if used.max() > FULLEST_RANGE:
        axis = "xyz"[int(used.argmax())]
        yield Finding(
            "warning",
            "scale-overflow",
            role,
            f"its {axis} uses {used.max():.0%} of the 32 bit integers that hold it (scale "
            f"{scales[int(used.argmax())]:g}): a shift can overflow it",
            _rescale(cloud, facts),
        )
    if facts is None:
        coarse, fine, far = scales >= COARSEST_SCALE_M, np.zeros(3, bool), distance > FAR_OFFSET_M
    else:
        metres = scales_in_metres(scales, facts)
        coarse, fine = metres >= COARSEST_SCALE_M * 0.9999, metres < FINEST_SCALE_M * 0.9999
        far = distance * (metres / scales) > FAR_OFFSET_M
    if coarse.any():
        yield Finding(
            "warning",
            "scale-coarse",
            role,
            f"coordinates are stored in steps of {_triple(scales)}, a tenth of a metre or more: "
            "detail is lost, and the result cannot be better",
            "get the cloud at a finer scale, such as 0.001 m (1e-8 in degrees); it cannot be mended here",
        )
    if fine.any():
        yield Finding(
            "note",
            "scale-fine",
            role,
            f"coordinates are stored in steps of {_triple(scales)}, below a tenth of a millimetre: "
            "files grow, coordinates can overflow, and QGIS may fail to index the cloud",
            _rescale(cloud, facts),
        )
    if (far & (used > ROOMY_RANGE)).any():
        yield Finding(
            "note",
            "offset-far",
            role,
            f"its offset {_triple(offsets)} is far from its coordinates: there is less room for a fine scale",
            "write it with an offset near the data, when it is written again",
        )


def _rescale(cloud: LasCloud, facts: CrsFacts | None) -> str:
    if facts is not None and facts.kind == "projected":
        return rewrite(cloud.path, scale_x=0.001, scale_y=0.001, scale_z=0.001)
    return "write it with a coarser scale and an offset near the data"


def _times(cloud: LasCloud, raw: RawHeader, role: Role) -> Iterator[Finding]:
    if "gps_time" not in cloud.header.point_format.dimension_names or not cloud.count:
        return
    times = _some_times(cloud)
    standard = bool(raw.encoding & _STANDARD_TIME_BIT)
    if times is None or not times.any():
        return
    beyond = times[(times < 0) | (times > SECONDS_A_WEEK)]
    fix = "correct the time type bit of its global encoding; registering does not use times"
    if standard and not len(beyond):
        yield Finding(
            "note",
            "gps-time",
            role,
            f"the time type bit means adjusted standard GPS time, but times like {times[0]:.1f} are "
            "seconds of a week",
            fix,
        )
    elif not standard and len(beyond):
        yield Finding(
            "note",
            "gps-time",
            role,
            f"the time type bit means seconds of a GPS week, but times like {beyond[0]:.1f} are not",
            fix,
        )
    elif not standard and cloud.header.point_format.id >= 6:
        yield Finding(
            "note",
            "gps-time",
            role,
            "its times are seconds of a GPS week: the week is not known",
            "",
        )


def _some_times(cloud: LasCloud, parts: int = 8, size: int = 2_000) -> Floats | None:
    """Return times from some places all over the file, (n,) seconds; None where they cannot be read."""
    from laspy import DecompressionSelection as Fields

    from mtpcr_geo.core.errors import InputError

    try:
        places = np.unique(np.linspace(0, max(cloud.count - size, 0), parts).astype(int)).tolist()
        records = cloud.records_at(places, size, Fields.XY_RETURNS_CHANNEL | Fields.GPS_TIME)
        times = np.concatenate([np.asarray(record["gps_time"], np.float64) for record in records])
    except InputError:
        return None  # reported where the points are read
    return times if np.isfinite(times).all() else None


def _triple(values: Floats) -> str:
    return f"({', '.join(f'{value + 0.0:g}' for value in values)})"
