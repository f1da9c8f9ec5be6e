"""The audit trail within a recording, as JSON: written at its end, and read back from the file alone."""

from __future__ import annotations

import json
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mtpcr_geo.core.cloud import Cloud
from mtpcr_geo.core.errors import InputError, MissingPartError
from mtpcr_geo.core.paths import short
from mtpcr_geo.core.types import Pair
from mtpcr_geo.crs.chain import TransformChain
from mtpcr_geo.export.run_json import plain
from mtpcr_geo.export.uncertainty_facts import check_facts

ENTITY = "trail"
VERSION = 1


def trail_json(
    properties: Mapping[str, Any], stages: Sequence[Mapping[str, Any]], pair: Pair | None, drawn: str
) -> str:
    """Return the trail of a run as JSON.

    Args:
        properties: what holds for the whole run: pipeline, versions, inputs.
        stages: the finished stages: tag, type, options, seconds, made.
        pair: the last state of the registration, if there is one.
        drawn: what was thinned for the recording.

    """
    verdict = pair.verdict if pair is not None else None
    solved = pair is not None and pair.T_target_source is not None
    trail = {
        "version": VERSION,
        **{name: properties[name] for name in ("pipeline", "versions", "inputs") if name in properties},
        "stages": list(stages),
        "verdict": verdict.name if verdict is not None else None,
        "sentence": verdict.headline if verdict is not None else None,
        "reasons": list(verdict.reasons) if verdict is not None else [],
        "checks": check_facts(verdict),
        "metrics": verdict.metrics if verdict is not None else {},
        "T_target_source": TransformChain.of(pair).T_file if pair is not None and solved else None,
        "drawn": drawn,
    }
    return json.dumps(plain(trail), allow_nan=False)


def recording_at(path: str | os.PathLike[str]) -> Path:
    """Return the recording that a folder holds, or that a path names.

    Raises:
        InputError: if there is none.

    """
    place = Path(path)
    try:
        file = place / "audit.rrd" if os.path.isdir(place) else place
        there = os.path.isfile(file)
    except (OSError, ValueError):
        file, there = place, False
    if not there:
        raise InputError(
            f"there is no recording {short(file)}; name the folder of a run, or its .rrd file "
            "(a run with --no-recording keeps none)"
        )
    return file


def read_trail(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read the audit trail of a recording; nothing but this file is read.

    Raises:
        InputError: if the file is no recording of this package's, or holds no trail.
        MissingPartError: if this rerun cannot read recordings.

    """
    try:
        from rerun.chunk import RrdReader
    except ImportError as error:
        raise MissingPartError("reading a recording needs rerun-sdk 0.41 or later; install it") from error
    file = recording_at(path)
    try:
        chunks = RrdReader(str(file)).stream().to_chunks()
        texts = [
            text
            for chunk in chunks
            if chunk.entity_path.strip("/") == ENTITY
            for row in chunk.to_record_batch().to_pylist()
            for text in row.get("TextDocument:text") or ()
        ]
    except (OSError, RuntimeError, ValueError) as error:
        raise InputError(f"{file} is no recording that rerun can read: {error}") from error
    if not texts:
        raise InputError(
            f"{file} holds no audit trail: another program wrote it, or a version of this one before trails "
            "were kept; run the registration again"
        )
    try:
        trail = json.loads(texts[-1])
    except (ValueError, RecursionError) as error:
        raise InputError(f"{file} holds an audit trail that is damaged: {error}") from error
    if not isinstance(trail, dict) or not isinstance(trail.get("stages"), list):
        raise InputError(f"{file} holds an audit trail that is damaged")
    if trail.get("version") != VERSION:
        raise InputError(
            f"{file} holds an audit trail of version {trail.get('version')}, and this program reads {VERSION}"
        )
    return trail


def what_was_made(value: object, before: Pair | None) -> str:
    """Return what a stage newly made, as a short text."""
    if isinstance(value, Cloud):
        return f"a cloud of {value.count:,} points, {Path(value.name).name}"
    if not isinstance(value, Pair):
        return "done"
    if before is None:
        return "both clouds in their work frames"
    found = []
    if value.target.bev is not None and value.target.bev is not before.target.bev:
        found.append(f"rasters of {value.target.bev.grid.cell:g} m cells")
    if value.matches is not None and value.matches is not before.matches:
        found.append(f"{len(value.matches.score)} matches")
    if value.tie_points is not None and value.tie_points is not before.tie_points:
        found.append(
            f"{len(value.tie_points.score)} tie points, {int(np.sum(value.tie_points.inlier))} agreeing"
        )
    if value.T_target_source is not None and value.T_target_source is not before.T_target_source:
        found.append("a transform")
    if value.verdict is not None and value.verdict is not before.verdict:
        found.append(f"verdict {value.verdict.name}")
    return ", ".join(found) or "done"
