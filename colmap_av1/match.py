"""Match the images of videos along motion vectors, and write a COLMAP database."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np

from colmap_av1.database.listed import (
    listed_image_cameras,
    listed_of_videos,
    read_listed_images,
)
from colmap_av1.database.writing import write_matches
from colmap_av1.geometry.cameras import focal_length_warning
from colmap_av1.images.files import alone_in, files_in
from colmap_av1.images.inputs import Inputs, read_inputs
from colmap_av1.images.photos import check_copies
from colmap_av1.images.positions import image_positions
from colmap_av1.images.preparing import (
    PreparedImages,
    PreparedInputs,
    prepare_images,
    write_all_prepared,
)
from colmap_av1.match_report import MatchReport, densify_options, length_quantiles
from colmap_av1.matching.few_matches import matching_warning
from colmap_av1.matching.mapper_limits import FORWARD_MOTION, SMALL_ANGLES
from colmap_av1.matching.shutter.correct import correct_rolling_shutter
from colmap_av1.options import CameraOptions, MatchOptions
from colmap_av1.poses.joint_matches import JointMatches
from colmap_av1.poses.mapper_start import choose_mapper_start
from colmap_av1.poses.match_prepared import match_prepared, wants_joint_estimate
from colmap_av1.util.cpus import one_blas_thread
from colmap_av1.util.files import check_outside, scratch_folder
from colmap_av1.util.progress import Progress, no_progress
from colmap_av1.util.run_context import RunContext
from colmap_av1.video.kept_pictures import KeptPictures
from colmap_av1.video.unchanged import unchanged


@one_blas_thread()
def match(
    database: str | os.PathLike[str],
    video: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    *,
    photos: str | os.PathLike[str] | None = None,
    image_path: str | os.PathLike[str] | None = None,
    options: MatchOptions = MatchOptions(),
    progress: Progress = no_progress,
) -> MatchReport:
    """Fill a COLMAP database with keypoints and verified matches from the motion of videos.

    If the database lists images, keypoints and matches are added to these, see
    `frames_of_images`; a new or empty database gets new images. The database is written last, in
    one transaction: an error or interrupt leaves it unchanged.

    With several videos, the images of each are in a folder named after it and have their own
    camera. SIFT links connect the videos and the photos.

    Args:
        database: the database file; created if it is missing.
        video: a video or several. A video that is not AV1 is converted first, to a temporary file
            next to the database or to a file that is kept (`options.keep_stream`).
        photos: folder of photos that become images, too, named by the folder and their path in it;
            None: no photos.
        image_path: folder to write the images to, for the mapper's colours and for training.
            Existing images of the right size are kept, and photos are copied to it. None: no
            images are written.
        options: options of every stage.
        progress: called with a stage's name, the amount of work done, and the total if known.

    Raises:
        VideoError: a video cannot be read, is given twice, changes during the run, or has no motion
            to match.
        BitstreamError: a stream is damaged, and `strict` is set or the damage is before the
            second frame.
        LimitError: a frame is larger than `options.read.max_frame_size`.
        EncodeError: no AV1 encoder works, or it fails.
        ImageError: images or names do not match the video, or a photo cannot be read.
        DatabaseError: the database is locked, is not a COLMAP database, does not match the video,
            or has features of its images, which `options.on_existing` does not allow.
        WriteError: an image or a converted stream cannot be written.
        OptionError: an option conflicts with the videos, their images or another option.

    Examples:
        >>> from colmap_av1 import ImageOptions, MatchOptions, match
        >>> options = MatchOptions(images=ImageOptions(every=6))
        >>> report = match("my.db", "video.mp4", image_path="my_frames", options=options)
        >>> report.num_frames, report.num_images
        (60, 10)
        >>> print(report.next_commands[1])
        colmap-av1 map --database my.db --image_path my_frames --output my_model
    """
    database = Path(database)
    folder = Path(image_path) if image_path is not None else None
    before = files_in(folder) if folder is not None else set[Path]()
    listed = read_listed_images(database, options.on_existing, options.camera)
    inputs = read_inputs(video, photos, options)
    if folder is not None:
        check_outside(folder, photos)
        check_copies(inputs.photos, folder)
    context = RunContext.of(options.run, progress)
    clock = context.clock
    num_written = 0
    blurred = list[str]()
    with unchanged(*inputs.states) as check_videos, ExitStack() as opened:
        scratch = None
        if wants_joint_estimate(options, writes_images=folder is not None):
            scratch = opened.enter_context(scratch_folder(database))
        prepared = _prepare(
            inputs,
            listed_of_videos(database, listed, inputs),
            folder,
            options,
            next_to=database,
            scratch=scratch,
            context=context,
        )
        image_set, videos = prepared.image_set, prepared.videos
        cameras = listed_image_cameras(database, listed, prepared) if listed else None
        found = match_prepared(prepared, cameras, scratch, options, context)
        names = image_set.images.names
        start = choose_mapper_start(found, names, clock, keep_cameras=cameras is not None)
        written = start.matched
        if folder is not None:
            check_videos()
            with clock.measure("images"), alone_in(folder):
                num_written, blurred = write_all_prepared(
                    prepared, folder, options.reading, context, before=before
                )
    with clock.measure("database"):
        positions = image_positions(image_set, inputs.videos, inputs.photos)
        write_matches(
            database,
            names,
            start.cameras if cameras is None else None,
            written,
            on_existing=options.on_existing,
            places=positions.places,
        )
    joint = found if isinstance(found, JointMatches) else None
    kinds = Counter(geometry.config.name for geometry in written.geometries)
    num_inliers = written.num_inliers
    doubts = [found.depth.warning, focal_length_warning(found.cameras)]
    # Few matches do not mean a gap if existing matches of the database may connect the images, or
    # with a joint estimate, which omits matches that only repeat tracks of other pairs.
    if options.on_existing != "append" and joint is None:
        doubts.append(matching_warning(found.matched, image_set))
    return MatchReport(
        database=database,
        videos=tuple(own.path for own in inputs.videos),
        streams=tuple(own.source.stream.path if own.source.is_kept else None for own in videos),
        conversion=inputs.conversion([own.source.conversion for own in videos]),
        photos=Path(photos) if photos is not None else None,
        image_path=folder,
        densify_options=densify_options(options, folder, videos),
        num_frames=image_set.num_frames - len(inputs.photos),
        num_coded_frames=sum(own.tracked.video.num_coded_frames for own in videos),
        num_images=len(written.keypoints),
        num_written_images=num_written,
        masked=image_set.masked,
        num_tracks=len(found.track_lengths),
        track_lengths=length_quantiles(found.track_lengths),
        num_observations=sum(len(keypoints.xy) for keypoints in written.keypoints),
        focal_length=found.focal_length,
        read_outs=tuple(own.tracked.video.read_out for own in videos),
        num_pairs=len(written.geometries),
        num_verified_pairs=int(np.count_nonzero(num_inliers)),
        num_matches=sum(len(matches) for matches in written.matches),
        num_inliers=int(num_inliers.sum()),
        configs=dict(sorted(kinds.items())),
        forward_motion=start.limits == FORWARD_MOTION,
        small_angles=start.limits == SMALL_ANGLES,
        fixed_intrinsics=start.fixed_intrinsics,
        links=found.links,
        estimate=joint.estimate if joint is not None else None,
        seconds=clock.seconds,
        warnings=(
            *inputs.warnings,
            *inputs.with_names([own.tracked.video.warnings for own in videos]),
            *positions.warnings,
            *found.warnings,
            *start.warnings,
            *(doubt for doubt in doubts if doubt is not None),
            *blurred,
        ),
    )


def _prepare(
    inputs: Inputs,
    listed: Sequence[Mapping[str, tuple[int, int]]],
    folder: Path | None,
    options: MatchOptions,
    *,
    next_to: Path,
    scratch: Path | None,
    context: RunContext,
) -> PreparedInputs:
    """Find or choose the images of each video, and number them consecutively.

    Args:
        inputs: the videos and photos.
        listed: for each video, (width, height) by name of the images that the database lists.
        folder: folder to write the images to; None: no images are written.
        options: all options.
        next_to: the database.
        scratch: folder that keeps decoded pictures for a joint estimate; None: no joint estimate
            follows, and only the tracks selected for matching are kept.
        context: state of the run.
    """
    if scratch is not None:
        options = replace(options, encode=options.encode.quick_by_default)
    videos = []
    for number, (video, label, masks, existing) in enumerate(
        zip(inputs.videos, inputs.labels, inputs.masks_of_videos, listed, strict=True)
    ):
        prepared = prepare_images(
            video,
            folder / label if folder is not None else None,
            options,
            listed=existing,
            masks=masks,
            next_to=next_to,
            context=context,
        )
        prepared = _correct_rolling_shutter(prepared, options.camera, context)
        if scratch is not None:
            kept = KeptPictures(scratch / f"{number}.raw")
            prepared = replace(prepared, source=replace(prepared.source, kept=kept))
        else:
            # The tracks of a video are its largest arrays: free those that are not matched.
            prepared = prepared.with_selected_tracks(options.density, context.clock)
        videos.append(prepared)
    image_set = inputs.image_set(
        [own.tracked.chosen for own in videos], [own.tracked.tracks.num_frames for own in videos]
    )
    return PreparedInputs(inputs, videos, image_set)


def _correct_rolling_shutter(
    prepared: PreparedImages, camera: CameraOptions, context: RunContext
) -> PreparedImages:
    """The images with their tracks corrected for the rolling shutter, if requested."""
    video = correct_rolling_shutter(
        prepared.tracked.video,
        prepared.shown,
        prepared.source.pictures.frame_rate,
        camera,
        context,
    )
    return replace(prepared, tracked=replace(prepared.tracked, video=video))
