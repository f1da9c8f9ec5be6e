"""Mutated files, pipelines, transforms and model descriptions, each by a seed; also a command for long runs.

    python tests/helpers_fuzz.py files --count 10000 --seed 1 --jobs 1

prints what each kind came to. A try is bad where it ends in anything but success or an error of the
package's own, warns, takes more than 20 s of processor time, or says that it wrote what it did not. Run
outside pytest, a crash ends the process, and so does a try that hangs for 3 minutes: the seed stands in the
file named by --last.
"""

from __future__ import annotations

import argparse
import collections
import copy
import faulthandler
import json
import random
import re
import struct
import sys
import tempfile
import time
import traceback
import warnings
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import laspy
import numpy as np
from pyproj import CRS
from typer.testing import CliRunner

from mtpcr_geo.cli.app import app
from mtpcr_geo.core.errors import MtpcrError
from mtpcr_geo.io.formats import open_any

LONGEST_S = 20.0
"""Of processor time: what else runs on the machine is no fault of a try."""
HANGING_S = 180.0
OWN_EXITS = {0, 2, 3, 4, 5, 6, 7, 8, 9}
N = 400
PLACE = np.array([400_000.0, 5_800_000.0, 30.0])


class BadTryError(AssertionError):
    """A try that ended as none may."""


def cloud_xyz() -> np.ndarray:
    rng = np.random.default_rng(5)
    xyz = rng.uniform(0, 40, (N, 3)) * [1, 1, 0.2]
    rounded: np.ndarray = np.round(xyz, 3)
    return np.asarray(rounded + PLACE)


def write_las(path: Path, version: str, fmt: int, *, keys: bool = False) -> Path:
    """Write a LAS or LAZ file with a CRS, records and extra dimensions."""
    xyz = cloud_xyz()
    header = laspy.LasHeader(version=version, point_format=fmt)
    header.scales, header.offsets = np.full(3, 0.001), np.floor(PLACE)
    header.vlrs.append(laspy.VLR("mine", 7, "a record", bytes(range(100))))
    header.add_extra_dim(laspy.ExtraBytesParams("height", "f4", "above ground"))
    if keys:
        directory = struct.pack("<16H", 1, 1, 0, 3, 1024, 0, 1, 1, 3072, 0, 1, 25833, 3076, 0, 1, 9001)
        header.vlrs.append(laspy.VLR("LASF_Projection", 34735, "keys", directory))
    else:
        header.add_crs(CRS.from_epsg(25833))
    las = laspy.LasData(header)
    las.x, las.y, las.z = xyz.T
    las.intensity = np.arange(N) % 1000
    las["height"] = np.arange(N, dtype=np.float32)
    las.write(path)
    return path


