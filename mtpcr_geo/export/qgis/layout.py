"""The page that a QGIS project prints: two maps of the overlap, legends, scale bars, and the verdict."""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from uuid import NAMESPACE_URL, uuid5
from xml.etree.ElementTree import Element, SubElement

from mtpcr_geo.core.version import __version__
from mtpcr_geo.core.wording import visible
from mtpcr_geo.export.qgis.layers import Extent, Group, MapLayer, extent_element

NAME = "Registration, A4"
_MAP, _LEGEND, _LABEL, _PICTURE, _SCALE_BAR, _PAGE = "65639", "65642", "65641", "65640", "65646", "65638"
_PAGE_MM = (297.0, 210.0)
_EDGE_MM, _GAP_MM, _TOP_MM, _MAP_HEIGHT_MM = 10.0, 7.0, 38.0, 132.0
_SEGMENT_MM = 12.0
_ROUND = (1.0, 1.25, 1.5, 2.0, 2.5, 3.0, 4.0, 5.0, 7.5)
_ARROW = (
    '<svg xmlns="http://www.w3.org/2000/svg" viewBox="0 0 20 30" width="20" height="30">'
    '<path d="M10 1 17 22 10 17 3 22z" fill="#232323" stroke="#fff" stroke-width="1"/>'
    '<text x="10" y="30" font-size="8" font-family="sans-serif" text-anchor="middle" fill="#232323">N</text>'
    "</svg>"
)
_LEGEND_STYLES = (
    ("title", 8, "0"),
    ("group", 8, "1"),
    ("subgroup", 8, "1"),
    ("symbol", 7, "0.8"),
    ("symbolLabel", 7, "0.8"),
)
_CAPTIONS = {
    "Before": "Before: heights as they came",
    "After": "After: heights, the registered source over the target",
    "Evidence": "Evidence: height difference, tie points, arrows of their plan residuals",
}


@dataclass(frozen=True, eq=False)
class Page:
    """What a page shows.

    Attributes:
        title, sentence: what was done, and the verdict.
        crs: of the maps, as WKT; None for local coordinates.
        extent: what the maps must show.
        groups: one map each.

    """

    title: str
    sentence: str
    crs: str | None
    extent: Extent
    groups: Sequence[Group]


def layout_element(page: Page) -> Element:
    """Return a print layout, A4 landscape."""
    layout = Element("Layout", name=NAME, units="mm", printResolution="300", worldFileMap="")
    pages = SubElement(layout, "PageCollection")
    sheet = _item(pages, _PAGE, "page", (0.0, 0.0, *_PAGE_MM), background="true")
    symbol = SubElement(sheet, "symbol", name="", type="fill", alpha="1", clip_to_extent="1", force_rhr="0")
    fill = SubElement(symbol, "layer", {"class": "SimpleFill", "enabled": "1", "locked": "0", "pass": "0"})
    options = SubElement(fill, "Option", type="Map")
    for name, value in (("color", "255,255,255,255"), ("style", "solid"), ("outline_style", "no")):
        SubElement(options, "Option", name=name, type="QString", value=value)

    wide = _PAGE_MM[0] - 2 * _EDGE_MM
    _label(layout, "title", (_EDGE_MM, 8.0, wide, 8.0), _said(page.title), points=15, bold=True)
    _label(layout, "verdict", (_EDGE_MM, 17.0, wide, 15.0), _said(page.sentence), points=9)
    width = (wide - _GAP_MM * (len(page.groups) - 1)) / len(page.groups)
    scale = _round_up(_scale(page.extent, width, _MAP_HEIGHT_MM))
    for index, group in enumerate(page.groups):
        left = _EDGE_MM + index * (width + _GAP_MM)
        _map(layout, group.name, (left, _TOP_MM, width, _MAP_HEIGHT_MM), page, scale)
        below = _TOP_MM + _MAP_HEIGHT_MM
        caption = (
            f"{_CAPTIONS.get(group.name, group.name)}, "
            f"1 : [% round(map_get(item_variables('{group.name}'), 'map_scale')) %]"
        )
        _label(
            layout, f"{group.name} caption", (left, _TOP_MM - 5.0, width, 4.5), caption, points=8, bold=True
        )
        _scale_bar(layout, group.name, (left + 2.0, below - 11.0, 60.0, 9.0), scale)
        _legend(layout, group, (left, below + 2.0, width, 35.0))
    north = (_EDGE_MM + width - 10.0, _TOP_MM + 2.0, 8.0, 12.0)
    picture = _item(layout, _PICTURE, "north", north)
    picture.set("file", "base64:" + base64.b64encode(_ARROW.encode()).decode())
    picture.set("mode", "0")
    picture.set("resizeMode", "0")
    frame = _crs_name(page.crs)
    foot = f"{frame}. Written by mtpcr_geo {__version__}; printed [% format_date(now(), 'yyyy-MM-dd') %]."
    _label(layout, "foot", (_EDGE_MM, 201.0, wide, 5.0), foot, points=7)
    return layout


