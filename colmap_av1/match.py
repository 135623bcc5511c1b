"""The whole way from a video to the rows of a COLMAP database."""

from __future__ import annotations

import copy
import os
import shlex
import warnings
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from colmap_av1.choice import ChosenImages, check_image_options, choose_images
from colmap_av1.content import check_content, is_turned_back
from colmap_av1.database import (
    DatabaseImage,
    is_square,
    make_camera,
    read_cameras,
    read_images,
    write_matches,
)
from colmap_av1.density import select_tracks
from colmap_av1.display import Display, shown_size, turned_back
from colmap_av1.encode import stream_of
from colmap_av1.errors import BitstreamError, DatabaseError, ImageError, OptionError, VideoError
from colmap_av1.focal import estimate_focal_length
from colmap_av1.images import (
    check_image_folder,
    check_images_there,
    existing_images,
    has_shape,
    image_size,
    size_of_images,
    write_images,
)
from colmap_av1.info import Structure, inspect
from colmap_av1.motion import FrameMotion, read_motion
from colmap_av1.options import CameraOptions, MatchOptions, OnExisting
from colmap_av1.overlays import remove_overlays
from colmap_av1.pairs import ImageKeypoints, image_keypoints, pair_matches, schedule_pairs
from colmap_av1.progress import Clock, Progress, no_progress
from colmap_av1.refine import refine_tracks
from colmap_av1.tracks import (
    Tracks,
    build_tracks,
    keep_observations,
    scale_tracks,
    show_tracks,
)
from colmap_av1.verify import TwoViewGeometry, verify_pairs
from colmap_av1.video import (
    decode_frames,
    frame_times,
    is_av1,
    open_stream,
    picture_size,
    presented_frames,
    read_display,
)

