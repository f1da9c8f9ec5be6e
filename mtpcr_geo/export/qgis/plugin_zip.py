"""The QGIS plugin as a zip that QGIS's plugin manager installs."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping
from importlib import resources
from pathlib import Path
from typing import Any

from mtpcr_geo.core.errors import OutputError
from mtpcr_geo.core.version import __version__

NAME = "mtpcr_geo_qgis"
"""Name of the plugin, and of its folder."""

_FILES = ("__init__.py", "plugin.py", "provider.py", "algorithms.py", "command.py", "icon.svg")
_EPOCH = (1980, 1, 1, 0, 0, 0)
_METADATA = """\
[general]
name=Lidar registration (mtpcr-geo)
qgisMinimumVersion=3.22
qgisMaximumVersion=4.99
description=Registers ground and aerial lidar clouds, and says whether to believe it
version={version}
author=mtpcr_geo contributors
about=Register, apply and check as algorithms of the Processing toolbox. They call the command mtpcr-geo, \
which has to be installed on this machine; nothing else is installed or downloaded.
hasProcessingProvider=yes
icon=icon.svg
tags=lidar,point cloud,registration,processing
category=Analysis
experimental=False
deprecated=False
"""


def write_plugin(path: Path, verbs: Mapping[str, Any], command: str | None = None) -> None:
    """Write the plugin.

    Args:
        path: the zip to write.
        verbs: parameters of the verbs register, apply and check, as the plugin reads them.
        command: file of the command that the plugin calls where nothing else is set.

    Raises:
        OutputError: if the file cannot be written.

    """
    code = resources.files("mtpcr_geo.export.qgis.plugin")
    files = {name: (code / name).read_bytes() for name in _FILES}
    files["metadata.txt"] = _METADATA.format(version=__version__).encode()
    files["verbs.json"] = json.dumps(verbs, indent=1).encode()
    if command is not None:
        files["written_by.json"] = json.dumps({"command": command}).encode()
    try:
        with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, data in sorted(files.items()):
                entry = zipfile.ZipInfo(f"{NAME}/{name}", _EPOCH)
                entry.compress_type = zipfile.ZIP_DEFLATED
                # readable by all: a zip says so itself
                entry.external_attr = 0o644 << 16
                archive.writestr(entry, data)
    except OSError as error:
        raise OutputError(f"cannot write the plugin {path}: {error}") from error
