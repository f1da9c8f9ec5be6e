"""Any method that is a command: two point files in, a 4x4 out.

A JSON file describes it::

    {
      "command": ["$PLADE", "{target}", "{source}", "{result}"],
      "format": "ply-normals",
      "time_limit_s": 600,
      "memory_limit_mib": 16000,
      "environment": {"OMP_NUM_THREADS": "2"}
    }

- ``{source}``, ``{target}`` and ``{result}`` stand for paths in an empty folder, the command's current
  one; ``{here}`` is the folder of the description, ``{seed}`` the run's seed. ``~`` and ``$NAME`` at the
  start of a word are expanded; there is no shell. A variable that is not set is an error before any run.
- ``format`` is what the point files are: "ply" (binary, float64), "ply-normals" (binary, float32, with
  outward unit normals nx ny nz), "npy" ((n, 3) float64), "xyz" (text) or "laz" (LAS 1.4, millimetres).
  Metres, z up, near the origin. ``crs`` (an EPSG code) is written into a LAZ.
- ``voxel`` thins the clouds to a point per voxel of this edge, metres, before they are written.
- The command writes the 4x4 that takes source to target as text to ``{result}``: the last sixteen numbers
  of the file count, row by row. Lines of text before them are skipped. A scale in it is taken out, and
  noted with the run; what else is no rigid transform is no result.
- An exit code other than 0, no such result, the time limit, or more memory than allowed: a run without an
  answer, with the telling lines of what the command printed as the reason; all of it is kept with the run.
  The memory limit is on the address space of each process and on the resident memory of all together; the
  memory reported is that of the command and all it started, sampled 20 times a second.
"""

from __future__ import annotations

import json
import os
import re
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from mtpcr_geo.benchmark.baselines.process import run_command, with_telling
from mtpcr_geo.benchmark.estimate import Estimate
from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.errors import MissingPartError, OptionError
from mtpcr_geo.pipeline.registry import first_problem

_NUMBER = re.compile(r"[-+]?(?:(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?|nan|inf(?:inity)?)", re.IGNORECASE)
_VARIABLE = re.compile(r"\$(?:\{(\w+)\}|(\w+))")
_LARGEST_RESULT = 2**20
_SKEW = 1e-2
"""Largest departure of a result's rotation, once its scale is out, from an orthogonal matrix."""


