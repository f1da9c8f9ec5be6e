"""Files that hold a pose known beforehand: every form that is read, and what is said of the others."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest

from mtpcr_geo.core import transforms
from mtpcr_geo.core.errors import InputError
from mtpcr_geo.export.prior_file import read_pose

T = transforms.compose(transforms.yaw_matrix(0.3), np.array([367_000.25, 5_820_000.5, 31.0]))
ROWS = T.tolist()
PDAL = {"type": "filters.transformation", "matrix": " ".join(f"{v:.17g}" for v in T.ravel())}


@pytest.mark.parametrize(
    "text",
    [
        json.dumps(ROWS),
        json.dumps(T.ravel().tolist()),
        json.dumps({"T_target_source": ROWS}),
        json.dumps({"matrix": ROWS, "other": 1}),
        json.dumps({"pipeline": ["source.laz", PDAL, {"type": "writers.las", "filename": "a.laz"}]}),
        "\n".join(" ".join(f"{v:.17g}" for v in row) for row in ROWS),
        "# from another program\n" + "\n".join(", ".join(repr(v) for v in row) for row in ROWS) + "\n\n",
    ],
)
def test_forms_that_are_read(tmp_path: Path, text: str) -> None:
    (tmp_path / "T").write_text(text, encoding="utf-8")
    found = read_pose(tmp_path / "T")
    assert isinstance(found, np.ndarray)
    assert np.array_equal(found, T)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "is no 4x4"),
        ("1 0 0\n0 1 0\n0 0 1\n", "is no 4x4 but 3 x 3; write four rows"),
        ("1 0 0 0\n0 1 0\n", "not of equal length"),
        ("yaw 3\n", "is no 4x4 .could not convert"),
        ("1 0 0 0\n0 1 0 0\n0 0 1 0\n5 6 7 1\n", "has its shift in the last row; transpose it"),
        ("1 0 0 0\n0 1 0 0\n0 0 1 0\n0 0 0 2\n", "its last row is 0 0 0 2"),
        ("1 0 0 nan\n0 1 0 0\n0 0 1 0\n0 0 0 1\n", "not finite"),
        ("{", "is not JSON"),
        ('{"a": 1}', "none of the keys T_target_source, matrix, transformation"),
        ('{"type": "mtpcr-geo transform", "version": 99}', "of version 99"),
        (json.dumps({"pipeline": [{"type": "filters.reprojection"}, PDAL]}), "by 2 stages, not by one 4x4"),
        (json.dumps({"pipeline": ["a.laz"]}), "by 0 stages"),
    ],
)
def test_files_that_hold_none(tmp_path: Path, text: str, says: str) -> None:
    (tmp_path / "T").write_text(text, encoding="utf-8")
    with pytest.raises(InputError, match=says) as error:
        read_pose(tmp_path / "T")
    assert "\n" not in str(error.value)


def test_a_file_that_is_no_text(tmp_path: Path) -> None:
    (tmp_path / "T").write_bytes(b"\xff\xfe\x00\x81")
    with pytest.raises(InputError, match="is no text"):
        read_pose(tmp_path / "T")
    with pytest.raises(InputError, match="cannot read"):
        read_pose(tmp_path)
