"""Poses known beforehand, as files: our own transforms, and 4x4 matrices of others."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.errors import InputError
from mtpcr_geo.core.paths import read_whole
from mtpcr_geo.crs.chain import TransformChain
from mtpcr_geo.export.transform import KIND, read_transform

MATRIX_KEYS = ("T_target_source", "matrix", "transformation")
_ROWS = "write four rows of four numbers, the last 0 0 0 1"


def read_pose(path: Path) -> TransformChain | Floats:
    """Read a pose from source to target file coordinates.

    Args:
        path: a ``transform.json``; a ``transform.pdal.json`` of a plain 4x4; JSON with four rows of four
            numbers, sixteen numbers, or an object that has them under one of `MATRIX_KEYS`; or text with
            four rows of four numbers, as CloudCompare writes them; a ``transform.cloudcompare.txt`` with
            the global shifts that it states.

    Returns:
        The chain of a ``transform.json``; else a 4x4.

    Raises:
        InputError: if it cannot be read, or is none of these.

    """
    try:
        text = read_whole(path).decode("utf-8-sig")
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror}; name a file with a 4x4") from error
    except UnicodeDecodeError as error:
        raise InputError(f"{path} is no text; name a transform.json, or a text file with a 4x4") from error
    if text.lstrip()[:1] in ("{", "["):
        return _from_json(text, path)
    lines = [line.split("#")[0].replace(",", " ").split() for line in text.splitlines()]
    try:
        numbers = [[float(word) for word in line] for line in lines if line]
    except ValueError as error:
        raise InputError(f"{path} is no 4x4 ({error}); {_ROWS}") from error
    T = matrix_of(numbers, str(path))
    try:
        shifts = [_shift(text, role) for role in ("source", "target")]
    except ValueError as error:
        raise InputError(f"{path} states a global shift that is none ({error})") from error
    with np.errstate(over="ignore", invalid="ignore"):
        moved = transforms.translation(-shifts[1]) @ T @ transforms.translation(shifts[0])
    if not np.isfinite(moved).all():
        raise InputError(f"{path} states numbers that are too large to be a pose")
    return np.asarray(moved)


def _shift(text: str, role: str) -> Floats:
    """Return the global shift that a matrix for CloudCompare states, (3,); zeros if it states none."""
    found = re.search(rf"^# {role} global shift: (\S+) (\S+) (\S+)$", text, re.M)
    return np.zeros(3) if found is None else np.array([float(one) for one in found.groups()])


def matrix_of(value: Any, name: str) -> Floats:
    """Return a 4x4 from nested or flat numbers, row by row.

    Raises:
        InputError: if it is none, or its last row is not 0 0 0 1.

    """
    try:
        array = np.asarray(value, np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{name} is no 4x4: its rows are not of equal length, or no numbers; {_ROWS}") from (
            error
        )
    if array.shape == (16,):
        array = array.reshape(4, 4)
    if array.shape != (4, 4):
        shape = " x ".join(map(str, array.shape)) or "one number"
        raise InputError(f"{name} is no 4x4 but {shape}; {_ROWS}")
    if not np.isfinite(array).all():
        raise InputError(f"{name} has numbers that are not finite; {_ROWS}")
    if np.array_equal(array[3], [0.0, 0.0, 0.0, 1.0]):
        return array
    if np.array_equal(array[:, 3], [0.0, 0.0, 0.0, 1.0]):
        raise InputError(f"{name} has its shift in the last row; transpose it: {_ROWS}")
    last = " ".join(f"{one:g}" for one in array[3])
    raise InputError(f"{name} is no rigid transform: its last row is {last}; {_ROWS}")


def _from_json(text: str, path: Path) -> TransformChain | Floats:
    try:
        document = json.loads(text)
    except RecursionError as error:
        raise InputError(f"{path} is nested too deeply; name a transform.json, or a 4x4") from error
    except ValueError as error:
        raise InputError(f"{path} is not JSON ({error}); name a transform.json, or a 4x4") from error
    if not isinstance(document, Mapping):
        return matrix_of(document, str(path))
    if document.get("type") == KIND:
        return read_transform(path)
    if "pipeline" in document:
        return _from_pdal(document["pipeline"], path)
    found = [key for key in MATRIX_KEYS if key in document]
    if not found:
        raise InputError(f"{path} has no 4x4: none of the keys {', '.join(MATRIX_KEYS)}; {_ROWS}")
    return matrix_of(document[found[0]], f"{path}: {found[0]}")


def _from_pdal(stages: Any, path: Path) -> Floats:
    """Return the 4x4 of a PDAL pipeline that moves points by nothing else."""
    named = [one for one in stages if isinstance(one, Mapping)] if isinstance(stages, list) else []
    kinds = ("transformation", "reprojection", "projpipeline")
    moves = [one for one in named if str(one.get("type", "")).endswith(kinds)]
    if len(moves) != 1 or moves[0].get("type") != "filters.transformation":
        raise InputError(
            f"{path} moves points by {len(moves)} stages, not by one 4x4; name the transform.json beside it"
        )
    try:
        numbers = [float(word) for word in str(moves[0].get("matrix", "")).split()]
    except ValueError as error:
        raise InputError(f"{path}: the matrix of its filters.transformation is no 4x4 ({error})") from error
    return matrix_of(numbers, f"{path}: the matrix of its filters.transformation")
