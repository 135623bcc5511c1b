"""The report of `match`, and the commands that continue from its database."""

from __future__ import annotations

import shlex
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from colmap_av1.images.preparing import PreparedImages
from colmap_av1.matching.links.report import LinkReport
from colmap_av1.matching.mapper_limits import FORWARD_MOTION, SMALL_ANGLES
from colmap_av1.options import DensifyOptions, ImageOptions, MapOptions, MatchOptions
from colmap_av1.options.fields import Options
from colmap_av1.options.words import words_of
from colmap_av1.poses.joint_matches import JointEstimate
from colmap_av1.util.arrays import Ints

_LENGTH_QUANTILES = (0.0, 0.25, 0.5, 0.75, 0.9, 1.0)


@dataclass(frozen=True)
class MatchReport:
    """What `match` read and wrote.

    Attributes:
        database: the database file.
        videos: the video files.
        streams: for each video, the AV1 file whose motion was read: the video or its conversion;
            None if the conversion was not kept.
        conversion: description of how videos were converted; None if all are AV1.
        photos: folder of the photos; None if none was given.
        image_path: folder of the images; None if none was given.
        densify_options: options with which `densify` reads the same videos, masks and images.
        num_frames: shown frames of the videos.
        num_coded_frames: coded frames, including hidden ones.
        num_images: images of the database.
        num_written_images: image files written; the others existed or were not requested.
        masked: share of the images' pixels that masks exclude; None without masks.
        num_tracks: tracks whose observations are keypoints: of motion, and with a joint estimate
            also of corners and SIFT links.
        track_lengths: quantiles of the number of images that observe a track, from 0 (shortest)
            to 1 (longest); empty without tracks.
        num_observations: keypoints of all images.
        focal_length: focal length of the first video in pixel heights, if it was estimated; None if
            it was given, or if it is not observable and the camera has an assumed one. Without a
            joint estimate, also None if it is from the container.
        read_outs: rolling-shutter read-out time of each video in milliseconds, from the first row
            to the last; None if the keypoints were not corrected for it.
        num_pairs: image pairs written.
        num_verified_pairs: pairs with a two-view geometry.
        num_matches: matches of all pairs.
        num_inliers: inlier matches of all pairs.
        configs: number of pairs by COLMAP's name of their two-view configuration.
        forward_motion: the camera moves along its optical axis, as in a driving car: the mapper
            finds no good initial pair unless its options allow this, and the focal length is hardly
            observable.
        small_angles: the joint estimate shows that the mapper needs a lower limit of the
            triangulation angle to begin with a pair from which a large model grows.
        fixed_intrinsics: the mapper should not refine focal length and distortion, because they
            are known and would diverge with its first images, as where the camera moves along its
            axis (those of an existing database only in this case), or because the images do not
            determine them, and no large model grows in a trial if they are refined.
        links: SIFT links between images that motion does not connect.
        estimate: summary of the joint estimate of all poses that matches were verified against;
            None if they were verified pair by pair.
        seconds: wall time of each stage.
        warnings: what the user should know, such as a damaged stream.
    """

    database: Path
    videos: tuple[Path, ...]
    streams: tuple[Path | None, ...]
    conversion: str | None
    photos: Path | None
    image_path: Path | None
    densify_options: DensifyOptions
    num_frames: int
    num_coded_frames: int
    num_images: int
    num_written_images: int
    masked: float | None
    num_tracks: int
    track_lengths: dict[float, int]
    num_observations: int
    focal_length: float | None
    read_outs: tuple[float | None, ...]
    num_pairs: int
    num_verified_pairs: int
    num_matches: int
    num_inliers: int
    configs: dict[str, int]
    forward_motion: bool
    small_angles: bool
    fixed_intrinsics: bool
    links: LinkReport
    estimate: JointEstimate | None
    seconds: dict[str, float]
    warnings: tuple[str, ...]

    @property
    def map_options(self) -> MapOptions:
        """Options for `map_database` with which the incremental mapper starts well."""
        angle = SMALL_ANGLES.init_min_tri_angle if self.small_angles else None
        return MapOptions(
            forward_motion=self.forward_motion or None,
            init_min_tri_angle=angle,
            refine_intrinsics=not self.fixed_intrinsics,
        )

    @property
    def next_commands(self) -> tuple[str, str, str]:
        """Shell commands: map the database with COLMAP, or with this package; then densify.

        The last command makes the point cloud for training Gaussian splats.
        """
        database = _path_word(self.database)
        output = _path_word(self.database.with_name(f"{self.database.stem}_model"))
        images = _path_word(self.image_path) if self.image_path is not None else "IMAGES"
        # fmt: off
        mapper = [
            "colmap", "mapper",
            "--database_path", database,
            "--image_path", images,
            "--output_path", output,
        ]
        if self.forward_motion:
            mapper += FORWARD_MOTION.words
        elif self.small_angles:
            mapper += SMALL_ANGLES.words
        if self.fixed_intrinsics:
            mapper += [
                "--Mapper.ba_refine_focal_length", "0",
                "--Mapper.ba_refine_extra_params", "0",
            ]
        ours = [
            "colmap-av1", "map",
            "--database", database,
            "--image_path", images,
            "--output", output,
            *_words_of(self.map_options),
        ]
        densify = [
            "colmap-av1", "densify",
            "--model", f"{output}/0",
            *(word for video in self.videos for word in ("--video", _path_word(video))),
            *(("--photos", _path_word(self.photos)) if self.photos is not None else ()),
            *(("--image_path", images) if self.image_path is not None else ()),
            *_words_of(self.densify_options),
            "--output", _path_word(self.database.with_name(f"{self.database.stem}_splats")),
        ]
        # fmt: on
        with_colmap = f"mkdir -p {shlex.quote(output)} && {shlex.join(mapper)}"
        return with_colmap, shlex.join(ours), shlex.join(densify)


def length_quantiles(lengths: Ints) -> dict[float, int]:
    """Quantiles of the lengths of tracks; empty without tracks."""
    if len(lengths) == 0:
        return {}
    found = np.quantile(lengths, _LENGTH_QUANTILES, method="lower")
    return dict(zip(_LENGTH_QUANTILES, map(int, found), strict=True))


def densify_options(
    given: MatchOptions, folder: Path | None, videos: Sequence[PreparedImages]
) -> DensifyOptions:
    """Options of `densify` on the same videos.

    Args:
        given: the options of this run.
        folder: the folder of the images.
        videos: the images of each video.
    """
    images = given.images
    first, every = images.first_number, images.every
    if not any(own.existed for own in videos):
        # The names of new images show their frames, see `ImageOptions.image_name`.
        first = 0 if folder is None and images.frame_list is None else None
        every = None
    return DensifyOptions(
        match=MatchOptions(
            images=ImageOptions(every=every, frame_list=images.frame_list, first_number=first),
            masks=given.masks,
            encode=given.encode,
            read=given.read,
            keep_stream=given.keep_stream if videos[0].source.conversion is not None else None,
            reencode=given.reencode,
        )
    )


def _words_of(options: Options) -> list[str]:
    """The options as words, each value after the name of its option."""
    return [part for word in words_of(options) for part in word.split("=", 1)]


def _path_word(path: Path) -> str:
    """The path as a shell word that programs take neither for an option nor for a URI."""
    return f"./{path}" if str(path).startswith(("-", "file:")) else str(path)
