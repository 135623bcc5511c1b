"""Match prepared images: against a joint estimate of all poses, or pair by pair."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

from colmap_av1.errors import ModelError, OptionError, VideoError
from colmap_av1.images.image_set import ImageSet, pictures_of
from colmap_av1.images.preparing import PreparedInputs
from colmap_av1.images.track_images import MIN_IMAGES
from colmap_av1.matching.cameras import ImageCameras, new_cameras
from colmap_av1.matching.match_images import ImageMatches, match_images
from colmap_av1.matching.matched_images import PairedImages
from colmap_av1.options import ImageOptions, MatchOptions, PairOptions, ReconstructOptions
from colmap_av1.poses.joint_matches import JointMatches, match_jointly
from colmap_av1.poses.run import Run
from colmap_av1.util.files import STAGES
from colmap_av1.util.run_context import RunContext


def wants_joint_estimate(options: MatchOptions, *, writes_images: bool) -> bool:
    """Whether to verify matches against a joint estimate, which has one camera per video.

    Raises:
        OptionError: `options.verify` requires it, but another option does not allow it.
    """
    verify = options.verify.verify
    chooses_pairs = options.pairs != PairOptions(min_matches=options.pairs.min_matches)
    has_own_cameras = options.camera.single_camera is False
    if verify == "joint" and has_own_cameras:
        raise OptionError(
            "verify is 'joint', which estimates one camera for all images of a video: leave out "
            "--single_camera, or give --verify pairs"
        )
    if verify == "joint" and chooses_pairs:
        raise OptionError(
            "verify is 'joint', which chooses the pairs itself: leave out --offsets, --growth and "
            "--max_span, or give --verify pairs"
        )
    if verify == "auto":
        return writes_images and not has_own_cameras and not chooses_pairs
    return verify == "joint"


def match_prepared(
    prepared: PreparedInputs,
    cameras: ImageCameras | None,
    scratch: Path | None,
    options: MatchOptions,
    context: RunContext,
) -> ImageMatches:
    """Match the images with a joint estimate, or pair by pair if it fails or is not wanted.

    Args:
        prepared: the images. Without a joint estimate, they have selected tracks only.
        cameras: cameras of a database that lists the images; None: new ones are made.
        scratch: folder for the joint estimate; None: match pair by pair.
        options: all options.
        context: state of the run.

    Raises:
        ModelError: the joint estimate fails, and `options.verify` requires it.
        VideoError: no two images are connected.
    """
    if scratch is None:
        return _match_pairs(prepared, cameras, options, context)
    try:
        if cameras is not None and _has_several_cameras(prepared.image_set, cameras):
            raise ModelError(
                "the database has several cameras for the images of one video, import them with "
                "--ImageReader.single_camera 1 to avoid this: leave out --verify joint"
            )
        return _match_jointly(prepared, cameras, scratch, options, context)
    except (ModelError, VideoError) as error:
        # What to do is for `reconstruct`, whose log is kept.
        reason = str(error).rpartition(": ")[0] or str(error)
        if options.verify.verify == "joint":
            if isinstance(error, VideoError):  # Nothing can be matched pair by pair, either.
                raise
            raise ModelError(f"{reason}: leave out --verify joint") from error
    videos = [own.with_selected_tracks(options.density, context.clock) for own in prepared.videos]
    found = _match_pairs(replace(prepared, videos=videos), cameras, options, context)
    if not found.depth.is_observable:
        return found
    warning = f"matches are verified pair by pair, without a joint estimate: {reason}"
    return replace(found, warnings=(*found.warnings, warning))


def _has_several_cameras(image_set: ImageSet, cameras: ImageCameras) -> bool:
    """Whether the images of a video have different cameras."""
    of_videos = [
        [cameras.of_images[image] for image in image_set.images_of(video)]
        for video in range(len(image_set.videos))
    ]
    return any(camera is not own[0] for own in of_videos for camera in own)


def _match_jointly(
    prepared: PreparedInputs,
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
    if any(own.tracked.video.sampled_ends is not None for own in prepared.videos):
        chosen = replace(chosen, tracks=replace(options.tracks, min_length=MIN_IMAGES))
    run = Run(
        inputs=prepared.inputs,
        sources=tuple(own.source for own in prepared.videos),
        shown=prepared.shown,
        output=scratch,
        stages=stages,
        options=ReconstructOptions(match=chosen),
        context=context,
        cameras=cameras,
    )
    videos = [own.tracked.for_matching for own in prepared.videos]
    return match_jointly(run, videos, prepared.image_set, options.density)


def _match_pairs(
    prepared: PreparedInputs,
    cameras: ImageCameras | None,
    options: MatchOptions,
    context: RunContext,
) -> ImageMatches:
    """Match the images along their tracks, and verify the matches pair by pair."""
    image_set, shown, photos = prepared.image_set, prepared.shown, prepared.inputs.photos

    def cameras_of(paired: PairedImages) -> ImageCameras:
        if cameras is not None:
            return cameras
        return new_cameras(paired, image_set, shown, photos, options.camera, context=context)

    return match_images(
        image_set,
        [own.tracked.for_matching for own in prepared.videos],
        cameras_of,
        pictures_of(image_set, shown, [photo.path for photo in photos], options.reading),
        options=options,
        context=context,
        name=prepared.inputs.name,
    )
