"""Option values that no stage can work with, refused before the long work."""

from __future__ import annotations

from typing import get_args

import numpy as np

from colmap_av1.errors import OptionError
from colmap_av1.images.camera import make_camera
from colmap_av1.images.choosing import check_image_options
from colmap_av1.matching.pairs import schedule_pairs
from colmap_av1.matching.verify import verify_pairs
from colmap_av1.motion.reading import check_read_options
from colmap_av1.options import MatchOptions, OnExisting
from colmap_av1.tracks.refine import refine_tracks
from colmap_av1.tracks.selection import select_tracks
from colmap_av1.tracks.tracks import Tracks


def check_options(options: MatchOptions, size: tuple[int, int]) -> None:
    """Refuse option values now that a stage would refuse after the long work.

    Args:
        options: options of every stage.
        size: (width, height) of the images.

    Raises:
        OptionError: an option has a value that cannot work.
    """
    check_read_options(options.read)
    check_image_options(options.images)
    kinds = get_args(OnExisting)
    if options.on_existing not in kinds:
        raise OptionError(f"on_existing is {options.on_existing!r}: give {', '.join(kinds)}")
    camera = make_camera(options.camera, *size)
    no_tracks = Tracks(
        *(0, 0, 0, np.zeros(1, np.int64), np.empty(0, np.int32)),
        *(np.empty((0, 2), np.float32), np.empty(0, np.float32), np.empty(0, np.bool_)),
    )
    refine_tracks(no_tracks, (), options.refine)
    select_tracks(no_tracks, options.density)
    schedule_pairs((), options.pairs)
    no_pairs = np.empty((0, 2), dtype=np.int32)
    verify_pairs((), no_pairs, (), camera, options=options.verify)
