"""Any method that is a command: two point files in, a 4x4 out.

A JSON file describes it::

    {
      "command": ["plade", "{target}", "{source}", "{result}"],
      "format": "ply",
      "time_limit_s": 600,
      "memory_limit_mib": 16000,
      "environment": {"OMP_NUM_THREADS": "2"}
    }

- ``{source}``, ``{target}`` and ``{result}`` stand for paths in an empty folder, the command's current
  one; ``{here}`` is the folder of the description, ``{seed}`` the run's seed. ``~`` and ``$NAME`` at the
  start of a word are expanded; there is no shell.
- ``format`` is what the point files are: "ply" (binary, float64), "npy" ((n, 3) float64), "xyz" (text) or
  "laz" (LAS 1.4, millimetres). Metres, z up, near the origin. ``crs`` (an EPSG code) is written into a LAZ.
- ``voxel`` thins the clouds to a point per voxel of this edge, metres, before they are written.
- The command writes the 4x4 that takes source to target as text to ``{result}``: the last sixteen numbers
  of the file count, row by row. Lines of text before them are skipped. A scale in it is taken out, and
  noted with the run.
- An exit code other than 0, no result within the time limit, or more memory than allowed: a run without an
  answer, with the end of what the command printed as the reason. The memory limit is on the address space
  of each process; the memory reported is that of the command and all it started, sampled 20 times a second.
"""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, ValidationError

from mtpcr_geo.benchmark.estimate import Estimate
from mtpcr_geo.core import transforms
from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.errors import OptionError
from mtpcr_geo.pipeline.registry import first_problem

