"""The QGIS project of a run: what was before, what is after, and the evidence, as far as it is there.

A ``.qgz`` is a zip of one XML file. It is written here, without QGIS, for QGIS 3.22 and newer; it holds no
paths but relative ones, so that the folder can be moved.
"""

from __future__ import annotations

import zipfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from uuid import NAMESPACE_URL, uuid5
from xml.etree.ElementTree import Element, SubElement, indent, tostring

from mtpcr_geo.core.errors import OutputError
from mtpcr_geo.core.wording import visible
from mtpcr_geo.export.qgis.layers import (
    Extent,
    Group,
    LayerFile,
    MapLayer,
    crs_element,
    extent_element,
    raster_layers,
    raster_place,
    shade_layer,
    vector_layers,
)
from mtpcr_geo.export.qgis.layout import Page, layout_element
from mtpcr_geo.export.raster_styles import QGIS_VERSION

BEFORE, AFTER, EVIDENCE = "Before", "After", "Evidence"
TITLES = {
    "tie_points": "Tie points",
    "links": "Plan residuals",
    "hypotheses": "Hypotheses",
    "footprints": "Footprints",
}
_MARGIN = 0.06
# a zip holds times: the same files make the same project
_EPOCH = (1980, 1, 1, 0, 0, 0)


@dataclass(frozen=True)
class About:
    """What the project says of the run.

    Attributes:
        source, target: names of the clouds.
        sentence: the verdict in one sentence.

    """

    source: str
    target: str
    sentence: str


def write_project(
    path: str | Path, rasters: Mapping[str, LayerFile], ties: LayerFile | None, about: About
) -> None:
    """Write a project of the files of a run.

    Groups: `BEFORE`, `AFTER` and `EVIDENCE`, each also a map theme; a page to print; bookmarks.

    Args:
        path: the ``.qgz`` to write.
        rasters: GeoTIFFs by role: source, target, registered, difference, target_upright.
        ties: the GeoPackage.
        about: what to say of the run.

    Raises:
        OutputError: if the file cannot be written.

    """
    root = project_element(rasters, ties, about)
    indent(root)
    text = b"<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n" + tostring(root) + b"\n"
    try:
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            entry = zipfile.ZipInfo("project.qgs", _EPOCH)
            entry.compress_type = zipfile.ZIP_DEFLATED
            archive.writestr(entry, text)
    except OSError as error:
        raise OutputError(f"cannot write the project {path}: {error}") from error


def project_element(rasters: Mapping[str, LayerFile], ties: LayerFile | None, about: About) -> Element:
    """Return the project as XML; see `write_project`."""
    tables = vector_layers(ties, TITLES, hidden=["hypotheses"]) if ties is not None else {}
    groups = _groups(rasters, tables)
    layers = [layer for group in groups for layer in group.layers()]
    crs = _map_crs(rasters, layers)
    places = _places(rasters, layers)
    title = visible(f"{about.source} registered to {about.target}")

    root = Element("qgis", version=QGIS_VERSION, projectname=title)
    SubElement(root, "homePath", path="")
    SubElement(root, "title").text = title
    SubElement(root, "projectCrs").append(crs_element(crs))
    root.append(_tree(groups))
    canvas = SubElement(root, "mapcanvas", name="theMapCanvas", annotationsVisible="1")
    SubElement(canvas, "units").text = "meters"
    if places:
        canvas.append(extent_element("extent", next(iter(places.values()))))
    SubElement(canvas, "rotation").text = "0"
    SubElement(canvas, "destinationsrs").append(crs_element(crs))
    SubElement(canvas, "rendermaptile").text = "0"
    held = SubElement(root, "projectlayers")
    held.extend(layer.element() for layer in layers)
    order = SubElement(root, "layerorder")
    for layer in layers:
        SubElement(order, "layer", id=layer.key)
    root.append(_properties(crs is not None))
    root.append(_themes(groups))
    metadata = SubElement(root, "projectMetadata")
    SubElement(metadata, "title").text = title
    SubElement(metadata, "abstract").text = visible(about.sentence)
    shown = [group for group in reversed(groups) if group.name != BEFORE] or groups
    if places:
        page = Page(title, about.sentence, crs, next(iter(places.values())), shown[:2])
        SubElement(root, "Layouts").append(layout_element(page))
        root.append(_bookmarks(places, crs))
        root.append(_views(places, crs))
    return root


def _groups(rasters: Mapping[str, LayerFile], tables: Mapping[str, MapLayer]) -> list[Group]:
    """Return the groups for which there is something, the one on top first."""
    groups = []
    fixed = rasters.get("target_upright", rasters.get("target"))
    evidence: list[MapLayer | Group] = [
        tables[name] for name in ("tie_points", "links", "hypotheses") if name in tables
    ]
    if "difference" in rasters:
        evidence += raster_layers(rasters["difference"], "difference", "Height difference", shaded=False)
    if fixed is not None and evidence:
        # below the difference: shades of crowns say nothing of the ground
        evidence.append(shade_layer(fixed, "evidence_target"))
    if evidence:
        groups.append(Group(EVIDENCE, evidence, shown=False))
    if "registered" in rasters and fixed is not None:
        members: list[MapLayer | Group] = [tables["footprints"]] if "footprints" in tables else []
        members += [
            _relief(rasters["registered"], "after_source", "Source, registered"),
            _relief(fixed, "after_target", "Target"),
        ]
        groups.append(Group(AFTER, members))
    before = [
        _relief(rasters[role], f"before_{role}", title)
        for role, title in (("source", "Source, as it came"), ("target", "Target"))
        if role in rasters
    ]
    if before:
        opened = not any(group.name == AFTER for group in groups)
        groups.append(Group(BEFORE, before, shown=opened))
    return groups


