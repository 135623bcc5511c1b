"""A second mapping, from the observations of the first bundle adjustment.

Bundle adjustment converges to a local minimum. If few tracks cross a fast turn, the first mapping
may be bent, and bundle adjustment does not straighten it. Even so, the corners that were found with
its poses form longer and more accurate tracks than the motion that it was mapped from. A model that
is mapped from these is usually less bent. Its cost may be about the same, because hardly any points
carry the scale across such a turn.

With little parallax, the first mapping may converge to a focal length of twice the true one. The
second mapping then begins with the initial one. On two clips of a room, its cost was 0.85 and 0.94
of the first.

`reconstruct` always maps models again that are not connected to the first: few points determine
them.
"""

from __future__ import annotations

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np  # before pycolmap: the other order breaks writing PNG files later
import pycolmap

from colmap_av1.database.writing import write_matches
from colmap_av1.errors import ModelError
from colmap_av1.geometry.cameras import with_initial_intrinsics
from colmap_av1.geometry.posed_model import PosedModel, reprojection_errors, write_posed_model
from colmap_av1.images.image_set import ImageSet
from colmap_av1.matching.matched_images import pair_by_tracks, verify_images
from colmap_av1.matching.pairs import covisible_pairs
from colmap_av1.options import MapOptions
from colmap_av1.poses.adjusting import adjust_posed, mean_cost, refines_intrinsics
from colmap_av1.poses.adjustment_stage import AdjustedResult
from colmap_av1.poses.longest_tracks import keep_longest_tracks
from colmap_av1.poses.mapping_stage import MappedResult, mapped_models
from colmap_av1.poses.model_tracks import tracks_of_model
from colmap_av1.poses.posed_images import FROM_PICTURES, posed_images_of, read_poses, triangulate_in
from colmap_av1.poses.run import Run
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.stages import Kept, run_stage

# The second mapping is rejected if it registers a smaller share of the images than this.
_LEAST_REGISTERED = 0.5
# It is rejected if its cost exceeds this multiple of the first cost. Costs at the same minimum
# differ by 0.1 %. On 18 walks the ratio was 0.94 to 1.0004, and the error of camera centres fell to
# 0.01 to 0.9 of the first on 17 of them; on the other it rose from 0.2 to 0.3 % of the extent. On
# one walk the ratio was 1.007, and the error rose from 0.6 to 9.6 %.
_MAX_COST_RATIO = 1.002
# Above this ratio, the observations do not show which of the two is right.
_CLEAR_RATIO = 0.99


@dataclass(frozen=True)
class RemappedResult(MappedResult):
    """Result of `remap_stage`.

    `other_models` begins with a model of the images that the second mapping leaves out, if any,
    with their first poses, and continues with the other models of the first mapping.

    Attributes:
        share: share of the images that it registers.
        kept: share of the observations in its images that agree with the second mapping.
        cost: mean robust cost of these with the first poses.
        new_cost: mean robust cost of these with the second mapping, after adjustment.
        from_initial: whether it began with initial intrinsics instead of those of the first.
    """

    share: float
    kept: float
    cost: float
    new_cost: float
    from_initial: bool

    def fits(self, least_kept: float) -> bool:
        """Whether it is large enough and fits the observations about as well as the first.

        If it began with initial intrinsics, it must fit them clearly better.

        Args:
            least_kept: smallest share of the observations that must agree with it.
        """
        is_whole = self.share >= _LEAST_REGISTERED and self.kept >= least_kept
        # If both focal lengths fit about equally well, the first model is kept.
        most = _CLEAR_RATIO if self.from_initial else _MAX_COST_RATIO
        return is_whole and self.new_cost <= most * self.cost

    @property
    def is_clearly_better(self) -> bool:
        """Whether it fits the observations clearly better than the first."""
        return self.new_cost <= _CLEAR_RATIO * self.cost


