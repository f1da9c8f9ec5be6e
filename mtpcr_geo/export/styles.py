"""How QGIS draws the layers of the GeoPackage: tie points, links, footprints, hypotheses.

A style is a list of XML elements, as in `mtpcr_geo.export.raster_styles`. QGIS reads it from the table
`layer_styles` of a GeoPackage, which it applies when the layer is opened, and from a project's layer.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from xml.etree.ElementTree import Element, SubElement

from mtpcr_geo.export.raster_styles import options_map, rgba

GOOD, FAIR, POOR, NEUTRAL, INK = "#1a9850", "#fdae33", "#d73027", "#787878", "#232323"
SOURCE, TARGET = "#e66101", "#2166ac"
LEAST_SPACING_MM = 3.0
"""Points closer together than this on the screen or the page give way to those that stand for them."""

# where a picture has no scale, all are drawn
_SPACED = f'"spacing_m" * 1000 >= {LEAST_SPACING_MM:g} * coalesce(@map_scale, 0)'

Rule = tuple[str, str, Sequence[Element]]
"""A condition, its line of the legend, and the symbol layers."""


def residual_style(limits_m: tuple[float, float] = (0.1, 0.5)) -> list[Element]:
    """Return the style of tie points: green, yellow and red by `plan_m`, held-out ones as diamonds.

    They thin out with the scale: a point whose `spacing_m`, its distance to the nearest one that stands for
    it, is less than 3 mm on the map is left out.

    Args:
        limits_m: where green ends and red begins, metres.

    """
    rules = [
        (f"({test}) AND {_SPACED}", label, [_marker(colour)]) for test, label, colour in _classes(limits_m)
    ]
    tip = '<b>[% "tie_point" %]</b>: plan [% round("plan_m", 3) %] m, height [% round("dz_m", 3) %] m'
    return [_ruled("marker", rules), _text("mapTip", tip)]


def link_style(limits_m: tuple[float, float] = (0.1, 0.5), exaggeration: float = 1.0) -> list[Element]:
    """Return the style of links: an arrow from the target's end towards the source's, drawn longer.

    Args:
        limits_m: where green ends and red begins, metres.
        exaggeration: factor on the length of the arrows of tie points that agree; the others are drawn as
            they are.

    """
    arrow = (
        "make_line(end_point($geometry), translate(end_point($geometry), "
        f"{exaggeration:g} * (x(start_point($geometry)) - x(end_point($geometry))), "
        f"{exaggeration:g} * (y(start_point($geometry)) - y(end_point($geometry)))))"
    )
    rules: list[Rule] = [
        (f'"inlier" AND ({test})', f"{label}, drawn {exaggeration:g} times", [_generated(arrow, colour)])
        for test, label, colour in _classes(limits_m)[:-1]
    ]
    rules.append(('NOT "inlier"', "does not agree, as it is", [_line(NEUTRAL, 0.2, "dot")]))
    return [_ruled("line", rules)]


def footprint_style() -> list[Element]:
    """Return the style of footprints: outlines only, the source in orange and the target in blue."""
    rules = [
        ("\"role\" = 'source'", "source, registered: convex outline", [_fill(SOURCE, "solid")]),
        ("\"role\" = 'target'", "target: convex outline", [_fill(TARGET, "dash")]),
    ]
    return [_ruled("fill", rules)]


def hypothesis_style() -> list[Element]:
    """Return the style of hypotheses: numbered by rank, the one that was followed in green."""
    rules = [
        ('"rank" = 1', "followed", [_marker(GOOD, "star", 4.5)]),
        ('"rank" > 1', "other pose", [_marker("#ffffff", "circle", 2.6)]),
    ]
    tip = 'rank [% "rank" %]: turned [% round("yaw_deg", 1) %] degrees, score [% round("score", 1) %]'
    return [_ruled("marker", rules), _labels("rank"), _text("mapTip", tip)]


def aliases(names: Mapping[str, str]) -> Element:
    """Return the element that names fields for people.

    Args:
        names: what to show for each field, in the order of the fields; the first one in the file is `fid`.

    """
    held = Element("aliases")
    for index, (field, name) in enumerate(names.items(), start=1):
        SubElement(held, "alias", index=str(index), field=field, name=name)
    return held


def _classes(limits_m: tuple[float, float]) -> list[tuple[str, str, str]]:
    low, high = limits_m
    return [
        (f'"plan_m" < {low:g}', f"below {low:g} m in plan", GOOD),
        (f'"plan_m" >= {low:g} AND "plan_m" < {high:g}', f"{low:g} to {high:g} m", FAIR),
        (f'"plan_m" >= {high:g}', f"{high:g} m and more", POOR),
        ('"plan_m" IS NULL', "no transform", NEUTRAL),
    ]


def _ruled(kind: str, rules: Iterable[Rule]) -> Element:
    """Return a rule-based renderer; kind is "marker", "line" or "fill"."""
    renderer = Element("renderer-v2", type="RuleRenderer", symbollevels="0", enableorderby="0")
    held = SubElement(renderer, "rules", key="root")
    symbols = SubElement(renderer, "symbols")
    for index, (test, label, layers) in enumerate(rules):
        SubElement(held, "rule", key=f"r{index}", symbol=str(index), filter=test, label=label)
        symbols.append(_symbol(str(index), kind, layers))
    return renderer


def _symbol(name: str, kind: str, layers: Iterable[Element]) -> Element:
    symbol = Element("symbol", name=name, type=kind, alpha="1", clip_to_extent="1", force_rhr="0")
    symbol.extend(layers)
    return symbol


def _layer(kind: str, values: dict[str, str]) -> Element:
    layer = Element("layer", {"class": kind, "enabled": "1", "locked": "0", "pass": "0"})
    options_map(layer, values)
    return layer


def _marker(colour: str, shape: str = "", size_mm: float = 2.4) -> Element:
    values = {
        "name": shape or "circle",
        "color": rgba(colour),
        "size": f"{size_mm:g}",
        "size_unit": "MM",
        "outline_color": rgba(INK),
        "outline_width": "0.25",
        "outline_width_unit": "MM",
    }
    layer = _layer("SimpleMarker", values)
    if not shape:
        _by_expression(layer, "name", "if(\"held_out\", 'diamond', 'circle')")
    return layer


def _line(colour: str, width_mm: float, style: str = "solid") -> Element:
    values = {"line_color": rgba(colour), "line_width": f"{width_mm:g}", "line_width_unit": "MM"}
    return _layer("SimpleLine", {**values, "line_style": style, "capstyle": "round"})


def _fill(colour: str, outline: str) -> Element:
    values = {"style": "no", "outline_color": rgba(colour), "outline_style": outline}
    return _layer("SimpleFill", {**values, "outline_width": "0.5", "outline_width_unit": "MM"})


def _generated(expression: str, colour: str) -> Element:
    """Return the symbol layer of an arrow along a line that an expression makes."""
    layer = _layer(
        "GeometryGenerator",
        {"SymbolType": "Line", "geometryModifier": expression, "units": "MapUnit"},
    )
    head = _layer("MarkerLine", {"placement": "lastvertex", "placements": "LastVertex", "rotate": "1"})
    tip = _layer(
        "SimpleMarker",
        {
            "name": "filled_arrowhead",
            "color": rgba(colour),
            "outline_color": rgba(INK),
            "outline_width": "0.1",
            "size": "2",
            "size_unit": "MM",
        },
    )
    head.append(_symbol("@head", "marker", [tip]))
    layer.append(_symbol("@arrow", "line", [_line(INK, 0.7), _line(colour, 0.45), head]))
    return layer


def _by_expression(layer: Element, name: str, expression: str) -> None:
    """Let an expression say one property of a symbol layer."""
    held = SubElement(SubElement(layer, "data_defined_properties"), "Option", type="Map")
    SubElement(held, "Option", name="name", type="QString", value="")
    properties = SubElement(held, "Option", name="properties", type="Map")
    one = SubElement(properties, "Option", name=name, type="Map")
    SubElement(one, "Option", name="active", type="bool", value="true")
    SubElement(one, "Option", name="expression", type="QString", value=expression)
    SubElement(one, "Option", name="type", type="int", value="3")
    SubElement(held, "Option", name="type", type="QString", value="collection")


def _labels(field: str) -> Element:
    """Return labels that show a field beside each point, with a white rim."""
    labeling = Element("labeling", type="simple")
    settings = SubElement(labeling, "settings", calloutType="simple")
    text = SubElement(
        settings,
        "text-style",
        fieldName=field,
        isExpression="0",
        fontFamily="Sans Serif",
        fontSize="9",
        fontSizeUnit="Point",
        textColor=rgba(INK),
        textOpacity="1",
    )
    rim = {"bufferDraw": "1", "bufferSize": "0.8", "bufferSizeUnits": "MM", "bufferOpacity": "1"}
    SubElement(text, "text-buffer", {**rim, "bufferColor": rgba("#ffffff")})
    SubElement(settings, "placement", placement="0", dist="1.8", distUnits="MM")
    SubElement(settings, "rendering", displayAll="0", obstacle="1")
    return labeling


def _text(tag: str, text: str) -> Element:
    element = Element(tag)
    element.text = text
    return element