def _relief(file: LayerFile, key: str, title: str) -> Group:
    return Group(title, raster_layers(file, key, "Heights"), expanded=False)


def _map_crs(rasters: Mapping[str, LayerFile], layers: Sequence[MapLayer]) -> str | None:
    """Return the CRS of the map: that of the registered source, or of the target."""
    for role in ("registered", "target_upright", "target"):
        if role in rasters:
            return raster_place(rasters[role].path)[0]
    return next((layer.crs for layer in layers), None)


def _places(rasters: Mapping[str, LayerFile], layers: Sequence[MapLayer]) -> dict[str, Extent]:
    """Return the places worth going to, the one at which the map opens first."""
    places = {}
    named = {
        "difference": "Overlap",
        "registered": "Source, registered",
        "target_upright": "Target",
        "target": "Target",
        "source": "Source, as it came",
    }
    for role, name in named.items():
        if role in rasters and name not in places:
            places[name] = _wider(raster_place(rasters[role].path)[1])
    if not places:
        extents = [layer.extent for layer in layers if layer.extent is not None]
        if extents:
            places["All"] = _wider(_union(extents))
    return places


def _wider(extent: Extent) -> Extent:
    west, south, east, north = extent
    margin = _MARGIN * max(east - west, north - south, 1.0)
    return west - margin, south - margin, east + margin, north + margin


def _union(extents: Sequence[Extent]) -> Extent:
    west, south, east, north = zip(*extents, strict=True)
    return min(west), min(south), max(east), max(north)


def _tree(groups: Sequence[Group]) -> Element:
    tree = Element("layer-tree-group")
    for group in groups:
        _branch(tree, group)
    return tree


def _branch(parent: Element, group: Group) -> None:
    node = SubElement(
        parent,
        "layer-tree-group",
        name=group.name,
        checked="Qt::Checked" if group.shown else "Qt::Unchecked",
        expanded="1" if group.expanded else "0",
    )
    for one in group.members:
        if isinstance(one, Group):
            _branch(node, one)
        else:
            SubElement(
                node,
                "layer-tree-layer",
                id=one.key,
                name=one.title,
                source=one.source,
                providerKey="ogr" if one.geometry else "gdal",
                checked="Qt::Checked" if one.shown else "Qt::Unchecked",
                expanded="0",
                legend_exp="",
            )


def _themes(groups: Sequence[Group]) -> Element:
    """Return a map theme for each group: its layers and no others."""
    themes = Element("visibility-presets")
    names = [group.name for group in groups]
    for group in groups:
        theme = SubElement(
            themes,
            "visibility-preset",
            {"name": group.name, "has-expanded-info": "1", "has-checked-group-info": "1"},
        )
        for layer in group.layers():
            if layer.shown:
                SubElement(theme, "layer", id=layer.key, style="default", visible="1", expanded="0")
        checked, expanded = (
            SubElement(theme, "checked-group-nodes"),
            SubElement(theme, "expanded-group-nodes"),
        )
        inner = [f"{group.name}/{one.name}" for one in group.members if isinstance(one, Group)]
        for name in (group.name, *inner):
            SubElement(checked, "checked-group-node", id=name)
        for name in names:
            SubElement(expanded, "expanded-group-node", id=name)
    return themes


def _properties(georeferenced: bool) -> Element:
    properties = Element("properties")
    values = {
        ("Paths", "Absolute"): ("bool", "false"),
        ("SpatialRefSys", "ProjectionsEnabled"): ("int", "1" if georeferenced else "0"),
        ("PositionPrecision", "Automatic"): ("bool", "false"),
        ("PositionPrecision", "DecimalPlaces"): ("int", "2"),
        ("Measurement", "DistanceUnits"): ("QString", "meters"),
        ("Measurement", "AreaUnits"): ("QString", "m2"),
    }
    scopes: dict[str, Element] = {}
    for (scope, key), (kind, text) in values.items():
        if scope not in scopes:
            scopes[scope] = SubElement(properties, scope)
        SubElement(scopes[scope], key, type=kind).text = text
    return properties


def _bookmarks(places: Mapping[str, Extent], crs: str | None) -> Element:
    held = Element("Bookmarks")
    for name, (west, south, east, north) in places.items():
        corners = [(west, south), (east, south), (east, north), (west, north), (west, south)]
        ring = ", ".join(f"{x:.17g} {y:.17g}" for x, y in corners)
        one = SubElement(
            held,
            "Bookmark",
            id=f"{{{uuid5(NAMESPACE_URL, name)}}}",
            name=name,
            group="",
            extent=f"POLYGON(({ring}))",
        )
        one.append(crs_element(crs))
    return held


def _views(places: Mapping[str, Extent], crs: str | None) -> Element:
    """Return where the map opens, and what "zoom to all" shows: not what lies in frames of its own."""
    views = Element("ProjectViewSettings", UseProjectScales="0", rotation="0")
    whole = _union(
        [extent for name, extent in places.items() if name != "Source, as it came"] or [*places.values()]
    )
    for tag, extent in (("DefaultViewExtent", next(iter(places.values()))), ("PresetFullExtent", whole)):
        numbers = zip(("xmin", "ymin", "xmax", "ymax"), extent, strict=True)
        one = SubElement(views, tag, {name: f"{value:.17g}" for name, value in numbers})
        one.append(crs_element(crs))
    return views
