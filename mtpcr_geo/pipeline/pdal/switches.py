"""PDAL's, GDAL's and PROJ's own switches: what their libraries may do while a pipeline uses them.

The pipeline's text and the files it names are looked through before; these switches stand behind that, for
what a library finds by itself in a file.
"""

from __future__ import annotations

import os
import sys
from collections.abc import Iterator
from contextlib import contextmanager
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


class _Environment:
    """The environment as it was before the first holder closed something in it, and who holds it."""

    def __init__(self) -> None:
        self.before: dict[str, str | None] = {}
        self.holders = 0

    def hold(self, values: dict[str, str]) -> None:
        self.holders += 1
        for name, value in values.items():
            self.before.setdefault(name, os.environ.get(name))
            os.environ[name] = value

    def release(self) -> None:
        self.holders -= 1
        if self.holders:
            return
        for name, value in self.before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
        self.before.clear()


_ENVIRONMENT = _Environment()


@contextmanager
def held_to(access: Access) -> Iterator[None]:
    """Keep the libraries to what is allowed, as long as PDAL works.

    The libraries read environment variables; each is as it was when the last holder is done. While several
    hold, what one of them closes is closed for all.
    """
    _ENVIRONMENT.hold(access._closed)
    try:
        yield
    finally:
        _ENVIRONMENT.release()


def keep_plugins_home() -> None:
    """Let PDAL look for plugins where it is installed only, unless PDAL_DRIVER_PATH says where.

    By itself it loads every ``libpdal_plugin_*`` of the current folder, as soon as it is asked which stages
    it has: a library that lies beside a pipeline would run.
    """
    if os.environ.get("PDAL_DRIVER_PATH"):
        return
    prefixes = dict.fromkeys((sys.prefix, sys.base_prefix, os.environ.get("CONDA_PREFIX") or sys.prefix))
    folders = [Path(prefix) / below for prefix in prefixes for below in ("lib", "lib64", "Library/bin")]
    there = [str(folder) for folder in folders if folder.is_dir() and folder.is_absolute()]
    os.environ["PDAL_DRIVER_PATH"] = os.pathsep.join(there or [str(Path(sys.prefix))])
