"""PDAL's, GDAL's and PROJ's own switches: what their libraries may do while a pipeline uses them.

The pipeline's text and the files it names are looked through before; these switches stand behind that, for
what a library finds by itself in a file.
"""

from __future__ import annotations

import os
import sys
from dataclasses import dataclass
from pathlib import Path

# nothing listens at port 0, and curl does not even ask for the address of a host behind a proxy
_NOWHERE = "http://127.0.0.1:0"
_NO_NETWORK = {
    **dict.fromkeys(("http_proxy", "https_proxy", "HTTPS_PROXY", "ftp_proxy", "all_proxy"), _NOWHERE),
    **dict.fromkeys(("FTP_PROXY", "ALL_PROXY", "GDAL_HTTP_PROXY", "GDAL_HTTPS_PROXY"), _NOWHERE),
    "no_proxy": "",
    "NO_PROXY": "",
    # the one file that GDAL may then fetch
    "CPL_VSIL_CURL_ALLOWED_FILENAME": "none",
    "GDAL_HTTP_MAX_RETRY": "0",
    "GML_DOWNLOAD_SCHEMA": "NO",
    "PROJ_NETWORK": "OFF",
}
_NO_CODE = {"GDAL_VRT_ENABLE_PYTHON": "NO", "OGR_SQLITE_LOAD_EXTENSIONS": ""}


@dataclass(frozen=True)
class Access:
    """What the stages of a pipeline may do.

    Attributes:
        code: run code of the pipeline's author.
        network: reach beyond this machine.

    """

    code: bool = False
    network: bool = False

    @property
    def _closed(self) -> dict[str, str]:
        return {**({} if self.code else _NO_CODE), **({} if self.network else _NO_NETWORK)}


def environment(access: Access) -> dict[str, str]:
    """Return the environment for a process of PDAL's: the libraries read there what they may do.

    By itself PDAL loads every ``libpdal_plugin_*`` of the current folder, as soon as it is asked which stages
    it has: a library that lies beside a pipeline would run. It is let look where it is installed only, unless
    PDAL_DRIVER_PATH says where.
    """
    variables = {**os.environ, **access._closed}
    if not variables.get("PDAL_DRIVER_PATH"):
        variables["PDAL_DRIVER_PATH"] = _plugins_home()
    return variables


def _plugins_home() -> str:
    prefixes = dict.fromkeys((sys.prefix, sys.base_prefix, os.environ.get("CONDA_PREFIX") or sys.prefix))
    folders = [Path(prefix) / below for prefix in prefixes for below in ("lib", "lib64", "Library/bin")]
    there = [str(folder) for folder in folders if folder.is_dir() and folder.is_absolute()]
    return os.pathsep.join(there or [str(Path(sys.prefix))])
