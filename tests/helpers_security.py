"""What a hostile pipeline is tried with: a server that hears who comes, a library that tells that it ran."""

from __future__ import annotations

import json
import shutil
import socketserver
import subprocess
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
import pytest

WMS = "<GDAL_WMS><Service name='TMS'><ServerUrl>{url}/x</ServerUrl></Service></GDAL_WMS>"
VRT = (
    "<VRTDataset rasterXSize='1' rasterYSize='1'><VRTRasterBand dataType='Byte' band='1'><SimpleSource>"
    "<SourceFilename relativeToVRT='1'>{url}</SourceFilename></SimpleSource></VRTRasterBand></VRTDataset>"
)
OGR_VRT = (
    "<OGRVRTDataSource><OGRVRTLayer name='a'><SrcDataSource>{url}</SrcDataSource></OGRVRTLayer>"
    "</OGRVRTDataSource>"
)
CONSTRUCTOR = (
    "#include <stdio.h>\n__attribute__((constructor)) static void ran(void)"
    '{{ FILE *file = fopen("{mark}", "w"); if (file) fclose(file); }}\n'
)


class _Listening(socketserver.BaseRequestHandler):
    """Note that somebody came, and hang up."""

    def handle(self) -> None:
        self.server.came.append(self.client_address)  # type: ignore[attr-defined]


@contextmanager
def listening() -> Iterator[tuple[str, list[Any]]]:
    """Serve on this machine; give the address, and the list of those who have come."""
    with socketserver.TCPServer(("127.0.0.1", 0), _Listening) as server:
        server.came = []  # type: ignore[attr-defined]
        thread = threading.Thread(target=server.serve_forever, args=(0.05,))
        thread.start()
        try:
            yield f"http://127.0.0.1:{server.server_address[1]}", server.came  # type: ignore[attr-defined]
        finally:
            server.shutdown()
            thread.join()


def build_library(path: Path, mark: Path) -> Path:
    """Compile a shared library whose constructor makes the file `mark`; skip where that is not possible."""
    if shutil.which("cc") is None or not sys.platform.startswith("linux"):
        pytest.skip("needs a C compiler, on Linux")
    source = path.with_suffix(".c")
    source.write_text(CONSTRUCTOR.format(mark=mark))
    subprocess.run(["cc", "-shared", "-fPIC", "-o", path, source], check=True)
    source.unlink()
    return path


def write_ept(folder: Path) -> Path:
    """Write an Entwine point tile of a hundred points."""
    for name in ("ept-data", "ept-hierarchy"):
        (folder / name).mkdir(parents=True)
    xyz = np.random.default_rng(0).integers(0, 1000, (100, 3)).astype("<i4")
    dimension = {"type": "signed", "size": 4, "scale": 0.01, "offset": 0, "minimum": 0, "maximum": 10}
    bounds = [0, 0, 0, 10, 10, 10]
    facts = {
        "bounds": bounds, "boundsConforming": bounds, "dataType": "binary", "hierarchyType": "json",
        "points": 100, "schema": [{"name": axis, **dimension} for axis in "XYZ"], "span": 128, "srs": {},
        "version": "1.0.0",
    }  # fmt: skip
    (folder / "ept.json").write_text(json.dumps(facts))
    (folder / "ept-hierarchy/0-0-0-0.json").write_text(json.dumps({"0-0-0-0": 100}))
    (folder / "ept-data/0-0-0-0.bin").write_bytes(xyz.tobytes())
    return folder / "ept.json"
