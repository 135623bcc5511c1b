"""Split models at seams that hardly any points connect.

If hardly any points connect the two sides of a seam, bundle adjustment leaves their relative pose
undetermined; if no points carry the scale across, it leaves their relative scale undetermined.
Such a model is bent, although each side is correct. The sides become separate models, as with
COLMAP's mapper where it cannot connect images.
"""

from __future__ import annotations

from collections.abc import Sequence
from collections.abc import Set as AbstractSet
from pathlib import Path

import numpy as np  # before pycolmap: the other order breaks writing PNG files later
from numpy.typing import NDArray

from colmap_av1.geometry.posed_model import PosedModel, read_posed_model, write_posed_model
from colmap_av1.images.image_set import ImageSet
from colmap_av1.poses.pose_stages import AdjustedResult, MappedResult
from colmap_av1.poses.posed_images import registered_by_video
from colmap_av1.poses.run import Run
from colmap_av1.poses.seams import REACH
from colmap_av1.util.graphs import connected_components
from colmap_av1.util.stages import Kept, run_stage

# Further models with fewer images are dropped, as by COLMAP's mapper (`min_model_size`). Most of
# them show a turn on the spot, which does not determine their shape.
FEWEST_IMAGES = 10
# Stretches of different videos are connected by at least this many common points, the number of
# inliers that COLMAP's mapper requires of a pair of images.
_BETWEEN_VIDEOS = 15
# Stretches of one video are connected by at least this many common points. Bent models had at most
# half of it at the seam.
_WITHIN_VIDEO = 100


def split_stage(
    run: Run,
    image_set: ImageSet,
    mapped: Kept[MappedResult],
    adjusted: Kept[AdjustedResult],
    seams: Sequence[tuple[str, str]],
    *,
    number: int,
) -> Kept[MappedResult]:
    """Split an adjusted model at its weak seams.

    Args:
        run: the run.
        image_set: all images.
        mapped: the models of the mapper.
        adjusted: the first of these, adjusted.
        seams: names of the images before and after each weak seam. The model is also split at the
            turns that lose the scale, see `AdjustedResult`.
        number: number of the next adjustment.

    Returns:
        The poses of the largest part. The other parts, largest first, precede the mapper's other
        models.
    """
    name = f"parts_{number}"

    def make(partial: Path) -> MappedResult:
        known = read_posed_model(run.stages / adjusted.result.poses)
        parts = parts_of(known, image_set, seams, adjusted.result.turns)
        (partial / name).mkdir()
        files = [f"{name}/{part}.npz" for part in range(len(parts))]
        for file, names in zip(files, parts, strict=True):
            images = [image for image in known.images if image.name in names]
            write_posed_model(partial / file, PosedModel(known.cameras, images))
        return MappedResult(
            poses=files[0],
            num_registered=len(parts[0]),
            registered=registered_by_video(parts[0], image_set),
            mapper=mapped.result.mapper,
            other_models=(*files[1:], *mapped.result.other_models),
        )

    return run_stage(
        run.stages,
        name,
        [
            mapped.digest,
            adjusted.digest,
            list(seams),
            _BETWEEN_VIDEOS,
            _WITHIN_VIDEO,
            FEWEST_IMAGES,
        ],
        MappedResult,
        into=run.stages,
        products=[name],
        make=make,
    )


def parts_of(
    model: PosedModel,
    image_set: ImageSet,
    seams: Sequence[tuple[str, str]],
    turns: Sequence[tuple[str, str]] = (),
) -> list[AbstractSet[str]]:
    """The names of the images of each part of a model, the largest part first.

    The images between two seams of a video form a stretch. Stretches with enough common points
    belong to the same part. Points that are visible throughout a turn do not count: they do not
    carry the scale. Parts of fewer than ten images are dropped, except the largest.

    Args:
        model: the model with its points.
        image_set: all images.
        seams: names of the images before and after each weak seam.
        turns: names of the images before and after each seam where a turn loses the scale.
    """
    names = image_set.images.names
    is_turn = np.isin(names, [first for first, _ in turns])
    is_seam = is_turn | np.isin(names, [first for first, _ in seams])
    sequence = image_set.sequence
    starts = np.append(True, is_seam[:-1] | (np.diff(sequence) != 0))
    stretch = np.cumsum(starts) - 1
    after_turn = stretch[np.flatnonzero(is_turn[:-1]) + 1]
    sequence_of = sequence[starts]
    index = {name: i for i, name in enumerate(names)}
    place = np.array([index[image.name] for image in model.images])
    of_image = stretch[place]
    points = model.points
    point = np.repeat(np.arange(len(points.xyz)), np.diff(points.offsets))
    view = np.argsort(np.argsort(place))[points.image]
    order = np.lexsort((view, point))
    point, view, at = point[order], view[order], of_image[points.image][order]
    common = _common(point, at, len(sequence_of))
    is_visit = (np.diff(point, prepend=-1) != 0) | (np.diff(view, prepend=0) > REACH)
    in_one_visit = _common(np.cumsum(is_visit), at, len(sequence_of))
    for pair in ((after_turn - 1, after_turn), (after_turn, after_turn - 1)):
        common[pair] -= in_one_visit[pair]
    is_same = np.equal.outer(sequence_of, sequence_of)
    edges = np.argwhere(common >= np.where(is_same, _WITHIN_VIDEO, _BETWEEN_VIDEOS))
    component = connected_components(len(sequence_of), edges)[of_image]
    registered = np.array([image.name for image in model.images])
    parts = [set(registered[component == number].tolist()) for number in np.unique(component)]
    parts.sort(key=lambda part: -len(part))
    return [parts[0], *(part for part in parts[1:] if len(part) >= FEWEST_IMAGES)]


def _common(
    point: NDArray[np.int64], stretch: NDArray[np.int64], num_stretches: int
) -> NDArray[np.int64]:
    """The number of points that each two stretches have in common.

    Args:
        point: int64 [n] point of each observation.
        stretch: int64 [n] stretch of its image.
        num_stretches: number of stretches.

    Returns:
        int64 [num_stretches, num_stretches].
    """
    from scipy.sparse import coo_array  # noqa: PLC0415 - slow to import

    seen = np.unique(np.column_stack([point, stretch]), axis=0)
    shape = (int(point.max(initial=-1)) + 1, num_stretches)
    sees = coo_array((np.ones(len(seen), np.int64), (seen[:, 0], seen[:, 1])), shape=shape).tocsr()
    return np.asarray((sees.T @ sees).toarray())
