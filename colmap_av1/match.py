"""From a video to the rows of a COLMAP database."""

from __future__ import annotations

import copy
import os
import shlex
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

from colmap_av1.database.reading import DatabaseImage, read_cameras, read_images
from colmap_av1.database.writing import write_matched_images, write_matches
from colmap_av1.errors import DatabaseError, OptionError
from colmap_av1.images.camera import check_pixel_aspect, make_camera
from colmap_av1.images.preparing import PreparedImages, prepare_images, write_chosen
from colmap_av1.matching.image_matches import (
    MatchedImages,
    PairedImages,
    pair_images,
    shared_focal_length,
    verify_images,
)
from colmap_av1.matching.links import LinkedImages, LinkReport, link_video
from colmap_av1.matching.weak_gaps import may_link
from colmap_av1.options import CameraOptions, MatchOptions
from colmap_av1.tracks.selection import select_tracks
from colmap_av1.tracks.tracks import Tracks, keep_frames
from colmap_av1.util.arguments import checks_arguments
from colmap_av1.util.progress import Clock, Progress, no_progress
from colmap_av1.video.facts import read_video
from colmap_av1.video.unchanged import unchanged

_NO_PAIRS = np.empty((0, 2), dtype=np.int32)
_LENGTH_QUANTILES = (0.0, 0.25, 0.5, 0.75, 0.9, 1.0)


@dataclass(frozen=True)
class MatchReport:
    """What `match` read and wrote.

    Attributes:
        database: the database file.
        video: the video file.
        stream: the AV1 file whose motion was read: the video, or what it was converted to; None
            where that was not kept.
        conversion: how the stream was made of the video, in words; None where it is the video.
        image_path: folder of the images; None where none was given.
        num_frames: shown frames of the video.
        num_coded_frames: frames with block data, hidden ones included.
        num_images: images of the database.
        num_written_images: image files written; others were there or not asked for.
        num_tracks: tracks in the video.
        track_lengths: quantiles of the number of frames that see a track, from 0 (shortest)
            to 1 (longest); empty without a track.
        num_observations: keypoints of all images.
        focal_length: in heights of a pixel, where it was estimated from the tracks; None where it
            was given, or the motion does not determine it and the camera has COLMAP's first guess.
        num_pairs: image pairs written.
        num_verified_pairs: those with a two-view geometry.
        num_matches: matches of all pairs.
        num_inliers: inlier matches of all pairs.
        configs: number of pairs by COLMAP's name of their two-view configuration.
        forward_motion: the camera moves along its axis, as in a driving car: the mapper starts
            with no pair unless its options allow that, and the focal length cannot be found.
        links: what connects images where motion does not.
        seconds: wall time of each stage.
        warnings: what the user should know, such as damage of the stream.
    """

    database: Path
    video: Path
    stream: Path | None
    conversion: str | None
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
    links: LinkReport
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
        mapper = [
            *("colmap", "mapper", "--database_path", database),
            *("--image_path", images, "--output_path", output),
        ]
        if self.forward_motion:
            mapper += [
                *("--Mapper.init_max_forward_motion", "1"),
                *("--Mapper.ba_refine_focal_length", "0"),
                *("--Mapper.ba_refine_extra_params", "0"),
            ]
        ours = [
            *("colmap-av1", "map", "--database", database),
            *("--image_path", images, "--output", output),
        ]
        if self.forward_motion:
            ours.append("--forward_motion")
        densify = [
            *("colmap-av1", "densify", "--model", f"{output}/0", "--video", _no_option(self.video)),
            *(("--image_path", images) if self.image_path is not None else ()),
            *("--output", _no_option(self.database.with_name(f"{self.database.stem}_splats"))),
        ]
        with_colmap = f"mkdir -p {shlex.quote(output)} && {shlex.join(mapper)}"
        return with_colmap, shlex.join(ours), shlex.join(densify)


