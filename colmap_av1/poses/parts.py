"""Split models at seams that hardly any points connect, and remove images with uncertain poses.

If hardly any points connect the two sides of a seam, bundle adjustment leaves their relative pose
undetermined; if no points carry the scale across, it leaves their relative scale undetermined.
Such a model is bent, although each side is correct. The sides become separate models, as with
COLMAP's mapper where it cannot connect images. They stay together if both see the same places with
parallax, which determines their relative scale.

With wrong poses, points may seem to have parallax: while a camera turns, a motion to the side looks
much like a rotation. If the images were mapped twice, and the second result fits the observations
hardly better than the first, the places must have parallax in both. The places may also look alike
only: see `false_links`.

Models that may bend, and all models but the first, also lose images at the ends of their videos,
until the positions of the others are certain.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from collections.abc import Set as AbstractSet
from pathlib import Path
from typing import Any

import numpy as np  # before pycolmap: the other order breaks writing PNG files later

from colmap_av1.geometry.colmap_model import camera_centres
from colmap_av1.geometry.posed_model import PosedModel, write_posed_model
from colmap_av1.geometry.uncertainty import MAX_CERTAIN_ERROR, MAX_IMAGES, centre_uncertainty
from colmap_av1.images.image_set import ImageSet
from colmap_av1.poses.adjustment_stage import AdjustedResult
from colmap_av1.poses.false_links import contradicted_seams, jumping_seams, misplaced_seams
from colmap_av1.poses.mapping_stage import MappedResult
from colmap_av1.poses.posed_images import read_poses
from colmap_av1.poses.run import Run
from colmap_av1.poses.seams import least_depth_angle, ray_angle
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.arrays import Bools, Ints
from colmap_av1.util.graphs import connected_components
from colmap_av1.util.stages import Kept, run_stage

# Further models with fewer images are dropped, as by COLMAP's mapper (`min_model_size`). Most of
# them show a turn on the spot, which does not determine their shape.
MIN_MODEL_SIZE = 10
# Stretches of different videos are connected by at least this many common points, the number of
# inliers that COLMAP's mapper requires of a pair of images.
_BETWEEN_VIDEOS = 15
# Stretches of one video are connected by at least this many common points that have depth in each
# stretch without the views of the other. On 13 rendered walks, the scales of straight stretches
# with 20 or more such points differed by 5 % at most. Those of stretches with no such point
# differed by up to a factor of 2.7, although they had 100 to 340 points in common.
_WITHIN_VIDEO = 20
# One in this many images, at least one, is removed at a time until a model is certain.
_REMOVED = 20


def split_stage(
    run: Run,
    image_set: ImageSet,
    mapped: Kept[MappedResult],
    adjusted: Kept[AdjustedResult],
    seams: Sequence[tuple[str, str]],
    *,
    leaps: Sequence[tuple[str, str]],
    tracks: Tracks,
    whole: Tracks,
    rival: Kept[AdjustedResult] | None,
    number: int,
) -> Kept[MappedResult]:
    """Split an adjusted model at its seams, see `parts_of`.

    It is also split where false links bend it, see `false_links`.

    Args:
        run: the run.
        image_set: all images.
        mapped: the models of the mapper.
        adjusted: the first of these, adjusted.
        seams: names of the images before and after each seam where it may be split.
        leaps: the same for seams where it is split only if points contradict the poses.
        tracks: the tracks of all videos.
        whole: these tracks before earlier splits, which cut them at all seams.
        rival: see `Estimate`.
        number: number of the next adjustment.

    Returns:
        The poses of the largest part. The other parts, largest first, precede the mapper's other
        models.
    """

    def parts(known: PosedModel) -> list[AbstractSet[str]]:
        other = read_poses(run, rival) if rival is not None else None
        num_threads = run.context.num_threads
        misplaced = misplaced_seams(known, image_set, tracks, leaps, num_threads=num_threads)
        false = [*contradicted_seams(known, image_set, tracks, seams), *misplaced]
        every = sorted({*seams, *misplaced})
        if not every:
            return [set(known.by_name)]
        found = parts_of(known, image_set, every, false=false, rival=other)
        if len(found[0]) < len(known.images):
            return found
        # Only if nothing else splits the model: a split and another adjustment may remove the
        # misplaced images that make the camera seem fast.
        jumping = jumping_seams(known, image_set, whole, adjusted.result.few_point_seams)
        if not jumping:
            return found
        return parts_of(known, image_set, every, false=[*false, *jumping], rival=other)

    key = [list(seams), list(leaps), rival.digest if rival is not None else None]
    return _parts_stage(run, mapped, adjusted, parts, name=f"parts_{number}", key=key)


def certain_stage(
    run: Run,
    image_set: ImageSet,
    mapped: Kept[MappedResult],
    adjusted: Kept[AdjustedResult],
    *,
    number: int,
) -> Kept[MappedResult]:
    """Keep the images of an adjusted model whose positions are certain, see `certain_parts`.

    Arguments and result are as for `split_stage`. The first part is empty if too few are certain.
    """

    def parts(known: PosedModel) -> list[AbstractSet[str]]:
        return certain_parts(known, image_set)

    return _parts_stage(run, mapped, adjusted, parts, name=f"certain_{number}")


def _parts_stage(
    run: Run,
    mapped: Kept[MappedResult],
    adjusted: Kept[AdjustedResult],
    parts_of_model: Callable[[PosedModel], list[AbstractSet[str]]],
    *,
    name: str,
    key: Sequence[Any] = (),
) -> Kept[MappedResult]:
    """Write the parts of an adjusted model, which replace it among the mapper's models.

    Args:
        run: the run.
        mapped: the mapper's models.
        adjusted: the adjusted model.
        parts_of_model: returns the names of the images of each part.
        name: name of the stage.
        key: what the parts depend on in addition to the model.
    """

    def make(partial: Path) -> MappedResult:
        known = read_poses(run, adjusted)
        with run.clock.measure("adjustment"):
            parts = parts_of_model(known)
        (partial / name).mkdir()
        files = [f"{name}/{part}.npz" for part in range(len(parts))]
        for file, names in zip(files, parts, strict=True):
            images = [image for image in known.images if image.name in names]
            write_posed_model(partial / file, PosedModel(known.cameras, images))
        return MappedResult(
            poses=files[0],
            num_registered=len(parts[0]),
            mapper=mapped.result.mapper,
            other_models=(*files[1:], *mapped.result.other_models),
        )

    return run_stage(
        run.stages,
        name,
        [mapped.digest, adjusted.digest, *key],
        MappedResult,
        products=[name],
        make=make,
    )


def certain_parts(model: PosedModel, image_set: ImageSet) -> list[AbstractSet[str]]:
    """The names of the images of a model whose positions are certain.

    Images at either end of a video are removed, the most uncertain first, until the expected error
    of the camera centres is small. Models of many images, which take long, are not examined.

    Args:
        model: the model with its points.
        image_set: all images.

    Returns:
        First the certain images, none if they are fewer than ten. Then stretches of ten images or
        more that were removed, which may be certain without the others.
    """
    is_posed = np.isin(image_set.images.names, [image.name for image in model.images])
    names, videos = np.array(image_set.images.names)[is_posed], image_set.sequence[is_posed]
    kept = np.ones(len(names), np.bool_)
    while MIN_MODEL_SIZE <= np.count_nonzero(kept) <= MAX_IMAGES:
        part = _with_images(model, set(names[kept].tolist()))
        error_of = dict(zip(part.by_name, centre_uncertainty(part).tolist(), strict=True))
        errors = np.array([error_of.get(name, 0.0) for name in names.tolist()])
        if np.sqrt(np.mean(errors[kept] ** 2)) <= MAX_CERTAIN_ERROR:
            break
        for _ in range(max(1, np.count_nonzero(kept) // _REMOVED)):
            left = np.flatnonzero(kept)
            is_end = np.diff(videos[left], prepend=-1, append=-1) != 0
            ends = left[is_end[:-1] | is_end[1:]]
            kept[ends[errors[ends].argmax()]] = False
    certain = set(names[kept].tolist()) if np.count_nonzero(kept) >= MIN_MODEL_SIZE else set[str]()
    stretch = np.cumsum((np.diff(kept, prepend=True) != 0) | (np.diff(videos, prepend=-1) != 0))
    removed = [set(names[~kept & (stretch == k)].tolist()) for k in np.unique(stretch[~kept])]
    return [certain, *(own for own in removed if len(own) >= MIN_MODEL_SIZE)]


def _with_images(model: PosedModel, names: AbstractSet[str]) -> PosedModel:
    """The model of some of its images, with the points that two or more of them observe."""
    return model.some(np.array([image.name in names for image in model.images]))[0]


def parts_of(
    model: PosedModel,
    image_set: ImageSet,
    seams: Sequence[tuple[str, str]],
    *,
    false: Sequence[tuple[str, str]] = (),
    rival: PosedModel | None = None,
) -> list[AbstractSet[str]]:
    """The names of the images of each part of a model, the largest part first.

    The images between two seams of a video form a stretch. Stretches belong to the same part if
    they have enough common points that have depth in each without the views of the other: these
    determine their relative scale. No points join the stretches on either side of a seam
    that false links bend, because it is not known which points are false. Parts of fewer than ten
    images are dropped, except the largest.

    Args:
        model: the model with its points.
        image_set: all images.
        seams: names of the images before and after each seam.
        false: those of the seams that false links bend, see `false_links`.
        rival: other poses of its images, and maybe of others, with points, that fit the
            observations about as well.
    """
    names = image_set.images.names
    sequence = image_set.sequence
    is_seam = np.isin(names, [first for first, _ in seams])
    starts = np.append(True, is_seam[:-1] | (np.diff(sequence) != 0))
    sequence_of = sequence[starts]
    stretch_of = dict(zip(names, (np.cumsum(starts) - 1).tolist(), strict=True))
    common, scaled = _common_points(model, stretch_of, len(sequence_of))
    if rival is not None:
        same = _with_images(rival, model.by_name.keys())
        scaled = np.minimum(scaled, _common_points(same, stretch_of, len(sequence_of))[1])
    is_same = np.equal.outer(sequence_of, sequence_of)
    for first, _ in false:
        before = stretch_of[first] + 1
        scaled[:before, before:] = scaled[before:, :before] = 0
    is_connected = np.where(is_same, scaled >= _WITHIN_VIDEO, common >= _BETWEEN_VIDEOS)
    registered = np.array([image.name for image in model.images])
    of_image = np.array([stretch_of[name] for name in registered.tolist()])
    component = connected_components(len(sequence_of), np.argwhere(is_connected))[of_image]
    parts = [set(registered[component == number].tolist()) for number in np.unique(component)]
    parts.sort(key=lambda part: -len(part))
    return [parts[0], *(part for part in parts[1:] if len(part) >= MIN_MODEL_SIZE)]


def _common_points(
    model: PosedModel, stretch_of: Mapping[str, int], num_stretches: int
) -> tuple[Ints, Ints]:
    """The number of points that every two stretches have in common.

    Args:
        model: the model with its points.
        stretch_of: stretch of each image, by name.
        num_stretches: number of stretches.

    Returns:
        int64 [num_stretches, num_stretches] all of these points, and those that have depth in each
        stretch.
    """
    from scipy.sparse import coo_array  # noqa: PLC0415 - slow to import

    of_image = np.array([stretch_of[image.name] for image in model.images])
    point, stretch, has_depth = _seen_in_stretches(model, of_image)
    shape = (len(model.points.xyz), num_stretches)

    def common(some: Bools) -> Ints:
        seen = (point[some], stretch[some])
        sees = coo_array((np.ones(len(seen[0]), np.int64), seen), shape=shape).tocsr()
        return np.asarray((sees.T @ sees).toarray())

    return common(np.ones_like(has_depth)), common(has_depth)


def _seen_in_stretches(model: PosedModel, of_image: Ints) -> tuple[Ints, Ints, Bools]:
    """The points that each stretch sees.

    Args:
        model: the model with its points.
        of_image: int64 [num_images] stretch of each image.

    Returns:
        Index of the point and of the stretch, each int64 [n], and whether the views of the stretch
        alone give the point depth, bool [n].
    """
    points = model.points
    point = points.point
    num_stretches = int(of_image.max()) + 1
    pair, first, visit = np.unique(
        point * num_stretches + of_image[points.image], return_index=True, return_inverse=True
    )
    centres = camera_centres(np.array([image.cam_from_world for image in model.images]))
    least = least_depth_angle(model.cameras[i.camera_id] for i in model.images)
    start = points.image[first][visit]
    angle = ray_angle(centres[points.image], centres[start], points.xyz[point])
    has_depth = np.zeros(len(pair), np.bool_)
    has_depth[visit[angle >= least]] = True
    return pair // num_stretches, pair % num_stretches, has_depth
