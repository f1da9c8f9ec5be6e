"""QML styles for QGIS, carried inside the GeoPackage.

QGIS reads a table `layer_styles` in a GeoPackage and applies the style marked as default when the
layer is opened, so residuals need not be coloured by hand.
"""

from __future__ import annotations

from xml.sax.saxutils import escape, quoteattr

GOOD, FAIR, POOR, NEUTRAL = "26,152,80", "254,196,79", "215,48,39", "120,120,120"
SOURCE, TARGET = "230,97,1", "33,102,172"


def residual_style(limits_m: tuple[float, float] = (0.1, 0.5)) -> str:
    """Return a QML for points coloured by `residual_m`: green below, yellow between, red above the limits."""
    low, high = limits_m
    rules = (
        (f'"residual_m" < {low:g}', f"below {low:g} m", GOOD),
        (f'"residual_m" >= {low:g} AND "residual_m" < {high:g}', f"{low:g} to {high:g} m", FAIR),
        (f'"residual_m" >= {high:g}', f"{high:g} m and more", POOR),
        ('"residual_m" IS NULL', "no transform", NEUTRAL),
    )
    return _ruled("marker", rules)


def link_style(limits_m: tuple[float, float] = (0.1, 0.5)) -> str:
    """Return a QML for lines coloured by `residual_m`, like the tie points they belong to."""
    low, high = limits_m
    rules = (
        (f'"residual_m" < {high:g}', f"below {high:g} m", GOOD if high <= low else FAIR),
        (f'"residual_m" >= {high:g}', f"{high:g} m and more", POOR),
    )
    return _ruled("line", rules)


def footprint_style() -> str:
    """Return a QML for footprints: outlines only, the source in orange and the target in blue."""
    rules = (
        ("\"role\" = 'target'", "target", TARGET),
        ("\"role\" = 'source'", "source, registered", SOURCE),
    )
    return _ruled("fill", rules)


def _ruled(kind: str, rules: tuple[tuple[str, str, str], ...]) -> str:
    """Return a rule-based QML document; kind is "marker", "line" or "fill"."""
    entries = "".join(
        f'<rule key="r{i}" symbol="{i}" filter={quoteattr(test)} label={quoteattr(label)}/>'
        for i, (test, label, _) in enumerate(rules)
    )
    symbols = "".join(_symbol(kind, i, colour) for i, (_, _, colour) in enumerate(rules))
    return (
        "<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>"
        '<qgis version="3.22" styleCategories="Symbology">'
        '<renderer-v2 type="RuleRenderer" symbollevels="0">'
        f'<rules key="root">{entries}</rules><symbols>{symbols}</symbols></renderer-v2></qgis>'
    )


def _symbol(kind: str, name: int, colour: str) -> str:
    layer, options = {
        "marker": (
            "SimpleMarker",
            {"name": "circle", "color": f"{colour},255", "size": "2.4", "size_unit": "MM"}
            | {"outline_color": "35,35,35,255", "outline_width": "0.2"},
        ),
        "line": ("SimpleLine", {"line_color": f"{colour},255", "line_width": "0.5", "line_width_unit": "MM"}),
        "fill": (
            "SimpleFill",
            {
                "color": f"{colour},30",
                "style": "solid",
                "outline_color": f"{colour},255",
                "outline_width": "0.5",
            },
        ),
    }[kind]
    chosen = "".join(
        f'<Option name="{escape(key)}" type="QString" value="{escape(value)}"/>'
        for key, value in options.items()
    )
    return (
        f'<symbol name="{name}" type="{kind}" alpha="1" clip_to_extent="1" force_rhr="0">'
        f'<layer class="{layer}" enabled="1" locked="0" pass="0"><Option type="Map">{chosen}</Option></layer>'
        "</symbol>"
    )
