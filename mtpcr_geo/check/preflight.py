"""The check itself: every file is read once, in the order in which `register` would refuse it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from mtpcr_geo.check import fitness, header, pair, place, points, upright
from mtpcr_geo.check.describe import CloudFacts, describe
from mtpcr_geo.check.findings import CloudRole, Finding, Role, by_severity, finding_of
from mtpcr_geo.check.inspection import Inspection
from mtpcr_geo.core.advice import as_called, python_words
from mtpcr_geo.core.arrays import Floats
from mtpcr_geo.core.errors import CrsError, InputError, MtpcrError, OptionError, RegistrationError
from mtpcr_geo.core.frames import box_points
from mtpcr_geo.core.scanner import Scanner, check_unit
from mtpcr_geo.core.units import Axes, Unit
from mtpcr_geo.crs import FrameLink, WorkFrame, resolve_frames
from mtpcr_geo.crs.near import check_reach, distance_to_box, place_in_work, rim_of
from mtpcr_geo.io.formats import open_any
from mtpcr_geo.io.las import LasCloud, check_distinct
from mtpcr_geo.io.sample import Scan, scan
from mtpcr_geo.method.bev import coverage_of, grid_around

if TYPE_CHECKING:
    from mtpcr_geo.core.progress import Progress
    from mtpcr_geo.crs import Vertical
    from mtpcr_geo.method.overlap import Overlap

Frames = tuple[WorkFrame, FrameLink, FrameLink]


@dataclass
class CheckReport:
    """The result of a check.

    Attributes:
        clouds: facts of each cloud, by role; a file that cannot be opened is not in it.
        relation: where they lie to each other; None for one cloud.
        findings: errors first; they name options as keywords of Python, or as the command spells them where
            it was called.
        files: the file of each cloud that was asked for, by role.
        exit_code: 0 where `register` would go on, else the code with which it would end.

    """

    clouds: dict[CloudRole, CloudFacts] = field(default_factory=dict)
    relation: pair.Relation | None = None
    findings: tuple[Finding, ...] = ()
    files: dict[CloudRole, str] = field(default_factory=dict)
    exit_code: int = 0

    @property
    def goes_on(self) -> bool:
        """Return whether `register` would go on."""
        return self.exit_code == 0


def _frames(
    source: Inspection,
    target: Inspection,
    declared: dict[CloudRole, str | None],
    local: bool,
    vertical: Vertical,
) -> Frames:
    return resolve_frames(
        target.cloud,
        source.cloud,
        target_crs=declared["target"],
        source_crs=declared["source"],
        local=local,
        vertical=vertical,
        target_bounds=target.known_bounds,
        source_bounds=source.known_bounds,
        target_scanner=target.scanner,
        source_scanner=source.scanner,
    )


def _frame_of(inspection: Inspection, declared: str | None, local: bool) -> FrameLink:
    """Return the link of one cloud to a frame of its own."""
    cloud, bounds = inspection.cloud, inspection.known_bounds
    _, link, _ = resolve_frames(
        cloud,
        cloud,
        target_crs=declared,
        source_crs=declared,
        local=local,
        target_bounds=bounds,
        source_bounds=bounds,
        target_scanner=inspection.scanner,
        source_scanner=inspection.scanner,
    )
    return link


@python_words
def check_clouds(
    source: str | Path,
    target: str | Path | None = None,
    *,
    source_crs: str | None = None,
    target_crs: str | None = None,
    source_unit: Unit | None = None,
    target_unit: Unit | None = None,
    source_axes: Axes = "z-up",
    target_axes: Axes = "z-up",
    source_text: str | None = None,
    target_text: str | None = None,
    scale: float | None = None,
    local: bool = False,
    vertical: Vertical = "refuse",
    near: tuple[float, float] | None = None,
    near_crs: str | None = None,
    within: float | None = None,
    progress: Progress | None = None,
) -> CheckReport:
    """Read one or two clouds as `register` would; report what is wrong with them, and how to mend it.

    Headers are read, and the points streamed once; of large clouds a sample is kept. Whether `register`
    would go on is found by the very functions that it calls, in its order.

    Args:
        source: file that would move, of any format that `read` takes.
        target: the one that would stay, or None to check one file alone.
        source_crs: CRS of the source, instead of what its file states.
        target_crs: CRS of the target, likewise.
        source_unit, target_unit: units of local clouds, if not metres.
        source_axes, target_axes: which of their axes points up.
        source_text, target_text: layouts of clouds that are text, as `read` takes them.
        scale: step of the coordinates of the LAS file that would be written.
        local: both clouds are local.
        vertical: what to do with different vertical datums.
        near: place near which the middle of the source lies, in the target's CRS.
        near_crs: CRS of that place, if not the target's.
        within: how far from there it may lie, metres; if None as far as the source reaches from its middle.
        progress: where to report the points read.

    Raises:
        OptionError: if the options contradict each other.

    """
    if target is None and source_crs is not None and target_crs is not None:
        raise OptionError("--target-crs is of no use with one cloud; give --source-crs, or a second cloud")
    if near is None and (near_crs is not None or within is not None):
        raise OptionError("--near-crs and --within are of use with --near only; give --near X Y")
    if near is not None and target is None:
        raise OptionError("--near is a place in the target, and there is one cloud; give a second one")
    check = _Check(scale)
    texts: dict[CloudRole, str | None] = {"source": source_text, "target": target_text}
    files: list[tuple[CloudRole, str | Path, str | None]]
    files = [("source", source, source_crs if target is not None else source_crs or target_crs)]
    if target is not None:
        files.insert(0, ("target", target, target_crs))
    declared = {role: text for role, _, text in files}
    scanners: dict[CloudRole, Scanner] = {
        "source": Scanner(source_unit, source_axes),
        "target": Scanner(target_unit, target_axes),
    }
    for role, path, text in files:
        check.files[role] = str(path)
        with check.stopping("input", role):
            cloud = open_any(path, text=texts[role])
            check.inspections[role] = Inspection(
                role, cloud, place.claim_of(cloud, text, local, scanners[role]), scanner=scanners[role]
            )
    if target is not None and len(check.inspections) == 2:
        with check.stopping("same-cloud", "both"):
            check_distinct(check.inspections["target"].cloud, check.inspections["source"].cloud)
    for inspection in check.inspections.values():
        check.inspect(inspection, declared[inspection.role], local, one=target is None, progress=progress)
    if target is not None and len(check.inspections) == 2:
        frames = check.compare(declared, local, vertical)
        if near is not None and frames is not None:
            check.place(near, near_crs, within, frames)
    else:
        check.alone(declared, local)
    check.rasters()
    return check.report()


class _Check:
    """A check in progress: what was inspected, found and refused so far."""

    def __init__(self, scale: float | None = None) -> None:
        self.scale = scale
        self.inspections: dict[CloudRole, Inspection] = {}
        self.findings: list[Finding] = []
        self.files: dict[CloudRole, str] = {}
        self.refusals: list[MtpcrError] = []
        self.relation: pair.Relation | None = None
        self.common: tuple[Floats, Floats] | None = None

    @contextmanager
    def stopping(self, code: str, role: Role) -> Iterator[None]:
        """Return a context that notes the error with which `register` would end, and goes on."""
        try:
            yield
        except MtpcrError as error:
            self.refuse(error, code, role)

    def refuse(self, error: MtpcrError, code: str, role: Role) -> None:
        """Note that `register` would end here, and why, unless that is reported already."""
        self.refusals.append(error)
        known = isinstance(error, CrsError) and any(found.code == "crs-missing" for found in self.findings)
        finding = finding_of(error, code, role)
        if not known and finding.what not in (found.what for found in self.findings):
            self.findings.append(finding)

    def inspect(
        self, inspection: Inspection, declared: str | None, local: bool, one: bool, progress: Progress | None
    ) -> None:
        """Inspect one cloud by itself."""
        cloud, claim, role = inspection.cloud, inspection.claim, inspection.role
        found = self.findings
        inspection.scan = self._scan(inspection, progress)
        found += place.claim_findings(cloud, claim, declared, local, role, one, inspection.bounds)
        unknown = declared is None and not local and cloud.crs is None
        inspection.seems_local = unknown and place.looks_local(inspection.bounds, cloud.count)
        whole = inspection.bounds if inspection.scan is None else inspection.scan.whole
        if isinstance(cloud, LasCloud):
            found += header.header_findings(cloud, claim.facts, role, whole)
        if claim.facts is not None and cloud.count:
            found += place.area_findings(claim.facts, inspection.bounds, role)
        if inspection.scan is None:
            return
        found += points.noise_findings(inspection.scan, role)
        found += points.no_return_findings(inspection.scan, role)
        found += points.stray_findings(inspection.scan, role)
        metres = header.scales_in_metres(np.ones(3), claim.facts) if claim.facts is not None else np.ones(3)
        found += points.precision_findings(cloud, inspection.scan, metres, role)
        try:
            link = _frame_of(inspection, "local" if inspection.seems_local else declared, local)
            sample = link.to_work(inspection.scan.sample)
        except (CrsError, InputError):
            return  # reported where the common frame is settled
        if link.file_crs is None and link.scanner.unit is None:
            try:
                check_unit(cloud.name, role, inspection.scan.sample, cloud.count)
            except InputError as error:
                if inspection.is_local:
                    self.refuse(error, "unit", role)
                return  # else it stands in the guess at a missing CRS
        try:
            dense = coverage_of(sample, points=None if inspection.scan.complete else cloud.count)
        except RegistrationError as error:
            inspection.too_large = error
            return
        # a sample may miss the outermost points
        outline = sample if inspection.scan.complete else link.to_work(box_points(inspection.bounds))
        low, high = outline.min(axis=0), outline.max(axis=0)
        inspection.measured = points.Measured(
            sample, low, high, float(link.origin[2]), dense.per_m2, dense.occupied_m2
        )
        found += points.plan_findings(inspection.measured, role)
        if role == "source":
            with self.stopping("scale", role):
                points.check_scale(link, inspection.scan, self.scale)
                found += points.storage_findings(link, inspection.scan, role, self.scale)
        if inspection.is_local or inspection.seems_local:
            found += upright.upright_findings(sample, role)
        upright_as_it_is = not any(one.role == role and one.code == "lies-on-its-side" for one in found)
        if claim.facts is not None and claim.facts.kind != "geocentric" and upright_as_it_is:
            stated = claim.facts.georeferenced
            found += points.height_findings(inspection.measured, claim.facts.height_unit_name, stated, role)

    def _scan(self, inspection: Inspection, progress: Progress | None) -> Scan | None:
        try:
            found = scan(inspection.cloud, progress=progress)
        except InputError as error:
            self.refuse(error, "input", inspection.role)
            return None
        if isinstance(inspection.cloud, LasCloud):
            self.findings += points.bounds_findings(inspection.cloud, found.whole, inspection.role)
        return found

    def alone(self, declared: dict[CloudRole, str | None], local: bool) -> None:
        """Settle the frame of the only cloud that could be opened."""
        for role, inspection in self.inspections.items():
            with self.stopping("crs", inspection.role):
                _frame_of(inspection, declared[role], local)

    def compare(
        self, declared: dict[CloudRole, str | None], local: bool, vertical: Vertical
    ) -> Frames | None:
        """Settle the common frame of both clouds, and compare them in it; None where there is none."""
        source, target = self.inspections["source"], self.inspections["target"]
        self.relation = pair.Relation("unknown")
        try:
            frames = _frames(source, target, declared, local, vertical)
            self.findings += pair.link_findings(frames[2], frames[1])
        except MtpcrError as error:
            self.refuse(error, "crs", "both")
            frames = None
        with self.stopping("crs", "both") if frames is not None else suppress(MtpcrError):
            # where only their heights do not go together, their plan still can be compared
            self._relate(frames or _frames(source, target, declared, local, "assume-same"), source, target)
        if self.relation.name == "unknown" and not self.relation.why:
            self.relation = pair.by_area(source, target)
        if self.relation.name != "overlapping":
            self.findings += pair.swapped_findings(source, target)
        self.findings += pair.lookalike_findings(source, target)
        self.findings += pair.result_findings(source, target)
        self.findings += pair.exchanged_findings(source, target)
        self.findings += pair.same_points_findings(source, target)
        return frames

    def place(
        self, near: tuple[float, float], near_crs: str | None, within: float | None, frames: Frames
    ) -> None:
        """Note a refusal where the source cannot reach the target from the place given."""
        _, to_target, to_source = frames
        source, target = (self.inspections[role].scan for role in ("source", "target"))
        if source is None or target is None:
            return
        with self.stopping("near", "both"):
            place = place_in_work(near, near_crs, to_target)
            sample, bounds = to_source.to_work(source.sample), to_target.to_work(target.sample)
            rim = rim_of(sample, sample.mean(axis=0))
            radius = rim if within is None else within
            box = np.stack([bounds.min(axis=0), bounds.max(axis=0)])
            check_reach(place, radius, rim, box, near, to_target, near_crs is not None)
            gap = distance_to_box(place, box)
            if gap > radius:
                self.findings.append(
                    Finding(
                        "warning",
                        "near",
                        "both",
                        f"the middle of the source lies {gap - radius:.0f} m outside the target at least, by "
                        "--near and --within",
                        "check the place; parts of the source can overlap at most",
                    )
                )

    def _relate(self, frames: Frames, source: Inspection, target: Inspection) -> None:
        frame, to_target, to_source = frames
        if source.scan is None or target.scan is None:
            self.relation = pair.Relation("unknown", why="a cloud cannot be read")
            return
        # register does so too, and it fails where the operation does not reach
        samples = [
            link.to_work(scan.sample) for link, scan in ((to_source, source.scan), (to_target, target.scan))
        ]
        if frame.crs is None or source.is_local or target.is_local:
            local = [inspection.role for inspection in (source, target) if inspection.is_local]
            which = "both have" if len(local) > 1 else f"the {local[0]} has"
            self.relation = pair.Relation(
                "unknown", why=f"{which} local coordinates; registering finds the place of the source"
            )
            return
        overlap: Overlap | None
        self.relation, overlap = pair.relate(samples[0] + (to_source.origin - to_target.origin), samples[1])
        areas = [one.measured.area_m2 for one in (source, target) if one.measured is not None]
        self.findings += pair.relation_findings(self.relation, min(areas, default=np.inf))
        if self.relation.name == "overlapping":
            self.common = samples[0] + (to_source.origin - to_target.origin), samples[1]
        if overlap is not None:
            self.findings += pair.height_pair_findings(overlap, float(to_target.origin[2]))

    def rasters(self) -> None:
        """Note a refusal where the rasters of the registration would not fit into memory."""
        for inspection in self.inspections.values():
            if inspection.too_large is not None:
                self.refuse(inspection.too_large, "raster-size", inspection.role)
        sides = [
            (inspection, inspection.measured)
            for inspection in self.inspections.values()
            if inspection.measured is not None
        ]
        # one that lies on its side is levelled first, or turned by an option
        on_side = {found.role for found in self.findings if found.code == "lies-on-its-side"}
        sides = [(one, measured) for one, measured in sides if one.role not in on_side]
        if self.refusals or not sides:
            return
        clouds = [
            fitness.Fitness(one.role, measured, one.cloud.count, one.is_local) for one, measured in sides
        ]
        cell = fitness.cell_for(clouds)
        for inspection, measured in sides:
            with self.stopping("raster-size", inspection.role):
                grid_around(measured.low, measured.high, cell)
        if not self.refusals:
            self.findings += fitness.fitness_findings(clouds)
            if self.common is not None:
                thinned = max(cloud.thinned for cloud in clouds)
                self.findings += fitness.ground_findings(*self.common, cell * thinned)

    def report(self) -> CheckReport:
        """Put together what was found."""
        in_order = sorted(self.inspections.items())
        found = [replace(one, what=as_called(one.what), fix=as_called(one.fix)) for one in self.findings]
        return CheckReport(
            {role: describe(inspection) for role, inspection in in_order},
            self.relation,
            by_severity(found),
            dict(sorted(self.files.items())),
            self.refusals[0].exit_code if self.refusals else 0,
        )
