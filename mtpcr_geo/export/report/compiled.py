"""The templates of a report, compiled.

That takes a quarter of a second the first time. The result is kept where Python keeps that of this module,
and left out for the same reasons: where that folder cannot be written, or nothing is to be kept. It is done
when this module is imported: by another thread, while the registration goes on.
"""

from __future__ import annotations

import os
import sys
from contextlib import suppress
from importlib.util import cache_from_source
from pathlib import Path

from jinja2 import BytecodeCache, Environment, PackageLoader, StrictUndefined
from jinja2.bccache import Bucket


class BesideModules(BytecodeCache):
    """Keeps compiled templates beside the compiled modules."""

    def load_bytecode(self, bucket: Bucket) -> None:
        """Take what was kept, if it is of this template and this Python."""
        with suppress(OSError), _file_of(bucket).open("rb") as file:
            bucket.load_bytecode(file)

    def dump_bytecode(self, bucket: Bucket) -> None:
        """Keep a template, where that is possible."""
        if sys.dont_write_bytecode:
            return
        path = _file_of(bucket)
        part = path.with_suffix(f".{os.getpid()}.part")
        with suppress(OSError):
            path.parent.mkdir(parents=True, exist_ok=True)
            part.write_bytes(bucket.bytecode_to_string())
            part.replace(path)


def _file_of(bucket: Bucket) -> Path:
    return Path(cache_from_source(__file__)).with_suffix(f".{bucket.key}.j2c")


ENVIRONMENT = Environment(
    loader=PackageLoader("mtpcr_geo.export.report"),
    # texts from files are escaped wherever they are put
    autoescape=True,
    undefined=StrictUndefined,
    keep_trailing_newline=False,
    bytecode_cache=BesideModules(),
)
TEMPLATES = {name: ENVIRONMENT.get_template(name) for name in ENVIRONMENT.list_templates(extensions=["j2"])}
TEMPLATE = TEMPLATES["report.html.j2"]