class Description(BaseModel):
    """The content of the JSON file."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    command: list[str] = Field(min_length=1, description="program and arguments, with placeholders")
    format: Literal["ply", "ply-normals", "npy", "xyz", "laz"] = Field(
        "ply", description="form of the point files"
    )
    crs: int | None = Field(None, description="EPSG code written into LAZ files")
    voxel: float | None = Field(None, gt=0, description="thinning before the files are written, metres")
    time_limit_s: float = Field(600.0, gt=0, description="time allowed, seconds")
    memory_limit_mib: int | None = Field(None, ge=16, description="memory allowed, MiB (not on Windows)")
    environment: dict[str, str] = Field(default_factory=dict, description="variables set for the command")
    note: str = Field("", description="where the program comes from, which version, and what it needs")


def read_description(path: Path) -> Description:
    """Read a description.

    Raises:
        OptionError: if it cannot be read, or is none.

    """
    try:
        return Description.model_validate(json.loads(path.read_text(encoding="utf-8")))
    except OSError as error:
        raise OptionError(f"cannot read the external method {path}: {error.strerror}") from error
    except ValidationError as error:
        raise OptionError(f"{path}: {first_problem(error, Description)}") from error
    except ValueError as error:
        raise OptionError(f"{path} is not JSON: {error}") from error


class External:
    """A command as a method.

    Args:
        file: its description.
        voxel: thinning, metres, in place of the description's.

    Raises:
        OptionError: if the description cannot be read.
        MissingPartError: if it names a variable that is not set.

    """

    def __init__(self, file: str, voxel: float | None = None) -> None:
        self.path = Path(file)
        self.description = read_description(self.path)
        if voxel is not None:
            if voxel <= 0:
                raise ValueError("voxel must be above 0")
            self.description = self.description.model_copy(update={"voxel": float(voxel)})
        self.time_limit_s = self.description.time_limit_s
        for word in self.description.command:
            for found in _VARIABLE.finditer(word):
                name = found[1] or found[2]
                if name not in os.environ:
                    raise MissingPartError(
                        f"{file} needs the variable {name}, which is not set: {self.description.note}"
                    )

    def estimate(self, source: Floats, target: Floats, *, seed: int) -> Estimate:
        """Write the clouds, run the command, read its answer."""
        with tempfile.TemporaryDirectory(prefix="mtpcr-geo-external-") as name:
            folder = Path(name)
            words = {"here": str(self.path.resolve().parent), "seed": str(seed)}
            for role, xyz in (("source", source), ("target", target)):
                path = folder / f"{role}.{self.description.format.partition('-')[0]}"
                write_points(path, xyz, self.description)
                words[role] = str(path)
            words["result"] = str(folder / "result.txt")
            answer = self._run(folder, words)
        if answer.T_target_source is None:
            return answer
        T, scale = rigid_part(answer.T_target_source, source.mean(axis=0))
        return replace(answer, T_target_source=T, details={"scale": scale})

    def _run(self, folder: Path, words: dict[str, str]) -> Estimate:
        ended = run_command(
            [_filled(word, words) for word in self.description.command],
            folder,
            environment=self.description.environment,
            time_limit_s=self.time_limit_s,
            memory_limit_mib=self.description.memory_limit_mib,
        )
        answer = Estimate(None, reason=ended.failure, memory_mib=ended.memory_mib, printed=ended.printed)
        if ended.failure:
            return answer
        try:
            return replace(answer, T_target_source=read_matrix(Path(words["result"])))
        except FileNotFoundError:
            failure = "exit code 0, but it wrote no result"
        except (OSError, ValueError) as error:
            failure = f"exit code 0, but no usable result ({error})"
        return replace(answer, reason=with_telling(failure, ended.printed))


def read_matrix(path: Path) -> Floats:
    """Read the last sixteen numbers of a text file as a 4x4 similarity, row by row.

    Raises:
        OSError: if it cannot be read.
        ValueError: if there are fewer, or they are no similarity: rotation, scale and shift.

    """
    with path.open("rb") as file:
        text = file.read(_LARGEST_RESULT + 1)
    if len(text) > _LARGEST_RESULT:
        raise ValueError(f"{path.name} is larger than {_LARGEST_RESULT} bytes")
    numbers: list[float] = []
    for line in text.decode("utf-8", "replace").splitlines():
        # words that hold digits, such as file names, are no numbers
        parts = re.split(r"[\s,;\[\]]+", line.strip(" \t,;[]"))
        if parts != [""] and all(_NUMBER.fullmatch(part) for part in parts):
            numbers += [float(part) for part in parts]
    if len(numbers) < 16:
        raise ValueError(f"{path.name} holds {len(numbers)} numbers, not sixteen")
    T = np.array(numbers[-16:]).reshape(4, 4)
    if not np.isfinite(T).all():
        raise ValueError("not all of its numbers are finite")
    if not np.allclose(T[3], [0.0, 0.0, 0.0, 1.0]):
        raise ValueError(f"the last row is {T[3].tolist()}, not 0 0 0 1")
    volume = float(np.linalg.det(T[:3, :3]))
    if volume <= 0.0:
        raise ValueError(f"its determinant is {volume:.3g}: a mirror image, or no rotation at all")
    R = T[:3, :3] / np.cbrt(volume)
    skew = float(np.abs(R.T @ R - np.eye(3)).max())
    if skew > _SKEW:
        raise ValueError(f"its axes are not at right angles, or of different lengths (by {skew:.3g})")
    return T


def rigid_part(T: Floats, centroid: Floats) -> tuple[Floats, float]:
    """Take the scale out of a similarity, keeping where it takes the source's centroid.

    Args:
        T: 4x4 similarity.
        centroid: (3,) of the source, metres.

    Returns:
        The 4x4 rigid transform, and the scale.

    """
    R = transforms.orthonormal(T[:3, :3])
    scale = float(np.cbrt(np.linalg.det(T[:3, :3])))
    return transforms.compose(R, T[:3, :3] @ centroid + T[:3, 3] - R @ centroid), scale


def write_points(path: Path, xyz: Floats, description: Description) -> None:
    """Write a cloud in the form that a description asks for."""
    xyz = np.ascontiguousarray(xyz, np.float64)
    if description.voxel is not None:
        import small_gicp

        xyz = np.asarray(small_gicp.voxelgrid_sampling(xyz, description.voxel).points())[:, :3].copy()
    if description.format == "npy":
        np.save(path, xyz)
    elif description.format == "xyz":
        np.savetxt(path, xyz, "%.6f")
    elif description.format == "ply":
        _write_ply(path, xyz, "double", ("x", "y", "z"))
    elif description.format == "ply-normals":
        from mtpcr_geo.benchmark.baselines.normals import oriented_normals

        columns = np.hstack([xyz, oriented_normals(xyz)])
        _write_ply(path, columns, "float", ("x", "y", "z", "nx", "ny", "nz"))
    else:
        from pyproj import CRS

        from mtpcr_geo.benchmark.pairs import write_laz
        from mtpcr_geo.core.cloud import ArrayCloud

        crs = None if description.crs is None else CRS.from_epsg(description.crs)
        write_laz(path, ArrayCloud(xyz, crs))


def _write_ply(path: Path, columns: Floats, kind: Literal["float", "double"], names: tuple[str, ...]) -> None:
    head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(columns)}\n"
    head += "".join(f"property {kind} {name}\n" for name in names) + "end_header\n"
    path.write_bytes(head.encode("ascii") + columns.astype("<f4" if kind == "float" else "<f8").tobytes())


def _filled(word: str, words: dict[str, str]) -> str:
    word = os.path.expanduser(os.path.expandvars(word))
    for name, value in words.items():
        word = word.replace("{" + name + "}", value)
    return word