def _said(text: str) -> str:
    """Return a text for a label, with nothing for QGIS to evaluate: names of files come from strangers."""
    return visible(text).replace("[%", "[ %")


def _crs_name(wkt: str | None) -> str:
    if wkt is None:
        return "Local coordinates of the target, metres"
    from pyproj import CRS

    crs = CRS.from_wkt(wkt)
    authority = crs.to_authority(min_confidence=100)
    return _said(crs.name + (f" ({':'.join(authority)})" if authority is not None else ""))


def _scale(extent: Extent, width_mm: float, height_mm: float) -> float:
    """Return the denominator at which an extent in metres just fits."""
    west, south, east, north = extent
    return max((east - west) / width_mm, (north - south) / height_mm, 1e-3) * 1000.0


def _round_up(value: float) -> float:
    power = 1.0
    while power * 10.0 <= value:
        power *= 10.0
    return next(step * power for step in (*_ROUND, 10.0) if step * power >= value)


def _round_down(value: float) -> float:
    power = 1e-3
    while power * 10.0 <= value:
        power *= 10.0
    return max(step * power for step in (1.0, 2.0, 5.0) if step * power <= value)


def _item(
    parent: Element, kind: str, name: str, place: tuple[float, float, float, float], **more: str
) -> Element:
    left, top, width, height = place
    key = f"{{{uuid5(NAMESPACE_URL, name)}}}"
    values = {
        "type": kind,
        "id": name,
        "uuid": key,
        "templateUuid": key,
        "position": f"{left:g},{top:g},mm",
        "positionOnPage": f"{left:g},{top:g},mm",
        "size": f"{width:g},{height:g},mm",
        "visibility": "1",
        "opacity": "1",
        "blendMode": "0",
        "frame": "false",
        "background": "false",
        "referencePoint": "0",
        "itemRotation": "0",
        "excludeFromExports": "0",
        **more,
    }
    return SubElement(parent, "LayoutItem", values)


def _map(
    layout: Element, theme: str, place: tuple[float, float, float, float], page: Page, scale: float
) -> None:
    item = _item(
        layout,
        _MAP,
        theme,
        place,
        frame="true",
        background="true",
        followPreset="true",
        followPresetName=theme,
        keepLayerSet="false",
        drawCanvasItems="false",
        mapRotation="0",
        labelMargin="0,mm",
    )
    west, south, east, north = page.extent
    x, y = (west + east) / 2.0, (south + north) / 2.0
    half = (place[2] / 2000.0 * scale, place[3] / 2000.0 * scale)
    item.append(extent_element("Extent", (x - half[0], y - half[1], x + half[0], y + half[1])))
    extent = item[-1]
    # the map takes it as attributes, a canvas as elements
    for number in list(extent):
        extent.set(number.tag, str(number.text))
        extent.remove(number)
    SubElement(item, "FrameColor", red="120", green="120", blue="120", alpha="255")
    SubElement(item, "BackgroundColor", red="255", green="255", blue="255", alpha="255")


def _label(
    layout: Element,
    name: str,
    place: tuple[float, float, float, float],
    text: str,
    *,
    points: int,
    bold: bool = False,
) -> None:
    item = _item(layout, _LABEL, name, place, labelText=text, htmlState="0", halign="1", valign="32")
    item.set("marginX", "0")
    item.set("marginY", "0")
    SubElement(item, "LabelFont", description=_font(points, bold), style="")
    SubElement(item, "FontColor", red="35", green="35", blue="35", alpha="255")
    _text_style(item, points, bold)


