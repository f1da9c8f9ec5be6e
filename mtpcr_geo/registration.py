"""The whole registration: two clouds in, a registered cloud and its evidence out.

`register` makes the stages and runs them; `build_pipeline` names the same stages as pipeline JSON.
"""

from __future__ import annotations

import os
import shutil
import tempfile
import weakref
from collections.abc import Sequence
from functools import cached_property
from html import escape
from pathlib import Path
from textwrap import wrap
from typing import TYPE_CHECKING, Any, cast, overload

import numpy as np
from pydantic import ValidationError

from mtpcr_geo.core import transforms
from mtpcr_geo.core.advice import python_words
from mtpcr_geo.core.cloud import Cloud
from mtpcr_geo.core.errors import MissingPartError, OptionError, RegistrationError
from mtpcr_geo.core.progress import Progress
from mtpcr_geo.core.system import cores
from mtpcr_geo.core.types import Floats, Pair, Verdict
from mtpcr_geo.core.uncertainty import Uncertainty
from mtpcr_geo.core.wording import visible
from mtpcr_geo.crs.chain import TransformChain
from mtpcr_geo.export.apply import move, moved_by, write_moved
from mtpcr_geo.io.memory import cloud_of, coordinates
from mtpcr_geo.pipeline.options import OUTPUT_NAMES, RegisterOptions, first_problem
from mtpcr_geo.pipeline.records import StageRecord
from mtpcr_geo.pipeline.runner import RunResult, run
from mtpcr_geo.pipeline.stage import chained
from mtpcr_geo.pipeline.stages.export import DERIVED_ROLES
from mtpcr_geo.pipeline.stages.memory import check_two, crs_of_arrays
from mtpcr_geo.pipeline.stages.steps import (
    further_files,
    readers_of,
    recording_writer,
    steps_of,
    writers_for,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from numpy.typing import ArrayLike
    from pyproj import CRS

    from mtpcr_geo.io.memory import CloudLike


class Registration:
    """Result of a registration.

    Attributes:
        verdict: accepted, doubtful or refused, with reasons and metrics.
        pair: the whole state, from levelled clouds to tie points; None where not even a pair was made.
        report: the finished stages, with their options, metadata and seconds.
        outputs: the files written, by what they are.
        not_written: why files were not written, by what they are.
        forced: whether files were written that the verdict withholds.
        force: whether a refused result may be used.

    """

    def __init__(
        self,
        result: RunResult,
        options: RegisterOptions | None = None,
        recording: Path | None = None,
    ) -> None:
        self.verdict = result.verdict or Verdict("refused", ("the pipeline judged nothing",), {})
        self.pair: Pair | None = result.pair
        self.report: Sequence[StageRecord] = result.done
        self._options = options or RegisterOptions()
        self.force = self._options.force
        self._result = result
        self._recording = recording
        self.outputs: dict[str, Path] = {}
        self.not_written: dict[str, str] = {}
        self.forced = False
        if recording is None:
            self._note(result)
        if recording is not None:
            weakref.finalize(self, shutil.rmtree, recording.parent, ignore_errors=True)

    @cached_property
    def T_target_source(self) -> Floats | None:
        """4x4 on the coordinates as they stand in the inputs, source to target; None if none was found.

        It is given even where the verdict is refused. Where a coordinate operation lies between both clouds,
        it is the best fit, and `apply` follows the exact chain.
        """
        return None if self._chain is None else self._chain.T_file

    @cached_property
    def T_source_target(self) -> Floats | None:
        """4x4 from target to source, the inverse of `T_target_source`."""
        T = self.T_target_source
        return None if T is None else np.asarray(np.linalg.inv(T), np.float64)

    @property
    def uncertainty(self) -> Uncertainty | None:
        """Covariance of the error of the pose about a stated pivot; None where too little agrees to tell."""
        return self.verdict.uncertainty

    def expected_error(self, points: ArrayLike) -> tuple[Floats, Floats]:
        """Return the expected error over the source's extent.

        Args:
            points: (n, 3) coordinates in the source's CRS and units.

        Returns:
            Standard deviation of where each comes to lie, in plan along the direction in which it is largest
            and in height: (n,) and (n,) metres.

        Raises:
            RegistrationError: if no transform was found, or its uncertainty is not known.

        """
        if self._chain is None or self.pair is None or self.uncertainty is None:
            raise RegistrationError(f"the expected error is not known: {'; '.join(self.verdict.reasons)}")
        work = self._chain.source.to_work(coordinates(points, "points"))
        return self.uncertainty.sigmas(transforms.apply(self._chain.T_target_source, work))

    @overload
    def apply(self, points: str | os.PathLike[str] | Cloud, *, force: bool = ...) -> Cloud: ...  # type: ignore[overload-overlap]
    @overload
    def apply(self, points: ArrayLike, *, force: bool = ...) -> Floats: ...
    def apply(self, points: CloudLike, *, force: bool = False) -> Floats | Cloud:
        """Move points from the source's frame to the target's, in the target's CRS and units.

        Args:
            points: (n, 3) coordinates in the source's CRS and units; or a file, `laspy.LasData` or `Cloud`.
            force: move them even if the verdict is refused.

        Returns:
            (n, 3) float64 for an array; else a `Cloud` that streams the moved points with all dimensions.

        Raises:
            RegistrationError: if no transform was found, or the verdict is refused.
            InputError: if `points` is no cloud, or cannot be read.
            CrsError: if a cloud is not in the source's CRS.

        """
        return move(self.chain(force=force), points)

    @overload
    def inverse(self, points: str | os.PathLike[str] | Cloud, *, force: bool = ...) -> Cloud: ...  # type: ignore[overload-overlap]
    @overload
    def inverse(self, points: ArrayLike, *, force: bool = ...) -> Floats: ...
    def inverse(self, points: CloudLike, *, force: bool = False) -> Floats | Cloud:
        """Move points from the target's frame to the source's: the inverse of `apply`.

        Args and errors are those of `apply`, with source and target exchanged.
        """
        return move(self.chain(force=force), points, inverse=True)

    def chain(self, *, force: bool = False) -> TransformChain:
        """Return the exact chain of transforms from source to target coordinates.

        Args:
            force: return it even if the verdict is refused.

        Raises:
            RegistrationError: if no transform was found, or the verdict is refused.

        """
        reasons = "; ".join(self.verdict.reasons)
        if self._chain is None:
            raise RegistrationError(f"no transform was found: {reasons}")
        if self.verdict.name == "refused" and not (force or self.force):
            raise RegistrationError(
                f"the verdict is refused: {reasons}; force=True uses the transform anyway"
            )
        return self._chain

    def plot(self) -> Figure:
        """Draw the registered source over the target, and the difference of their lowest heights.

        Returns:
            A matplotlib figure; notebooks show it, ``savefig`` writes it.

        Raises:
            MissingPartError: if matplotlib is not installed.
            RegistrationError: if the clouds were not even rasterised.

        """
        try:
            from mtpcr_geo.export.figure import registration_figure
        except ImportError as error:
            raise MissingPartError(
                f'plot() needs matplotlib ({error}): pip install "mtpcr-geo[plot]"'
            ) from error
        if self.pair is None or self.pair.source.bev is None or self.pair.target.bev is None:
            raise RegistrationError(f"there is nothing to plot: {'; '.join(self.verdict.reasons)}")
        names = " to ".join(Path(side.cloud.name).name for side in (self.pair.source, self.pair.target))
        return registration_figure(self.pair, f"{names}: {self.verdict.name}")

    @python_words
    def save(
        self,
        folder: str | os.PathLike[str],
        *,
        overwrite: bool = False,
        force: bool = False,
        progress: Progress | None = None,
    ) -> dict[str, Path]:
        """Write what the command ``register`` writes: the registered cloud, its transform, the evidence.

        Input files are read again for the registered cloud and their hashes; arrays must not have been
        changed since. The recording is among the files where `register` was called with recording=True.
        A refused registration leaves its evidence only, and a doubtful one with a rival far away no cloud.

        Args:
            folder: made if it is not there.
            overwrite: replace files that are already there.
            force: write cloud and transform even if the verdict withholds them.
            progress: receives the progress of long steps.

        Returns:
            The files written, by what they are, which is also in `outputs`.

        Raises:
            OutputError: if a file exists already or cannot be written; nothing is left then.
            InputError: if an input file has changed since.

        """
        options = self._options.model_copy(update={"force": force or self.force, "recording": False})
        source = self.pair.source.cloud if self.pair is not None else None
        stages = writers_for(source, Path(folder), options, self._recording)
        taken = {stage.tag for stage in stages}
        last = [
            tag
            for tag, value in self._result.values.items()
            if value is self.pair and value is not None and tag not in taken
        ]
        nodes = chained(stages, tuple(last[-1:]))
        earlier = further_files(Path(folder)) if self._recording is None else []
        again = run(nodes, overwrite=overwrite, progress=progress, before=self._result, replaces=earlier)
        self._note(again)
        return self.outputs

    def _note(self, result: RunResult) -> None:
        """Keep what a run wrote and withheld."""
        written = result.written
        self.outputs = _by_name(written.files)
        self.not_written = {_name_of(path): why for path, why in written.withheld.items()}
        self.forced = written.forced

    def __repr__(self) -> str:
        rows = self._rows()
        width = max((len(name) for name, _ in rows), default=0)
        lines = [
            f"Registration: {self.verdict.name}",
            *(f"  {line}" for line in wrap(self.verdict.headline, 108)),
        ]
        return visible("\n".join(lines + [f"  {name:<{width}}  {text}" for name, text in rows]))

    def _repr_html_(self) -> str:
        rows = "".join(
            f"<tr><th style='text-align:left'>{escape(name)}</th>"
            f"<td style='text-align:left'>{escape(visible(text))}</td></tr>"
            for name, text in self._rows()
        )
        head = f"<b>Registration: {escape(self.verdict.name)}</b><p>{escape(self.verdict.headline)}</p>"
        return f"<div>{head}<table>{rows}</table></div>"

    def _rows(self) -> list[tuple[str, str]]:
        """Return clouds, transform, overlap and reasons of the verdict, as (name, text)."""
        from mtpcr_geo.export.descriptions import registration_rows

        return registration_rows(self.pair, self.verdict)

    @cached_property
    def _chain(self) -> TransformChain | None:
        solved = self.pair is not None and self.pair.T_target_source is not None
        return TransformChain.of(cast(Pair, self.pair)) if solved else None


@python_words
def register(
    source: CloudLike,
    target: CloudLike,
    out: str | os.PathLike[str] | None = None,
    *,
    progress: Progress | None = None,
    **options: Any,
) -> Registration:
    """Bring the source cloud to the target cloud.

    Nothing is written unless a folder is given; `Registration.save` writes the same files later.

    Args:
        source: the cloud that moves: a file that `read` takes; (n, 3) coordinates in metres; `laspy.LasData`;
            or a `Cloud`.
        target: the cloud that stays, likewise.
        out: folder for the result and its evidence; made if it is not there.
        progress: receives the progress of long steps.
        options: fields of `mtpcr_geo.pipeline.options.RegisterOptions`. Arrays are local unless `source_crs`
            or `target_crs` names a CRS. A recording is kept where a folder is given, or with recording=True.

    Returns:
        The result. Where no transform is found the verdict is refused; that is no error.

    Raises:
        MtpcrError: if an input, an option or an output cannot be used; nothing is written then.

    """
    chosen = read_options({"recording": out is not None, **options})
    if out is None and chosen.overwrite:
        raise OptionError("overwrite is of use with a folder only: give out, or save(folder, overwrite=True)")
    readers = readers_of(source, target, chosen)
    check_two(readers)
    chosen = chosen.model_copy(update=crs_of_arrays(chosen, source, target))
    steps = chained(steps_of(chosen), ("target", "source"))
    nodes = [*chained(readers[:1]), *chained(readers[1:]), *steps]
    if out is not None:
        writers = writers_for(source, Path(out), chosen)
        nodes += chained(writers, (nodes[-1].tag,))
        earlier = further_files(Path(out))
        with cores(chosen.threads):
            result = run(nodes, overwrite=chosen.overwrite, progress=progress, replaces=earlier)
        return Registration(result, chosen)
    if not chosen.recording:
        with cores(chosen.threads):
            return Registration(run(nodes, progress=progress), chosen)
    # kept in a temporary folder until it is saved; deleted together with the registration
    folder = Path(tempfile.mkdtemp(prefix="mtpcr-geo-"))
    nodes += chained([recording_writer(folder, chosen.recording_mb)], (nodes[-1].tag,))
    try:
        with cores(chosen.threads):
            result = run(nodes, progress=progress)
    except BaseException:
        shutil.rmtree(folder, ignore_errors=True)
        raise
    return Registration(result, chosen, recording=folder / OUTPUT_NAMES["recording"])


@python_words
def apply(
    transform: Registration | str | os.PathLike[str],
    points: CloudLike,
    out: str | os.PathLike[str] | None = None,
    *,
    inverse: bool = False,
    overwrite: bool = False,
    scale: float | None = None,
    cloud_crs: str | CRS | None = None,
    progress: Progress | None = None,
) -> Floats | Cloud | Path:
    """Move points by the transform of a registration.

    Args:
        transform: a registration, or the ``transform.json`` of one.
        points: (n, 3) coordinates in the source's CRS and units (in the target's with `inverse`); or a file,
            `laspy.LasData` or `Cloud`.
        out: a file to write the moved cloud to, its ending the format; nothing is written if not given.
        inverse: go from target to source.
        overwrite: replace `out` if it is there.
        scale: storage step of a LAS file, in units of its CRS; metres where those are degrees.
        cloud_crs: CRS of a cloud, taken instead of what it states; "local" if it has none.
        progress: where to report the points written.

    Returns:
        The file written; else (n, 3) float64 for an array, and for others a `Cloud` that streams the moved
        points.

    Raises:
        RegistrationError: if no transform was found, or the verdict is refused.
        InputError: if an input cannot be read.
        CrsError: if a cloud is not in the frame from which the transform starts.
        OutputError: if the output cannot be written, or exists.

    """
    if not isinstance(transform, Registration):
        from mtpcr_geo.export.transform import read_transform

        chain = read_transform(Path(transform))
    else:
        chain = transform.chain()
    if out is None:
        return move(chain, points, inverse=inverse, cloud_crs=cloud_crs)
    moved = moved_by(chain, cloud_of(points, "points"), inverse=inverse, cloud_crs=cloud_crs)
    reads = [Path(one) for one in (transform, points) if isinstance(one, str | os.PathLike)]
    write_moved(Path(out), moved, overwrite=overwrite, reads=reads, progress=progress, scale=scale)
    return Path(out)


def build_pipeline(
    source: str | Path, target: str | Path, out: str | Path, options: RegisterOptions
) -> list[dict[str, Any]]:
    """Name the stages of a registration of two files, as pipeline JSON; defaults are left out."""
    readers = readers_of(source, target, options)
    steps = chained(steps_of(options), ("target", "source"))
    writers = writers_for(source, Path(out), options)
    nodes = [*chained(readers[:1]), *chained(readers[1:]), *steps, *chained(writers, (steps[-1].tag,))]
    # a single input is the stage before
    return [
        {key: value for key, value in node.audit().items() if key != "inputs" or len(node.inputs) > 1}
        for node in nodes
    ]


def read_options(options: dict[str, Any]) -> RegisterOptions:
    """Check options of a registration.

    Raises:
        OptionError: naming the option; a misspelt one names the nearest valid one.

    """
    try:
        return RegisterOptions.model_validate(options)
    except ValidationError as error:
        raise OptionError(first_problem(error, RegisterOptions)) from None


def registration_of(result: RunResult) -> Registration:
    """Return the result of a pipeline that registers."""
    return Registration(result)


def _by_name(paths: Sequence[Path]) -> dict[str, Path]:
    """Return files of a registration by what they are; of a source of many files, the folder of the moved."""
    return {_name_of(path): path.parent if _is_part(path) else path for path in paths}


def _name_of(path: Path) -> str:
    if _is_part(path):
        return "registered"
    names = {path.name: name for name, path in OUTPUT_NAMES.items()}
    if path.name.startswith("registered.") and path.name not in names and path.parent.name != "bev":
        return "registered_also"
    for role in ("source", "target", *DERIVED_ROLES):
        names |= {
            f"{role}.tif": f"bev_{role}",
            f"{role}.qml": f"style_{role}",
            f"{role}.tif.points": "points",
        }
    return names.get(path.name, path.stem)


def _is_part(path: Path) -> bool:
    return path.parent.name == "registered"