def remap_stage(
    run: Run, image_set: ImageSet, mapped: Kept[MappedResult], adjusted: Kept[AdjustedResult]
) -> Kept[RemappedResult]:
    """Map the images again from the observations of their adjustment.

    Args:
        run: the run.
        image_set: the images.
        mapped: the models of the first mapping.
        adjusted: the first of these, adjusted.
    """
    name = "remapped"
    from_initial = adjusted.result.has_long_focal_length

    def make(partial: Path) -> RemappedResult:
        known = read_poses(run, adjusted)
        tracks = tracks_of_model(known, image_set)
        with run.clock.measure("poses"):
            start = known
            if from_initial:
                cameras = {i: with_initial_intrinsics(own) for i, own in known.cameras.items()}
                start = replace(known, cameras=cameras)
            found = _map_tracks(run, image_set, start, tracks)
        poses = found if found is not None else known
        files = [f"{name}/0.npz"]
        (partial / name).mkdir()
        write_posed_model(partial / files[0], PosedModel(poses.cameras, poses.images))
        by_name = poses.by_name
        left = [image for image in known.images if image.name not in by_name]
        if left:
            files.append(f"{name}/1.npz")
            write_posed_model(partial / files[1], PosedModel(known.cameras, left))
        kept = cost = new_cost = 0.0
        if found is not None:
            with run.clock.measure("adjustment"):
                kept, cost, new_cost = _costs(run, image_set, known, found, tracks)
        return RemappedResult(
            poses=files[0],
            num_registered=len(poses.images),
            mapper="global",
            other_models=(*files[1:], *mapped.result.other_models),
            share=len(found.images) / len(known.images) if found is not None else 0.0,
            kept=kept,
            cost=cost,
            new_cost=new_cost,
            from_initial=from_initial,
        )

    match, pose_options = run.options.match, run.options.poses
    given = (match.pairs, match.verify, run.context.seed, pose_options.mapper_threads)
    return run_stage(
        run.stages,
        name,
        [mapped.digest, adjusted.digest, given],
        RemappedResult,
        products=[name],
        make=make,
    )


def _map_tracks(
    run: Run, image_set: ImageSet, known: PosedModel, tracks: Tracks
) -> PosedModel | None:
    """Map the images of a model from its tracks with COLMAP's global mapper; None if it fails."""
    options = run.options
    # COLMAP's model files do not hold that focal lengths are known, so pairs are verified with
    # fundamental matrices. With essential matrices, most rendered walks came out slightly more
    # accurate, but the walk `cafe` bent, with each of four seeds: 10 % of its extent instead of
    # 0.9 %.
    cameras = [known.cameras[image.camera_id] for image in known.images]
    frames = posed_images_of(known, image_set).frames
    min_matches = options.match.pairs.min_matches
    paired = pair_by_tracks(tracks, frames, lambda own: covisible_pairs(own, min_matches))
    matched = verify_images(paired, cameras, options.match.verify, run.context)
    names = [image.name for image in known.images]
    map_options = MapOptions(
        mapper="global",
        refine_intrinsics=refines_intrinsics(options),
        seed=run.context.seed,
        num_threads=options.poses.mapper_threads,
    )
    with tempfile.TemporaryDirectory() as folder:
        database = Path(folder) / "database.db"
        write_matches(database, names, cameras, matched)
        keep_longest_tracks(database)
        try:
            found = mapped_models(run, database, map_options, "early", len(names))
        except ModelError:  # the first mapping is there
            return None
    return _with_camera_ids(found[0], known) if found else None


def _with_camera_ids(found: PosedModel, known: PosedModel) -> PosedModel:
    """A model of images of `known`, with the camera ids of `known`."""
    known_by_name = known.by_name
    cameras, images = dict[int, pycolmap.Camera](), []
    for image in found.images:
        number = known_by_name[image.name].camera_id
        cameras[number] = found.cameras[image.camera_id]
        cameras[number].camera_id = number
        images.append(replace(image, camera_id=number))
    return PosedModel(cameras, images)


def _costs(
    run: Run, image_set: ImageSet, known: PosedModel, found: PosedModel, tracks: Tracks
) -> tuple[float, float, float]:
    """Compare two models by the robust cost of the same observations.

    Args:
        run: the run.
        image_set: the images.
        known: the first model, with points.
        found: the second model: poses of all images of `known`, or of some.
        tracks: the observations of `known`, see `tracks_of_model`.

    Returns:
        The share of the observations in images of `found` that agree with it, and their mean robust
        costs with `known` and with `found`, after adjustment.
    """
    registered = posed_images_of(found, image_set)
    in_both = np.isin(tracks.frame, registered.frames)
    triangulated = triangulate_in(run, registered, tracks, FROM_PICTURES)
    points, agreeing = triangulated.model_points(), triangulated.points.observation
    if len(points.xyz) == 0:
        return 0.0, 0.0, 0.0
    adjusted = adjust_posed(run, replace(registered.model, points=points)).model
    known_errors = reprojection_errors(known)[in_both][agreeing]
    return (
        len(agreeing) / len(triangulated.view),
        mean_cost(known_errors),
        mean_cost(reprojection_errors(adjusted)),
    )
