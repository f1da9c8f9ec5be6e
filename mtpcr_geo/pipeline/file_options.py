"""Options of the files that are read and written: how a text is laid out, which formats, which step."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from mtpcr_geo.pipeline.shown import INPUTS, OUTPUT, Shown


def _layout(value: Any) -> Any:
    """Return a layout as text, from text or a mapping; whatever is none is refused."""
    from mtpcr_geo.io.formats.text_layout import TextLayout

    return str(TextLayout.read(value)) if isinstance(value, str | Mapping) else value


TextLayoutText = Annotated[str, BeforeValidator(_layout)]
_METAVAR = "COLUMNS"
TEXT_GRAMMAR = (
    "names of the columns in order, - for one to leave out, then separator=, decimal= and skip= (lines "
    "before the points) where needed, such as 'x y z - intensity separator=; skip=2'; found in the file if "
    "not given"
)
SourceText = Annotated[
    TextLayoutText | None,
    Field(description=f"layout of a source that is text (XYZ, CSV, TXT, any ending): {TEXT_GRAMMAR}"),
    Shown(INPUTS, metavar=_METAVAR),
]
TargetText = Annotated[
    TextLayoutText | None,
    Field(description="layout of a target that is text, likewise"),
    Shown(INPUTS, metavar=_METAVAR),
]
CloudText = Annotated[
    TextLayoutText | None,
    Field(description=f"layout of a cloud that is text: {TEXT_GRAMMAR}"),
    Shown(INPUTS, ("--text",), metavar=_METAVAR),
]
AlsoFormat = Literal["input", "ply", "pcd", "xyz", "csv", "npy", "e57", "las", "copc.laz"]
Also = Annotated[
    AlsoFormat | None,
    Field(
        description="write the registered cloud in this format too, beside registered.laz; input is the "
        "source's own"
    ),
    Shown(OUTPUT),
]
Scale = Annotated[
    float | None,
    Field(
        gt=0,
        allow_inf_nan=False,
        description="step of the coordinates of the LAS file that is written, in units of its CRS, metres "
        "where those are degrees; if not given a millimetre, or the input's own where that is finer, as long "
        "as 32 bits hold the cloud",
    ),
    Shown(OUTPUT),
]
