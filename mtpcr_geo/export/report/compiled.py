"""The templates of a report, compiled.

That takes a quarter of a second, and is done when this module is imported: by another thread, while the
registration goes on.
"""

from __future__ import annotations

from jinja2 import Environment, PackageLoader, StrictUndefined

ENVIRONMENT = Environment(
    loader=PackageLoader("mtpcr_geo.export.report"),
    # texts from files are escaped wherever they are put
    autoescape=True,
    undefined=StrictUndefined,
    keep_trailing_newline=False,
)
TEMPLATES = {name: ENVIRONMENT.get_template(name) for name in ENVIRONMENT.list_templates(extensions=["j2"])}
TEMPLATE = TEMPLATES["report.html.j2"]
