"""From a video to the rows of a COLMAP database."""

from __future__ import annotations

import os
import shlex
from collections import Counter
from collections.abc import Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from colmap_av1.database.listed import check_no_camera, listed_cameras, listed_of_videos
from colmap_av1.database.reading import DatabaseImage, read_images
from colmap_av1.database.writing import write_matched_images, write_matches
from colmap_av1.errors import DatabaseError, ModelError, OptionError, VideoError
from colmap_av1.geometry.cameras import check_pixel_aspect, focal_length_warning
from colmap_av1.images.files import alone_in, files_in
from colmap_av1.images.image_set import ImageSet, ShownVideo, pictures_of
from colmap_av1.images.inputs import Inputs, read_inputs
from colmap_av1.images.photos import check_places, place_photos
from colmap_av1.images.positions import image_positions
from colmap_av1.images.preparing import PreparedImages, prepare_images, write_all_prepared
from colmap_av1.images.recognising import check_content
from colmap_av1.matching.cameras import ImageCameras, new_cameras, shape_of
from colmap_av1.matching.gaps import fast_frames, matching_warnings
from colmap_av1.matching.image_matches import PairedImages
from colmap_av1.matching.initial_pairs import demote_bad_initial_pairs
from colmap_av1.matching.links import LinkReport
from colmap_av1.matching.match_images import (
    ImageMatches,
    ImageMatchOptions,
    SelectedTracks,
    match_images,
)
from colmap_av1.matching.shutter.correct import without_shutter
from colmap_av1.options import ImageOptions, MatchOptions, PairOptions, ReconstructOptions
from colmap_av1.poses.joint_matches import JointEstimate, JointMatches, match_jointly
from colmap_av1.poses.run import Run
from colmap_av1.poses.track_stage import VideoTracks, encoding_for_pictures
from colmap_av1.tracks.selection import select_tracks
from colmap_av1.tracks.tracks import least_length
from colmap_av1.tracks.video_tracks import decodable_frames
from colmap_av1.util.cpus import one_blas_thread
from colmap_av1.util.files import scratch_folder
from colmap_av1.util.progress import Clock, Progress, no_progress
from colmap_av1.util.run_context import RunContext
from colmap_av1.video.kept_pictures import KeptPictures
from colmap_av1.video.unchanged import unchanged

_NO_PAIRS = np.empty((0, 2), dtype=np.int32)
_LENGTH_QUANTILES = (0.0, 0.25, 0.5, 0.75, 0.9, 1.0)