def bases(folder: Path) -> dict[str, bytes]:
    """Return whole files of each format, by name."""
    from mtpcr_geo.core.cloud import ArrayCloud
    from mtpcr_geo.io.write import write_cloud

    folder.mkdir(exist_ok=True)
    xyz = cloud_xyz()
    write_las(folder / "a.las", "1.2", 3, keys=True)
    write_las(folder / "b.las", "1.4", 6)
    write_las(folder / "c.laz", "1.4", 7)
    write_las(folder / "d.laz", "1.2", 1, keys=True)
    write_cloud(folder / "e.copc.laz", ArrayCloud(xyz, CRS.from_epsg(25833), "e"), None, CRS.from_epsg(25833))
    np.save(folder / "f.npy", xyz)
    np.savetxt(folder / "g.xyz", xyz, fmt="%.3f")
    rows = "\n".join(f"{x:.3f},{y:.3f},{z:.3f},{i}" for i, (x, y, z) in enumerate(xyz))
    (folder / "h.csv").write_text(f"x,y,z,intensity\n{rows}\n")
    (folder / "i.pts").write_text(f"{N}\n" + "\n".join(f"{x} {y} {z} 7" for x, y, z in xyz) + "\n")
    head = f"1\n{N}\n0 0 0\n1 0 0\n0 1 0\n0 0 1\n1 0 0 0\n0 1 0 0\n0 0 1 0\n400000 5800000 30 1\n"
    (folder / "j.ptx").write_text(head + "\n".join(f"{x} {y} {z} 0.5" for x, y, z in xyz - PLACE) + "\n")
    ply = "ply\nformat {} 1.0\nelement vertex {}\n" + "".join(f"property double {a}\n" for a in "xyz")
    head = (ply + "end_header\n").format("binary_little_endian", N)
    (folder / "k.ply").write_bytes(head.encode() + xyz.astype("<f8").tobytes())
    head = (ply + "end_header\n").format("ascii", N)
    (folder / "l.ply").write_text(head + "\n".join("{} {} {}".format(*row) for row in xyz) + "\n")
    pcd = (
        f"VERSION .7\nFIELDS x y z\nSIZE 8 8 8\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {N}\nHEIGHT 1\n"
        f"VIEWPOINT 0 0 0 1 0 0 0\nPOINTS {N}\nDATA binary\n"
    )
    (folder / "m.pcd").write_bytes(pcd.encode() + xyz.astype("<f8").tobytes())
    try:
        import pye57
    except ImportError:
        pass
    else:
        with pye57.E57(str(folder / "n.e57"), mode="w") as file:
            file.write_scan_raw({f"cartesian{axis}": xyz[:, i] for i, axis in enumerate("XYZ")})
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def regions(name: str, data: bytes) -> list[tuple[int, int]]:
    """Return the parts of a file that decide what it is: header, records, table of chunks, all."""
    whole = (0, len(data))
    if not name.endswith((".las", ".laz")):
        return [(0, min(len(data), 400)), whole]
    size, points = struct.unpack_from("<HI", data, 94)
    found = [(0, size), (94, 227), (size, points), (points, min(points + 400, len(data))), whole]
    if name.endswith(".laz"):
        (table,) = struct.unpack_from("<q", data, points)
        found.append((points, points + 8))
        if 0 < table < len(data):
            found.append((table, min(table + 64, len(data))))
    return [one for one in found if one[1] > one[0]]


NUMBERS = [0, 1, -1, 2**15, 2**31 - 1, 2**31, 2**32 - 1, 2**63 - 1, -(2**63)]
FLOATS = [0.0, -0.0, 1e300, -1e300, 1e308, 1e-300, float("nan"), float("inf"), -1.0, 1e20]


