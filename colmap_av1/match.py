"""The whole way from a video to the rows of a COLMAP database."""

from __future__ import annotations

import os
import shlex
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_av1.database import (
    DatabaseImage,
    make_camera,
    read_cameras,
    read_images,
    write_matches,
)
from colmap_av1.errors import DatabaseError, ImageError, OptionError, VideoError
from colmap_av1.images import (
    are_named_by,
    check_image_folder,
    check_image_sizes,
    frames_of_images,
    image_names,
    write_images,
)
from colmap_av1.motion import FrameMotion, read_motion
from colmap_av1.options import MatchOptions
from colmap_av1.pairs import image_keypoints, pair_matches, schedule_pairs
from colmap_av1.tracks import Tracks, build_tracks
from colmap_av1.verify import TwoViewGeometry, verify_pairs
from colmap_av1.video import display_rotation, open_stream

# Called with a stage's name, what is done of it and, where known, of how much.
Progress = Callable[[str, int, "int | None"], None]

_NO_PAIRS = np.empty((0, 2), dtype=np.int32)
# The mapper's default limit for the translation along the axis of a first pair.
_INIT_MAX_FORWARD_MOTION = 0.95
_LENGTH_QUANTILES = (0.0, 0.25, 0.5, 0.75, 0.9, 1.0)


@dataclass(frozen=True)
class MatchReport:
    """What `match` read and wrote.

    Attributes:
        database: the database file.
        video: the video file.
        image_path: folder of the images; None where none was given.
        num_frames: shown frames of the video.
        num_coded_frames: frames with block data, hidden ones included.
        num_images: images of the database.
        num_written_images: image files written; others were there or not asked for.
        num_tracks: tracks in the video.
        track_lengths: quantiles of the number of frames that see a track, from 0 (shortest)
            to 1 (longest).
        num_observations: keypoints of all images.
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
    image_path: Path | None
    num_frames: int
    num_coded_frames: int
    num_images: int
    num_written_images: int
    num_tracks: int
    track_lengths: dict[float, int]
    num_observations: int
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
        video: an AV1 video.
        image_path: folder to write the images to, for the mapper's colours and for
            training; existing images of the right size are kept. None: none are written.
        options: options of every stage.
        progress: called with a stage's name, what is done, and of how much where known.

    Raises:
        VideoError: the video cannot be read, or has no motion to match.
        BitstreamError: the stream is damaged, and strict or before its second frame.
        ImageError: images or names do not fit the video.
        DatabaseError: the database is locked, no COLMAP database, not empty, or does not
            fit the video.
        OptionError: an option has a value that cannot work.
    """
    options = options if options is not None else MatchOptions()
    database, video = Path(database), Path(video)
    folder = Path(image_path) if image_path is not None else None
    report = progress if progress is not None else _no_progress
    clock = _Clock()

    # What can be refused is refused before the long work.
    with open_stream(video) as stream:
        stream_size = (stream.width, stream.height)
        num_packets = stream.num_frames
    listed = _read_listed_images(database)
    _check_options(options, stream_size)
    if listed:
        _check_listed_sizes(listed, stream_size, video, options)
    if folder is not None:
        names_or_pattern = [i.name for i in listed] if listed else options.image_name
        check_image_folder(folder, names_or_pattern, stream_size)

    motion = read_motion(video, options.read)
    if folder is not None:
        motion = _of_one_size(motion)
    tracks, num_coded_frames, notes = _chain(motion, options, clock, report, num_packets)
    names, frames = _choose_images(listed, tracks, options)
    size = (tracks.width, tracks.height)
    if size != stream_size:
        if listed:
            _check_listed_sizes(listed, size, video, options)
        if folder is not None:
            check_image_folder(folder, names, size)

    with clock.measure("pairs"):
        keypoints = image_keypoints(tracks, frames.tolist())
        pairs = schedule_pairs(keypoints, options.pairs)
        if len(pairs) == 0:
            raise VideoError(
                f"{video}: no two images share {options.pairs.min_matches} tracks, so there is "
                "nothing to match: 'colmap-av1 info --video' says what the stream lacks"
            )
        matches = [pair_matches(keypoints[i], keypoints[j]) for i, j in pairs]

    with clock.measure("verification"):
        camera_of_image, new_cameras = _cameras(database, listed, names, size, options)
        geometries = verify_pairs(
            keypoints,
            pairs,
            matches,
            camera_of_image,
            options=options.verify,
            progress=lambda done: report("verification", done, len(pairs)),
        )

    num_written = 0
    if folder is not None:
        with clock.measure("images"):
            num_written = write_images(
                video,
                folder,
                names,
                frames.tolist(),
                num_threads=options.verify.num_threads,
                operating_point=options.read.operating_point,
                progress=lambda done: report("images", done, len(names)),
            )

    with clock.measure("database"):
        write_matches(
            database,
            names,
            new_cameras,
            keypoints,
            pairs=pairs,
            matches=matches,
            geometries=geometries,
        )
    lengths = np.diff(tracks.offsets)
    quantiles = np.quantile(lengths, _LENGTH_QUANTILES, method="lower")
    kinds = [geometry.config.name for geometry in geometries]
    num_inliers = [len(geometry.inlier_matches) for geometry in geometries]
    return MatchReport(
        database=database,
        video=video,
        image_path=folder,
        num_frames=tracks.num_frames,
        num_coded_frames=num_coded_frames,
        num_images=len(keypoints),
        num_written_images=num_written,
        num_tracks=len(lengths),
        track_lengths={q: int(v) for q, v in zip(_LENGTH_QUANTILES, quantiles, strict=True)},
        num_observations=sum(len(k.xy) for k in keypoints),
        num_pairs=len(geometries),
        num_verified_pairs=sum(count > 0 for count in num_inliers),
        num_matches=sum(len(m) for m in matches),
        num_inliers=sum(num_inliers),
        configs={kind: kinds.count(kind) for kind in sorted(set(kinds))},
        forward_motion=_is_forward_motion(geometries),
        seconds=clock.seconds,
        warnings=notes,
    )


