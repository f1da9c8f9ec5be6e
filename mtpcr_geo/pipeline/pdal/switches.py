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
_NO_CODE = {"GDAL_VRT_ENABLE_PYTHON": "NO", "OGR_SQLITE_LOAD_EXTENSIONS": "", "PDAL_ALLOW_SHELL": "0"}
# drivers that ask servers past curl, or that are for servers alone; GPSBabel starts a program. GDAL warns
# of those that it lacks, so they are named only where PDAL's process keeps its standard error to itself
_DRIVERS_OUT = (
    "ADBC AmigoCloud Carto Cloudant CouchDB CSW DAAS DODS EEDA EEDAI Elasticsearch GEORASTER GPSBabel HANA "
    "HTTP IDB INGRES JPIPKAK MongoDB MongoDBv3 MSSQLSpatial MySQL NGW OAPIF OCI ODBC OGDI OGR_DODS OGR_OGDI "
    "PGeo PLMOSAIC PLSCENES PostGISRaster PostgreSQL RDA SDE STACIT STACTA WCS WFS WMS WMTS"
)


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
        closed = {**({} if self.code else _NO_CODE), **({} if self.network else _NO_NETWORK)}
        if not (self.code or self.network):
            mine = os.environ.get("GDAL_SKIP", "")
            between = "," if "," in mine else " "
            closed["GDAL_SKIP"] = between.join([*filter(None, [mine]), *_DRIVERS_OUT.split()])
        return closed


def environment(access: Access) -> dict[str, str]:
    """Return the environment for a process of PDAL's: the libraries read there what they may do.

    By itself PDAL loads every ``libpdal_plugin_*`` of the current folder, as soon as it is asked which stages
    it has: a library that lies beside a pipeline would run. It is let look where it is installed only, unless
    PDAL_DRIVER_PATH says where.
    """
    # where code is allowed, filters.shell needs no second leave
    variables = {"PDAL_ALLOW_SHELL": "1", **os.environ, **access._closed}
    if not variables.get("PDAL_DRIVER_PATH"):
        variables["PDAL_DRIVER_PATH"] = _plugins_home()
    return variables


def _plugins_home() -> str:
    prefixes = dict.fromkeys((sys.prefix, sys.base_prefix, os.environ.get("CONDA_PREFIX") or sys.prefix))
    folders = [Path(prefix) / below for prefix in prefixes for below in ("lib", "lib64", "Library/bin")]
    there = [str(folder) for folder in folders if folder.is_dir() and folder.is_absolute()]
    return os.pathsep.join(there or [str(Path(sys.prefix))])
