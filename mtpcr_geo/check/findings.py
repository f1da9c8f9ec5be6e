"""What a check finds, and how it is worded."""

from __future__ import annotations

import json
import shlex
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

from mtpcr_geo.core.errors import MtpcrError

Severity = Literal["error", "warning", "note"]
CloudRole = Literal["source", "target"]
Role = CloudRole | Literal["both"]

_ORDER = ("error", "warning", "note", "source", "target", "both")
ABOUT_FILES = frozenset(
    ("wkt-bit-unset", "wkt-bit-wrong", "wkt-missing", "legacy-count", "return-counts", "gps-time")
    + ("extra-dimensions", "bounds-wide", "offset-far", "scale-fine", "epoch-missing")
)
"""Codes of findings about how a file is written, which change nothing in a registration."""


@dataclass(frozen=True)
class Finding:
    """One thing that is wrong, or worth knowing.

    Attributes:
        severity: "error": it will not be registered like this; "warning": the result would probably be
            wrong or hard to use; "note": good to know.
        code: a short name for programs, such as "crs-missing".
        role: which cloud it is about.
        what: what is the matter, with numbers.
        fix: what to do about it; "" where nothing needs to be done.

    """

    severity: Severity
    code: str
    role: Role
    what: str
    fix: str = ""


def finding_of(error: MtpcrError, code: str, role: Role) -> Finding:
    """Return a refusal as a finding: a message states what is wrong, a semicolon, and what to do."""
    what, _, fix = " ".join(str(error).split()).partition("; ")
    return Finding("error", code, role, what, fix)


def by_severity(findings: Iterable[Finding]) -> tuple[Finding, ...]:
    """Sort findings by what matters first.

    Errors before warnings before notes; of these, what bears on a registration before what is about how a
    file is written; then the source's before the target's.
    """

    def place(found: Finding) -> tuple[int, bool, int]:
        return _ORDER.index(found.severity), found.code in ABOUT_FILES, _ORDER.index(found.role)

    return tuple(sorted(findings, key=place))


def rewrite(path: object, **options: float) -> str:
    """Return how to write a file anew, as LAS 1.4 with its CRS as WKT and a true header.

    Args:
        path: the file.
        options: of the writer, such as ``scale_x``.

    """
    new = "new.laz"
    writer = {"type": "writers.las", "filename": new, **options} if options else new
    return f"write it anew: echo {shlex.quote(json.dumps([str(path), writer]))} | mtpcr-geo pipeline -"
