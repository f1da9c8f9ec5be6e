"""The layers of a QGIS project: rasters and tables with style, CRS and extent, as their files have them."""

from __future__ import annotations

import sqlite3
from collections.abc import Sequence
from contextlib import closing
from copy import deepcopy
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import Any
from xml.etree import ElementTree
from xml.etree.ElementTree import Element, SubElement

from mtpcr_geo.export.raster_styles import shade_style

Extent = tuple[float, float, float, float]
"""West, south, east and north in map units."""


@dataclass(frozen=True, eq=False)
class LayerFile:
    """One file of a run that holds layers.

    Attributes:
        where: its path as the project writes it, relative to the project.
        path: where it can be read now.

    """

    where: str
    path: Path


@dataclass(frozen=True, eq=False)
class MapLayer:
    """One layer of a project.

    Attributes:
        key: its id in the project.
        title: what the list of layers shows.
        source: file, and table where it has several.
        geometry: "Point", "Line" or "Polygon"; "" for a raster.
        style: elements as in a ``.qml`` file.
        crs: WKT, or None for local coordinates.
        extent: in its own coordinates; None for a table without rows.
        shown: whether it is drawn when its group is.

    """

    key: str
    title: str
    source: str
    geometry: str
    style: Sequence[Element]
    crs: str | None
    extent: Extent | None
    shown: bool = True

    def element(self) -> Element:
        """Return the layer as the project holds it."""
        layer = Element(
            "maplayer", type="vector" if self.geometry else "raster", styleCategories="AllStyleCategories"
        )
        if self.geometry:
            layer.set("geometry", self.geometry)
            layer.set("labelsEnabled", "1")
        if self.extent is not None:
            layer.append(extent_element("extent", self.extent))
        for tag, text in (("id", self.key), ("datasource", self.source), ("layername", self.title)):
            SubElement(layer, tag).text = text
        SubElement(layer, "srs").append(crs_element(self.crs))
        provider = SubElement(layer, "provider")
        provider.text = "ogr" if self.geometry else "gdal"
        if self.geometry:
            provider.set("encoding", "UTF-8")
        flags = SubElement(layer, "flags")
        for name, value in (("Identifiable", "1"), ("Removable", "1"), ("Searchable", "1"), ("Private", "0")):
            SubElement(flags, name).text = value
        layer.extend(deepcopy(list(self.style)))
        return layer


@dataclass(frozen=True, eq=False)
class Group:
    """A group in the list of layers.

    Attributes:
        name: what the list shows.
        members: layers and groups, the one on top first.
        shown: whether it is drawn when the project is opened.
        expanded: whether the list shows its members.

    """

    name: str
    members: Sequence[MapLayer | Group]
    shown: bool = True
    expanded: bool = True

    def layers(self) -> list[MapLayer]:
        """Return all layers in it, the one on top first."""
        return list(
            chain.from_iterable(one.layers() if isinstance(one, Group) else [one] for one in self.members)
        )


def raster_layers(file: LayerFile, key: str, title: str, *, shaded: bool = True) -> list[MapLayer]:
    """Return a raster's layer in colours, and above it the one that shades it.

    Args:
        file: the GeoTIFF; its style lies beside it.
        key: start of the ids.
        title: of the layer.
        shaded: whether to add the shading.

    """
    crs, extent = raster_place(file.path)
    colours = MapLayer(f"{key}_colours", title, file.where, "", style_beside(file.path), crs, extent)
    return [shade_layer(file, key), colours] if shaded else [colours]


def shade_layer(file: LayerFile, key: str) -> MapLayer:
    """Return the layer that shades the layers below by the heights of a raster."""
    crs, extent = raster_place(file.path)
    return MapLayer(f"{key}_shading", "Shading", file.where, "", shade_style(), crs, extent)


def raster_place(path: Path) -> tuple[str | None, Extent]:
    """Return CRS (WKT, or None) and extent of a raster file."""
    import warnings

    import rasterio
    from rasterio.errors import NotGeoreferencedWarning

    with warnings.catch_warnings():
        warnings.simplefilter("ignore", NotGeoreferencedWarning)
        with rasterio.open(path) as file:
            crs = file.crs.to_wkt() if file.crs is not None else None
            bounds = file.bounds
    return crs, (bounds.left, bounds.bottom, bounds.right, bounds.top)


def style_beside(path: Path) -> list[Element]:
    """Return the style of a raster from the ``.qml`` beside it."""
    return list(ElementTree.parse(_style_path(path)).getroot())


def vector_layers(file: LayerFile, titles: dict[str, str], hidden: Sequence[str] = ()) -> dict[str, MapLayer]:
    """Return the layers of a GeoPackage by table, as far as they are there.

    Args:
        file: the GeoPackage, its styles in it.
        titles: tables, and what to call them.
        hidden: tables that are not drawn at first.

    """
    query = """
        SELECT c.table_name, g.geometry_type_name, c.min_x, c.min_y, c.max_x, c.max_y, s.styleQML,
            r.definition
        FROM gpkg_contents c JOIN gpkg_geometry_columns g USING (table_name)
        JOIN gpkg_spatial_ref_sys r ON r.srs_id = g.srs_id
        LEFT JOIN layer_styles s ON s.f_table_name = c.table_name"""
    kinds = {"POINT": "Point", "LINESTRING": "Line", "POLYGON": "Polygon"}
    with closing(sqlite3.connect(file.path)) as base:
        rows: list[tuple[Any, ...]] = base.execute(query).fetchall()
    found = {}
    for table, kind, *extent, style, definition in rows:
        if table in titles:
            crs = None if definition == "undefined" else definition
            found[table] = MapLayer(
                # QGIS replaces ids of ten letters and less
                f"evidence_{table}",
                titles[table],
                f"{file.where}|layername={table}",
                kinds[kind],
                list(ElementTree.fromstring(style)) if style else [],
                crs,
                None if extent[0] is None else tuple(extent),
                table not in hidden,
            )
    return found


def crs_element(wkt: str | None) -> Element:
    """Return a CRS as QGIS keeps it: by its code, or where it has none by its definition."""
    from pyproj import CRS

    held = Element("spatialrefsys")
    if wkt is None:
        SubElement(held, "wkt")
        SubElement(held, "authid")
        return held
    crs = CRS.from_wkt(wkt)
    authority = crs.to_authority(min_confidence=100)
    held.set("nativeFormat", "Wkt")
    SubElement(held, "wkt").text = crs.to_wkt()
    SubElement(held, "authid").text = ":".join(authority) if authority is not None else ""
    SubElement(held, "description").text = crs.name
    return held


def extent_element(tag: str, extent: Extent) -> Element:
    """Return an extent as QGIS keeps it."""
    held = Element(tag)
    for name, value in zip(("xmin", "ymin", "xmax", "ymax"), extent, strict=True):
        SubElement(held, name).text = f"{value:.17g}"
    return held


def _style_path(path: Path) -> Path:
    return path.with_suffix(".qml")