_NO_PAIRS = np.empty((0, 2), dtype=np.int32)
# The mapper's default limit for the translation along the axis of a first pair.
_INIT_MAX_FORWARD_MOTION = 0.95
# Of the tracks; fewer over the picture are left out without a word.
_NOTABLE_SHARE = 0.01
# Camera models that a pinhole camera is a first guess of.
_RECTILINEAR = ("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "FULL_OPENCV")
_LENGTH_QUANTILES = (0.0, 0.25, 0.5, 0.75, 0.9, 1.0)


@dataclass(frozen=True)
class MatchReport:
    """What `match` read and wrote.

    Attributes:
        database: the database file.
        video: the video file.
        stream: the AV1 file whose motion was read: the video, or what it was converted to.
        image_path: folder of the images; None where none was given.
        num_frames: shown frames of the video.
        num_coded_frames: frames with block data, hidden ones included.
        num_images: images of the database.
        num_written_images: image files written; others were there or not asked for.
        num_tracks: tracks in the video.
        track_lengths: quantiles of the number of frames that see a track, from 0 (shortest)
            to 1 (longest).
        num_observations: keypoints of all images.
        focal_length: in heights of a pixel, where the tracks told it; None where it was given,
            or the motion does not tell it, so that the camera has COLMAP's first guess.
        num_pairs: image pairs written.
        num_verified_pairs: those with a two-view geometry.
        num_matches: matches of all pairs.
        num_inliers: inlier matches of all pairs.
        configs: number of pairs by COLMAP's name of their two-view configuration.
        forward_motion: the camera moves along its axis, as in a driving car: the mapper starts
            with no pair unless told to, and the focal length cannot be found.
        seconds: wall time of each stage.
        warnings: what the user should know, such as damage of the stream.
    """

    database: Path
    video: Path
    stream: Path
    image_path: Path | None
    num_frames: int
    num_coded_frames: int
    num_images: int
    num_written_images: int
    num_tracks: int
    track_lengths: dict[float, int]
    num_observations: int
    focal_length: float | None
    num_pairs: int
    num_verified_pairs: int
    num_matches: int
    num_inliers: int
    configs: dict[str, int]
    forward_motion: bool
    seconds: dict[str, float]
    warnings: tuple[str, ...]

    @property
    def next_commands(self) -> tuple[str, str]:
        """Shell lines that map the database: with COLMAP, and with pycolmap."""
        output = str(self.database.with_name(f"{self.database.stem}_model"))
        images = str(self.image_path) if self.image_path is not None else "IMAGES"
        mapper = [
            *("colmap", "mapper", "--database_path", str(self.database)),
            *("--image_path", images, "--output_path", output),
        ]
        if self.forward_motion:
            mapper += ["--Mapper.init_max_forward_motion", "1"]
            mapper += [
                "--Mapper.ba_refine_focal_length",
                "0",
                "--Mapper.ba_refine_extra_params",
                "0",
            ]
        script = [
            *("python", "examples/map_with_pycolmap.py", "--database", str(self.database)),
            *("--image_path", images, "--output", output),
        ]
        if self.forward_motion:
            script.append("--forward_motion")
        return f"mkdir -p {shlex.quote(output)} && {shlex.join(mapper)}", shlex.join(script)


@dataclass(frozen=True)
class VideoSource:
    """Where the motion and the pictures of a video come from.

    Attributes:
        stream: the AV1 file whose motion is read.
        pictures: the file whose pictures become images.
        display: how players show the stream's pictures.
        presented: indices of the stream's frames that players show, where they hide some.
        num_packets: number of packets of the stream; None where unknown.
    """

    stream: Path
    pictures: Path
    display: Display
    presented: NDArray[np.int32] | None
    num_packets: int | None


@dataclass(frozen=True)
class TrackedVideo:
    """The tracks of a video, and what was noticed while they were made.

    Attributes:
        tracks: tracks through all shown frames.
        num_coded_frames: frames with block data, hidden ones included.
        warnings: what the user should know, such as damage of the stream.
    """

    tracks: Tracks
    num_coded_frames: int
    warnings: tuple[str, ...]


@dataclass(frozen=True)
class PreparedImages:
    """The images of a video, before anything is matched.

    Attributes:
        source: the video.
        display: how its pictures are shown in the images.
        tracked: the video's tracks, in its own pixels.
        tracks: the same in pixels of the images.
        chosen: the images.
        size: (width, height) of the images.
        pixel_aspect: width of a pixel of theirs over its height.
    """

    source: VideoSource
    display: Display
    tracked: TrackedVideo
    tracks: Tracks
    chosen: ChosenImages
    size: tuple[int, int]
    pixel_aspect: float


@dataclass(frozen=True)
class PairedImages:
    """Keypoints of the images, and the matches between them.

    Attributes:
        keypoints: keypoints of each image.
        pairs: int32 [m, 2] indices of images.
        matches: for each pair, uint32 [n, 2] indices of matching keypoints.
    """

    keypoints: list[ImageKeypoints]
    pairs: NDArray[np.int32]
    matches: list[NDArray[np.uint32]]


@dataclass(frozen=True)
class MatchedImages(PairedImages):
    """Keypoints of the images, and the verified matches between them.

    Attributes:
        geometries: two-view geometry of each pair.
        forward_motion: the camera moves along its axis, see `MatchReport`.
    """

    geometries: list[TwoViewGeometry]
    forward_motion: bool


def match(
    database: str | os.PathLike[str],
    video: str | os.PathLike[str],
    *,
    image_path: str | os.PathLike[str] | None = None,
    options: MatchOptions | None = None,
    progress: Progress | None = None,
) -> MatchReport:
    """Fill a COLMAP database with keypoints and verified matches from a video's motion.

    A database that lists images gets rows for these, see `frames_of_images`; a new or empty
    one gets images of its own. The database is written last and in one transaction: any
    error or interrupt leaves it as it was.

    Args:
        database: the database file; made where it is missing.
        video: a video; one that is not AV1 is converted first, see `encode.stream_of`.
        image_path: folder to write the images to, for the mapper's colours and for
            training; existing images of the right size are kept. None: none are written.
        options: options of every stage.
        progress: called with a stage's name, what is done, and of how much where known.

    Raises:
        VideoError: the video cannot be read, or has no motion to match.
        BitstreamError: the stream is damaged, and strict or before its second frame.
        ImageError: images or names do not fit the video.
        DatabaseError: the database is locked, no COLMAP database, has features of its
            images and must not (`options.on_existing`), or does not fit the video.
        OptionError: an option has a value that cannot work.
    """
    options = options if options is not None else MatchOptions()
    progress = progress if progress is not None else no_progress
    database, video = Path(database), Path(video)
    folder = Path(image_path) if image_path is not None else None
    clock = Clock()

    listed = _read_listed_images(database, options)
    existing = {image.name: (image.width, image.height) for image in listed}
    prepared = prepare_images(
        video, folder, options, listed=existing, clock=clock, progress=progress
    )
    source, display, chosen = prepared.source, prepared.display, prepared.chosen
    tracked, tracks, size = prepared.tracked, prepared.tracks, prepared.size

    with clock.measure("pairs"):
        seen = np.isin(tracks.frame, chosen.frames)
        tracks = select_tracks(keep_observations(tracks, seen), options.density)
    pixel_aspect = prepared.pixel_aspect
    paired = pair_images(video, tracks, chosen, options, clock=clock, progress=progress)
    focal_length = None
    if not listed:
        focal_length = shared_focal_length(paired, size, pixel_aspect, options, clock=clock)
    cameras, new_cameras = _cameras(
        *(database, listed, chosen.names, size, options.camera),
        pixel_aspect=pixel_aspect,
        focal_length=focal_length,
    )
    notes = [*tracked.warnings, *_camera_notes(cameras, listed, pixel_aspect)]
    matched = verify_images(paired, cameras, options, clock=clock, progress=progress)

    num_written = 0
    if folder is not None:
        with clock.measure("images"):
            num_written = write_images(
                source.pictures,
                folder,
                chosen.names,
                chosen.frames.tolist(),
                num_threads=options.verify.num_threads,
                operating_point=options.read.operating_point,
                display=display,
                progress=lambda done: progress("images", done, len(chosen.names)),
            )

    with clock.measure("database"):
        write_matches(
            database,
            chosen.names,
            new_cameras,
            matched.keypoints,
            pairs=matched.pairs,
            matches=matched.matches,
            geometries=matched.geometries,
            on_existing=options.on_existing,
        )
    lengths = np.diff(tracks.offsets)
    quantiles = np.quantile(lengths, _LENGTH_QUANTILES, method="lower")
    kinds = [geometry.config.name for geometry in matched.geometries]
    num_inliers = [len(geometry.inlier_matches) for geometry in matched.geometries]
    return MatchReport(
        database=database,
        video=video,
        stream=source.stream,
        image_path=folder,
        num_frames=tracks.num_frames,
        num_coded_frames=tracked.num_coded_frames,
        num_images=len(matched.keypoints),
        num_written_images=num_written,
        num_tracks=len(lengths),
        track_lengths={q: int(v) for q, v in zip(_LENGTH_QUANTILES, quantiles, strict=True)},
        num_observations=sum(len(k.xy) for k in matched.keypoints),
        focal_length=focal_length,
        num_pairs=len(matched.geometries),
        num_verified_pairs=sum(count > 0 for count in num_inliers),
        num_matches=sum(len(m) for m in matched.matches),
        num_inliers=sum(num_inliers),
        configs={kind: kinds.count(kind) for kind in sorted(set(kinds))},
        forward_motion=matched.forward_motion,
        seconds=clock.seconds,
        warnings=tuple(notes),
    )


def prepare_images(
    video: Path,
    folder: Path | None,
    options: MatchOptions,
    *,
    listed: Mapping[str, tuple[int, int]],
    clock: Clock,
    progress: Progress,
) -> PreparedImages:
    """Chain the motion of a video into tracks and find or choose the frames that are images.

    Args:
        video: a video.
        folder: folder of the images, which may exist; None: none are wanted.
        options: all but those of density, pairs and verification are used; all are checked.
        listed: (width, height) of images that a database lists, by name.
        clock: gets the stages up to "choice".
        progress: told about these stages.

    Raises:
        VideoError: the video cannot be read.
        BitstreamError: the stream is damaged, and strict or before its second frame.
        ImageError: images or names do not fit the video.
        OptionError: an option has a value that cannot work.
    """
    # What can be refused is refused before the long work.
    video_size = picture_size(video)
    display = read_display(video)
    existing = dict(listed)
    if folder is not None and not existing:
        names = existing_images(folder, options.images.image_name)
        existing = {name: image_size(folder / name) for name in names}
    back = _way_back(video, display, video_size, existing, folder)
    if back is not None:
        # What exists was written by a program that does not turn pictures.
        display = replace(display, turn=Display().turn, pixel_aspect=back.pixel_aspect)
        video_size = shown_size(video_size, back)
    size = size_of_images(existing, video_size, display.pixel_aspect)
    check_options(options, size)
    if folder is not None:
        check_image_folder(folder, list(existing) or options.images.image_name, size)
        if size != video_size:
            check_images_there(folder, list(existing))

    source = open_source(video, options, clock=clock, progress=progress)
    tracked = track_video(
        source, options, one_size=folder is not None, clock=clock, progress=progress
    )
    tracks = tracked.tracks if back is None else show_tracks(tracked.tracks, back)
    if (tracks.width, tracks.height) != video_size:
        if source.stream != source.pictures:
            raise VideoError(
                f"{source.stream}: its pictures are {tracks.width}x{tracks.height}, those of "
                f"{video} {video_size[0]}x{video_size[1]}: convert it by another --encoder"
            )
        video_size = (tracks.width, tracks.height)
        size = size_of_images(existing, video_size, display.pixel_aspect)

    def decode() -> Iterator[tuple[int, NDArray[np.uint8]]]:
        pictures = _decodable_frames(source.pictures, tracks.num_frames, options, display)
        for index, picture in pictures:
            progress("looking", index + 1, tracks.num_frames)
            yield index, picture

    with clock.measure("choice"):
        chosen = choose_images(
            tracks,
            options.images,
            existing=list(existing),
            folder=folder,
            times=lambda: _times(source, tracks.num_frames),
            decode=decode,
        )
    if folder is not None:
        check_image_folder(folder, chosen.names, size)
        kept = zip(chosen.names, chosen.frames.tolist(), strict=True)
        first_kept = next(((n, f) for n, f in kept if (folder / n).exists()), None)
        if not existing and first_kept is not None:
            check_content([folder / first_kept[0]], [first_kept[1]], decode())
    return PreparedImages(
        source=source,
        display=display,
        tracked=tracked,
        tracks=scale_tracks(tracks, size),
        chosen=chosen,
        size=size,
        # Images may be scaled by different factors along x and y.
        pixel_aspect=display.pixel_aspect * video_size[0] * size[1] / (video_size[1] * size[0]),
    )


def open_source(
    video: Path, options: MatchOptions, *, clock: Clock, progress: Progress
) -> VideoSource:
    """Find the AV1 stream of a video, or make it: its motion is read, not its pictures.

    Args:
        video: a video of any codec.
        options: those of encoding and reading are used.
        clock: gets the stage "encoding" where a stream is made.
        progress: told about the stage "encoding".

    Raises:
        VideoError: the file is missing or no video that can be read.
        EncodeError: no AV1 encoder works, or the stream cannot be written.
        OptionError: an option has a value that cannot work.
    """
    stream = video
    if not is_av1(video) or (options.reencode and inspect(video, options.read).reasons):
        with clock.measure("encoding"):
            encoded = stream_of(
                video,
                strict=options.read.strict,
                options=options.encode,
                keep_stream=options.keep_stream,
                progress=progress,
            )
        stream = encoded.output
    with open_stream(stream) as opened:
        num_packets = opened.num_frames
    # A stream made of a video holds the frames that its edit list hides, too.
    return VideoSource(stream, video, read_display(stream), presented_frames(video), num_packets)


def track_video(
    source: VideoSource,
    options: MatchOptions,
    *,
    one_size: bool,
    clock: Clock,
    progress: Progress,
) -> TrackedVideo:
    """Chain the motion of a video into tracks as it is read, and refine them.

    Args:
        source: the video.
        options: those of reading, chaining and refinement are used.
        one_size: refuse shown frames of several sizes, as refinement does.
        clock: gets the stages "motion" and "tracks", with refinement "decoding" and
            "refinement".
        progress: told about the stages "motion" and "refinement".

    Raises:
        VideoError: the video shows no frame.
        BitstreamError: the stream is damaged, and strict or before its second frame.
        ImageError: the frames change their size and must not.
    """
    motion: Iterable[FrameMotion] = read_motion(source.stream, options.read)
    if one_size or options.refine.refine != "none":
        motion = _of_one_size(motion)
    structure = Structure()
    motion = _counted(clock.iterate("motion", motion), structure)

    def count(done: int) -> None:
        progress("motion", done, source.num_packets)

    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        with clock.measure("tracks"):
            tracks = build_tracks(motion, options.tracks, count)
            num_frames, num_tracks = tracks.num_frames, len(tracks.offsets)
            tracks = remove_overlays(tracks)
            share_over_picture = 1 - len(tracks.offsets) / num_tracks
            tracks = show_tracks(tracks, source.display, source.presented)
        # Reading happened inside the chaining.
        clock.seconds["tracks"] -= clock.seconds["motion"]
        if options.refine.refine != "none":
            with clock.measure("refinement"):
                pictures = clock.iterate(
                    "decoding", _decodable_frames(source.pictures, tracks.num_frames, options)
                )
                tracks = refine_tracks(
                    tracks,
                    pictures,
                    options.refine,
                    lambda done: progress("refinement", done, tracks.num_frames),
                )
            clock.seconds["refinement"] -= clock.seconds["decoding"]
    notes = [str(w.message) for w in caught]
    if share_over_picture >= _NOTABLE_SHARE:
        notes.append(
            f"{share_over_picture:.0%} of the tracks stand still while the picture moves, as "
            "logos and dashboards do: they are left out"
        )
    # Of the whole file, so a rate that is found low is even lower.
    bits = 8 * source.stream.stat().st_size
    reasons = structure.reasons(bits / (num_frames * tracks.width * tracks.height))
    if reasons and source.stream == source.pictures:
        notes.append(f"{'; '.join(reasons)}; or let --reencode 1 convert the video first")
    return TrackedVideo(tracks, structure.num_coded, tuple(notes))


def pair_images(
    video: Path,
    tracks: Tracks,
    chosen: ChosenImages,
    options: MatchOptions,
    *,
    clock: Clock,
    progress: Progress,
) -> PairedImages:
    """Match the images along the tracks.

    Args:
        video: the file that messages name.
        tracks: tracks of the whole video.
        chosen: the images.
        options: those of pairs are used.
        clock: gets the stage "pairs".
        progress: told about the stage "pairs".

    Raises:
        VideoError: no two images share enough tracks.
    """
    with clock.measure("pairs"):
        keypoints = image_keypoints(tracks, chosen.frames.tolist())
        pairs = schedule_pairs(keypoints, options.pairs)
        if len(pairs) == 0:
            raise VideoError(
                f"{video}: no two images share {options.pairs.min_matches} tracks, so there is "
                "nothing to match: 'colmap-av1 info --video' says what the stream lacks, "
                "--reencode 1 converts it first"
            )
        matches = []
        for i, j in pairs:
            matches.append(pair_matches(keypoints[i], keypoints[j]))
            progress("pairs", len(matches), len(pairs))
    return PairedImages(keypoints, pairs, matches)


def shared_focal_length(
    paired: PairedImages,
    size: tuple[int, int],
    pixel_aspect: float,
    options: MatchOptions,
    *,
    clock: Clock,
) -> float | None:
    """The focal length that the tracks tell of a camera about which nothing is given.

    Args:
        paired: the images, all of one camera.
        size: (width, height) of the images in pixels.
        pixel_aspect: width of a pixel over its height.
        options: those of the camera and the seed are used.
        clock: gets the stage "focal length".

    Returns:
        In heights of a pixel; None where parameters are given or the motion does not tell it.
    """
    camera = options.camera
    if camera.camera_params is not None or camera.camera_model not in (None, *_RECTILINEAR):
        return None
    with clock.measure("focal length"):
        return estimate_focal_length(
            paired.keypoints,
            paired.pairs,
            paired.matches,
            size,
            pixel_aspect=pixel_aspect,
            seed=options.verify.seed,
        )


def verify_images(
    paired: PairedImages,
    cameras: Any,
    options: MatchOptions,
    *,
    clock: Clock,
    progress: Progress,
) -> MatchedImages:
    """Verify the pairs.

    Args:
        paired: the images and their matches.
        cameras: the camera of all images, or one for each.
        options: those of verification are used.
        clock: gets the stage "verification".
        progress: told about the stage "verification".
    """
    keypoints, pairs, matches = paired.keypoints, paired.pairs, paired.matches
    with clock.measure("verification"):
        geometries = verify_pairs(
            keypoints,
            pairs,
            matches,
            cameras,
            options=options.verify,
            progress=lambda done: progress("verification", done, len(pairs)),
        )
    return MatchedImages(keypoints, pairs, matches, geometries, _is_forward_motion(geometries))


def check_options(options: MatchOptions, size: tuple[int, int]) -> None:
    """Refuse option values now that a stage would refuse after the long work.

    Args:
        options: options of every stage.
        size: (width, height) of the images.

    Raises:
        OptionError: an option has a value that cannot work.
    """
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
    verify_pairs((), _NO_PAIRS, (), camera, options=options.verify)


def _is_forward_motion(geometries: Sequence[TwoViewGeometry]) -> bool:
    """Whether COLMAP's mapper would take most pairs for forward motion and not start with them.

    Only pairs with known intrinsics say in which direction the camera moved.
    """
    along_axis = [abs(float(g.tvec[2])) for g in geometries if g.tvec is not None]
    return bool(along_axis) and float(np.median(along_axis)) >= _INIT_MAX_FORWARD_MOTION


def _read_listed_images(database: Path, options: MatchOptions) -> list[DatabaseImage]:
    """The images of the database, after a look at whether it can be written."""
    listed = read_images(database)
    filled = next((i for i in listed if i.num_keypoints or i.num_matches), None)
    if filled is not None and options.on_existing == "error":
        raise DatabaseError(
            f"{database}: image '{filled.name}' already has {filled.num_keypoints} keypoints and "
            f"{filled.num_matches} matches: --on_existing append adds to them, replace removes them"
        )
    if database.exists() and database.stat().st_size:
        # Nothing is written, but the write lock is taken.
        write_matches(database, (), (), (), pairs=_NO_PAIRS, matches=(), geometries=())
    elif not os.access(database.resolve().parent, os.W_OK | os.X_OK):
        raise DatabaseError(f"{database}: no permission to write a database there")
    return listed


def _way_back(
    video: Path,
    display: Display,
    video_size: tuple[int, int],
    existing: dict[str, tuple[int, int]],
    folder: Path | None,
) -> Display | None:
    """What turns shown pictures to how images that exist show them; None where they are shown so.

    Their shape says it. Where either would do, the first image says it by what it shows, if its
    file is there; else images count as turned, as players and ffmpeg do.
    """
    if display.turn == Display().turn or not existing:
        return None
    back = turned_back(display)
    name, size = next(iter(existing.items()))
    as_shown = has_shape(size, video_size)
    as_stored = has_shape(size, shown_size(video_size, back))
    if as_shown and as_stored and folder is not None and (folder / name).exists():
        return back if is_turned_back(folder / name, decode_frames(video), display) else None
    return back if as_stored and not as_shown else None


def _times(source: VideoSource, num_frames: int) -> NDArray[np.float64] | None:
    """Times of the frames that players show; None where they are unknown."""
    times = frame_times(source.stream)
    if times is not None and source.presented is not None:
        times = times[source.presented[source.presented < len(times)]]
    return None if times is None or len(times) < num_frames else times[:num_frames]


def _counted(motion: Iterable[FrameMotion], structure: Structure) -> Iterator[FrameMotion]:
    """The same frames; counts them."""
    for frame in motion:
        structure.add(frame)
        yield frame


def _of_one_size(motion: Iterable[FrameMotion]) -> Iterator[FrameMotion]:
    """The same frames; refuses shown frames of several sizes, which share no camera."""
    size: tuple[int, int] | None = None
    for frame in motion:
        if frame.display_index >= 0:
            size = size or (frame.width, frame.height)
            if (frame.width, frame.height) != size:
                raise ImageError(
                    f"the video changes its size from {size[0]}x{size[1]} to "
                    f"{frame.width}x{frame.height}, so its frames cannot be images of one camera: "
                    "leave out the image folder and --refine, or re-encode the video at one size"
                )
        yield frame


def _decodable_frames(
    video: Path, num_frames: int, options: MatchOptions, display: Display | None = None
) -> Iterator[tuple[int, NDArray[np.uint8]]]:
    """The pictures of the frames that have tracks; those before a damage, with a warning."""
    decoded = decode_frames(
        video,
        operating_point=options.read.operating_point,
        num_threads=options.verify.num_threads,
        display=display,
    )
    count = 0
    try:
        for index, image in decoded:
            if index >= num_frames:
                return
            yield index, image
            count += 1
    except BitstreamError as error:
        if options.read.strict:
            raise
        warnings.warn(f"{error}; tracks are refined in {count} frames only", stacklevel=2)
    finally:
        decoded.close()


def _cameras(
    database: Path,
    listed: Sequence[DatabaseImage],
    names: Sequence[str],
    size: tuple[int, int],
    options: CameraOptions,
    *,
    pixel_aspect: float,
    focal_length: float | None,
) -> tuple[list[Any], Any]:
    """The camera of each image, and what the database is to get where it lists no images."""
    if listed:
        cameras = read_cameras(database)
        camera_id = {image.name: image.camera_id for image in listed}
        missing = next((n for n in names if camera_id[n] not in cameras), None)
        if missing is not None:
            raise DatabaseError(f"{database}: image '{missing}' has no camera")
        return [cameras[camera_id[name]] for name in names], None
    camera = make_camera(options, *size, pixel_aspect, focal_length)
    if options.single_camera:
        return [camera] * len(names), camera
    # Images share a camera where theirs are one object.
    each = [copy.copy(camera) for _ in names]
    return each, each


def _camera_notes(cameras: Sequence[Any], listed: Sequence[Any], pixel_aspect: float) -> list[str]:
    """What is to be said of cameras whose one focal length cannot be right."""
    if is_square(pixel_aspect) or len(cameras[0].focal_length_idxs()) == 2:
        return []
    what_to_do = (
        "import the images with one of these" if listed else "leave out --camera_model or give one"
    )
    return [
        f"pixels are {pixel_aspect:.3f} times as wide as high, but {cameras[0].model_name} has one "
        f"focal length for both directions; OPENCV and PINHOLE have two: {what_to_do}"
    ]