def _is_forward_motion(geometries: Sequence[TwoViewGeometry]) -> bool:
    """Whether COLMAP's mapper would take most pairs for forward motion and not start with them.

    Only pairs with known intrinsics say in which direction the camera moved.
    """
    along_axis = [abs(float(g.tvec[2])) for g in geometries if g.tvec is not None]
    return bool(along_axis) and float(np.median(along_axis)) >= _INIT_MAX_FORWARD_MOTION


def _check_options(options: MatchOptions, size: tuple[int, int]) -> None:
    """Refuse option values now that a stage would refuse after the long work."""
    if options.image_step < 1:
        raise OptionError(f"image_step is {options.image_step}: give 1 or more")
    image_names(options.image_name, ())
    camera = make_camera(options.camera, *size)
    schedule_pairs((), options.pairs)
    verify_pairs((), _NO_PAIRS, (), camera, options=options.verify)


def _read_listed_images(database: Path) -> list[DatabaseImage]:
    """The images of the database, after a look at whether it can be written."""
    listed = read_images(database)
    filled = next((i for i in listed if i.num_keypoints or i.num_matches), None)
    if filled is not None:
        raise DatabaseError(
            f"{database}: image '{filled.name}' already has {filled.num_keypoints} keypoints and "
            f"{filled.num_matches} matches: use a new database, or one that only lists images"
        )
    if database.exists() and database.stat().st_size:
        # Nothing is written, but the write lock is taken.
        write_matches(database, (), (), (), pairs=_NO_PAIRS, matches=(), geometries=())
    elif not os.access(database.resolve().parent, os.W_OK | os.X_OK):
        raise DatabaseError(f"{database}: no permission to write a database there")
    return listed


def _check_listed_sizes(
    listed: Sequence[DatabaseImage], size: tuple[int, int], video: Path, options: MatchOptions
) -> None:
    names = [image.name for image in listed]
    # Images of this package are never turned; those of other programs usually are.
    own = are_named_by(options.image_name, names)
    sizes = [(image.width, image.height) for image in listed]
    check_image_sizes(names, sizes, size, 0 if own else display_rotation(video))


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
                    "leave out the image folder, or re-encode the video at one size"
                )
        yield frame


def _chain(
    motion: Iterable[FrameMotion],
    options: MatchOptions,
    clock: _Clock,
    report: Progress,
    num_packets: int | None,
) -> tuple[Tracks, int, tuple[str, ...]]:
    """Chain the motion as it is read, so that no frame's motion is kept."""
    num_coded_frames = 0

    def count(done: int) -> None:
        nonlocal num_coded_frames
        num_coded_frames = done
        report("motion", done, num_packets)

    with warnings.catch_warnings(record=True) as caught, clock.measure("tracks"):
        warnings.simplefilter("always")
        tracks = build_tracks(clock.iterate("motion", motion), options.tracks, count)
    # Reading happened inside the chaining.
    clock.seconds["tracks"] -= clock.seconds["motion"]
    return tracks, num_coded_frames, tuple(str(warning.message) for warning in caught)


def _choose_images(
    listed: Sequence[DatabaseImage], tracks: Tracks, options: MatchOptions
) -> tuple[list[str], NDArray[np.int32]]:
    """Names of the images and the frames they stand for, in display order."""
    if not listed:
        chosen = np.arange(0, tracks.num_frames, options.image_step, dtype=np.int32)
        return image_names(options.image_name, chosen.tolist()), chosen
    names = [image.name for image in listed]
    frames = frames_of_images(names, tracks.num_frames, options.first_number)
    order = np.argsort(frames)
    return [names[i] for i in order], frames[order]


def _cameras(
    database: Path,
    listed: Sequence[DatabaseImage],
    names: Sequence[str],
    size: tuple[int, int],
    options: MatchOptions,
) -> tuple[list[Any], Any]:
    """The camera of each image, and what the database is to get where it lists no images."""
    if listed:
        cameras = read_cameras(database)
        camera_id = {image.name: image.camera_id for image in listed}
        missing = next((n for n in names if camera_id[n] not in cameras), None)
        if missing is not None:
            raise DatabaseError(f"{database}: image '{missing}' has no camera")
        return [cameras[camera_id[name]] for name in names], None
    camera = make_camera(options.camera, *size)
    each = [camera] * len(names)
    return each, camera if options.camera.single_camera else each


class _Clock:
    """Wall time of named stages, in the order in which they first ran."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}

    @contextmanager
    def measure(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        try:
            yield
        finally:
            elapsed = time.perf_counter() - start
            self.seconds[stage] = self.seconds.get(stage, 0.0) + elapsed

    def iterate(self, stage: str, items: Iterable[Any]) -> Iterator[Any]:
        """Yield from `items`, measuring the time they take to come."""
        iterator = iter(items)
        self.seconds.setdefault(stage, 0.0)
        while True:
            with self.measure(stage):
                try:
                    item = next(iterator)
                except StopIteration:
                    return
            yield item


def _no_progress(stage: str, done: int, total: int | None) -> None:
    del stage, done, total
