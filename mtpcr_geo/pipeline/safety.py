"""What a pipeline may not do unasked: run code, or reach beyond this machine."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

from mtpcr_geo.core.errors import OptionError
from mtpcr_geo.pipeline.grammar import StageSpec

CODE_STAGES = frozenset({"filters.python", "filters.matlab", "filters.julia", "readers.numpy"})
# by connection strings, or by files that list further, possibly remote, ones
NETWORK_STAGES = frozenset(
    {
        "readers.i3s",
        "readers.oci",
        "readers.pgpointcloud",
        "readers.stac",
        "readers.tiledb",
        "readers.tindex",
        "writers.oci",
        "writers.pgpointcloud",
        "writers.tiledb",
    }
)
# options that read further options, or write, past every check
_CLOSED = {
    "option_file": "put its options into the pipeline",
    "log": "use --metadata and --verbose",
}
_REMOTE = re.compile(r"\s*[a-z][a-z0-9+.-]*://", re.IGNORECASE)
_VIRTUAL = re.compile(r"(^|[\s\"'{(,])/vsi", re.IGNORECASE)
# GDAL opens "PG:host=...", "WMS:..." and inline XML where a file is expected; one letter is a drive
_FILE_OPTIONS = frozenset({"filename", "raster", "datasource", "path"})
_CONNECTION = re.compile(r"\s*(<|[A-Za-z][A-Za-z0-9_]+:(?!//))")


def check(specs: Sequence[StageSpec], *, allow_code: bool, allow_network: bool) -> None:
    """Refuse stages that run code or reach the network.

    Raises:
        OptionError: naming the stage, and the flag that allows it.

    """
    for spec in specs:
        if spec.type in CODE_STAGES and not allow_code:
            raise OptionError(
                f"{spec.label} runs code of the pipeline's author; say --allow-code if you trust it"
            )
        if spec.type in NETWORK_STAGES and not allow_network:
            raise OptionError(f"{spec.label} may reach beyond this machine; say --allow-network to let it")
        for name, instead in _CLOSED.items():
            if name in spec.options:
                raise OptionError(f"{spec.label}: the option {name!r} is not handled; {instead}")
        for name, text in _texts(spec.options):
            if not allow_network and _reaches_out(name, text):
                raise OptionError(
                    f"{spec.label}: option {name!r} names something remote or virtual, {text[:60]!r}; "
                    "say --allow-network to let it"
                )


def _reaches_out(name: str, text: str) -> bool:
    if _REMOTE.match(text) or _VIRTUAL.search(text):
        return True
    return name in _FILE_OPTIONS and _CONNECTION.match(text) is not None


def _texts(options: Mapping[str, Any]) -> Iterator[tuple[str, str]]:
    for name, value in options.items():
        if name == "user_data":
            continue
        values: list[Any] = value if isinstance(value, list) else [value]
        for one in values:
            if isinstance(one, str):
                yield name, one
            elif isinstance(one, Mapping):
                yield from _texts(one)