_NUMBER = re.compile(r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?")
_SAMPLE_S = 0.05
# runs the command with a limit on its address space; a limit in the parent would bind the parent
_LIMITER = (
    "import os, resource, sys; n = int(sys.argv[1]); resource.setrlimit(resource.RLIMIT_AS, (n, n)); "
    "os.execvp(sys.argv[2], sys.argv[2:])"
)


class Description(BaseModel):
    """The content of the JSON file."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    command: list[str] = Field(min_length=1, description="program and arguments, with placeholders")
    format: Literal["ply", "npy", "xyz", "laz"] = Field("ply", description="form of the point files")
    crs: int | None = Field(None, description="EPSG code written into LAZ files")
    voxel: float | None = Field(None, gt=0, description="thinning before the files are written, metres")
    time_limit_s: float = Field(600.0, gt=0, description="time allowed, seconds")
    memory_limit_mib: int | None = Field(
        None, ge=16, description="address space allowed, MiB (not on Windows)"
    )
    environment: dict[str, str] = Field(default_factory=dict, description="variables set for the command")
    note: str = Field("", description="where the program comes from and what it needs")


class External:
    """A command as a method.

    Args:
        file: its description.

    """

    def __init__(self, file: str) -> None:
        self.path = Path(file)
        try:
            self.description = Description.model_validate(json.loads(self.path.read_text(encoding="utf-8")))
        except OSError as error:
            raise OptionError(f"cannot read the external method {file}: {error.strerror}") from error
        except ValidationError as error:
            raise OptionError(f"{file}: {first_problem(error, Description)}") from error
        except ValueError as error:
            raise OptionError(f"{file} is not JSON: {error}") from error

    def estimate(self, source: Floats, target: Floats, *, seed: int) -> Estimate:
        """Write the clouds, run the command, read its answer."""
        with tempfile.TemporaryDirectory(prefix="mtpcr-geo-external-") as name:
            folder = Path(name)
            words = {"here": str(self.path.resolve().parent), "seed": str(seed)}
            for role, xyz in (("source", source), ("target", target)):
                path = folder / f"{role}.{self.description.format}"
                write_points(path, xyz, self.description)
                words[role] = str(path)
            words["result"] = str(folder / "result.txt")
            answer = self._run(folder, words)
        if answer.T_target_source is None:
            return answer
        T, scale = rigid_part(answer.T_target_source, source.mean(axis=0))
        return replace(answer, T_target_source=T, details={"scale": scale})

    def _run(self, folder: Path, words: dict[str, str]) -> Estimate:
        reported = folder / "output.txt"
        command = [_filled(word, words) for word in self.description.command]
        limit = self.description.memory_limit_mib
        if limit is not None and os.name == "posix":
            command = [sys.executable, "-c", _LIMITER, str(limit * 2**20), *command]
        with reported.open("wb") as output:
            try:
                process = subprocess.Popen(
                    command,
                    cwd=folder,
                    stdin=subprocess.DEVNULL,
                    stdout=output,
                    stderr=subprocess.STDOUT,
                    env=os.environ | self.description.environment,
                    start_new_session=True,
                )
            except OSError as error:
                return Estimate(None, reason=f"cannot run {command[0]}: {error.strerror}")
            code, memory, stopped = _waited(process, self.description.time_limit_s)
        if stopped:
            reason = f"stopped at the time limit of {self.description.time_limit_s:g} s"
            return Estimate(None, reason=reason, memory_mib=memory)
        if code != 0:
            return Estimate(None, reason=f"exit code {code}: {_end_of(reported)}", memory_mib=memory)
        try:
            T = read_matrix(Path(words["result"]))
        except (OSError, ValueError) as error:
            return Estimate(None, reason=f"no usable result ({error})", memory_mib=memory)
        return Estimate(T, memory_mib=memory)


def read_matrix(path: Path) -> Floats:
    """Read the last sixteen numbers of a text file as a 4x4, row by row.

    Raises:
        OSError: if it cannot be read.
        ValueError: if there are fewer, or they are no transform.

    """
    numbers: list[float] = []
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        # words that hold digits, such as file names, are no numbers
        parts = re.split(r"[\s,;\[\]]+", line.strip(" \t,;[]"))
        if parts != [""] and all(_NUMBER.fullmatch(part) for part in parts):
            numbers += [float(part) for part in parts]
    if len(numbers) < 16:
        raise ValueError(f"{path.name} holds {len(numbers)} numbers, not sixteen")
    T = np.array(numbers[-16:]).reshape(4, 4)
    if not np.allclose(T[3], [0.0, 0.0, 0.0, 1.0]):
        raise ValueError(f"the last row is {T[3].tolist()}, not 0 0 0 1")
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
        head = f"ply\nformat binary_little_endian 1.0\nelement vertex {len(xyz)}\n"
        head += "".join(f"property double {axis}\n" for axis in "xyz") + "end_header\n"
        path.write_bytes(head.encode("ascii") + xyz.astype("<f8").tobytes())
    else:
        from pyproj import CRS

        from mtpcr_geo.benchmark.pairs import write_laz
        from mtpcr_geo.core.cloud import ArrayCloud

        crs = None if description.crs is None else CRS.from_epsg(description.crs)
        write_laz(path, ArrayCloud(xyz, crs))


def _filled(word: str, words: dict[str, str]) -> str:
    word = os.path.expanduser(os.path.expandvars(word))
    for name, value in words.items():
        word = word.replace("{" + name + "}", value)
    return word


def _waited(process: subprocess.Popen[bytes], limit: float) -> tuple[int, float | None, bool]:
    """Wait for a process: its exit code, its peak memory in MiB, and whether it had to be stopped."""
    end = time.monotonic() + limit
    peak: float | None = None
    while True:
        try:
            return process.wait(_SAMPLE_S), peak, False
        except subprocess.TimeoutExpired:
            # what the system adds up at the end would count this process too, as it was at the fork
            now = tree_memory_mib(process.pid)
            peak = now if peak is None else max(peak, now or 0.0)
        if time.monotonic() > end:
            if os.name == "posix":
                # its own session: what it has started goes with it
                os.killpg(process.pid, signal.SIGKILL)
            else:
                process.kill()
            return process.wait(), peak, True


def tree_memory_mib(pid: int) -> float | None:
    """Return the resident memory of a process and all that descend from it, now, in MiB.

    None where the system does not tell (it is read from ``/proc``).
    """
    folder = Path("/proc") / str(pid)
    try:
        status = (folder / "status").read_text()
        children = (folder / "task" / str(pid) / "children").read_text().split()
    except OSError:
        return None
    own = next((int(line.split()[1]) for line in status.splitlines() if line.startswith("VmRSS:")), 0)
    return own / 1024 + sum(tree_memory_mib(int(child)) or 0.0 for child in children)


def _end_of(reported: Path) -> str:
    lines = reported.read_text(encoding="utf-8", errors="replace").split("\n")
    printed = [line.strip() for line in lines if line.strip()]
    return printed[-1][:300] if printed else "it printed nothing"