@checks_arguments
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
        video: a video; one that is not AV1 is converted first, to a file beside the database that
            is there as long as it is read, or to one that is kept (`options.keep_stream`).
        image_path: folder to write the images to, for the mapper's colours and for
            training; existing images of the right size are kept. None: none are written.
        options: options of every stage.
        progress: called with a stage's name, what is done, and of how much where known.

    Raises:
        VideoError: the video cannot be read, changes meanwhile, or has no motion to match.
        BitstreamError: the stream is damaged, and strict or before its second frame.
        ImageError: images or names do not fit the video.
        DatabaseError: the database is locked, no COLMAP database, has features of its
            images and must not (`options.on_existing`), or does not fit the video.
        OptionError: an option does not fit the video or its images.
    """
    options = options if options is not None else MatchOptions()
    progress = progress if progress is not None else no_progress
    database = Path(database)
    folder = Path(image_path) if image_path is not None else None
    clock = Clock()

    listed = _read_listed_images(database, options)
    existing = {image.name: (image.width, image.height) for image in listed}
    video = read_video(video, options.read.operating_point)
    with unchanged(video.state) as check_video:
        prepared = prepare_images(
            *(video, folder, options),
            listed=existing,
            beside=database,
            clock=clock,
            progress=progress,
        )
        source, chosen, display = prepared.source, prepared.chosen, prepared.display
        # All tracks of a video are its largest arrays: they make room for the matches.
        prepared = _with_chosen_tracks(prepared, options, clock)
        cameras, linked = _match_images(
            prepared, database, listed, options, clock=clock, progress=progress
        )

        num_written = 0
        if folder is not None:
            check_video()
            with clock.measure("images"):
                num_written = write_chosen(
                    source.pictures,
                    folder,
                    chosen,
                    options,
                    display=display,
                    progress=progress,
                )

    with clock.measure("database"):
        write_matched_images(
            database, chosen.names, cameras.new, linked.matched, options.on_existing
        )
    return MatchReport(
        database=database,
        video=video.path,
        stream=source.stream.path if source.is_kept else None,
        conversion=source.conversion,
        image_path=folder,
        num_frames=prepared.tracks.num_frames,
        num_coded_frames=prepared.tracked.num_coded_frames,
        num_written_images=num_written,
        focal_length=cameras.focal_length,
        seconds=clock.seconds,
        links=linked.report,
        warnings=(*prepared.tracked.warnings, *cameras.warnings, *linked.report.warnings),
        **_figures(prepared.tracks, linked.matched),
    )


def _match_images(
    prepared: PreparedImages,
    database: Path,
    listed: Sequence[DatabaseImage],
    options: MatchOptions,
    *,
    clock: Clock,
    progress: Progress,
) -> tuple[_Cameras, LinkedImages]:
    """Match the images along their tracks, verify that, and link what motion does not connect."""
    source, chosen, inter_share = prepared.source, prepared.chosen, prepared.tracked.inter_share
    paired = pair_images(
        *(source.pictures.path, prepared.tracks, chosen, options),
        needed=not may_link(inter_share, chosen.frames, options.links),
        clock=clock,
        progress=progress,
    )
    cameras = _cameras(
        *(database, listed, chosen.names, paired, options),
        size=prepared.size,
        pixel_aspect=prepared.pixel_aspect,
        clock=clock,
    )
    matched = verify_images(paired, cameras.of_images, options, clock=clock, progress=progress)
    linked = link_video(
        *(source, matched, cameras.of_images, prepared.size, inter_share),
        display=prepared.display,
        options=options,
        clock=clock,
        progress=progress,
    )
    return cameras, linked


def _with_chosen_tracks(
    prepared: PreparedImages, options: MatchOptions, clock: Clock
) -> PreparedImages:
    """The images with the tracks that are matched, in place of all tracks of the video."""
    with clock.measure("pairs"):
        frames = prepared.chosen.frames
        tracks = select_tracks(keep_frames(prepared.tracks, frames), options.density)
    return replace(prepared, tracks=tracks, tracked=replace(prepared.tracked, tracks=tracks))


def _figures(tracks: Tracks, matched: MatchedImages) -> dict[str, Any]:
    """The counts of tracks and matches in `MatchReport`."""
    lengths = np.diff(tracks.offsets)
    quantiles = np.quantile(lengths, _LENGTH_QUANTILES, method="lower") if len(lengths) else ()
    kinds = [geometry.config.name for geometry in matched.geometries]
    num_inliers = [len(geometry.inlier_matches) for geometry in matched.geometries]
    return {
        "num_images": len(matched.keypoints),
        "num_tracks": len(lengths),
        "track_lengths": {
            q: int(length) for q, length in zip(_LENGTH_QUANTILES, quantiles, strict=False)
        },
        "num_observations": sum(len(k.xy) for k in matched.keypoints),
        "num_pairs": len(matched.geometries),
        "num_verified_pairs": sum(count > 0 for count in num_inliers),
        "num_matches": sum(len(m) for m in matched.matches),
        "num_inliers": sum(num_inliers),
        "configs": {kind: kinds.count(kind) for kind in sorted(set(kinds))},
        "forward_motion": matched.forward_motion,
    }


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
        _check_no_camera(database, options.camera)
    if database.exists() and database.stat().st_size:
        # Nothing is written, but the write lock is taken.
        write_matches(database, (), (), (), pairs=_NO_PAIRS, matches=(), geometries=())
    elif not os.access(database.resolve().parent, os.W_OK | os.X_OK):
        raise DatabaseError(
            f"{database}: no permission to write a database there: give another path"
        )
    return listed


def _check_no_camera(database: Path, options: CameraOptions) -> None:
    """Refuse options of new cameras where the images have theirs."""
    default = CameraOptions()
    changed = [
        field.name
        for field in fields(options)
        if getattr(options, field.name) != getattr(default, field.name)
    ]
    if changed:
        raise OptionError(
            f"{database}: its images have cameras, so {changed[0]} would change nothing: leave it "
            "out, or import the images with that camera"
        )


@dataclass(frozen=True)
class _Cameras:
    """The cameras of the images.

    Attributes:
        of_images: the camera of each image; images share one where it is the same object.
        new: what a database that lists no images is to get: one camera, or one for each image.
        focal_length: the estimated one, see `MatchReport`.
        warnings: what the user should know of them.
    """

    of_images: list[Any]
    new: Any
    focal_length: float | None
    warnings: list[str]


def _cameras(
    database: Path,
    listed: Sequence[DatabaseImage],
    names: Sequence[str],
    paired: PairedImages,
    options: MatchOptions,
    *,
    size: tuple[int, int],
    pixel_aspect: float,
    clock: Clock,
) -> _Cameras:
    """Those of the database where it lists the images, else new ones."""
    if listed:
        of_images = _listed_cameras(database, listed, names)
        what_to_do = "import the images with one of these"
        warnings = check_pixel_aspect(of_images[0], pixel_aspect, what_to_do)
        return _Cameras(of_images, None, None, warnings)
    focal_length = shared_focal_length(paired, size, pixel_aspect, options, clock=clock)
    camera = make_camera(options.camera, *size, pixel_aspect, focal_length)
    what_to_do = "leave out --camera_model or give one"
    warnings = check_pixel_aspect(camera, pixel_aspect, what_to_do)
    if options.camera.single_camera:
        return _Cameras([camera] * len(names), camera, focal_length, warnings)
    each = [copy.copy(camera) for _ in names]
    return _Cameras(each, each, focal_length, warnings)


def _listed_cameras(
    database: Path, listed: Sequence[DatabaseImage], names: Sequence[str]
) -> list[Any]:
    """The cameras that the database has of its images, one for each name."""
    cameras = read_cameras(database)
    camera_id = {image.name: image.camera_id for image in listed}
    missing = next((n for n in names if camera_id[n] not in cameras), None)
    if missing is not None:
        raise DatabaseError(f"{database}: image '{missing}' has no camera: import the images again")
    return [cameras[camera_id[name]] for name in names]
