"""Select the longest tracks, from which COLMAP's global mapper starts.

The time of global positioning and bundle adjustment is proportional to the number of observations.
The longest tracks determine the poses nearly as well as all tracks, and another adjustment follows.
The mapper's own selection (`track_required_tracks_per_view`) only counts the tracks of each image:
it may leave out all tracks across a gap, because links are shorter than the tracks on either side.
"""

from __future__ import annotations

import sqlite3
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_av1.database.file import write_existing
from colmap_av1.database.reading import image_ids_from_pair_id, matches_from_row
from colmap_av1.util.arrays import Bools, Ints
from colmap_av1.util.graphs import connected_components

# Number of tracks that each image and each pair keeps.
TRACKS_OF_IMAGE, TRACKS_OF_PAIR = 200, 30


def keep_longest_tracks(database: Path) -> None:
    """Remove the inlier matches of all but the longest tracks from a database.

    Each image keeps 200 tracks and each pair 30, or all if it has fewer. Keypoints, matches and the
    matrices of two-view geometries stay.

    Args:
        database: COLMAP database with verified matches.

    Raises:
        DatabaseError: it cannot be read or written.
    """

    def fill(connection: sqlite3.Connection) -> None:
        query = "SELECT pair_id, rows, data FROM two_view_geometries WHERE rows > 0"
        rows = connection.execute(query).fetchall()
        if not rows:
            return
        query = "SELECT image_id, rows FROM keypoints ORDER BY image_id"
        image_ids, num_keypoints = np.array(connection.execute(query).fetchall(), np.int64).T
        pair_ids = [pair_id for pair_id, _, _ in rows]
        inliers = [matches_from_row(database, *row) for row in rows]
        ends = np.array([image_ids_from_pair_id(pair_id) for pair_id in pair_ids], np.int64)
        kept = _on_longest_tracks(num_keypoints, np.searchsorted(image_ids, ends), inliers)
        connection.executemany(
            "UPDATE two_view_geometries SET rows = ?, data = ? WHERE pair_id = ?",
            [
                (int(keep.sum()), own[keep].tobytes(), pair_id)
                for pair_id, own, keep in zip(pair_ids, inliers, kept, strict=True)
            ],
        )

    write_existing(database, fill)


def _on_longest_tracks(
    num_keypoints: Ints,
    pairs: Ints,
    matches: list[NDArray[np.uint32]],
) -> list[Bools]:
    """Select the matches on the tracks that are kept.

    Args:
        num_keypoints: int64 [num_images].
        pairs: int64 [num_pairs, 2] indices of images.
        matches: uint32 [n, 2] the matched keypoints of each pair.

    Returns:
        bool [n] for each pair.
    """
    counts = [len(own) for own in matches]
    pair = np.repeat(np.arange(len(pairs)), counts)
    first = np.concatenate([[0], np.cumsum(num_keypoints)])
    ends = np.concatenate(matches).astype(np.int64) + first[pairs[pair]]
    component = connected_components(int(first[-1]), ends)[ends[:, 0]]
    track = np.unique(component, return_inverse=True)[1]
    images_of = _members(np.repeat(track, 2), pairs[pair].ravel())
    pairs_of = _members(track, pair)
    in_image = np.zeros(len(num_keypoints), np.int64)
    in_pair = np.zeros(len(pairs), np.int64)
    is_kept = np.zeros(len(images_of), np.bool_)
    for number in sorted(range(len(images_of)), key=lambda k: -len(images_of[k])):
        own_images, own_pairs = images_of[number], pairs_of[number]
        few_in_image = (in_image[own_images] < TRACKS_OF_IMAGE).any()
        is_kept[number] = few_in_image or (in_pair[own_pairs] < TRACKS_OF_PAIR).any()
        if is_kept[number]:
            in_image[own_images] += 1
            in_pair[own_pairs] += 1
    return np.split(is_kept[track], np.cumsum(counts)[:-1])


def _members(track: Ints, member: Ints) -> list[Ints]:
    """The members of each track, without repetitions."""
    num_members = int(member.max()) + 1
    track, member = np.divmod(np.unique(track * num_members + member), num_members)
    return np.split(member, np.flatnonzero(np.diff(track)) + 1)
