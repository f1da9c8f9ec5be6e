"""`run.json`: the result of a run and how it came about, for programs to read.

Units are those in which a key ends; what is not known is null. ``<...>`` stands
for a name: a stage's tag, a role (source, target, result, work), a library.

- ``sentence``: verdict, probability and expected accuracy in one sentence, with which terminal, report and
  recording begin
- ``verdict``: accepted, doubtful or refused; null where the run ended before a verdict
- ``reasons``: why: one sentence each
- ``probability``: of being within 5 degrees and 2 m of the truth, as in the metrics; null from keypoints, or
  where nothing was judged
- ``checks``: the table of checks, those that decide first; empty where nothing was judged
- ``checks[].check``: what was checked
- ``checks[].value``: what was found
- ``checks[].wanted``: what is wanted
- ``checks[].status``: passed, not passed, warning (not met, and the verdict does not depend on it), or not
  checked
- ``checks[].meaning``: what the figure is
- ``uncertainty``: of the pose; null where too little agrees to tell
- ``uncertainty.covariance``: 6x6, of the error of the pose as a correction about the pivot
- ``uncertainty.order``: of its rows
- ``uncertainty.axes``: 3x3, takes work axes to those of the covariance: x, y and up of the levelled target
- ``uncertainty.pivot_work``: the pivot, middle of what was fitted, in the target's work coordinates
- ``uncertainty.pivot``: the same in the coordinates of the result
- ``uncertainty.farthest``: the registered source's point farthest from the pivot, in the coordinates of the
  result
- ``uncertainty.from``: what it was taken from
- ``uncertainty.blocks``: blocks of the overlap, left out one at a time
- ``uncertainty.correspondences``: corresponding points in them
- ``rivals``: other poses that fit nearly as well, with a margin below the limit, strongest first; empty where
  there are none, and where the verdict is accepted
- ``rivals[].east_m``: where one puts the middle of the tie points, from where the pose found does
- ``rivals[].north_m``: likewise
- ``rivals[].turn_deg``: by how much it is turned against the pose found, counter-clockwise
- ``rivals[].margin``: strength of the pose found over its own
- ``rivals[].far``: whether it is another place, and not the same a little off: then a doubtful run writes no
  registered cloud unless forced
- ``metrics``: what the verdict rests on, see below; empty where the run failed before
- ``T_target_source``: 4x4 on coordinates as they stand in the files, source to target; null if not found
- ``frames``: CRS and units of source, target and result, and the work frame; null without a pair
- ``time_s.<tag>``: seconds of each stage
- ``time_s.total``: seconds from the start to the writing of this file
- ``peak_memory_mb``: largest memory of the process so far, MiB; null where the system does not report it
- ``options.<tag>``: options of each stage, defaults included
- ``stages[].type``: type of the stage, in the order in which they ran
- ``stages[].tag``: its name in the pipeline
- ``stages[].options``: its options, as above
- ``stages[].seconds``: its time
- ``stages[].cpu_s``: processor time of all threads meanwhile, the recording's too
- ``stages[].read_mb``: read from files meanwhile, MiB; this and what follows are null where the system does
  not report it
- ``stages[].written_mb``: likewise written
- ``stages[].memory_mb``: memory that the process held at its end, MiB
- ``stages[].peak_memory_mb``: largest memory of the process so far
- ``stages[].metadata``: its own figures, see below
- ``stages[].skipped``: why it did not run or made nothing, where it did not
- ``stages[].failed``: why the registration ended there, where it did
- ``pipeline``: the pipeline JSON that was run
- ``versions.<library>``: version of this package, of Python and of the libraries installed
- ``inputs[].path``: each file read
- ``inputs[].bytes``: its size
- ``inputs[].sha256``: its hash
- ``outputs``: files written before this one
- ``not_written``: files that were not written; empty where all were
- ``not_written[].path``: each file that was not written
- ``not_written[].why``: why not
- ``forced``: whether files were written that the verdict withholds

The frames; ``result`` is that of the registered cloud:

- ``frames.<role>.crs``: null for local coordinates, else as follows
- ``frames.<role>.crs.name``: its name
- ``frames.<role>.crs.authority``: its code, such as EPSG:25832; null without one
- ``frames.<role>.units``: units of x, y and z
- ``frames.<role>.operation``: how its coordinates come to the work frame, by the name of the operation
- ``frames.<role>.accuracy_m``: accuracy of the operation; null where nobody stated one
- ``frames.<role>.grids``: grid files that it uses
- ``frames.<role>.heights``: what heights refer to
- ``frames.<role>.vertical``: what was to be done with different vertical datums
- ``frames.<role>.notes``: what had to be assumed
- ``frames.<role>.grid_scale``: least and greatest length on the map of a metre on the ground
- ``frames.work.source_origin``: subtracted from the source's metric coordinates, metres
- ``frames.work.target_origin``: the same for the target

The metrics:

- ``metrics.held_out_tie_points``: tie points each judged by a transform solved without it
- ``metrics.held_out_agreeing``: of these, tie points within the tolerance in plan
- ``metrics.held_out_agreeing_share``: the same as a share, 0 to 1
- ``metrics.held_out_tolerance_m``: the tolerance
- ``metrics.held_out_median_m``: median plan residual of the held-out tie points
- ``metrics.neg_log10_p``: significance: -log10 of the probability that chance makes as many agree; at most
  300
- ``metrics.hypothesis_margin``: how many times stronger the pose is than the next distinct one; null if
  unknown
- ``metrics.patch_support``: share of the patches in the overlap that agree on the pose; null from keypoints
- ``metrics.null_ratio``: how many times stronger the pose is than the best of the mirrored source, which has
  no right pose; null from keypoints
- ``metrics.null_p``: probability that the best hypothesis of a scene without a right pose is as strong, from
  the tail of the mirrored source's; null where there are too few, and from keypoints
- ``metrics.narrow_prior``: whether the place was known so well beforehand that hardly any other pose was
  searched; the probability then counts the margin for no more than the mirrored source's
- ``metrics.overlap_m2``: ground that both clouds see
- ``metrics.overlap_source``: the same as a share of the source's ground, 0 to 1
- ``metrics.overlap_target``: the same as a share of the target's ground, 0 to 1
- ``metrics.ground_cells``: cells in which both see the ground
- ``metrics.ground_agreeing``: of these, cells whose heights agree within 0.5 m
- ``metrics.ground_checked``: whether there are enough of them to judge by
- ``metrics.ground_spread_m``: spread of the height differences between both grounds, in blocks; null if
  unknown
- ``metrics.ground_relief_m``: relief of the ground in those blocks, a plane taken off; null if unknown
- ``metrics.ground_noise_m``: what that spread would be if all of it came of the scatter of the cells within
  the blocks; null if unknown
- ``metrics.repeats``: whether the scene under the pose fits itself after a shift, as rows do
- ``metrics.self_likeness``: correlation of that scene with itself, moved: from 0.3 on it may be rows; null
  where a matcher of keypoints was asked for
- ``metrics.probability``: probability of being within 5 degrees and 2 m of the truth, from a model fitted to
  runs of known answer; null from keypoints
- ``metrics.probability_precise``: the same of being within 0.2 degrees and 0.5 m, from that and from the
  uncertainty; null where either is not known
- ``metrics.refinement_lost``: whether surfaces fit better where the tie points do not agree, and these were
  followed
- ``metrics.refined_away_m``: how far the refinement ended from where the tie points had led, in plan, at the
  middle of these
- ``metrics.vertical_offset_m``: metres added to the source's heights, with vertical: estimate
- ``metrics.yaw_deg``: yaw of the transform in the work frame, counter-clockwise from above
- ``metrics.tilt_deg``: angle by which it tilts the vertical
- ``metrics.shift_work_m``: its translation between work coordinates
- ``metrics.prior_distance_m``: how far the middle of the source lies from where --near or --prior puts it
- ``metrics.prior_yaw_difference_deg``: how far the yaw is from that of --yaw or --prior
- ``metrics.tie_points``: all tie points
- ``metrics.tie_points_agreeing``: of these, tie points that agree with the final transform in plan, within
  the tolerance; the same as are drawn as agreeing
- ``metrics.tie_points_height_off``: of these, tie points whose heights are off by more than
  ``tie_points_height_tolerance_m``: they are matched in plan, and stand on a crown in one cloud and beside it
  in the other
- ``metrics.tie_points_height_tolerance_m``: three robust standard deviations of the agreeing ones' heights, a
  cell at least
- ``metrics.tie_points_plan_median_m``: median distance in plan of those that agree
- ``metrics.tie_points_height_median_m``: median of the absolute height differences of those that agree
- ``metrics.held_out_effective``: places that the held-out tie points stand for, overlapping patches once
- ``metrics.held_out_effective_agreeing``: of these, places that agree
- ``metrics.held_out_expected``: held-out tie points that chance would make agree; null from keypoints
- ``metrics.solid_cells``: cells inside roofs of one cloud that the other fills
- ``metrics.free_space_conflicts``: of these, cells in which the other sees the ground
- ``metrics.heights_elsewhere``: how many times as many heights both clouds would fill in the same columns,
  were the source raised or lowered; null where their lowest points are ground, or they share too few columns
- ``metrics.objects_missing``: share of what stands higher than 2.5 m in one cloud at whose place the other
  sees bare ground only, in the direction in which it is less; null where too little stands in the overlap
- ``metrics.sigma_plan_m``: standard deviation of the middle of the overlap in plan, along its weakest
  direction; this and what follows are null or missing where too little agrees to tell
- ``metrics.sigma_height_m``: standard deviation of its height
- ``metrics.sigma_yaw_deg``: standard deviation of the yaw
- ``metrics.sigma_tilt_deg``: standard deviation of the tilt about its weakest axis
- ``metrics.sigma_plan_far_m``: as in the middle, at the source's point that lies farthest from there
- ``metrics.sigma_height_far_m``: likewise
- ``metrics.within_95_plan_m``: what 95 % of the errors in plan are below, in the middle of the overlap
- ``metrics.within_95_height_m``: the same of the height
- ``metrics.within_95_plan_far_m``: as in the middle, at the farthest point of the source
- ``metrics.within_95_height_far_m``: likewise
- ``metrics.weakest_direction_deg``: direction in plan in which the middle is least sure, from y (north) to x
  (east), 0 to 180
- ``metrics.uncertainty_blocks``: blocks of the overlap, left out one at a time
- ``metrics.quarters_apart_plan_m``: standard deviation of where the quarters of the overlap, each solved by
  itself, put their middles, in plan
- ``metrics.quarters_apart_height_m``: the same in height
- ``metrics.weakest_motion_m``: standard deviation of the motion in plan, shift or turn, that the fit tells
  least
- ``metrics.weakest_motion_turning``: share of it that is a turn about the middle, 0 to 1
- ``metrics.drift_plan_m``: by how much what is left after the fit bends along the overlap, in plan; null with
  few blocks
- ``metrics.drift_height_m``: the same in height
- ``metrics.drift_length_m``: length of the overlap along that axis
- ``metrics.drift_clearness``: the bend over its own standard error

A stage's own figures (``stages[].metadata``), by its type; stages that PDAL serves have what PDAL reports:

- ``readers.las filename``: the file
- ``readers.las count``: points by its header
- ``readers.las minimum``: least coordinates by its header
- ``readers.las maximum``: greatest coordinates by its header
- ``readers.las srs``: its CRS as WKT, or empty
- ``readers.memory name``: what a cloud given from Python is called
- ``readers.memory count``: its points
- ``readers.memory srs``: its CRS as WKT, or empty
- ``mtpcr.level <role>.points``: points read
- ``mtpcr.level <role>.noise_points``: of these, classified as noise (7, 18) or flagged withheld, and left
  out
- ``mtpcr.level <role>.stray_points``: points that lie far from all others: kept in what is written, left
  out of everything else
- ``mtpcr.level <role>.header_remarks``: what the points say otherwise than the header of the file, and
  whether they are coarse single-precision numbers, a sentence each; only where there is something
- ``mtpcr.level <role>.no_return_points``: points that mark beams without a return, all on exactly one place:
  kept in what is written, left out of everything else
- ``mtpcr.level <role>.sampled``: points kept to work on
- ``mtpcr.level <role>.method``: none, plane, floor, verticals or refinement: what the cloud was levelled by
- ``mtpcr.level <role>.tilt_deg``: angle between its z axis and the vertical found
- ``mtpcr.level <role>.why``: why it was kept as it is, where it was
- ``mtpcr.level <role>.trusted``: whether its vertical is known: by the CRS, or since the options say so
- ``mtpcr.level <role>.plane_tilt_deg``: tilt of the ground plane
- ``mtpcr.level <role>.plane_inlier_share``: share of the points on that plane, 0 to 1
- ``mtpcr.level <role>.floor_tilt_deg``: tilt of the sheet of lowest points
- ``mtpcr.level <role>.floor_share``: share of coarse cells whose lowest point lies near it, 0 to 1
- ``mtpcr.level <role>.verticals``: points on walls, poles and trunks that agree on the vertical
- ``mtpcr.level <role>.verticals_spread_deg``: their robust spread about it
- ``mtpcr.level <role>.plane_to_verticals_deg``: angle between the plane's normal and the vertical
- ``mtpcr.bev cell_m``: edge of a cell
- ``mtpcr.bev cell_chosen``: whether it was chosen from the densities
- ``mtpcr.bev gamma_m``: gamma of Eq. 1, where that chose the cells
- ``mtpcr.bev <role>.cell_m``: edge of a cell of this raster
- ``mtpcr.bev <role>.width``: columns
- ``mtpcr.bev <role>.height``: rows
- ``mtpcr.bev <role>.filled_share``: share of the cells with points, 0 to 1
- ``mtpcr.bev <role>.points_per_m2``: points per occupied square metre
- ``mtpcr.bev <role>.area_m2``: occupied ground
- ``mtpcr.enhance <role>.mean_grey``: mean of the image that is matched, 0 to 255
- ``mtpcr.enhance <role>.saturated_share``: share of its pixels that are 0 or 255
- ``mtpcr.match matches``: matches found
- ``mtpcr.match prior.given_by``: what the search was narrowed by: georef, file, matrix, near or yaw
- ``mtpcr.match prior.middle_of_source``: mean of the source's points, in its file's coordinates
- ``mtpcr.match prior.place``: where that lies by the prior, in the target's file's coordinates
- ``mtpcr.match prior.within_m``: how far from there it may lie
- ``mtpcr.match prior.yaw_deg``: yaw by the prior, between work coordinates
- ``mtpcr.match prior.yaw_tolerance_deg``: how far from that it may be
- ``mtpcr.match method``: name of a keypoint matcher
- ``mtpcr.match cell_m``: cell of the last search; from keypoints, those of both rasters
- ``mtpcr.match extent_m``: edge of a square of the smaller cloud's occupied area, from which lengths follow
- ``mtpcr.match patch_m``: edge of a patch of the local matches
- ``mtpcr.match search_radius_m``: how far around the pose each patch was searched
- ``mtpcr.match searched[].cell_m``: cell of each level of the search
- ``mtpcr.match searched[].scores``: scores of its hypotheses, best first
- ``mtpcr.match margin``: strength of the best hypothesis over that of the next distinct one
- ``mtpcr.match support``: share of the patches that agree on the best pose, 0 to 1
- ``mtpcr.match support_next``: the same of the next distinct pose
- ``mtpcr.match neg_log10_p``: significance of that support
- ``mtpcr.match patches``: patches in the overlap
- ``mtpcr.match scores``: scores of the hypotheses at the finest cells
- ``mtpcr.match strengths``: their strengths: of the best one, score times support, times how well the ground
  agrees; of the others, that over how many times stronger it is; from keypoints that vote, pairs that agree
  on each pose, less the two that always do
- ``mtpcr.match ground_spread_m``: robust spread of the differences between both grounds' heights under each
  of them; null where too little ground is compared
- ``mtpcr.match ground_relief_m``: what it would be if neither ground told anything of the other; null
  likewise
- ``mtpcr.match ground_beyond_plane_m``: the same of what is left of each ground beside its own plane; null
  likewise
- ``mtpcr.match mirrored_strengths``: score times support of the hypotheses of the mirrored source; null where
  it was not searched; from keypoints that vote, pairs that agree on each, less two
- ``mtpcr.match self_likeness``: correlation of the scene under the best hypothesis with itself, moved: a
  scene that repeats itself has 0.4 and more
- ``mtpcr.match by_proposals``: whether the best hypothesis was proposed by the network
- ``mtpcr.match second_opinion.margin``: where the network was asked to match by itself: strength of its best
  pose over the next distinct one and the mirrored source's; null where it found none
- ``mtpcr.match second_opinion.taken``: whether its matches took the place of those by heights; then the other
  figures are those of the network
- ``mtpcr.match null_ratio``: strength of the best hypothesis over the best of these, the ground weighed
- ``mtpcr.match verticals[].source``: what the source was levelled by, where several verticals were tried
- ``mtpcr.match verticals[].target``: the same of the target
- ``mtpcr.match verticals[].source_tilt_deg``: tilt of the source's vertical there
- ``mtpcr.match verticals[].target_tilt_deg``: tilt of the target's
- ``mtpcr.match verticals[].strength``: of the best hypothesis there; null where nothing was found
- ``mtpcr.match verticals[].margin``: over the next distinct one
- ``mtpcr.match verticals[].taken``: whether the run went on from there
- ``mtpcr.match margin_at_the_place``: in a survey, the margin over rivals at the place alone; ``margin`` is
  the lesser of that and ``survey.margin``
- ``mtpcr.match null_ratio_at_the_place``: likewise over the mirrored source at the place alone
- ``mtpcr.match survey.place``: where the survey's mosaic puts the middle of the source's raster, in the
  survey's CRS
- ``mtpcr.match survey.yaw_deg``: how it is turned there
- ``mtpcr.match survey.cell_m``: cell at which hypotheses of the survey are judged
- ``mtpcr.match survey.searched[].cell_m``: cell of each level of the search
- ``mtpcr.match survey.searched[].windows``: in how many windows it was searched
- ``mtpcr.match survey.hypotheses``: hypotheses that were followed from there
- ``mtpcr.match survey.margin``: strength of the best over that of the next anywhere in what was searched
- ``mtpcr.match survey.null_ratio``: over the best of the mirrored source anywhere
- ``mtpcr.match survey.strengths``: of the hypotheses judged
- ``mtpcr.match survey.mirrored_strengths``: of those of the mirrored source
- ``mtpcr.match survey.cut_out``: what was cut out of the survey as the target, in its CRS: lowest and highest
  x and y
- ``mtpcr.match survey.tiles[].path``: a tile that was read
- ``mtpcr.match survey.tiles[].bytes``: its size
- ``mtpcr.match survey.tiles[].modified_ns``: time of its last change, nanoseconds since 1970
- ``mtpcr.match zoom``: factor by which images were magnified before keypoints were sought
- ``mtpcr.match turns_deg``: turns of the source that were tried
- ``mtpcr.match turn_matches``: matches at each of them; where keypoints vote, their candidates
- ``mtpcr.match turn_agreeing``: of these, matches that agree on one pose; where keypoints vote, keypoints of
  which a candidate agrees on the pose of most votes
- ``mtpcr.match turn_deg``: the turn that was taken: the yaw found, where orientations were compared by less
  than all keypoints, or on shrunk images
- ``mtpcr.match agreeing_by_chance``: share of the places that agree with the best pose of the mirrored
  source, which cannot be right; null where the network describes no places
- ``mtpcr.match agreeing``: matches that agree at that turn; where keypoints vote, pairs that agree on the
  pose
- ``mtpcr.match tolerance_m``: how far agreeing matches may lie from the pose
- ``mtpcr.match keypoints``: keypoints in source and target
- ``mtpcr.focus overlap``: share of the source's ground that the target covers, after the first pass
- ``mtpcr.focus theta``: share from which there is no second pass
- ``mtpcr.focus agreeing_before``: matches that agreed on a pose in the first pass
- ``mtpcr.focus matches_before``: matches of the first pass
- ``mtpcr.focus pose_known``: whether enough of them agreed
- ``mtpcr.focus applied``: whether the second pass was taken
- ``mtpcr.focus why``: why not, where it was not
- ``mtpcr.focus cells_m``: cells of the second pass, source and target
- ``mtpcr.focus agreeing_after``: matches that agreed in the second pass
- ``mtpcr.focus matches_after``: matches of the second pass
- ``mtpcr.inverse_mapping tie_points``: matches that became tie points
- ``mtpcr.inverse_mapping held_out``: of these, kept from the solve
- ``mtpcr.solve used``: tie points solved from
- ``mtpcr.solve inliers``: of these, within the final threshold
- ``mtpcr.solve iterations``: rounds until nothing changed
- ``mtpcr.solve threshold_m``: the final threshold
- ``mtpcr.solve yaw_deg``: yaw found, between levelled clouds
- ``mtpcr.solve settings.<name>``: robust_start, upright, tries and seed, as in the options
- ``mtpcr.refine <fit>.ground_cells``: cells where both see the ground; fit is ground_before or ground_after
  ICP
- ``mtpcr.refine <fit>.ground_cells_agreeing``: of these, cells that agree with the fit
- ``mtpcr.refine <fit>.rise_m``: by how much the source was raised
- ``mtpcr.refine <fit>.ground_spread_m``: robust spread of the height differences
- ``mtpcr.refine <fit>.tilt_deg``: by how much it was tilted
- ``mtpcr.refine <fit>.followed``: whether the fit was taken over
- ``mtpcr.refine raised``: whether the source was raised or lowered to where far more of both clouds meets
  than where their lowest points, by the tie points or the ground, had led
- ``mtpcr.refine icp.method``: variant of ICP
- ``mtpcr.refine icp.voxel_m``: thinning of the points
- ``mtpcr.refine icp.points_source``: points kept of the source
- ``mtpcr.refine icp.points_target``: points kept of the target
- ``mtpcr.refine icp.tried.<candidate>.surface_residual``: how badly flat surfaces meet: 0 all meet, 1 none
  does
- ``mtpcr.refine icp.tried.<candidate>.tie_points``: tie points that agree with it
- ``mtpcr.refine icp.chosen``: the candidate that was taken
- ``mtpcr.refine icp.followed``: whether that is a run of ICP
- ``mtpcr.refine icp.lost_tie_points``: whether a run was not followed because tie points were lost
- ``mtpcr.refine icp.left_tie_points``: whether the run that was followed lost them: few had agreed, and
  surfaces met far better
- ``mtpcr.refine icp.rounds[].max_correspondence_distance_m``: farthest correspondence of each round
- ``mtpcr.refine icp.rounds[].iterations``: its iterations
- ``mtpcr.refine icp.rounds[].inliers``: points with a correspondence at its end
- ``mtpcr.refine icp.rounds[].converged``: whether it stood still
- ``mtpcr.refine icp.fine.voxel_m``: thinning of the points in a last, finer round, where there was one
- ``mtpcr.refine icp.fine.max_correspondence_distance_m``: farthest correspondence of that round
- ``mtpcr.refine icp.fine.iterations``: its iterations
- ``mtpcr.refine icp.fine.inliers``: points with a correspondence at its end
- ``mtpcr.refine icp.fine.converged``: whether it stood still
- ``mtpcr.refine icp.rotated_deg``: angle by which ICP turned the start
- ``mtpcr.refine slid_m``: how far ICP had gone in plan from the tie points of a scene that repeats itself,
  where that was too far and plan and yaw were left as the tie points have them
- ``mtpcr.refine from_search``: whether the pose of the search was refined in place of what the tie points led
  to, since surfaces met better there; then the figures are of the refinement from there
- ``mtpcr.refine levelled_again``: whether the source was levelled by the vertical that ICP found, matched and
  solved again; then the figures are those of the second refinement
- ``mtpcr.refine matched_again_cell_m``: where surfaces met better beside the tie points, and new tie points
  on coarser rasters agreed with that: cell of those, metres; then the figures are of the second refinement
- ``mtpcr.refine tilt_deg``: angle between the source's z axis and that vertical
- ``mtpcr.assess verdict``: as above
- ``mtpcr.assess reasons``: as above
- ``mtpcr.assess <metric>``: the metrics, as above
- ``mtpcr.assess tie_points_and_ground_agreeing``: with a prior: tie points and cells of ground that agree
  with the result
- ``mtpcr.assess with_prior``: the same for the prior
- ``mtpcr.assess surface_residual``: how badly flat surfaces meet under the result and under the prior: 0 all
  meet, 1 none does; null where there are too few
- ``mtpcr.assess prior_kept``: whether the prior was kept
- ``mtpcr.write_recording size_mb``: size that the recording may have, megabytes
- ``mtpcr.write_recording points_source``: points of the source in memory
- ``mtpcr.write_recording points_source_shown``: of these, points drawn of the aligned source
- ``mtpcr.write_recording points_target``: points of the target in memory
- ``mtpcr.write_recording points_target_shown``: of these, points drawn of the target
- ``mtpcr.write_recording picture_side``: longest side of a picture, pixels
- ``writers.las filename``: the file
- ``writers.las count``: points written
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np


def write_run_json(path: Path, facts: Mapping[str, Any]) -> None:
    """Write what is known of a run as strict JSON.

    Args:
        path: file to write.
        facts: what the module docstring lists.

    """
    path.write_text(json.dumps(plain(facts), indent=1, allow_nan=False) + "\n", encoding="utf-8")


def plain(value: Any) -> Any:
    """Return a value as JSON has it: arrays become lists, and what is not finite becomes null."""
    if isinstance(value, Mapping):
        return {str(key): plain(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple | set):
        return [plain(inner) for inner in value]
    if isinstance(value, np.ndarray | np.generic):
        return plain(value.tolist())
    if isinstance(value, float):
        return value if math.isfinite(value) else None
    if value is None or isinstance(value, bool | int | str):
        return value
    return str(value)
