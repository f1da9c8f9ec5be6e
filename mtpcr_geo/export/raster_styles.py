"""How QGIS draws the rasters: colours of height, shading, signed differences.

A style is a list of XML elements. QGIS reads the same elements from a ``.qml`` file beside a raster, which it
applies when the raster is opened, and from a project's layer; they are valid for QGIS 3.22 and newer.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Sequence
from itertools import pairwise
from pathlib import Path
from xml.etree.ElementTree import Element, SubElement, indent, tostring

import numpy as np

from mtpcr_geo.core.arrays import Floats, Image
from mtpcr_geo.core.errors import OutputError

QGIS_VERSION = "3.22.0"
"""The oldest QGIS for which styles and projects are written."""

Stops = Sequence[tuple[float, str]]
"""Places from 0 to 1 along a colour ramp, and their colours."""

RELIEF: Stops = (
    (0.0, "#3f7f64"),
    (0.18, "#7fae72"),
    (0.36, "#d0d490"),
    (0.54, "#e3c37c"),
    (0.72, "#c08a5c"),
    (0.88, "#a0785f"),
    (1.0, "#f5f2ee"),
)
DIFFERENCE: Stops = (
    (0.0, "#1f4e99"),
    (0.25, "#5b9bd0"),
    (0.45, "#d6e6f2"),
    (0.5, "#fbfbf5"),
    (0.55, "#fbe0cc"),
    (0.75, "#e58a55"),
    (1.0, "#a3211f"),
)
LARGEST_DIFFERENCE_M = 1.0
SMALLEST_RANGE_M = 1.0
_SHOWN_PERCENT = (2.0, 98.0)
_MOST_SAMPLED = 200_000
_NORMAL, _MULTIPLY = "0", "6"
_SHADE_OPACITY = 0.6
# level ground stays nearly as bright as its colour
_SHADE_BRIGHTNESS = 60


def height_limits(tops: Iterable[Image]) -> tuple[float, float]:
    """Return the heights that a colour ramp spans: the middle 96 % of those given.

    Args:
        tops: (h, w) heights in metres, NaN where empty.

    Returns:
        Least and greatest, metres, at least a metre apart.

    """
    parts = [np.asarray(top[np.isfinite(top)], np.float64) for top in tops]
    z = np.concatenate([part[:: max(1, len(part) // _MOST_SAMPLED)] for part in parts] or [np.empty(0)])
    if not len(z):
        return 0.0, SMALLEST_RANGE_M
    low, high = (float(value) for value in np.percentile(z, _SHOWN_PERCENT))
    return low, max(high, low + SMALLEST_RANGE_M)


def difference_limit(difference: Image) -> float:
    """Return the difference at which both ends of the ramp lie: five times the noise of those that agree.

    Args:
        difference: (h, w) metres, NaN where there is none.

    Returns:
        Whole decimetres, from 0.2 to 1 m.

    """
    known: Floats = difference[np.isfinite(difference)].astype(np.float64)
    if not len(known):
        return LARGEST_DIFFERENCE_M
    # walls and crowns differ by metres: the median of what is left knows nothing of them
    noise = 1.4826 * float(np.median(np.abs(known - np.median(known))))
    return float(np.clip(np.ceil(50.0 * noise) / 10.0, 0.2, LARGEST_DIFFERENCE_M))


def relief_style(low: float, high: float) -> list[Element]:
    """Return the style that colours band 1 by height, from green (low) over tan and brown to white (high)."""
    return _pipe(_pseudocolour(RELIEF, low, high), _NORMAL)


def difference_style(limit: float) -> list[Element]:
    """Return the style of signed differences in band 1: blue below, red above, pale where there is none."""
    return _pipe(_pseudocolour(DIFFERENCE, -limit, limit), _NORMAL)


def shade_style() -> list[Element]:
    """Return the style that shades band 1 as if lit from north-west, and darkens the layers below.

    It is half transparent: at the foot of walls the slope between two cells is so steep that full shades
    would draw every edge in black.
    """
    shade = Element(
        "rasterrenderer",
        type="hillshade",
        band="1",
        azimuth="315",
        angle="45",
        zfactor="1",
        multidirection="0",
        opacity=f"{_SHADE_OPACITY:g}",
        alphaBand="-1",
        nodataColor="",
    )
    return _pipe(shade, _MULTIPLY, brightness=_SHADE_BRIGHTNESS, smooth=True)


def qml(elements: Iterable[Element]) -> bytes:
    """Return a style as the document that QGIS reads and writes."""
    root = Element("qgis", version=QGIS_VERSION, styleCategories="AllStyleCategories")
    root.extend(elements)
    indent(root)
    return b"<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>\n" + tostring(root) + b"\n"


def write_qml(path: str | os.PathLike[str], elements: Iterable[Element]) -> None:
    """Write a style to a file, which QGIS applies to the raster of the same name.

    Raises:
        OutputError: if the file cannot be written.

    """
    try:
        Path(path).write_bytes(qml(elements))
    except OSError as error:
        raise OutputError(f"cannot write the style {Path(path)}: {error}") from error


def options_map(parent: Element, values: dict[str, str]) -> Element:
    """Append the element in which QGIS keeps named values."""
    held = SubElement(parent, "Option", type="Map")
    for name, value in values.items():
        SubElement(held, "Option", name=name, type="QString", value=value)
    return held


def rgba(colour: str, alpha: int = 255) -> str:
    """Return a colour such as "#3f7f64" as QGIS writes it in options: red, green, blue and alpha."""
    red, green, blue = (int(colour[place : place + 2], 16) for place in (1, 3, 5))
    return f"{red},{green},{blue},{alpha}"


def _pipe(renderer: Element, blend: str, brightness: int = 0, smooth: bool = False) -> list[Element]:
    """Return a layer's pipe and its blend mode; a smooth one takes heights between the cells' centres."""
    pipe = Element("pipe")
    # colours show the cells as they are; shades need slopes, and a cell drawn larger has none but at its edge
    methods = {
        "zoomedInResamplingMethod": "cubic" if smooth else "nearestNeighbour",
        "zoomedOutResamplingMethod": "nearestNeighbour",
    }
    enabled = "true" if smooth else "false"
    provider = SubElement(pipe, "provider")
    SubElement(provider, "resampling", {"enabled": enabled, "maxOversampling": "2", **methods})
    pipe.append(renderer)
    SubElement(pipe, "brightnesscontrast", brightness=str(brightness), contrast="0", gamma="1")
    SubElement(pipe, "huesaturation", saturation="0", grayscaleMode="0", colorizeOn="0", invertColors="0")
    SubElement(pipe, "rasterresampler", maxOversampling="2")
    SubElement(pipe, "resamplingStage").text = "provider" if smooth else "resamplingFilter"
    mode = Element("blendMode")
    mode.text = blend
    return [pipe, mode]


def _pseudocolour(stops: Stops, low: float, high: float) -> Element:
    limits = {"classificationMin": f"{low:.3f}", "classificationMax": f"{high:.3f}"}
    kind = {"type": "singlebandpseudocolor", "band": "1", "opacity": "1", "alphaBand": "-1"}
    renderer = Element("rasterrenderer", {**kind, "nodataColor": "", **limits})
    origin = SubElement(renderer, "minMaxOrigin")
    for name, text in (("limits", "None"), ("extent", "WholeRaster"), ("statAccuracy", "Estimated")):
        SubElement(origin, name).text = text
    shader = SubElement(
        SubElement(renderer, "rastershader"),
        "colorrampshader",
        colorRampType="INTERPOLATED",
        classificationMode="1",
        clip="0",
        minimumValue=limits["classificationMin"],
        maximumValue=limits["classificationMax"],
        labelPrecision="2",
    )
    ramp = SubElement(shader, "colorramp", type="gradient", name="[source]")
    between = ":".join(f"{place:g};{rgba(colour)}" for place, colour in stops[1:-1])
    ends = {"color1": rgba(stops[0][1]), "color2": rgba(stops[-1][1])}
    options_map(ramp, {**ends, "discrete": "0", "rampType": "gradient", "stops": between})
    for place, colour in stops:
        value = low + place * (high - low)
        SubElement(shader, "item", value=f"{value:.3f}", label=f"{value:.2f} m", color=colour, alpha="255")
    legend = SubElement(
        shader,
        "rampLegendSettings",
        useContinuousLegend="1",
        orientation="2",
        direction="0",
        minimumLabel="",
        maximumLabel="",
        prefix="",
        suffix=" m",
    )
    number = SubElement(SubElement(legend, "numericFormat", id="basic"), "Option", type="Map")
    SubElement(number, "Option", name="decimals", type="int", value="1")
    SubElement(number, "Option", name="show_thousand_separator", type="bool", value="false")
    SubElement(number, "Option", name="show_trailing_zeros", type="bool", value="true")
    assert all(one[0] < other[0] for one, other in pairwise(stops))
    return renderer