def mutate(rng: random.Random, name: str, data: bytes) -> bytes:
    """Return a file changed in one to four ways."""
    found = bytearray(data)
    for _ in range(rng.choice([1, 1, 1, 2, 4])):
        if len(found) < 16:
            break
        low, high = rng.choice(regions(name, data))
        high = min(high, len(found) - 9)
        at = rng.randrange(min(low, high - 1), high) if high > 1 else 0
        way = rng.randrange(9)
        if way == 0:
            found[at] ^= 1 << rng.randrange(8)
        elif way == 1:
            found[at] = rng.choice([0, 255, 127, 128, 10, 32, rng.randrange(256)])
        elif way == 2:
            found[at : at + 8] = struct.pack("<d", rng.choice(FLOATS))
        elif way == 3:
            kind, bits = rng.choice([("<H", 16), ("<I", 32), ("<Q", 64)])
            found[at : at + bits // 8] = struct.pack(kind, rng.choice(NUMBERS) % 2**bits)
        elif way == 4:
            del found[rng.randrange(at, len(found)) :]
        elif way == 5:
            del found[at : at + rng.randrange(1, 64)]
        elif way == 6:
            found[at:at] = bytes(rng.randrange(256) for _ in range(rng.randrange(1, 64)))
        elif way == 7:
            length = rng.randrange(1, 64)
            found[at : at + length] = found[at : at + length][::-1]
        else:
            text = rng.choice(
                [b"nan", b"1e999", b"-1", b"9" * 30, b"\0" * 8, b"\xff" * 8, b"POLYGON", b"\n\n"]
            )
            found[at : at + len(text)] = text
    return bytes(found)


def command(*arguments: Any) -> tuple[int, str]:
    """Run a command in this process; return its exit code, and what it printed on standard error.

    Raises:
        BadTryError: if it ends as no command may.

    """
    start = time.process_time()
    result = CliRunner().invoke(app, [str(one) for one in arguments])
    if time.process_time() - start > LONGEST_S:
        raise BadTryError(f"{arguments[0]}: took {time.process_time() - start:.0f} s")
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        text = "".join(traceback.format_exception(result.exception))
        raise BadTryError(f"{arguments[0]}: {text}")
    if result.exit_code not in OWN_EXITS:
        raise BadTryError(f"{arguments[0]}: exit {result.exit_code}: {result.output[-500:]}")
    for text in (result.stdout, result.stderr):
        if any(not letter.isprintable() and letter != "\n" for letter in text):
            raise BadTryError(f"{arguments[0]}: raw control characters: {text[-300:]!r}")
    return result.exit_code, result.stderr


class Drill:
    """One kind of tries; `one` makes and judges the try of a seed, and says how it ended."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder

    def one(self, seed: int) -> str:
        """Make one try."""
        raise NotImplementedError


class Files(Drill):
    """Mutated clouds: checked, and moved by no transform at all; what is written is what was read."""

    def __init__(self, folder: Path, names: tuple[str, ...] = ()) -> None:
        super().__init__(folder)
        self.bases = {n: d for n, d in bases(folder / "bases").items() if not names or n in names}
        self.still = folder / "still.json"
        write_still(self.still)

    def one(self, seed: int) -> str:
        rng = random.Random(seed)
        name = rng.choice(sorted(self.bases))
        path = self.folder / f"try{Path(name).suffix if 'copc' not in name else '.copc.laz'}"
        path.write_bytes(mutate(rng, name, self.bases[name]))
        checked, _ = command("check", path)
        out = self.folder / "out.las"
        out.unlink(missing_ok=True)
        moved, said = command("apply", self.still, path, out, "-q")
        if moved == 0:
            same_points(path, out, said)
        elif out.exists():
            raise BadTryError(f"exit {moved}, and a file is left")
        left = [one.name for one in self.folder.iterdir() if ".part-" in one.name]
        if left:
            raise BadTryError(f"left behind: {left}")
        return f"{Path(name).suffix[1:]}: check {checked}, apply {moved}"


def write_still(path: Path) -> None:
    """Write a transform that moves nothing, for any cloud without CRS or in EPSG:25833."""
    from helpers_scene import make_pair

    from mtpcr_geo.export.transform import write_transform_json

    write_transform_json(path, make_pair())
    found = json.loads(path.read_text())
    found["work"]["T_target_source"] = np.eye(4).tolist()
    low, high = PLACE - 1e4, PLACE + 1e4
    found["chain"]["source_bounds"] = [low.tolist(), high.tolist()]
    found["chain"]["target"] = found["chain"]["source"]
    found["pivot"]["source"] = PLACE.tolist()
    path.write_text(json.dumps(found))


def same_points(path: Path, out: Path, said: str) -> None:
    """Hold what was written against what was read.

    Raises:
        BadTryError: if a point is missing or moved.

    """
    read = np.concatenate([np.zeros((0, 3)), *open_any(path).xyz_chunks()])
    cloud = open_any(out)
    written = np.concatenate([np.zeros((0, 3)), *cloud.xyz_chunks()])
    left_out = re.search(r"([\d,]+) points? (is|are) left out", said)
    missing = int(left_out[1].replace(",", "")) if left_out else 0
    if len(read) != len(written) + missing:
        raise BadTryError(f"{len(read)} points read, {len(written)} written, exit 0")
    # three roundings: frames of the transform, the step of the output, a double at its place
    step = np.asarray(cloud.header.scales) if hasattr(cloud, "header") else np.full(3, 1e-3)
    near = step + 1e-6
    if missing:
        # the rest stands in the order of the file
        kept, rows = [], iter(read)
        for one in written:
            with np.errstate(over="ignore", invalid="ignore"):
                kept.append(next((row for row in rows if (np.abs(row - one) <= near).all()), one + np.inf))
        read = np.array(kept).reshape(-1, 3)
    off = np.abs(read - written) - near - 8 * np.spacing(np.abs(read))
    if len(read) and not (off <= 0).all():
        raise BadTryError(f"points moved by up to {np.abs(read - written).max()}, exit 0")


class Texts(Drill):
    """Mutated JSON and TOML: the tree is changed, or the letters."""

    texts: tuple[str, ...] = ()

    def take(self, text: str) -> object:
        """Read a text as the package does; raises MtpcrError."""
        raise NotImplementedError

    def one(self, seed: int) -> str:
        rng = random.Random(seed)
        text = self.changed(rng, rng.choice(self.texts))
        try:
            return f"taken: {self.take(text)}"
        except MtpcrError as error:
            return f"refused, {error.exit_code}"

    def changed(self, rng: random.Random, text: str) -> str:
        """Return the text changed in its tree or its letters."""
        if rng.random() < 0.6:
            tree = json.loads(text)
            for _ in range(rng.choice([1, 1, 2, 3])):
                change(rng, tree)
            text = json.dumps(tree)
        if rng.random() < 0.5:
            text = letters_changed(rng, text)
        return text


VALUES: list[Any] = [
    None, True, 0, -1, 1e308, -1e300, 1e-320, 2**70, 7,
    "", "a", "1", "\0", "\x1b[31m", "\u202e", "\ud800", [], {}, [[]],
    {"a": 1}, "EPSG:4326", "nan", "/vsicurl/x", "../../x", "CON", "a" * 3000, ["a", 1, None], float("nan"),
    "mtpcr.bev", "filters.range", "writers.las", "x.laz",
]  # fmt: skip


def change(rng: random.Random, tree: Any) -> None:
    """Change one place of a tree of dicts and lists."""
    places: list[tuple[Any, Any]] = []

    def visit(node: Any) -> None:
        keys = list(node) if isinstance(node, dict) else range(len(node)) if isinstance(node, list) else []
        for key in keys:
            places.append((node, key))
            visit(node[key])

    visit(tree)
    if not places:
        return
    node, key = rng.choice(places)
    way = rng.randrange(5)
    if way == 0:
        del node[key]
    elif way == 1:
        other, at = rng.choice(places)
        if (isinstance(other, dict) and at in other) or (isinstance(other, list) and at < len(other)):
            node[key] = json.loads(json.dumps(other[at]))
    elif way == 2 and isinstance(node, dict):
        # a copy: what is changed in one try must not be there in the next
        value = copy.deepcopy(rng.choice(VALUES))
        node[rng.choice([*map(str, VALUES), "filename", "type", "tag", "inputs", "cell"])] = value
    elif way == 3 and isinstance(node, list):
        node.insert(key, copy.deepcopy(rng.choice(VALUES)))
    else:
        node[key] = copy.deepcopy(rng.choice(VALUES))


def letters_changed(rng: random.Random, text: str) -> str:
    """Change, take or add letters."""
    at = rng.randrange(len(text) + 1)
    piece = rng.choice(
        ["", "{", "}", "[", "]", ",", '"', "\\", "9" * 400, "\0", "\x1b", "e9", "-", "\n", "é", "."]
    )
    return text[:at] + piece + text[at + rng.choice([0, 0, 1, 5, 50]) :]


def without_comments(text: str) -> str:
    """Return JSON without the lines of comments that PDAL allows."""
    return "\n".join(line for line in text.split("\n") if not line.lstrip().startswith("//"))


class Pipelines(Texts):
    """Mutated pipelines, as far as they can be judged without a run: grammar, safety, options, files."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        ready = Path(__file__).parents[1] / "pipelines"
        own = [
            ["t.laz", "s.laz", {"type": "mtpcr.register"}, {"type": "mtpcr.apply"}, "o.laz"],
            [
                "t.laz",
                {"type": "filters.range", "limits": "Z[0:1]"},
                {"type": "writers.las", "filename": "o.las"},
            ],
            [
                {"type": "readers.las", "filename": "t.laz", "tag": "a"},
                {"type": "mtpcr.bev", "inputs": ["a"]},
            ],
        ]
        kept = [without_comments(path.read_text()) for path in sorted(ready.glob("*.json"))]
        self.texts = (*kept, *map(json.dumps, own))

    def take(self, text: str) -> object:
        from mtpcr_geo.pipeline.grammar import link, parse
        from mtpcr_geo.pipeline.plan import plan

        return f"{len(plan(link(parse(text)))) > 0}"


class Transforms(Texts):
    """Mutated transforms: read, and points moved by them."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        write_still(folder / "t.json")
        self.texts = ((folder / "t.json").read_text(),)

    def take(self, text: str) -> object:
        from mtpcr_geo.export.transform import doubts_of, read_transform

        path = self.folder / "try.json"
        path.write_text(text, encoding="utf-8", errors="surrogatepass")
        chain = read_transform(path)
        doubts_of(path)
        xyz = cloud_xyz()[:5]
        moved = chain.forward(xyz)
        if not np.isfinite(moved).all():
            raise BadTryError("points moved to what is not finite")
        return np.allclose(chain.inverse(moved), xyz, rtol=0, atol=1e-3)


class Models(Texts):
    """Mutated descriptions of models."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        from importlib import resources

        cards = resources.files("mtpcr_geo.match.learned").joinpath("cards")
        self.texts = tuple(card.read_text("utf-8") for card in cards.iterdir() if card.name.endswith(".toml"))

    def changed(self, rng: random.Random, text: str) -> str:
        for _ in range(rng.choice([1, 2, 3])):
            text = letters_changed(rng, text)
            if rng.random() < 0.4:
                value = rng.choice(
                    ["1", "nan", '"../../x"', "[1]", "{}", "9" * 400, '"/etc/passwd"', "true", "[[]]"]
                )
                lines = text.split("\n")
                at = rng.randrange(len(lines))
                lines[at] = f"{lines[at].partition('=')[0]}= {value}"
                text = "\n".join(lines)
        return text

    def take(self, text: str) -> object:
        from mtpcr_geo.match.learned.model_cards import descriptions, inventory

        for path in self.folder.glob("*.toml"):
            path.unlink()
        (self.folder / "mine.toml").write_text(text, encoding="utf-8", errors="surrogatepass")
        return f"{len(descriptions(self.folder)) > 0 and len(list(inventory(self.folder))) > 0}"


def text_changed(rng: random.Random, text: str) -> str:
    """Return JSON changed in its tree or its letters, and other texts in their letters."""
    tree_too = text.startswith("{") and rng.random() < 0.6
    if tree_too:
        tree = json.loads(text)
        for _ in range(rng.choice([1, 1, 2, 3])):
            change(rng, tree)
        text = json.dumps(tree)
    for _ in range(0 if tree_too else rng.choice([1, 2, 4])):
        text = letters_changed(rng, text)
        if rng.random() < 0.3:
            # a word for another
            words = text.split(" ") if " " in text else text.split(",")
            words[rng.randrange(len(words))] = rng.choice([str(one) for one in VALUES])
            text = (" " if " " in text else ",").join(words)
    return text


class Named(Drill):
    """Texts that name clouds or places: virtual point clouds, lists, tables of jobs, priors, matrices."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        write_las(folder / "a.las", "1.4", 6)
        write_still(folder / "still.json")
        vpc = {"type": "FeatureCollection", "features": [
            {"type": "Feature", "id": "a", "properties": {"pc:count": N, "proj:epsg": 25833},
             "assets": {"data": {"href": "./a.las", "roles": ["data"]}}}]}  # fmt: skip
        matrix = "\n".join(["1 0 0 5", "0 1 0 6", "0 0 1 7", "0 0 0 1"])
        moves = {"pipeline": [{"type": "filters.transformation", "matrix": matrix.replace("\n", " ")}]}
        self.texts = {
            "t.vpc": json.dumps(vpc),
            "list.txt": "# tiles\na.las\n./a.las\n",
            "jobs.csv": "name,source,target,cell,near,level\none,a.las,a.las,2,400000 5800000,none\n",
            "m.txt": f"{matrix}\n# source global shift: -400000 -5800000 0\n",
            "m.json": json.dumps(moves),
            "still.json": (folder / "still.json").read_text(),
        }

    def one(self, seed: int) -> str:
        from mtpcr_geo.export.prior_file import read_pose
        from mtpcr_geo.survey.jobs import jobs_of

        rng = random.Random(seed)
        name = rng.choice(sorted(self.texts))
        path = self.folder / f"try-{name}"
        path.write_text(text_changed(rng, self.texts[name]), encoding="utf-8", errors="surrogatepass")
        if name in ("t.vpc", "list.txt"):
            return f"{name}: {command('check', f'@{path}' if name == 'list.txt' else path)[0]}"
        try:
            if name == "jobs.csv":
                keys = [job.key for job in jobs_of(path, None, {})]
                return f"{name}: {len(keys)} jobs"
            read_pose(path)
        except MtpcrError as error:
            return f"{name}: refused, {error.exit_code}"
        return f"{name}: taken"


class Folders(Drill):
    """Folders of surveys, batches and runs with changed records in them: an error, or brought up to date."""

    def __init__(self, folder: Path) -> None:
        super().__init__(folder)
        self.cloud = write_las(folder / "a.las", "1.4", 6)
        self.survey = folder / "survey"
        command("survey", "build", self.cloud, "-o", self.survey, "-q")
        run = {
            "version": 1, "verdict": "refused", "T_target_source": np.eye(4).tolist(), "metrics": {"a": 1.0},
            "inputs": [{"path": str(self.cloud), "bytes": 1, "sha256": "0" * 64, "modified": "x"}],
            "options": {"read": {"filename": "a.las"}}, "versions": {"numpy": "1"},
            "pipeline": [{"type": "mtpcr.read", "tag": "read", "filename": str(self.cloud)},
                         {"type": "mtpcr.write_run", "tag": "run", "inputs": ["read"], "filename": "r.json"}],
        }  # fmt: skip
        self.run = folder / "run"
        self.run.mkdir()
        row = {"name": "a", "source": "a.las", "target": "a.las", "verdict": "accepted", "key": "K",
               "footprint": [0, 0, 9, 0, 9, 9], "crs": CRS.from_epsg(25833).to_wkt(), "x": 1.0}  # fmt: skip
        self.texts = {
            self.survey / "survey.json": (self.survey / "survey.json").read_text(),
            self.survey / "index.vpc": (self.survey / "index.vpc").read_text(),
            self.run / "run.json": json.dumps(run),
            folder / "batch" / "rows" / "a.json": json.dumps(row),
        }

    def one(self, seed: int) -> str:
        rng = random.Random(seed)
        path = rng.choice(sorted(self.texts))
        path.parent.mkdir(parents=True, exist_ok=True)
        text = text_changed(rng, self.texts[path])
        try:
            if path.name == "a.json":
                return self.batch(path, text)
            path.write_text(text, encoding="utf-8", errors="surrogatepass")
            if path.name == "run.json":
                ended = command("verify", self.run)[0]
            else:
                ended = command("survey", "build", self.cloud, "-o", self.survey, "-q")[0]
                self.opened()
        finally:
            path.write_text(self.texts.get(path, ""))
        return f"{path.name}: {ended}"

    def opened(self) -> None:
        """Open the survey as a registration does."""
        from mtpcr_geo.survey.index import Survey

        try:
            survey = Survey.open(self.survey)
            survey.tiles_in(survey.bounds[:, :2])
            survey.blocks()
        except MtpcrError:
            pass

    def batch(self, path: Path, text: str) -> str:
        """Go on with a batch whose only job is done, as its row says."""
        from mtpcr_geo.survey.batch import MARK
        from mtpcr_geo.survey.jobs import jobs_of

        table = self.folder / "jobs.csv"
        table.write_text("name,source,target\na,a.las,a.las\n")
        (path.parents[1] / MARK).write_text('{"format": "mtpcr-geo batch", "version": 1}')
        text = text.replace('"K"', json.dumps(jobs_of(table, None, {})[0].key))
        path.write_text(text, encoding="utf-8", errors="surrogatepass")
        return f"row: {command('batch', table, '-o', path.parents[1], '-q')[0]}"


class Bags(Drill):
    """Mutated bags of ROS 1 and ROS 2: an error, or points that are finite."""

    def __init__(self, folder: Path) -> None:
        from helpers_bags import UPRIGHT, seen, write_bag

        super().__init__(folder)
        self.T_imu_lidar = UPRIGHT
        scans = [(stamp, xyz[:40], time[:40]) for stamp, xyz, time in seen(UPRIGHT, 1)[1][:3]]
        write_bag(folder / "one.bag", 1, scans)
        write_bag(folder / "two", 2, scans)
        self.files = [folder / "one.bag", *sorted((folder / "two").iterdir())]
        self.bases = {path: path.read_bytes() for path in self.files}

    def one(self, seed: int) -> str:
        from mtpcr_geo.benchmark.graco import read_sequence

        rng = random.Random(seed)
        path = rng.choice([self.files[0], *self.files])
        bag = path if path.suffix == ".bag" else path.parent
        path.write_bytes(mutate(rng, path.name, self.bases[path]))
        start = time.process_time()
        try:
            xyz = read_sequence(bag, self.T_imu_lidar)
            ended = "read"
            if not np.isfinite(xyz).all():
                raise BadTryError("points that are not finite")
        except MtpcrError as error:
            ended = f"refused, {error.exit_code}"
        finally:
            path.write_bytes(self.bases[path])
        if time.process_time() - start > LONGEST_S:
            raise BadTryError(f"took {time.process_time() - start:.0f} s")
        return f"{path.suffix[1:]}: {ended}"


DRILLS: dict[str, Callable[[Path], Drill]] = {
    "files": Files,
    "pipelines": Pipelines,
    "transforms": Transforms,
    "models": Models,
    "bags": Bags,
    "named": Named,
    "folders": Folders,
}


def tries(
    drill: Drill, seeds: Iterator[int] | range, last: Path | None = None
) -> Iterator[tuple[int, str, str]]:
    """Yield the seed of each try, how it ended, and what was bad about it or ""."""
    for seed in seeds:
        if last is not None:
            last.write_text(str(seed))
        faulthandler.dump_traceback_later(HANGING_S, exit=True)
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            try:
                ended, bad = drill.one(seed), ""
            except Exception:  # noqa: BLE001 - whatever comes is what is looked for
                ended, bad = "bad", traceback.format_exc(limit=-6)
        faulthandler.cancel_dump_traceback_later()
        yield seed, ended, bad


def main() -> int:
    """Run tries, and print what they came to."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kind", choices=sorted(DRILLS))
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--last", type=Path)
    given = parser.parse_args()
    table: collections.Counter[str] = collections.Counter()
    bads: dict[str, list[tuple[int, str]]] = {}
    start = time.monotonic()
    with tempfile.TemporaryDirectory() as folder:
        drill = DRILLS[given.kind](Path(folder))
        for seed, ended, bad in tries(drill, range(given.seed, given.seed + given.count), given.last):
            table[ended] += 1
            if bad:
                key = re.sub(r"[\d.]+", "#", bad.strip().splitlines()[-1])[:160]
                bads.setdefault(key, []).append((seed, bad))
                if len(bads[key]) == 1:
                    print(f"seed {seed}: {bad}", flush=True)
    for ended, count in sorted(table.items()):
        print(f"{count:7} {ended}")
    for key, found in bads.items():
        print(f"BAD {len(found)} (seeds {[seed for seed, _ in found[:5]]}): {key}")
    bad_tries = sum(map(len, bads.values()))
    seconds = time.monotonic() - start
    print(f"{given.count} {given.kind} from seed {given.seed}, {bad_tries} bad, {seconds:.0f} s")
    return int(bool(bads))


if __name__ == "__main__":
    sys.exit(main())
