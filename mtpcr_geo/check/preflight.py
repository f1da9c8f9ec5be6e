"""The check itself: every file looked at once, in the order in which `register` would refuse it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from mtpcr_geo.check import header, pair, place, points
from mtpcr_geo.check.describe import describe
from mtpcr_geo.check.findings import CloudRole, Finding, Role, by_severity, finding_of
from mtpcr_geo.core.errors import CrsError, InputError, MtpcrError, OptionError, RegistrationError
from mtpcr_geo.core.frames import box_points
from mtpcr_geo.crs import FrameLink, WorkFrame, resolve_frames
from mtpcr_geo.io.las import LasCloud, check_distinct, open_cloud
from mtpcr_geo.io.sample import Scan, scan
from mtpcr_geo.method.bev import choose_cell, coverage_of, grid_around

if TYPE_CHECKING:
    from mtpcr_geo.core.progress import Progress
    from mtpcr_geo.crs import Vertical
    from mtpcr_geo.method.overlap import Overlap

Floats = NDArray[np.float64]
Frames = tuple[WorkFrame, FrameLink, FrameLink]


@dataclass
class Inspection:
    """One cloud, as far as it could be looked at.

    Attributes:
        role: "source" or "target".
        cloud: the opened file.
        claim: the CRS it is taken to be in.
        scan: its sample and true bounds, or None where it is unsound.
        measured: it in metres of a frame of its own, or None.
        too_large: why no raster of it can be made, or None.

    """

    role: CloudRole
    cloud: LasCloud
    claim: place.Claim
    scan: Scan | None = None
    measured: points.Measured | None = None
    too_large: RegistrationError | None = None

    @property
    def bounds(self) -> Floats:
        """(2, 3) lowest and highest coordinates: those of the points if known, else of the header."""
        if self.scan is not None:
            return np.stack([self.scan.minimum, self.scan.maximum])
        return np.stack([self.cloud.minimum, self.cloud.maximum])


@dataclass
class CheckReport:
    """What a check came to.

    Attributes:
        clouds: facts of each cloud, by role; a file that cannot be opened is not in it.
        relation: where they lie to each other; None for one cloud.
        findings: errors first.
        exit_code: 0 where `register` would go on, else the code with which it would end.

    """

    clouds: dict[str, dict[str, Any]] = field(default_factory=dict)
    relation: pair.Relation | None = None
    findings: tuple[Finding, ...] = ()
    exit_code: int = 0

    @property
    def goes_on(self) -> bool:
        """Return whether `register` would go on."""
        return self.exit_code == 0


def _frames(
    source: Inspection, target: Inspection, said: dict[CloudRole, str | None], local: bool, vertical: Vertical
) -> Frames:
    return resolve_frames(
        target.cloud,
        source.cloud,
        target_crs=said["target"],
        source_crs=said["source"],
        local=local,
        vertical=vertical,
    )


def _is_local(looked: Inspection) -> bool:
    return looked.claim.facts is not None and looked.claim.facts.kind == "local"


def check_clouds(
    source: str | Path,
    target: str | Path | None = None,
    *,
    source_crs: str | None = None,
    target_crs: str | None = None,
    local: bool = False,
    vertical: Vertical = "refuse",
    progress: Progress | None = None,
) -> CheckReport:
    """Look at one or two clouds as `register` would, and say what is wrong with them and how to mend it.

    Headers are read, and the points streamed once; of large clouds a sample is kept. Whether `register`
    would go on is found by the very functions that it calls, in its order.

    Args:
        source: LAS, LAZ or COPC file that would move.
        target: the one that would stay, or None to look at one file alone.
        source_crs: CRS of the source, instead of what its file states.
        target_crs: CRS of the target, likewise.
        local: both clouds are local, in metres.
        vertical: what to do with different vertical datums.
        progress: where to report the points read.

    Raises:
        OptionError: if the options contradict each other.

    """
    if target is None and source_crs is not None and target_crs is not None:
        raise OptionError("--target-crs is of no use with one cloud; give --source-crs, or a second cloud")
    check = _Check()
    files: list[tuple[CloudRole, str | Path, str | None]]
    files = [("source", source, source_crs if target is not None else source_crs or target_crs)]
    if target is not None:
        files.insert(0, ("target", target, target_crs))
    said = {role: text for role, _, text in files}
    for role, path, text in files:
        with check.stopping("input", role):
            cloud = open_cloud(path)
            check.looked[role] = Inspection(role, cloud, place.claim_of(cloud, text, local))
    if target is not None and len(check.looked) == 2:
        with check.stopping("same-cloud", "both"):
            check_distinct(check.looked["target"].cloud, check.looked["source"].cloud)
    for looked in check.looked.values():
        check.look(looked, said[looked.role], local, one=target is None, progress=progress)
    if target is not None and len(check.looked) == 2:
        check.compare(said, local, vertical)
    else:
        check.alone(said, local)
    check.rasters()
    return check.report()


class _Check:
    """A check on its way: what was looked at, found and refused so far."""

    def __init__(self) -> None:
        self.looked: dict[CloudRole, Inspection] = {}
        self.findings: list[Finding] = []
        self.refusals: list[MtpcrError] = []
        self.relation: pair.Relation | None = None

    @contextmanager
    def stopping(self, code: str, role: Role) -> Iterator[None]:
        """Note an error with which `register` would end, and go on with the rest."""
        try:
            yield
        except MtpcrError as error:
            self.refuse(error, code, role)

    def refuse(self, error: MtpcrError, code: str, role: Role) -> None:
        """Note that `register` would end here, and why, if that is not said already."""
        self.refusals.append(error)
        said = isinstance(error, CrsError) and any(found.code == "crs-missing" for found in self.findings)
        finding = finding_of(error, code, role)
        if not said and finding.what not in (found.what for found in self.findings):
            self.findings.append(finding)

    def look(
        self, looked: Inspection, said: str | None, local: bool, one: bool, progress: Progress | None
    ) -> None:
        """Look at one cloud by itself."""
        cloud, claim, role = looked.cloud, looked.claim, looked.role
        found = self.findings
        found += place.claim_findings(cloud, claim, said, local, role, one)
        found += header.header_findings(cloud, claim.facts, role)
        looked.scan = self._scan(looked, progress)
        if claim.facts is not None:
            found += place.area_findings(claim.facts, looked.bounds, role)
        if looked.scan is None:
            return
        found += points.noise_findings(looked.scan, role)
        try:
            _, link, _ = resolve_frames(cloud, cloud, target_crs=said, source_crs=said, local=local)
            sample = link.to_work(looked.scan.sample)
        except (CrsError, InputError):
            return  # said where the common frame is settled
        try:
            dense = coverage_of(sample, points=cloud.count)
        except RegistrationError as error:
            looked.too_large = error
            return
        # a sample may miss the outermost points
        outline = sample if looked.scan.complete else link.to_work(box_points(looked.bounds))
        low, high = outline.min(axis=0), outline.max(axis=0)
        looked.measured = points.Measured(
            sample, low, high, float(link.origin[2]), dense.per_m2, dense.occupied_m2
        )
        found += points.density_findings(looked.measured, cloud.count, role)
        found += points.plan_findings(looked.measured, role)
        if claim.facts is not None and claim.facts.kind != "geocentric":
            stated = claim.facts.kind != "local"
            found += points.height_findings(looked.measured, claim.facts.height_unit_name, stated, role)

    def _scan(self, looked: Inspection, progress: Progress | None) -> Scan | None:
        watched = points.Watched(looked.cloud)
        try:
            found = scan(watched, progress=progress)
        except InputError as error:
            self.refuse(error, "input", looked.role)
            return None
        self.findings += points.bounds_findings(looked.cloud, watched, looked.role)
        return found

    def alone(self, said: dict[CloudRole, str | None], local: bool) -> None:
        """Settle the frame of the only cloud that could be opened."""
        for role, looked in self.looked.items():
            with self.stopping("crs", looked.role):
                resolve_frames(
                    looked.cloud, looked.cloud, target_crs=said[role], source_crs=said[role], local=local
                )

    def compare(self, said: dict[CloudRole, str | None], local: bool, vertical: Vertical) -> None:
        """Settle the common frame of both clouds, and look at them in it."""
        source, target = self.looked["source"], self.looked["target"]
        self.relation = pair.Relation("unknown")
        try:
            frames = _frames(source, target, said, local, vertical)
            self.findings += pair.link_findings(frames[2], frames[1])
        except MtpcrError as error:
            self.refuse(error, "crs", "both")
            frames = None
        with self.stopping("crs", "both") if frames is not None else suppress(MtpcrError):
            # where only their heights do not go together, their plan still can be compared
            self._relate(frames or _frames(source, target, said, local, "assume-same"), source, target)
        if self.relation.name == "unknown" and not self.relation.why:
            self.relation = pair.by_area(source, target)
        if self.relation.name != "overlapping":
            self.findings += pair.swapped_findings(source, target)
        self.findings += pair.same_points_findings(source, target)

    def _relate(self, frames: Frames, source: Inspection, target: Inspection) -> None:
        frame, to_target, to_source = frames
        if source.scan is None or target.scan is None:
            self.relation = pair.Relation("unknown", why="a cloud cannot be read")
            return
        # register does so too, and it fails where the operation does not reach
        samples = [
            link.to_work(scan.sample) for link, scan in ((to_source, source.scan), (to_target, target.scan))
        ]
        if frame.crs is None or _is_local(source) or _is_local(target):
            local = " and the ".join(looked.role for looked in (source, target) if _is_local(looked))
            self.relation = pair.Relation(
                "unknown", why=f"the {local} has local coordinates; registering finds its place"
            )
            return
        overlap: Overlap | None
        self.relation, overlap = pair.relate(samples[0] + (to_source.origin - to_target.origin), samples[1])
        self.findings += pair.relation_findings(self.relation)
        if overlap is not None:
            self.findings += pair.height_pair_findings(overlap, float(to_target.origin[2]))

    def rasters(self) -> None:
        """See whether the rasters of the registration would fit into memory."""
        for looked in self.looked.values():
            if looked.too_large is not None:
                self.refuse(looked.too_large, "raster-size", looked.role)
        sides = [(looked, looked.measured) for looked in self.looked.values() if looked.measured is not None]
        if self.refusals or not sides:
            return
        cell = choose_cell(*(measured.per_m2 for _, measured in sides))
        for looked, measured in sides:
            with self.stopping("raster-size", looked.role):
                grid_around(measured.low, measured.high, cell)

    def report(self) -> CheckReport:
        """Put together what was found."""
        in_order = sorted(self.looked.items())
        return CheckReport(
            {role: describe(looked) for role, looked in in_order},
            self.relation,
            by_severity(self.findings),
            self.refusals[0].exit_code if self.refusals else 0,
        )