@dataclass(frozen=True)
class MatchReport:
    """What `match` read and wrote.

    Attributes:
        database: the database file.
        videos: the video files.
        streams: for each, the AV1 file whose motion was read: the video, or what it was converted
            to; None where that was not kept.
        conversion: how the streams were made of the videos, in words; None where they are these.
        photos: folder of the photos; None where none was given.
        image_path: folder of the images; None where none was given.
        num_frames: shown frames of the videos.
        num_coded_frames: frames with block data, hidden ones included.
        num_images: images of the database.
        num_written_images: image files written; others were there or not asked for.
        masked: share of the images' pixels that masks leave out; None without masks.
        num_tracks: tracks of the videos that images are matched along.
        track_lengths: quantiles of the number of images that see a track, from 0 (shortest)
            to 1 (longest); empty without a track.
        num_observations: keypoints of all images.
        focal_length: of the first video, in heights of a pixel, where it was estimated from the
            tracks; None where it was given, or the motion does not determine it and the camera has
            COLMAP's first guess.
        read_outs: of each video, the time in milliseconds in which the shutter reads the rows of a
            picture, where keypoints were corrected for it; None: they were not.
        num_pairs: image pairs written.
        num_verified_pairs: those with a two-view geometry.
        num_matches: matches of all pairs.
        num_inliers: inlier matches of all pairs.
        configs: number of pairs by COLMAP's name of their two-view configuration.
        forward_motion: the camera moves along its axis, as in a driving car: the mapper starts
            with no pair unless its options allow that, and the focal length cannot be found.
        links: what connects images where motion does not.
        estimate: summary of the joint estimate of all poses that matches were verified against;
            None: they were verified pair by pair.
        seconds: wall time of each stage.
        warnings: what the user should know, such as damage of the stream.
    """

    database: Path
    videos: tuple[Path, ...]
    streams: tuple[Path | None, ...]
    conversion: str | None
    photos: Path | None
    image_path: Path | None
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
    links: LinkReport
    estimate: JointEstimate | None
    seconds: dict[str, float]
    warnings: tuple[str, ...]

    @property
    def next_commands(self) -> tuple[str, str, str]:
        """Shell lines: two that map the database, with COLMAP and with this package; one after.

        The last one makes the cloud that training of Gaussian splats starts from.
        """
        database = _no_option(self.database)
        output = _no_option(self.database.with_name(f"{self.database.stem}_model"))
        images = _no_option(self.image_path) if self.image_path is not None else "IMAGES"
        # fmt: off
        mapper = [
            "colmap", "mapper",
            "--database_path", database,
            "--image_path", images,
            "--output_path", output,
        ]
        ours = [
            "colmap-av1", "map",
            "--database", database,
            "--image_path", images,
            "--output", output,
        ]
        if self.forward_motion:
            mapper += [
                "--Mapper.init_max_forward_motion", "1",
                "--Mapper.ba_refine_focal_length", "0",
                "--Mapper.ba_refine_extra_params", "0",
            ]
            ours.append("--forward_motion")
        densify = [
            "colmap-av1", "densify",
            "--model", f"{output}/0",
            *(word for video in self.videos for word in ("--video", _no_option(video))),
            *(("--photos", _no_option(self.photos)) if self.photos is not None else ()),
            *(("--image_path", images) if self.image_path is not None else ()),
            "--output", _no_option(self.database.with_name(f"{self.database.stem}_splats")),
        ]
        # fmt: on
        with_colmap = f"mkdir -p {shlex.quote(output)} && {shlex.join(mapper)}"
        return with_colmap, shlex.join(ours), shlex.join(densify)


