"""Match the images of videos along motion vectors, and write a COLMAP database."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from colmap_av1.database.listed import check_no_camera, listed_cameras, listed_of_videos
from colmap_av1.database.reading import DatabaseImage, read_images
from colmap_av1.database.writing import check_writable, write_matches
from colmap_av1.errors import DatabaseError, ModelError, OptionError, VideoError
from colmap_av1.geometry.cameras import check_pixel_aspect, focal_length_warning
from colmap_av1.images.files import alone_in, files_in
from colmap_av1.images.image_set import ImageSet, ShownVideo, pictures_of
from colmap_av1.images.inputs import Inputs, read_inputs
from colmap_av1.images.photos import check_copies, copy_photos
from colmap_av1.images.positions import image_positions
from colmap_av1.images.preparing import PreparedImages, prepare_images, write_all_prepared
from colmap_av1.images.recognising import check_content, frames_near
from colmap_av1.images.track_images import MIN_IMAGES
from colmap_av1.match_report import MatchReport, densify_options, length_quantiles
from colmap_av1.matching.cameras import ImageCameras, new_cameras
from colmap_av1.matching.few_matches import matching_warning
from colmap_av1.matching.mapper_limits import FORWARD_MOTION, SMALL_ANGLES
from colmap_av1.matching.match_images import ImageMatches, SelectedTracks, match_images
from colmap_av1.matching.matched_images import PairedImages
from colmap_av1.matching.shutter.correct import correct_rolling_shutter
from colmap_av1.options import (
    ImageOptions,
    MatchOptions,
    PairOptions,
    ReconstructOptions,
)
from colmap_av1.poses.joint_matches import JointMatches, match_jointly
from colmap_av1.poses.mapper_start import choose_mapper_start
from colmap_av1.poses.run import Run
from colmap_av1.poses.track_stage import VideoTracks, encoding_for_pictures
from colmap_av1.tracks.selection import select_tracks
from colmap_av1.tracks.video_tracks import decodable_frames
from colmap_av1.util.cpus import one_blas_thread
from colmap_av1.util.files import STAGES, check_outside, scratch_folder
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
    given = options

    before = files_in(folder) if folder is not None else set[Path]()
    listed = _read_listed_images(database, options)
    inputs = read_inputs(video, photos, options)
    if folder is not None:
        check_outside(folder, photos)
        check_copies(inputs.photos, folder)
    context = RunContext.of(options.run, progress)
    clock = context.clock
    with unchanged(*inputs.states) as check_videos, ExitStack() as opened:
        scratch = None
        if _is_joint(folder, options):
            scratch = opened.enter_context(scratch_folder(database))
            options = replace(options, encode=encoding_for_pictures(options.encode))
        images = _prepare(
            inputs,
            listed_of_videos(database, listed, inputs),
            folder,
            options,
            next_to=database,
            scratch=scratch,
            context=context,
        )
        cameras = _listed_cameras(database, listed, images) if listed else None
        found = _match_images(images, cameras, scratch, options, context)
        names = images.image_set.images.names
        start = choose_mapper_start(found, names, clock, keep_cameras=cameras is not None)
        written = start.matched
        num_written, blurred = 0, list[str]()
        if folder is not None:
            check_videos()
            with clock.measure("images"), alone_in(folder):
                _check_images_of_other_runs(images, folder, before, options)
                num_written = copy_photos(inputs.photos, folder)
                labelled = zip(inputs.labels, images.videos, strict=True)
                of_videos, blurred = write_all_prepared(labelled, folder, options.reading, progress)
                num_written += of_videos

    with clock.measure("database"):
        positions = image_positions(images.image_set, inputs.videos, inputs.photos)
        write_matches(
            database,
            names,
            None if listed else start.cameras,
            written,
            on_existing=options.on_existing,
            places=positions.places,
        )
    joint = found if isinstance(found, JointMatches) else None
    videos = images.videos
    kinds = Counter(geometry.config.name for geometry in written.geometries)
    num_inliers = written.num_inliers
    notes = inputs.with_names([own.tracked.video.warnings for own in videos])
    notes += (*positions.warnings, *found.warnings, *start.warnings)
    doubts = [found.depth.warning, focal_length_warning(found.cameras)]
    # Few matches do not mean a gap if existing matches of the database may connect the images, or
    # with a joint estimate, which omits matches that only repeat tracks of other pairs.
    if options.on_existing != "append" and joint is None:
        doubts.append(matching_warning(found.matched, images.image_set))
    notes += tuple(doubt for doubt in doubts if doubt is not None)
    return MatchReport(
        database=database,
        videos=tuple(own.path for own in inputs.videos),
        streams=tuple(own.source.stream.path if own.source.is_kept else None for own in videos),
        conversion=inputs.conversion([own.source.conversion for own in videos]),
        photos=Path(photos) if photos is not None else None,
        image_path=folder,
        densify_options=densify_options(given, folder, videos),
        num_frames=images.image_set.num_frames - len(inputs.photos),
        num_coded_frames=sum(own.tracked.video.num_coded_frames for own in videos),
        num_images=len(written.keypoints),
        num_written_images=num_written,
        masked=images.image_set.masked,
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
        warnings=(*inputs.warnings, *notes, *blurred),
    )


def _check_images_of_other_runs(
    images: _Images, folder: Path, before: set[Path], options: MatchOptions
) -> None:
    """Refuse images of another video that another run has written since this one began.

    Args:
        images: the images of this run.
        folder: folder that they will be written to.
        before: files that existed when this run began.
        options: only the options for reading are used.

    Raises:
        ImageError: an image does not show its frame.
    """
    for label, own in zip(images.inputs.labels, images.videos, strict=True):
        for name, frame in zip(
            own.tracked.chosen.names, own.tracked.chosen.frames.tolist(), strict=True
        ):
            path = folder / label / name
            if path not in before and path.exists():
                pictures = decodable_frames(
                    own.source.pictures,
                    own.tracked.tracks.num_frames,
                    options.reading,
                    own.shown.display,
                    use="images are compared with the video",
                    wanted=frames_near([frame]),
                )
                check_content([path], [frame], pictures)
                break


@dataclass(frozen=True)
class _Images:
    """The images of all videos and photos, before they are matched.

    Attributes:
        inputs: the videos and photos.
        videos: the images of each video, and its tracks in pixels of these images.
        image_set: all images, numbered consecutively.
    """

    inputs: Inputs
    videos: Sequence[PreparedImages]
    image_set: ImageSet

    @property
    def shown(self) -> tuple[ShownVideo, ...]:
        """The videos, whose pictures are shown in the size of the images."""
        return tuple(
            ShownVideo.in_images(own.shown, own.source.pictures, own.source.kept)
            for own in self.videos
        )


def _is_joint(folder: Path | None, options: MatchOptions) -> bool:
    """Whether to verify matches against a joint estimate, which has one camera per video."""
    verify, pairs = options.verify.verify, PairOptions(min_matches=options.pairs.min_matches)
    each = options.camera.single_camera is False
    if verify == "joint" and each:
        raise OptionError(
            "verify is 'joint', which estimates one camera for all images of a video: leave out "
            "--single_camera, or give --verify pairs"
        )
    if verify == "joint" and options.pairs != pairs:
        raise OptionError(
            "verify is 'joint', which chooses the pairs itself: leave out --offsets, --growth and "
            "--max_span, or give --verify pairs"
        )
    if verify == "auto":
        return folder is not None and not each and options.pairs == pairs
    return verify == "joint"


def _prepare(
    inputs: Inputs,
    listed: Sequence[Mapping[str, tuple[int, int]]],
    folder: Path | None,
    options: MatchOptions,
    *,
    next_to: Path,
    scratch: Path | None,
    context: RunContext,
) -> _Images:
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
        prepared = _correct_rolling_shutter(prepared, options, context)
        if scratch is not None:
            kept = KeptPictures(scratch / f"{number}.raw")
            prepared = replace(prepared, source=replace(prepared.source, kept=kept))
        else:
            # The tracks of a video are its largest arrays: free those that are not matched.
            prepared = _with_selected_tracks(prepared, options, context)
        videos.append(prepared)
    image_set = inputs.image_set(
        [own.tracked.chosen for own in videos], [own.tracked.tracks.num_frames for own in videos]
    )
    return _Images(inputs, videos, image_set)


def _match_images(
    images: _Images,
    cameras: ImageCameras | None,
    scratch: Path | None,
    options: MatchOptions,
    context: RunContext,
) -> ImageMatches:
    """Match the images with a joint estimate, or pair by pair if it fails or is not wanted.

    Args:
        images: the images.
        cameras: cameras of a database that lists the images; None: new ones are made.
        scratch: folder for the joint estimate; None: match pair by pair.
        options: all options.
        context: state of the run.

    Raises:
        ModelError: the joint estimate fails, and `options.verify` requires it.
        VideoError: no two images are connected.
    """
    if scratch is None:
        return _match_pairs(images, cameras, options, context)
    try:
        if cameras is not None and _has_several_cameras(images.image_set, cameras):
            raise ModelError(
                "the database has several cameras for the images of one video, import them with "
                "--ImageReader.single_camera 1 to avoid this: leave out --verify joint"
            )
        return _match_jointly(images, cameras, scratch, options, context)
    except (ModelError, VideoError) as error:
        # What to do is for `reconstruct`, whose log is kept.
        reason = str(error).rpartition(": ")[0] or str(error)
        if options.verify.verify == "joint":
            if isinstance(error, VideoError):  # Nothing can be matched pair by pair, either.
                raise
            raise ModelError(f"{reason}: leave out --verify joint") from error
    videos = [_with_selected_tracks(own, options, context) for own in images.videos]
    found = _match_pairs(replace(images, videos=videos), cameras, options, context)
    if not found.depth.is_observable:
        return found
    warning = f"matches are verified pair by pair, without a joint estimate: {reason}"
    return replace(found, warnings=(*found.warnings, warning))


def _has_several_cameras(image_set: ImageSet, cameras: ImageCameras) -> bool:
    of_videos = [
        [cameras.of_images[image] for image in image_set.images_of(video)]
        for video in range(len(image_set.videos))
    ]
    return any(camera is not own[0] for own in of_videos for camera in own)


def _match_jointly(
    images: _Images,
    cameras: ImageCameras | None,
    scratch: Path,
    options: MatchOptions,
    context: RunContext,
) -> JointMatches:
    """Match the images by the observations that agree with an estimate of all poses."""
    stages = scratch / STAGES
    stages.mkdir()
    # The images are already chosen, and their names need not suit trainers. Tracks are long enough
    # in all frames, of which only the images may be left.
    chosen = replace(options, images=ImageOptions())
    if any(own.tracked.video.sampled_ends is not None for own in images.videos):
        chosen = replace(chosen, tracks=replace(options.tracks, min_length=MIN_IMAGES))
    run = Run(
        images.inputs,
        tuple(own.source for own in images.videos),
        images.shown,
        scratch,
        stages,
        ReconstructOptions(match=chosen),
        context,
        cameras=cameras,
    )
    return match_jointly(
        run,
        [
            VideoTracks(
                own.tracked.tracks,
                own.tracked.chosen,
                own.tracked.video.inter_share,
                own.tracked.fast,
                own.tracked.video.read_out,
            )
            for own in images.videos
        ],
        images.image_set,
        options.density,
    )


def _match_pairs(
    images: _Images,
    listed: ImageCameras | None,
    options: MatchOptions,
    context: RunContext,
) -> ImageMatches:
    """Match the images along their tracks, and verify the matches pair by pair."""
    image_set, videos = images.image_set, images.videos

    def cameras(paired: PairedImages) -> ImageCameras:
        if listed is not None:
            return listed
        return new_cameras(
            paired, image_set, images.shown, images.inputs.photos, options.camera, context=context
        )

    return match_images(
        image_set,
        [
            SelectedTracks(own.tracked.tracks, own.tracked.video.inter_share, own.tracked.fast)
            for own in videos
        ],
        cameras,
        pictures_of(
            image_set, images.shown, [photo.path for photo in images.inputs.photos], options.reading
        ),
        options=options,
        context=context,
        name=images.inputs.name,
    )


def _correct_rolling_shutter(
    prepared: PreparedImages, options: MatchOptions, context: RunContext
) -> PreparedImages:
    """The images with their tracks corrected for the rolling shutter, if requested."""
    video = correct_rolling_shutter(
        prepared.tracked.video,
        prepared.shown,
        prepared.source.pictures.frame_rate,
        options.camera,
        context,
    )
    return replace(prepared, tracked=replace(prepared.tracked, video=video))


def _with_selected_tracks(
    prepared: PreparedImages, options: MatchOptions, context: RunContext
) -> PreparedImages:
    """The images with only the tracks selected for matching."""
    tracked = prepared.tracked
    with context.clock.measure("pairs"):
        tracks = select_tracks(tracked.tracks.keep_frames(tracked.chosen.frames), options.density)
    return replace(prepared, tracked=tracked.with_tracks(tracks))


def _read_listed_images(database: Path, options: MatchOptions) -> list[DatabaseImage]:
    """Read the images of the database, and check that it can be written."""
    check_writable(database)
    listed = read_images(database)
    filled = next((i for i in listed if i.num_keypoints or i.num_matches), None)
    if filled is not None and options.on_existing == "error":
        raise DatabaseError(
            f"{database}: image '{filled.name}' already has {filled.num_keypoints} keypoints and "
            f"{filled.num_matches} matches: --on_existing append adds to them, replace removes them"
        )
    if listed:
        check_no_camera(database, options.camera)
    return listed


def _listed_cameras(
    database: Path, listed: Sequence[DatabaseImage], images: _Images
) -> ImageCameras:
    """The cameras of a database that lists the images."""
    image_set = images.image_set
    of_images = listed_cameras(database, listed, image_set.images.names)
    notes = images.inputs.with_names(
        [
            check_pixel_aspect(
                of_images[image_set.images_of(video).start],
                shown.pixel_aspect,
                "import the images with one of these",
            )
            for video, shown in enumerate(images.shown)
        ]
    )
    return ImageCameras(of_images, None, tuple(notes))
