"""The first stages of `reconstruct`: tracks, and a database of the images matched along them.

Each stage leaves what the next one, and a later run, resume from.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np  # before pycolmap: the other order breaks writing PNG files later
from numpy.typing import NDArray

from colmap_av1.database.writing import write_matched_images
from colmap_av1.errors import ImageError, OptionError
from colmap_av1.images.choosing import ChosenImages, choose_images
from colmap_av1.images.inputs import Inputs
from colmap_av1.images.key_images import key_images, spread_images
from colmap_av1.images.names import image_names
from colmap_av1.images.positions import ImagePositions
from colmap_av1.images.takes import Takes, pictures_of
from colmap_av1.matching.image_matches import (
    MatchedImages,
    NewCameras,
    PairedImages,
    new_cameras,
    pair_images,
    pairs_of_takes,
    shape_of,
    verify_images,
)
from colmap_av1.matching.link_plan import images_to_link
from colmap_av1.matching.links import LinkedImages, link_images
from colmap_av1.matching.shutter.correct import shutter_settings, without_shutter
from colmap_av1.matching.two_view_geometry import TwoViewConfig
from colmap_av1.matching.weak_gaps import may_link
from colmap_av1.model.track_points import chaining_for_points
from colmap_av1.options import DensityOptions, ReconstructOptions
from colmap_av1.tracks.selection import select_tracks
from colmap_av1.tracks.tracks import Tracks, keep_frames, keep_long_tracks, least_length
from colmap_av1.tracks.video_tracks import (
    VideoSource,
    decoded_pictures,
    refine_in_images,
    times_of_frames,
    track_video,
)
from colmap_av1.util.digests import digest_if_there, file_digest
from colmap_av1.util.progress import Clock, Progress
from colmap_av1.util.stages import Kept, run_stage
from colmap_av1.video.unchanged import FileState, check_unchanged

# A mapper may leave a bogus model of two images where it finds no start.
LEAST_IMAGES = 3
_LINKS = "links.npz"


@dataclass(frozen=True)
class Run:
    """What every stage is given.

    Attributes:
        inputs: the videos and photos.
        sources: for each video, where its motion and pictures come from.
        output: the folder that is made.
        stages: the folder in it that holds what later runs resume from.
        options: options of every stage.
        clock: gets the time of each stage.
        progress: called in each stage.
        positions: where the images were taken; None before these are chosen.
    """

    inputs: Inputs
    sources: tuple[VideoSource, ...]
    output: Path
    stages: Path
    options: ReconstructOptions
    clock: Clock
    progress: Progress
    positions: ImagePositions | None = None

    @property
    def files(self) -> tuple[FileState, ...]:
        """All files as they were at the start."""
        photos = [photo.state for photo in self.inputs.photos]
        return (*(file for source in self.sources for file in source.files), *photos)

    @property
    def photo_digests(self) -> list[list[str]]:
        """Name and digest of each photo, which stages depend on."""
        return [[photo.name, file_digest(photo.path)] for photo in self.inputs.photos]


@dataclass(frozen=True)
class VideoTracks:
    """What `track_stage` keeps of a video.

    Attributes:
        tracks: its tracks.
        chosen: the frames that are images.
        inter_share: see `TrackedVideo`.
    """

    tracks: Tracks
    chosen: ChosenImages
    inter_share: NDArray[np.float32]

    def doubted_at(self, frames: Sequence[int]) -> VideoTracks:
        """The same, but for frames whose motion is not to be trusted, whatever the stream says."""
        share = self.inter_share.copy()
        share[list(frames)] = 0.0
        return replace(self, inter_share=share)


def stage_of_video(run: Run, video: int) -> str:
    """Name of the stage that makes the tracks of a video."""
    label = run.inputs.labels[video]
    return f"tracks_{label}" if label else "tracks"


def track_stage(run: Run, video: int) -> Kept:
    """Chain the motion of a video into tracks and choose the frames that are images."""
    source, clock, progress = run.sources[video], run.clock, run.progress
    masks = run.inputs.masks_of_videos[video]
    options = chaining_for_points(run.options.match, run.options.triangulate)
    name, shown = stage_of_video(run, video), source.pictures

    def make(partial: Path) -> dict[str, Any]:
        tracked = track_video(source, options, one_size=True, clock=clock, progress=progress)
        if masks is not None:
            left = masks.on_frames(tracked.tracks, least_length(options.tracks))
            share = masks.on_motion(tracked.inter_share)
            tracked = replace(tracked, tracks=left, inter_share=share)
        tracks = tracked.tracks
        with clock.measure("choice"):
            is_long = not options.images.ways and tracks.num_frames > run.options.max_images
            if is_long:
                chosen = _images_of_long_video(run, tracks, tracked.inter_share)
            else:
                chosen = choose_images(
                    pose_tracks(run, tracks),
                    options.images,
                    existing=(),
                    folder=partial,
                    times=lambda: times_of_frames(source, tracks.num_frames),
                    decode=lambda: decoded_pictures(source, options),
                )
        tracked = refine_in_images(
            tracked, source, chosen.frames, options, clock=clock, progress=progress
        )
        if masks is not None:
            left = masks.on_tracks(tracked.tracks, chosen, least_length(options.tracks))
            tracked = replace(tracked, tracks=left)
        tracks, read_out = without_shutter(
            tracked.tracks, shown.display, shown.frame_rate, options, clock
        )
        # Of a long video no other frame is of use from here on.
        tracks = keep_frames(tracks, chosen.frames) if is_long else tracks
        _check_chosen(run, chosen, tracks.num_frames)
        _write_tracks(partial / f"{name}.npz", VideoTracks(tracks, chosen, tracked.inter_share))
        check_unchanged(*source.files)
        return {
            "num_frames": tracks.num_frames,
            "num_tracks": len(tracks.offsets) - 1,
            "read_out": read_out,
            "warnings": list(tracked.warnings),
        }

    mapping = run.options.mapping
    choice = (run.options.max_images, mapping.pose_tracks_per_image, mapping.pose_spacing)
    shutter = shutter_settings(options.camera)
    given = (options.images, choice, options.read, options.tracks, options.refine, shutter)
    listed = digest_if_there(options.images.frame_list)
    masked = run.inputs.masks.digest if run.inputs.masks is not None else None
    return run_stage(
        run.stages,
        name,
        [[file_digest(file.path) for file in source.files], given, listed, masked],
        into=run.stages,
        products=[f"{name}.npz"],
        make=make,
    )


def _check_chosen(run: Run, chosen: ChosenImages, num_frames: int) -> None:
    """Refuse images of a video that are too few for a model, or have names unfit for trainers."""
    if len(run.sources) == 1 and len(chosen.names) + len(run.inputs.photos) < LEAST_IMAGES:
        raise ImageError(
            f"{len(chosen.names)} of {num_frames} frames become images: a model needs "
            f"{LEAST_IMAGES} or more"
        )
    unfit = next((n for n in chosen.names if "/" in n or n.count(".") != 1), None)
    if unfit is not None:
        raise OptionError(f"image '{unfit}': trainers want a flat name with one dot")


def _write_tracks(path: Path, own: VideoTracks) -> None:
    with path.open("wb") as file:
        # Names are kept by np.savez as they are.
        names, frames = np.array(own.chosen.names), own.chosen.frames
        np.savez(file, **vars(own.tracks), names=names, frames=frames, inter_share=own.inter_share)


def read_tracks(run: Run, video: int) -> VideoTracks:
    """The tracks, images and shares of inter units that `track_stage` kept of a video."""
    with np.load(run.stages / f"{stage_of_video(run, video)}.npz") as file:
        chosen = ChosenImages([str(name) for name in file["names"]], file["frames"])
        return VideoTracks(_tracks_of(file), chosen, file["inter_share"])


def _write_links(folder: Path, linked: LinkedImages) -> None:
    folder.mkdir()
    broken = np.array([before for before, _ in linked.report.broken_gaps], np.int32)
    with (folder / _LINKS).open("wb") as file:
        np.savez(file, **vars(linked.tracks), broken=broken)


def read_links(stages: Path) -> tuple[Tracks, NDArray[np.int32]]:
    """The links as tracks, and the frames before the gaps that no other track crosses."""
    with np.load(stages / _LINKS) as file:
        return _tracks_of(file), file["broken"]


def _tracks_of(file: Any) -> Tracks:
    arrays = {field.name: file[field.name] for field in dataclasses.fields(Tracks)}
    for name in ("num_frames", "width", "height"):
        arrays[name] = int(arrays[name])
    return Tracks(**arrays)


def pose_tracks(run: Run, tracks: Tracks) -> Tracks:
    """The tracks that poses are estimated from; short ones are for points only."""
    return keep_long_tracks(tracks, least_length(run.options.match.tracks))


def match_stage(
    run: Run,
    videos: Sequence[VideoTracks],
    takes: Takes,
    tracked: Sequence[Kept],
    doubted: Sequence[int],
) -> Kept:
    """Write the database of the tracks that the poses come from, and of links.

    Args:
        run: what every stage is given.
        videos: the tracks of each video.
        takes: the images.
        tracked: what `track_stage` kept of each video.
        doubted: frames, counted through the videos, whose motion is not to be trusted.
    """
    options, clock = run.options, run.clock
    mapping = options.mapping
    videos = [
        own.doubted_at([f - first for f in doubted if 0 <= f - first < own.tracks.num_frames])
        for own, first in zip(videos, takes.first_frame.tolist(), strict=False)
    ]
    density = _pose_density(run)

    def make(partial: Path) -> dict[str, Any]:
        with clock.measure("pairs"):
            index = _key_images(run, videos, takes)
        keyed = takes.some(index)
        paired = _paired_images(run, videos, keyed)
        made = _cameras(run, videos, takes, index, paired)
        cameras = made.of_images
        apart = len(takes.take) / len(keyed.take)
        linked = _match_images(run, videos, paired, cameras, keyed, images_apart=apart)
        matched = linked.matched
        with clock.measure("database"):
            write_matched_images(
                *(partial / "database.db", keyed.images.names, cameras, matched),
                places=run.positions.places[index] if run.positions is not None else None,
            )
        _write_links(partial / run.stages.name, linked)
        of_videos = cameras[: keyed.images_of(len(videos)).start]
        return {
            "links": dataclasses.asdict(linked.report),
            "link_warnings": [*made.warnings, *linked.report.warnings],
            "key_images": index,
            "num_key_images": len(index),
            "num_pose_tracks": len(np.unique(np.concatenate([k.track for k in paired.keypoints]))),
            "guessed": not all(camera.has_prior_focal_length for camera in of_videos),
            **_pair_facts(matched),
        }

    match = options.match
    given = (density, mapping.key_images, match.pairs, match.verify, match.camera, match.links)
    return run_stage(
        run.stages,
        "matches",
        [
            [t.digest for t in tracked],
            *(takes.videos, run.photo_digests, given, options.match.run.seed, list(doubted)),
            run.positions.digest if run.positions is not None else None,
        ],
        into=run.output,
        products=["database.db", f"{run.stages.name}/{_LINKS}"],
        make=make,
    )


def _images_of_long_video(
    run: Run, tracks: Tracks, inter_share: NDArray[np.float32]
) -> ChosenImages:
    """As many images as a trainer wants of a video with more frames, its key images among them."""
    name = run.options.match.images.image_name
    frames = np.arange(tracks.num_frames, dtype=np.int32)
    every = ChosenImages(image_names(name, frames.tolist()), frames)
    tracks = pose_tracks(run, tracks)
    key = _key_images_of_video(run, tracks, every, inter_share)
    return every.some(spread_images(tracks, run.options.max_images, key))


def _key_images_of_video(
    run: Run, tracks: Tracks, chosen: ChosenImages, inter_share: NDArray[np.float32]
) -> NDArray[np.int64]:
    """The key images among some images of a video, by their index."""
    mapping = run.options.mapping
    return key_images(
        tracks,
        chosen.frames,
        images_to_link(inter_share, chosen.frames, run.options.match.links),
        spacing=mapping.pose_spacing,
        num_cells=mapping.pose_tracks_per_image,
    )


def _key_images(run: Run, videos: Sequence[VideoTracks], takes: Takes) -> list[int]:
    """The images that are mapped, by their index: all, where key images are not wanted.

    Photos are key images: no track says where they are.
    """
    if not run.options.mapping.key_images:
        return list(range(len(takes.take)))
    index: list[int] = []
    for video, own in enumerate(videos):
        frames = own.chosen.frames
        tracks = keep_frames(pose_tracks(run, own.tracks), frames)
        found = _key_images_of_video(run, tracks, own.chosen, own.inter_share)
        index += (found + takes.images_of(video).start).tolist()
    return index + list(range(takes.images_of(len(videos)).start, len(takes.take)))


def _pose_density(run: Run) -> DensityOptions:
    """Which tracks the poses come from."""
    mapping = run.options.mapping
    return DensityOptions(
        preset="sparse",
        max_tracks_per_image=mapping.pose_tracks_per_image,
        spacing=mapping.pose_spacing,
    )


def _paired_images(run: Run, videos: Sequence[VideoTracks], takes: Takes) -> PairedImages:
    """Some images of all takes, matched along a spread selection of tracks for poses."""
    options, density = run.options.match, _pose_density(run)
    paired = []
    for video, own in enumerate(videos):
        chosen = takes.of_video(video)
        with run.clock.measure("pairs"):
            sparse = select_tracks(
                keep_frames(pose_tracks(run, own.tracks), chosen.frames), density
            )
        linked_anyway = may_link(own.inter_share, chosen.frames, options.links)
        paired.append(
            pair_images(
                *(run.sources[video].pictures.path, sparse, chosen, options),
                needed=takes.num_takes == 1 and not linked_anyway,
                clock=run.clock,
                progress=run.progress,
            )
        )
    return pairs_of_takes(paired, takes)


def _cameras(
    run: Run,
    videos: Sequence[VideoTracks],
    takes: Takes,
    index: Sequence[int],
    paired: PairedImages,
) -> NewCameras:
    """The cameras of the key images, that are some of all images.

    What is estimated comes from all images: a few that lie far apart mislead.
    """
    options, photos = run.options.match, run.inputs.photos
    opened = [source.pictures for source in run.sources]
    shapes = [shape_of(v, v.picture_size, v.display.pixel_aspect) for v in opened]
    if options.camera.camera_params is not None or len(index) == len(takes.take):
        keyed = takes.some(index)
        return new_cameras(paired, keyed, shapes, photos, options, clock=run.clock)
    every = _paired_images(run, videos, takes)
    made = new_cameras(every, takes, shapes, photos, options, clock=run.clock)
    return replace(made, of_images=[made.of_images[i] for i in index])


def _match_images(
    run: Run,
    videos: Sequence[VideoTracks],
    paired: PairedImages,
    cameras: Sequence[Any],
    takes: Takes,
    *,
    images_apart: float,
) -> LinkedImages:
    """The images matched along some tracks of each video and by links."""
    options, clock, progress = run.options.match, run.clock, run.progress
    files = [source.pictures for source in run.sources]
    matched = verify_images(paired, cameras, options, clock=clock, progress=progress)
    shares = [own.inter_share for own in videos]
    photos = [photo.path for photo in run.inputs.photos]
    return link_images(
        *(takes, matched, cameras, np.concatenate([*shares, run.inputs.no_motion])),
        pictures_of(takes, [(file, None) for file in files], photos, options),
        name=run.inputs.name,
        images_apart=images_apart,
        options=options,
        clock=clock,
        progress=progress,
    )


def _pair_facts(matched: MatchedImages) -> dict[str, Any]:
    """Facts of the pairs that explain why a mapper finds no initial pair."""
    configs = [geometry.config for geometry in matched.geometries]
    return {
        "forward_motion": matched.forward_motion,
        "num_pairs": len(configs),
        "num_flat_pairs": configs.count(TwoViewConfig.PLANAR_OR_PANORAMIC),
        "num_verified_pairs": len(configs) - configs.count(TwoViewConfig.DEGENERATE),
        "keypoints_per_image": sum(len(k.xy) for k in matched.keypoints) / len(matched.keypoints),
    }
