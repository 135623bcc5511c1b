"""Choose the pairs of the planned pictures, match their features and verify the matches."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import pycolmap
from numpy.typing import NDArray

from colmap_av1.geometry.masks import Mask
from colmap_av1.images.image_set import ImageSet, Pictures
from colmap_av1.matching.features.retrieval import similar_images
from colmap_av1.matching.features.sift import (
    Features,
    extract_features,
    masked_features,
    match_features,
)
from colmap_av1.matching.links.plan import reach
from colmap_av1.matching.matched_images import MatchedImages
from colmap_av1.matching.pairs import ImageKeypoints
from colmap_av1.matching.two_view_geometry import TwoViewGeometry
from colmap_av1.matching.verify import verify_pairs
from colmap_av1.options import LinkOptions, VerifyOptions
from colmap_av1.util.cpus import one_blas_thread
from colmap_av1.util.memory import usable_memory
from colmap_av1.util.run_context import RunContext
from colmap_av1.util.threads import map_on_threads

# Up to this number of pairs, all are matched, because retrieval would not be faster.
_MAX_EXHAUSTIVE_PAIRS = 200
# An image that is linked to another video is also matched with this many neighbours, which gives
# its features depth.
_NEIGHBOURS = 2
# Bytes that one extraction needs at most, with the pictures that wait for it.
_EXTRACTION_MEMORY = 1 << 29
# Distance between videos in the order that `supported_links` uses; larger than `_SUPPORT_REACH`.
_VIDEO_OFFSET = 100
# Fewest inliers across a gap. A loop closure needs more, because nothing else confirms it.
_MIN_GAP_INLIERS = 20
_MIN_LOOP_INLIERS = 25
# A loop closure is confirmed by another one between neighbours up to this distance.
_SUPPORT_REACH = 2


@dataclass(frozen=True)
class Links:
    """Verified matches of features.

    Attributes:
        pairs: int32 [m, 2] indices of images, first < second, ascending.
        geometries: the two-view geometry of each pair; its inliers are indices of features.
    """

    pairs: NDArray[np.int32]
    geometries: list[TwoViewGeometry]

    def joined(self, other: Links) -> Links:
        """These links together with those of other pairs."""
        pairs = np.concatenate([self.pairs, other.pairs])
        geometries = [*self.geometries, *other.geometries]
        order = np.lexsort((pairs[:, 1], pairs[:, 0])).tolist()
        return Links(pairs[order], [geometries[k] for k in order])


def features_of_images(
    wanted: list[int],
    pictures: Pictures,
    cameras: Sequence[pycolmap.Camera],
    masks: Sequence[Mask | None],
    options: LinkOptions,
    *,
    effort: Literal["light", "full"],
    context: RunContext,
) -> dict[int, Features]:
    """Extract features outside masked pixels; positions are in pixels of the images."""
    found: dict[int, Features] = {}

    def features_of(shown: tuple[int, NDArray[np.uint8]]) -> tuple[int, Features]:
        image, picture = shown
        features = extract_features(picture, options.max_link_features, effort)
        features = masked_features(features, picture, masks[image])
        width, height = int(cameras[image].width), int(cameras[image].height)
        scale = np.array([width / picture.shape[1], height / picture.shape[0]], np.float32)
        return image, replace(features, xy=features.xy * scale)

    num_threads = max(1, min(context.num_threads, usable_memory() // 2 // _EXTRACTION_MEMORY))
    for image, features in map_on_threads(features_of, pictures(wanted), num_threads):
        found[image] = features
        context.progress("links", len(found), len(wanted))
    return found


def loop_pairs(
    image_set: ImageSet,
    matched: MatchedImages,
    loop: list[int],
    features: dict[int, Features],
    options: LinkOptions,
    *,
    seed: int,
) -> set[tuple[int, int]]:
    """Find similar images of one video that tracks do not connect."""
    pairs: set[tuple[int, int]] = set()
    for video in range(len(image_set.videos)):
        images = image_set.images_of(video)
        present = [image for image in loop if image in images and image in features]
        if len(present) < 2:
            continue
        index = np.array(present)
        similar = similar_images(
            [features[i] for i in present],
            np.abs(index[:, None] - index) > reach(matched, images),
            options.link_candidates,
            seed=seed,
        )
        pairs |= {(present[a], present[b]) for a, b in similar.tolist()}
    return pairs


def pairs_between(
    images: Sequence[int],
    features: dict[int, Features],
    image_set: ImageSet,
    options: LinkOptions,
    *,
    seed: int,
) -> set[tuple[int, int]]:
    """Pair images of different videos or photos: all if there are few pairs, else similar ones."""
    present = np.array([image for image in images if image in features], dtype=np.int64)
    if len(present) < 2:
        return set()
    sequence = image_set.sequence[present]
    allowed = sequence[:, None] != sequence
    if np.count_nonzero(allowed) > 2 * _MAX_EXHAUSTIVE_PAIRS:
        pairs = similar_images(
            [features[i] for i in present.tolist()], allowed, options.link_candidates, seed=seed
        ).tolist()
    else:
        pairs = np.argwhere(np.triu(allowed)).tolist()
    return {(int(present[a]), int(present[b])) for a, b in pairs}


def neighbour_pairs(
    links: Links, images: Sequence[int], image_set: ImageSet
) -> set[tuple[int, int]]:
    """Pair neighbouring images of a video that are both linked to other videos.

    These pairs give depth to features that are linked to a single image of another video.
    """
    sequence = image_set.sequence
    between = [pair for pair in links.pairs.tolist() if sequence[pair[0]] != sequence[pair[1]]]
    linked = {image for pair in between for image in pair}
    there = [image for image in images if image in linked]
    return {
        (a, b)
        for index, a in enumerate(there)
        for b in there[index + 1 : index + 1 + _NEIGHBOURS]
        if sequence[a] == sequence[b]
    }


def match_pairs(
    pairs: NDArray[np.int32],
    features: dict[int, Features],
    cameras: Sequence[pycolmap.Camera],
    verify: VerifyOptions,
    context: RunContext,
) -> Links:
    """Match the features of image pairs and verify the matches.

    Pairs with an image that has no entry in `features` are left out.
    """
    nothing = np.empty((0, 2), np.float32)
    xy = [features[i].xy if i in features else nothing for i in range(len(cameras))]
    views = [ImageKeypoints(own, np.arange(len(own), dtype=np.int64)) for own in xy]
    there = [i in features and j in features for i, j in pairs.tolist()]
    pairs = pairs[np.array(there, dtype=np.bool_)]

    def match(pair: list[int]) -> NDArray[np.uint32]:
        return match_features(features[pair[0]], features[pair[1]])

    matches = []
    with one_blas_thread():
        for found in map_on_threads(match, pairs.tolist(), context.num_threads):
            matches.append(found)
            context.progress("link matches", len(matches), len(pairs))
    options = replace(verify, min_num_inliers=max(verify.min_num_inliers, _MIN_GAP_INLIERS))
    geometries = verify_pairs(
        views,
        pairs,
        matches,
        cameras,
        options,
        num_threads=context.num_threads,
        seed=context.seed,
    )
    kept = [k for k, g in enumerate(geometries) if len(g.inlier_matches) > 0]
    return Links(pairs[kept], [geometries[k] for k in kept])


def supported_links(
    links: Links, loops: set[tuple[int, int]], images: Sequence[int], image_set: ImageSet
) -> Links:
    """Drop loop closures that no neighbouring loop closure confirms.

    Args:
        links: the links.
        loops: pairs of images that close a loop or connect videos.
        images: the images of these pairs, ascending; images close together in the list have nearly
            the same view.
        image_set: the images. Photos have no neighbours: their links are confirmed by a third
            image that is linked to both.
    """
    position = {
        image: k + _VIDEO_OFFSET * int(image_set.sequence[image]) for k, image in enumerate(images)
    }
    photos = set(image_set.photos)
    pairs = [(i, j) for i, j in links.pairs.tolist()]
    sure = {
        (i, j)
        for (i, j), g in zip(pairs, links.geometries, strict=True)
        if (i, j) in loops and len(g.inlier_matches) >= _MIN_LOOP_INLIERS
    }
    positions = {(position[i], position[j]) for i, j in sure}
    around = range(-_SUPPORT_REACH, _SUPPORT_REACH + 1)
    linked: dict[int, set[int]] = {}
    for i, j in sure:
        linked.setdefault(i, set()).add(j)
        linked.setdefault(j, set()).add(i)

    def is_supported(i: int, j: int) -> bool:
        a, b = position[i], position[j]
        near = ((a + da, b + db) in positions for da in around for db in around if da or db)
        return any(near) or bool({i, j} & photos and linked[i] & linked[j])

    supported = {pair for pair in sure if is_supported(*pair)}
    kept = [k for k, pair in enumerate(pairs) if pair not in loops or pair in supported]
    return Links(links.pairs[kept], [links.geometries[k] for k in kept])
