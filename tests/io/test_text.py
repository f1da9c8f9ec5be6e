"""Text as programs of many countries write it: decimal commas, byte order marks, quotes, empty fields."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from mtpcr_geo.core.errors import InputError
from mtpcr_geo.io.formats import open_any

XYZ = np.array(
    [[453231.848, 5712348.864, 103.017], [453230.1, 5712347.0, 102.5], [453229.0, 5712346.25, 99.0]]
)


def table_of(path: Path, content: str | bytes) -> dict[str, np.ndarray]:
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    return dict(next(iter(open_any(path).table_chunks())))


def xyz_of(path: Path, content: str | bytes) -> np.ndarray:
    return open_any(path).to_array() if table_of(path, content) else np.empty(0)


@pytest.mark.parametrize("head", ["", "x{0}y{0}z\n", "# made by a scanner, in metres\n", "3\n"])
@pytest.mark.parametrize("sign", [";", "\t", " ", " ; "])
def test_a_comma_within_numbers_is_the_decimal_sign(sign, head, tmp_path):
    rows = [sign.join(f"{value:.3f}".rstrip("0").rstrip(".") for value in row) for row in XYZ]
    table = table_of(tmp_path / "a.txt", head.format(sign) + "\n".join(rows).replace(".", ",") + "\n")
    assert list(table) == ["X", "Y", "Z"]
    assert np.array_equal(np.column_stack([table[axis] for axis in "XYZ"]), XYZ)


@pytest.mark.parametrize(
    "text",
    ["1,2,3\n4,5,6\n", "1, 2, 3\n4, 5, 6\n", "1 ,2 ,3\n4 ,5 ,6\n", "1;2;3\n4;5;6\n", "1,2,3,\n4,5,6,\n",
     "1.0,2.0,3.0\n4,5,6\n", "1,2;3\n4,5;6\n"],
)  # fmt: skip
def test_a_comma_between_numbers_stays_one(text, tmp_path):
    assert xyz_of(tmp_path / "a.csv", text).tolist() == [[1, 2, 3], [4, 5, 6]]


@pytest.mark.parametrize("head", [b"", b"x,y,z\n", b"# notes\n"])
def test_a_byte_order_mark_is_no_part_of_a_number(head, tmp_path):
    text = b"\xef\xbb\xbf" + head + b"1.5,2.0,3.0\n4,5,6\n"
    assert xyz_of(tmp_path / "a.csv", text).tolist() == [[1.5, 2, 3], [4, 5, 6]]


def test_wide_characters_are_said(tmp_path):
    (tmp_path / "a.txt").write_bytes("1 2 3\n4 5 6\n".encode("utf-16"))
    with pytest.raises(InputError, match=r"UTF-16; save it as UTF-8"):
        open_any(tmp_path / "a.txt")


@pytest.mark.parametrize("head", ["", '"x","y","z"\n'])
def test_numbers_in_quotes(head, tmp_path):
    assert xyz_of(tmp_path / "a.csv", f'{head}"1.5","2","3"\n"4","5","6"\n').tolist() == [
        [1.5, 2, 3],
        [4, 5, 6],
    ]
    text = head.replace(",", ";") + '"1,5";"2";"3"\n"4";"5";"6"\n'
    assert xyz_of(tmp_path / "b.csv", text).tolist() == [[1.5, 2, 3], [4, 5, 6]]


def test_commas_in_quoted_numbers_and_between_them_are_refused(tmp_path):
    (tmp_path / "a.csv").write_text('"1,5","2,0","3,0"\n"4,5","5,0","6,0"\n')
    with pytest.raises(InputError, match="semicolons between columns"):
        open_any(tmp_path / "a.csv")


@pytest.mark.parametrize("sign", [",", ";"])
@pytest.mark.parametrize("named", [True, False])
def test_an_empty_field_is_a_missing_value_of_its_column(sign, named, tmp_path):
    rows = ["1.5,2,3,,5", "1,2,3,4,", "1,2,3, ,5", '1,2,3,"",5']
    head = "x,y,z,reflectance,range\n" if named else ""
    table = table_of(tmp_path / "a.csv", (head + "\n".join(rows) + "\n").replace(",", sign))
    first, second = ("reflectance", "range") if named else ("column_4", "column_5")
    assert np.array_equal(table[first], [np.nan, 4, np.nan, np.nan], equal_nan=True)
    assert np.array_equal(table[second], [5, np.nan, 5, 5], equal_nan=True)
    assert table["X"].tolist() == [1.5, 1, 1, 1]


def test_a_field_may_be_empty_far_behind_the_first_lines(tmp_path):
    rows = ["1.5,2,3,4"] * 3000 + ["1.5,2,3,"]
    table = table_of(tmp_path / "a.csv", "x,y,z,range\n" + "\n".join(rows) + "\n")
    assert np.isnan(table["range"]).nonzero()[0].tolist() == [3000]


@pytest.mark.parametrize(("row", "axis"), [(",2,3,4", "x"), ("1,,3,4", "y"), ("1,2, ,4", "z")])
def test_a_missing_coordinate_is_refused_with_its_line(row, axis, tmp_path):
    (tmp_path / "a.csv").write_text(f"x,y,z,range\n1,2,3,4\n1,2,3,4\n{row}\n1,2,3,4\n")
    with pytest.raises(InputError, match=rf"line 4 of .*a\.csv has no {axis}; "):
        open_any(tmp_path / "a.csv")


def test_a_coordinate_that_is_stated_to_be_none_is_read(tmp_path):
    assert np.isnan(xyz_of(tmp_path / "a.csv", "x,y,z\n1,2,3\nnan,2,3\n")).sum() == 1


@pytest.mark.parametrize("head", ["x,y,z,intensity,\n", ""])
def test_a_separator_behind_the_last_column_is_none(tmp_path: Path, head: str) -> None:
    path = tmp_path / "a.csv"
    path.write_text(head + "1.5,2.5,3.5,10,\n2.5,3.5,4.5,20,\n")
    table = next(open_any(path).table_chunks())
    assert list(table["X"]) == [1.5, 2.5]
    assert len(table) == 4