@one_blas_thread()
def match(
    database: str | os.PathLike[str],
    video: str | os.PathLike[str] | Sequence[str | os.PathLike[str]],
    *,
    photos: str | os.PathLike[str] | None = None,
    image_path: str | os.PathLike[str] | None = None,
    options: MatchOptions | None = None,
    progress: Progress | None = None,
) -> MatchReport:
    """Fill a COLMAP database with keypoints and verified matches from the motion of videos.

    A database that lists images gets rows for these, see `frames_of_images`; a new or empty
    one gets images of its own. The database is written last and in one transaction: any
    error or interrupt leaves it as it was.

    Images of several videos lie in a folder for each, named like it, and have a camera each; what
    their pictures show in common connects them, and photos with them.

    Args:
        database: the database file; made where it is missing.
        video: a video, or several; one that is not AV1 is converted first, to a file beside the
            database that is there as long as it is read, or to one that is kept
            (`options.keep_stream`).
        photos: folder of photos that become images, too, named by the folder and their path in it;
            None: there are none.
        image_path: folder to write the images to, for the mapper's colours and for
            training; existing images of the right size are kept, photos are copied to it. None:
            none are written.
        options: options of every stage.
        progress: called with a stage's name, what is done, and of how much where known.

    Raises:
        VideoError: a video cannot be read, is given twice, changes meanwhile, or has no motion to
            match.
        BitstreamError: a stream is damaged, and strict or before its second frame.
        ImageError: images or names do not fit the video, or a photo cannot be read.
        DatabaseError: the database is locked, no COLMAP database, has features of its
            images and must not (`options.on_existing`), or does not fit the video.
        OptionError: an option does not fit the videos, their images or another option.
    """
    options = options if options is not None else MatchOptions()
    progress = progress if progress is not None else no_progress
    database = Path(database)
    folder = Path(image_path) if image_path is not None else None
    clock = Clock()

    before = files_in(folder) if folder is not None else set[Path]()
    listed = _read_listed_images(database, options)
    inputs = read_inputs(video, photos, options)
    if folder is not None:
        check_places(inputs.photos, folder)
    context = RunContext.of(options.run, clock, progress)
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
            beside=database,
            scratch=scratch,
            context=context,
        )
        cameras = _listed_cameras(database, listed, images) if listed else None
        found = _match_images(images, cameras, scratch, options, context)
        # With a guessed focal length the poses of pairs are wrong and cannot be compared.
        known = all(camera.has_prior_focal_length for camera in found.cameras)
        poses = found.poses if isinstance(found, JointMatches) and known else ()
        written = demote_bad_initial_pairs(found.matched, found.cameras, clock, poses)
        num_written, blurred = 0, list[str]()
        if folder is not None:
            check_videos()
            with clock.measure("images"), alone_in(folder):
                _check_images_of_others(images, folder, before, options)
                num_written = place_photos(inputs.photos, folder)
                labelled = zip(inputs.labels, images.videos, strict=True)
                of_videos, blurred = write_all_prepared(labelled, folder, options.reading, progress)
                num_written += of_videos

    with clock.measure("database"):
        positions = image_positions(images.image_set, inputs.videos, inputs.photos)
        write_matched_images(
            database,
            images.image_set.images.names,
            None if listed else found.cameras,
            written,
            on_existing=options.on_existing,
            places=positions.places,
        )
    videos = images.videos
    kinds = Counter(geometry.config.name for geometry in written.geometries)
    num_inliers = [len(geometry.inlier_matches) for geometry in written.geometries]
    notes = inputs.with_names([own.tracked.video.warnings for own in videos])
    notes += (*positions.warnings, *found.warnings)
    doubts = (found.depth.warning, focal_length_warning(found.cameras))
    notes += tuple(doubt for doubt in doubts if doubt is not None)
    # What a database holds already may join the images, too, and joint matches are fewer where all
    # others are the same tracks in more images.
    if options.on_existing != "append" and not isinstance(found, JointMatches):
        notes += matching_warnings(written, images.image_set)
    return MatchReport(
        database=database,
        videos=tuple(own.path for own in inputs.videos),
        streams=tuple(own.source.stream.path if own.source.is_kept else None for own in videos),
        conversion=inputs.conversion([own.source.conversion for own in videos]),
        photos=Path(photos) if photos is not None else None,
        image_path=folder,
        num_frames=images.image_set.num_frames - len(inputs.photos),
        num_coded_frames=sum(own.tracked.video.num_coded_frames for own in videos),
        num_images=len(written.keypoints),
        num_written_images=num_written,
        masked=images.image_set.masked,
        num_tracks=len(found.track_lengths),
        track_lengths=_length_quantiles(found.track_lengths),
        num_observations=sum(len(keypoints.xy) for keypoints in written.keypoints),
        focal_length=found.focal_length,
        read_outs=tuple(own.tracked.video.read_out for own in videos),
        num_pairs=len(written.geometries),
        num_verified_pairs=sum(count > 0 for count in num_inliers),
        num_matches=sum(len(matches) for matches in written.matches),
        num_inliers=sum(num_inliers),
        configs=dict(sorted(kinds.items())),
        forward_motion=written.forward_motion,
        links=found.links,
        estimate=found.estimate if isinstance(found, JointMatches) else None,
        seconds=clock.seconds,
        warnings=(*inputs.warnings, *notes, *blurred),
    )


def _check_images_of_others(
    images: _Images, folder: Path, before: set[Path], options: MatchOptions
) -> None:
    """Refuse images that another run has written since this one began, if of another video.

    Args:
        images: the images of this run.
        folder: where they are to be written.
        before: files that were there when this run began.
        options: those of reading are used.

    Raises:
        ImageError: an image shows something else than the frame it should.
    """
    for label, own in zip(images.inputs.labels, images.videos, strict=True):
        for name, frame in zip(
            own.tracked.chosen.names, own.tracked.chosen.frames.tolist(), strict=True
        ):
            path = folder / label / name
            if path not in before and path.exists():
                pictures = decodable_frames(
                    own.source.pictures, own.tracked.tracks.num_frames, options.reading, own.display
                )
                check_content([path], [frame], pictures)
                break


