"""Virtual rasters (VRT) over the blocks of a mosaic: one for each band and level, which QGIS opens."""

from __future__ import annotations

from collections.abc import Sequence
from xml.etree import ElementTree

from mtpcr_geo.survey.index import write_atomic
from mtpcr_geo.survey.mosaic import BANDS, BLOCK_CELLS, FACTORS, Mosaic, Place


def write_virtual(mosaic: Mosaic, places: Sequence[Place]) -> None:
    """Write ``top_1m.vrt`` and the like: a band at a level, with the block files as they are below it.

    Args:
        mosaic: the blocks.
        places: those that there are.

    """
    if not places:
        return
    for number, band in enumerate(BANDS, start=1):
        for factor in FACTORS:
            name = f"{band}_{mosaic.frame.cell_m * factor:g}m.vrt"
            write_atomic(mosaic.folder / name, _virtual(mosaic, places, number, factor))


def _axes_of(wkt: str) -> list[int]:
    """Return the axes of a CRS, counted from 1, in the order of the data: east, north, up."""
    from pyproj import CRS

    axes = CRS.from_wkt(wkt).axis_info
    numbers = list(range(1, len(axes) + 1))
    first, second = axes[:2]
    # on a pole both point the same way, and their names say which is which
    at_pole = first.direction == second.direction and first.name.lower().startswith("northing")
    if (first.direction, second.direction) == ("north", "east") or at_pole:
        numbers[:2] = [2, 1]
    return numbers


def _virtual(mosaic: Mosaic, places: Sequence[Place], number: int, factor: int) -> bytes:
    frame = mosaic.frame
    side = BLOCK_CELLS // factor
    west, east = min(c for c, _ in places), max(c for c, _ in places) + 1
    south, north = min(r for _, r in places), max(r for _, r in places) + 1
    step = frame.cell_m * factor / frame.unit_m
    edge = frame.block_m / frame.unit_m
    root = ElementTree.Element(
        "VRTDataset", rasterXSize=str((east - west) * side), rasterYSize=str((north - south) * side)
    )
    mapping = ",".join(map(str, _axes_of(frame.raster_wkt)))
    ElementTree.SubElement(root, "SRS", dataAxisToSRSAxisMapping=mapping).text = frame.raster_wkt
    placed = (west * edge, step, 0.0, north * edge, 0.0, -step)
    ElementTree.SubElement(root, "GeoTransform").text = ", ".join(f"{value:.17g}" for value in placed)
    about = ElementTree.SubElement(root, "Metadata")
    ElementTree.SubElement(about, "MDI", key="AREA_OR_POINT").text = "Area"
    band = ElementTree.SubElement(root, "VRTRasterBand", dataType="Float32", band="1")
    ElementTree.SubElement(band, "Description").text = BANDS[number - 1]
    ElementTree.SubElement(band, "NoDataValue").text = "nan"
    for column, row in places:
        source = ElementTree.SubElement(band, "SimpleSource")
        if factor > 1:
            opening = ElementTree.SubElement(source, "OpenOptions")
            ElementTree.SubElement(opening, "OOI", key="OVERVIEW_LEVEL").text = str(FACTORS.index(factor) - 1)
        name = mosaic.path_of((column, row)).relative_to(mosaic.folder).as_posix()
        ElementTree.SubElement(source, "SourceFilename", relativeToVRT="1").text = name
        ElementTree.SubElement(source, "SourceBand").text = str(number)
        # with the size known, a file is opened when it is looked at only
        block = min(256, side)
        ElementTree.SubElement(
            source, "SourceProperties", RasterXSize=str(side), RasterYSize=str(side), DataType="Float32",
            BlockXSize=str(block), BlockYSize=str(block),
        )  # fmt: skip
        size = str(side)
        ElementTree.SubElement(source, "SrcRect", xOff="0", yOff="0", xSize=size, ySize=size)
        x, y = str((column - west) * side), str((north - row - 1) * side)
        ElementTree.SubElement(source, "DstRect", xOff=x, yOff=y, xSize=size, ySize=size)
    ElementTree.indent(root, " ")
    return bytes(ElementTree.tostring(root, encoding="utf-8"))