def _font(points: int, bold: bool) -> str:
    return f"Sans Serif,{points},-1,5,{75 if bold else 50},0,0,0,0,0"


def _text_style(parent: Element, points: int, bold: bool = False) -> None:
    SubElement(
        parent,
        "text-style",
        fontFamily="Sans Serif",
        fontSize=str(points),
        fontSizeUnit="Point",
        fontWeight="75" if bold else "50",
        textColor="35,35,35,255",
        textOpacity="1",
    )


def _scale_bar(
    layout: Element, map_name: str, place: tuple[float, float, float, float], scale: float
) -> None:
    units = _round_down(_SEGMENT_MM / 1000.0 * scale)
    item = _item(
        layout,
        _SCALE_BAR,
        f"{map_name} scale",
        place,
        mapUuid=f"{{{uuid5(NAMESPACE_URL, map_name)}}}",
        style="Single Box",
        unitType="meters",
        unitLabel="m",
        numSegments="3",
        numSegmentsLeft="0",
        numUnitsPerSegment=f"{units:g}",
        numMapUnitsPerScaleBarUnit="1",
        segmentSizeMode="0",
        height="2",
        labelBarSpace="1",
        boxContentSpace="0.5",
        outlineWidth="0.2",
        alignment="0",
        background="true",
    )
    _text_style(item, 8)
    SubElement(item, "BackgroundColor", red="255", green="255", blue="255", alpha="200")
    SubElement(item, "fillColor", red="35", green="35", blue="35", alpha="255")
    SubElement(item, "fillColor2", red="255", green="255", blue="255", alpha="255")
    SubElement(item, "strokeColor", red="35", green="35", blue="35", alpha="255")


def _legend(layout: Element, group: Group, place: tuple[float, float, float, float]) -> None:
    """Add the legend of a group: what has colours, without the shading."""
    item = _item(
        layout,
        _LEGEND,
        f"{group.name} legend",
        place,
        map_uuid=f"{{{uuid5(NAMESPACE_URL, group.name)}}}",
        title="",
        columnCount=str(len(_with_legend(group))),
        splitLayer="0",
        equalColumnWidth="0",
        resizeToContents="1",
        legendFilterByAtlas="0",
        symbolWidth="4",
        symbolHeight="3",
        columnSpace="5",
        maxSymbolSize="0",
        minSymbolSize="0",
        symbolAlignment="1",
        boxSpace="0",
        wmsLegendWidth="50",
        wmsLegendHeight="25",
    )
    styles = SubElement(item, "styles")
    for name, points, margin in _LEGEND_STYLES:
        style = SubElement(
            styles, "style", name=name, marginTop=margin, marginLeft="1", indent="0", alignment="1"
        )
        bold = name == "subgroup"
        # QGIS before 3.24 reads the font, later ones the text style
        SubElement(style, "styleFont", description=_font(points, bold), style="")
        _text_style(style, points, bold)
    tree = SubElement(item, "layer-tree-group")
    for layer in _with_legend(group):
        one = SubElement(
            tree,
            "layer-tree-layer",
            id=layer.key,
            name=layer.title,
            source=layer.source,
            providerKey="ogr" if layer.geometry else "gdal",
            checked="Qt::Checked",
            expanded="1",
            legend_exp="",
        )
        properties = SubElement(SubElement(one, "customproperties"), "Option", type="Map")
        SubElement(properties, "Option", name="cached_name", type="QString", value=layer.title)
        if not layer.geometry:
            difference = layer.key.startswith("difference")
            note = "registered minus target" if difference else "highest in each cell"
            # instead of the number and the description of the band
            SubElement(properties, "Option", name="legend/label-0", type="QString", value=note)


def _with_legend(group: Group) -> list[MapLayer]:
    """Return the layers whose colours mean something: of several rasters of heights the first.

    The arrows have the colours of the tie points.
    """
    skipped = ("_shading", "_links")
    shown = [layer for layer in group.layers() if layer.shown and not layer.key.endswith(skipped)]
    first = next((layer for layer in shown if layer.title == "Heights"), None)
    return [layer for layer in shown if layer.title != "Heights" or layer is first]
