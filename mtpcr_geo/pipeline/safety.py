"""What a pipeline may not do unasked: run code, or reach beyond this machine."""

from __future__ import annotations

from collections.abc import Sequence

from mtpcr_geo.core.errors import OptionError, OutputError
from mtpcr_geo.core.suggestions import meant, nearest
from mtpcr_geo.pipeline import reach
from mtpcr_geo.pipeline.grammar import StageSpec, file_of
from mtpcr_geo.pipeline.pdal.allowed import ALLOWED, ONE_FILE, REFUSED
from mtpcr_geo.pipeline.pdal.switches import Access
from mtpcr_geo.pipeline.registry import stage_types

_FAMILIES = ("readers.", "filters.", "writers.")
# by connection strings, or by files that list further, possibly remote, ones
NETWORK_STAGES = frozenset(
    {
        "readers.i3s",
        "readers.oci",
        "readers.pgpointcloud",
        "readers.slpk",
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

_WRITES_BESIDE = {
    "filters.csf": "leaves files of its own in the current folder (filters.smrf finds ground too)",
}


def check(specs: Sequence[StageSpec], access: Access) -> None:
    """Refuse stages and options that run code or reach the network, and those that nobody knows.

    Nothing of PDAL is loaded or asked for this.

    Args:
        specs: the linked pipeline.
        access: what it may do.

    Raises:
        OptionError: naming the stage, and the flag that allows it.
        OutputError: if a stage would write beside the outputs that come into place together.

    """
    for spec in specs:
        if not spec.type.startswith(_FAMILIES):
            continue
        _check_outputs(spec)
        if spec.type in NETWORK_STAGES and not access.network:
            raise OptionError(f"{spec.label} may reach beyond this machine; say --allow-network to let it")
        for name, instead in _CLOSED.items():
            if name in spec.options:
                raise OptionError(f"{spec.label}: the option {name!r} is not handled; {instead}")
        if not access.code:
            _check_known(spec)
        if not access.network:
            reach.check(spec)


def _check_known(spec: StageSpec) -> None:
    """Refuse a stage or an option that is not known to run no code."""
    known = set(ALLOWED.get(spec.type, ()))
    own = stage_types().get(spec.type)
    if own is not None:
        known |= set(own.Options.model_fields) | {"user_data"}
    if spec.type in _WRITES_BESIDE:
        raise OptionError(f"{spec.label} {_WRITES_BESIDE[spec.type]}; say --allow-code if it may do so")
    if not known:
        near = nearest(spec.type, ALLOWED)
        hint = f"; did you mean {near!r}?" if near else ""
        raise OptionError(
            f"{spec.label} is none of the stages known to run no code{hint}"
            f"{'' if hint else ';'} say --allow-code if you trust the pipeline"
        )
    for name in spec.options:
        if name not in known:
            hint = meant(name, sorted(known)) if nearest(name, known) else ""
            raise OptionError(
                f"{spec.label}: no option {name!r}{hint or ' is known to run no code;'} "
                "say --allow-code if this PDAL has it and you trust the pipeline"
            )


def _check_outputs(spec: StageSpec) -> None:
    """Refuse a writer whose files do not come into place with the others."""
    if spec.type in REFUSED:
        raise OptionError(f"{spec.label} is not run: {REFUSED[spec.type]}")
    for (kind, name), drivers in ONE_FILE.items():
        if spec.type != kind:
            continue
        driver = spec.options.get(name)
        if driver is not None and str(driver).lower() not in drivers:
            raise OutputError(
                f"{spec.label}: the driver {str(driver)[:40]!r} may write several files, and outputs come "
                f"into place together or not at all; take one of {', '.join(sorted(drivers))}"
            )
        if driver is None and kind == "writers.ogr" and (file_of(spec.options) or "").lower().endswith("shp"):
            raise OutputError(
                f"{spec.label}: a shapefile is several files, and outputs come into place together or not at "
                "all; write .geojson or .gpkg"
            )