@dataclass(frozen=True)
class _Images:
    """The images of all videos and photos, before any are matched.

    Attributes:
        inputs: the videos and photos.
        videos: the images of each video, with its tracks in their pixels.
        fast: of each video, where the camera moves fast: bool [num_frames], see `fast_frames`.
        image_set: all images, counted through.
    """

    inputs: Inputs
    videos: Sequence[PreparedImages]
    fast: Sequence[NDArray[np.bool_]]
    image_set: ImageSet

    @property
    def shown(self) -> tuple[ShownVideo, ...]:
        """The videos, as their pictures are looked at."""
        return tuple(
            ShownVideo(v.source.pictures, v.size, v.pixel_aspect, v.display, v.source.kept)
            for v in self.videos
        )


def _is_joint(folder: Path | None, options: MatchOptions) -> bool:
    """Whether matches are to agree with a joint estimate, which has one camera for a video."""
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
    beside: Path,
    scratch: Path | None,
    context: RunContext,
) -> _Images:
    """Find or choose the images of each video, and count them through.

    Args:
        inputs: the videos and photos.
        listed: (width, height) of the images of each video that a database lists, by name.
        folder: folder of the images; None: none are wanted.
        options: all options.
        beside: the database.
        scratch: folder that keeps decoded pictures for a joint estimate; None: there is none, and
            only tracks that are matched are kept.
        context: gets the stages.
    """
    videos, fast = [], []
    for number, (video, label, masks, existing) in enumerate(
        zip(inputs.videos, inputs.labels, inputs.masks_of_videos, listed, strict=True)
    ):
        prepared = prepare_images(
            video,
            folder / label if folder is not None else None,
            options,
            listed=existing,
            masks=masks,
            beside=beside,
            context=context,
        )
        fast.append(fast_frames(prepared.tracked.tracks))
        prepared = _without_shutter(prepared, options, context)
        if scratch is not None:
            kept = KeptPictures(scratch / f"{number}.raw")
            prepared = replace(prepared, source=replace(prepared.source, kept=kept))
        else:
            # All tracks of a video are its largest arrays: they make room for the next.
            prepared = _with_selected_tracks(prepared, options, context)
        videos.append(prepared)
    image_set = inputs.image_set(
        [own.tracked.chosen for own in videos], [own.tracked.tracks.num_frames for own in videos]
    )
    return _Images(inputs, videos, fast, image_set)


