"""Correct the tracks of a video for its rolling shutter."""

from __future__ import annotations

from dataclasses import replace

from colmap_av1.geometry.cameras import is_nearly_pinhole, is_square
from colmap_av1.images.orientation import ShownImages
from colmap_av1.matching.shutter.estimate import estimate_read_out
from colmap_av1.options import CameraOptions
from colmap_av1.options.camera import DEFAULT_MODEL, camera_of_model, parse_camera_params
from colmap_av1.tracks.shutter import correct_tracks
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.tracks.video_tracks import TrackedVideo
from colmap_av1.util.run_context import RunContext
from colmap_av1.video.display import UPRIGHT, Display


def correct_rolling_shutter(
    video: TrackedVideo,
    shown: ShownImages,
    frame_rate: float | None,
    camera: CameraOptions,
    context: RunContext,
) -> TrackedVideo:
    """Move tracks to their positions in the middle of each picture's read-out, if requested.

    Args:
        video: tracks of all frames; neighbouring observations give their velocities.
        shown: how images show the video; tracks are in pixels of the images.
        frame_rate: frames per second; None if unknown.
        camera: the read-out time, the model and given intrinsics.
        context: its clock gets the stage "shutter".

    Returns:
        The video with corrected tracks and their read-out time, or with a warning if they cannot be
        corrected.
    """
    tracks = video.tracks
    if camera.rolling_shutter == "none" or tracks.num_frames == 0:
        return video
    with context.clock.measure("shutter"):
        down = rows_down(shown.display, (tracks.width, tracks.height))
        found = _read_out(
            tracks,
            frame_rate,
            camera,
            down=down,
            pixel_aspect=shown.pixel_aspect,
            seed=context.seed,
        )
        if frame_rate is None or isinstance(found, str):
            warning = f"keypoints are not corrected for a rolling shutter: {found}"
            return replace(video, warnings=(*video.warnings, warning))
        return replace(
            video,
            tracks=correct_tracks(tracks, found, down),
            read_out=found / frame_rate * 1000,
        )


def _read_out(
    tracks: Tracks,
    rate: float | None,
    camera: CameraOptions,
    *,
    down: tuple[int, int],
    pixel_aspect: float,
    seed: int,
) -> float | str:
    """The read-out time in frames, or why it is unknown."""
    if rate is None:
        return "the video has no frame rate"
    if camera.rolling_shutter != "estimate":
        return float(camera.rolling_shutter) / 1000 * rate
    if not is_nearly_pinhole(camera.camera_model) or not is_square(pixel_aspect):
        return (
            "the time is not estimated for fisheye lenses and pixels that are not square: give it "
            "in milliseconds"
        )
    found = estimate_read_out(tracks, down, _focal_length(camera), seed)
    return found if isinstance(found, str) else found.frames


def shutter_settings(camera: CameraOptions) -> tuple[str, ...]:
    """The options that the correction of tracks depends on."""
    lens = (str(camera.camera_model), str(camera.camera_params))
    return (camera.rolling_shutter, *(lens if camera.rolling_shutter == "estimate" else ()))


def rows_down(display: Display, size: tuple[int, int]) -> tuple[int, int]:
    """The direction in the displayed picture in which the sensor reads its rows, see `row_times`.

    The sensor is assumed to be wider than high: a picture that is stored upright was rotated before
    it was stored.

    Args:
        display: how players show the pictures.
        size: (width, height) of the displayed pictures.
    """
    (_, across), (_, down) = display.turn
    if display.turn == UPRIGHT and size[0] < size[1]:
        return (1, 0)
    return across, down


def _focal_length(camera: CameraOptions) -> float | None:
    """The given focal length in pixels; None if none is given."""
    if camera.camera_params is None:
        return None
    model = camera_of_model(camera.camera_model or DEFAULT_MODEL)
    model.params = parse_camera_params(camera.camera_params, model)
    return float(model.mean_focal_length())
