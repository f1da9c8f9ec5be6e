"""The jobs of a batch: one source each, its target and options, from a table or a folder."""

from __future__ import annotations

import csv
import io
import json
import os
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from hashlib import sha256
from pathlib import Path
from typing import Any

from mtpcr_geo.core.errors import InputError, MtpcrError, OptionError
from mtpcr_geo.core.paths import read_whole, real
from mtpcr_geo.io.formats import files_at
from mtpcr_geo.io.many import placed
from mtpcr_geo.pipeline.options import PRIOR_WORDS, RegisterOptions
from mtpcr_geo.registration import read_options
from mtpcr_geo.survey import is_survey
from mtpcr_geo.survey.index import INDEX

OWN_COLUMNS = ("name", "source", "target")
_OF_THE_BATCH = ("overwrite",)
_PAIRS = ("near",)
_PATHS = ("prior", "models")


@dataclass(frozen=True)
class Job:
    """One registration of a batch.

    Attributes:
        name: of its folder and its row.
        source, target: the clouds; the target may be a survey.
        options: fields of `RegisterOptions` that are not at their defaults.

    """

    name: str
    source: Path
    target: Path
    options: Mapping[str, Any]

    @property
    def key(self) -> str:
        """What changes when the job would give another result: its files, its options."""
        about: dict[str, Any] = {
            "source": _states(self.source),
            "target": _states(self.target / INDEX if is_survey(self.target) else self.target),
            "options": dict(self.options),
        }
        for name, path in _paths_in(self.options).items():
            about[name] = [_state(one) for one in _at(path)]
        return sha256(json.dumps(about, sort_keys=True, default=str).encode()).hexdigest()

    @property
    def reads(self) -> tuple[Path, ...]:
        """All files and folders that the job reads, as it names them."""
        return (self.source, self.target, *_paths_in(self.options).values())

    @property
    def is_here(self) -> bool:
        """Whether all that the job reads is found."""
        return all(state[1] >= 0 for path in self.reads for state in _states(path))

    def placed(self, folder: str | os.PathLike[str] = "") -> Job:
        """Return the job with all paths absolute, so that any process on any machine reads the same by them.

        Args:
            folder: what the paths are relative to; the present one if not given.

        """
        paths = {name: str(placed(path, folder)) for name, path in _paths_in(self.options).items()}
        source, target = placed(self.source, folder), placed(self.target, folder)
        return replace(self, source=source, target=target, options={**self.options, **paths})


def jobs_of(path: Path, target: Path | None, common: Mapping[str, Any]) -> list[Job]:
    """Read the jobs of a batch.

    Args:
        path: a table (CSV) with a row a job, whose paths are relative to it; or a folder, pattern or list of
            sources.
        target: of the jobs that name none.
        common: options of all jobs; columns of the table take precedence.

    Returns:
        The jobs, with absolute paths, links not followed.

    Raises:
        InputError: if the table cannot be read, or names no job.
        OptionError: if a column is no option, a value is none of it, or a target is missing.

    """
    if path.suffix.lower() == ".csv" and os.path.isfile(path):
        return _of_table(path, target, common)
    sources = files_at(placed(path))
    if target is None:
        raise OptionError("name the target of the sources: --target FILE, or the folder of a survey")
    options = _given(common)
    return [Job(name, source, target, options).placed() for name, source in _named(sources)]


def _of_table(path: Path, target: Path | None, common: Mapping[str, Any]) -> list[Job]:
    try:
        text = read_whole(path).decode("utf-8-sig")
        rows = list(csv.DictReader(io.StringIO(text), strict=True))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"cannot read the table {path} ({error}); give CSV with a row a job") from error
    if not rows:
        raise InputError(f"the table {path} has no rows; give a row a job, below a row of column names")
    if "source" not in rows[0]:
        raise InputError(
            f"the table {path} has no column source; its columns are {', '.join(map(str, rows[0]))}"
        )
    jobs: list[Job] = []
    taken: set[str] = set()
    for number, row in enumerate(rows, start=2):
        where = f"{path}, line {number}"
        if None in row:
            raise InputError(f"{where} has more values than there are columns")
        values = {key.strip(): (text or "").strip() for key, text in row.items()}
        if not values["source"]:
            raise InputError(f"{where} names no source")
        named = values.get("target") or ""
        if not named and target is None:
            raise OptionError(f"{where} names no target; add a column target, or give --target")
        options = {key: _value(key, text) for key, text in values.items() if text and key not in OWN_COLUMNS}
        try:
            given = _given({**common, **options})
        except MtpcrError as error:
            raise OptionError(f"{where}: {error}") from None
        # what the table says is relative to it, what the command line says to where it is given
        here = {key: str(placed(one)) for key, one in _paths_in(given).items() if key not in options}
        name = folder_name(values.get("name") or Path(values["source"]).stem)
        if name.lower() in taken:
            raise InputError(f"{where}: there is a job {name} already; add a column name")
        taken.add(name.lower())
        goal = Path(named) if named else placed(target or "")
        jobs.append(Job(name, Path(values["source"]), goal, {**given, **here}).placed(path.parent))
    return jobs


def _given(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return options that are not at their defaults, checked; and that of the recording, off in a batch."""
    wrong = next((key for key in options if key in _OF_THE_BATCH), None)
    if wrong is not None:
        raise OptionError(f"{wrong} is an option of the whole batch, and of no job")
    read = read_options(dict(options))
    asked = {"recording": read.recording} if "recording" in options else {}
    return read.model_dump(mode="json", exclude_defaults=True) | asked


def _value(name: str, text: str) -> Any:
    if name in _PAIRS:
        return [part for part in re.split(r"[\s;,]+", text) if part]
    field = RegisterOptions.model_fields.get(name)
    if field is not None and field.annotation is bool:
        return {"": False, "yes": True, "no": False}.get(text.lower(), text)
    return text


def _named(sources: Sequence[Path]) -> list[tuple[str, Path]]:
    """Return each source with a name that no other has, upper and lower case taken as one.

    Of names that would be the same each gets a suffix that follows from the path alone.
    """
    each = list({os.path.abspath(source): source for source in sources}.items())
    names = [folder_name(source.stem) for _, source in each]
    often = Counter(name.casefold() for name in names)
    return [
        (
            name if often[name.casefold()] == 1 else f"{name}-{sha256(os.fsencode(path)).hexdigest()[:8]}",
            source,
        )
        for name, (path, source) in zip(names, each, strict=True)
    ]


def folder_name(text: str) -> str:
    """Return a name that a folder may have."""
    return re.sub(r"[^\w.+-]+", "_", text).strip(".") or "job"


def _paths_in(options: Mapping[str, Any]) -> dict[str, Path]:
    """Return the options that are a file or a folder."""
    found = {name: options[name] for name in _PATHS if isinstance(options.get(name), str | os.PathLike)}
    return {name: Path(value) for name, value in found.items() if name != "prior" or value not in PRIOR_WORDS}


def _at(path: Path) -> list[Path]:
    """Return the files of a folder; what is none is itself."""
    try:
        return sorted(path.iterdir()) if path.is_dir() else [path]
    except OSError:
        return [path]


def _states(path: Path) -> list[tuple[str, int, int]]:
    try:
        files = files_at(path)
    except (OSError, InputError):
        files = [path]
    return [_state(one) for one in files]


def _state(path: Path) -> tuple[str, int, int]:
    """Return what changes when a file does."""
    try:
        found = path.stat()
    except (OSError, ValueError):
        return str(path), -1, -1
    return str(real(path)), found.st_size, found.st_mtime_ns