def _match_images(
    images: _Images,
    cameras: ImageCameras | None,
    scratch: Path | None,
    options: MatchOptions,
    context: RunContext,
) -> ImageMatches:
    """Match the images, by a joint estimate if there is a folder for it and it succeeds.

    Args:
        images: the images.
        cameras: those of a database that lists the images; None: they are made anew.
        scratch: the folder.
        options: all options.
        context: gets the stages.

    Raises:
        ModelError: the joint estimate fails, and `options.verify` asks for one.
        VideoError: nothing connects any two images.
    """
    if scratch is None:
        return _match_pairs(images, cameras, options, context)
    try:
        if cameras is not None and _has_several_cameras(images.image_set, cameras):
            raise ModelError("the database has several cameras for the images of one video")
        return _match_jointly(images, cameras, scratch, options, context)
    except (ModelError, VideoError) as error:
        if options.verify.verify == "joint":
            raise
        reason = str(error).rpartition(": ")[0] or str(error)
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
    """Match the images by what agrees with an estimate of all poses."""
    stages = scratch / ".stages"
    stages.mkdir()
    # The images are chosen.
    chosen = replace(options, images=ImageOptions())
    run = Run(
        images.inputs,
        tuple(own.source for own in images.videos),
        images.shown,
        scratch,
        stages,
        ReconstructOptions(match=chosen),
        context.clock,
        context.progress,
        cameras=cameras,
    )
    tracked = [own.tracked for own in images.videos]
    return match_jointly(
        run,
        [
            VideoTracks(own.tracks, own.chosen, own.video.inter_share, own.video.read_out)
            for own in tracked
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
    shapes = [shape_of(own.video, own.size, own.pixel_aspect) for own in images.shown]

    def cameras(paired: PairedImages) -> ImageCameras:
        if listed is not None:
            return listed
        return new_cameras(
            paired, image_set, shapes, images.inputs.photos, options.camera, context=context
        )

    return match_images(
        image_set,
        [
            SelectedTracks(
                own.source.pictures.path,
                own.tracked.tracks,
                own.tracked.video.inter_share,
                fast,
            )
            for own, fast in zip(videos, images.fast, strict=True)
        ],
        images.inputs.no_motion,
        cameras,
        pictures_of(
            image_set, images.shown, [photo.path for photo in images.inputs.photos], options.reading
        ),
        options=ImageMatchOptions(
            options.pairs, options.verify, options.links, least_length(options.tracks)
        ),
        context=context,
        name=images.inputs.name,
    )


def _without_shutter(
    prepared: PreparedImages, options: MatchOptions, context: RunContext
) -> PreparedImages:
    """The images with their tracks corrected for the shutter's read-out, if that is wanted."""
    tracked = prepared.tracked
    tracks, read_out = without_shutter(
        tracked.tracks,
        prepared.display,
        prepared.source.pictures.frame_rate,
        options.camera,
        context,
    )
    video = replace(tracked.video, tracks=tracks, read_out=read_out)
    return replace(prepared, tracked=replace(tracked, video=video))


def _with_selected_tracks(
    prepared: PreparedImages, options: MatchOptions, context: RunContext
) -> PreparedImages:
    """The images with the tracks that are matched, in place of all."""
    tracked = prepared.tracked
    with context.clock.measure("pairs"):
        tracks = select_tracks(tracked.tracks.keep_frames(tracked.chosen.frames), options.density)
    return replace(prepared, tracked=tracked.with_tracks(tracks))


def _length_quantiles(lengths: NDArray[np.int64]) -> dict[float, int]:
    """Quantiles of the lengths of tracks; empty without a track."""
    if len(lengths) == 0:
        return {}
    found = np.quantile(lengths, _LENGTH_QUANTILES, method="lower")
    return dict(zip(_LENGTH_QUANTILES, map(int, found), strict=True))


def _no_option(path: Path) -> str:
    """The path, spelled so that programs do not take it for an option."""
    return f"./{path}" if str(path).startswith("-") else str(path)


def _read_listed_images(database: Path, options: MatchOptions) -> list[DatabaseImage]:
    """The images of the database, after a look at whether it can be written."""
    listed = read_images(database)
    filled = next((i for i in listed if i.num_keypoints or i.num_matches), None)
    if filled is not None and options.on_existing == "error":
        raise DatabaseError(
            f"{database}: image '{filled.name}' already has {filled.num_keypoints} keypoints and "
            f"{filled.num_matches} matches: --on_existing append adds to them, replace removes them"
        )
    if listed:
        check_no_camera(database, options.camera)
    if database.exists() and database.stat().st_size:
        # Nothing is written, but the write lock is taken.
        write_matches(database, (), (), (), pairs=_NO_PAIRS, matches=(), geometries=())
    elif not os.access(database.resolve().parent, os.W_OK | os.X_OK):
        raise DatabaseError(
            f"{database}: no permission to write a database there: give another path"
        )
    return listed


def _listed_cameras(
    database: Path, listed: Sequence[DatabaseImage], images: _Images
) -> ImageCameras:
    """The cameras of a database that lists the images."""
    image_set = images.image_set
    of_images = listed_cameras(database, listed, image_set.images.names)
    notes: dict[str, None] = {}
    for video, shown in enumerate(images.shown):
        camera = of_images[image_set.images_of(video).start]
        notes |= dict.fromkeys(
            check_pixel_aspect(camera, shown.pixel_aspect, "import the images with one of these")
        )
    return ImageCameras(of_images, None, tuple(notes))
