"""Correct the tracks of a video for its rolling shutter."""

from __future__ import annotations

from colmap_av1.geometry.cameras import is_nearly_pinhole, is_square
from colmap_av1.matching.shutter.estimate import estimate_read_out
from colmap_av1.options import CameraOptions
from colmap_av1.options.camera import DEFAULT_MODEL, camera_of_model, parse_camera_params
from colmap_av1.tracks.shutter import correct_tracks
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.run_context import RunContext
from colmap_av1.video.display import UPRIGHT, Display


def correct_rolling_shutter(
    tracks: Tracks,
    display: Display,
    rate: float | None,
    camera: CameraOptions,
    context: RunContext,
) -> tuple[Tracks, float | None]:
    """Move tracks to their positions in the middle of each picture's read-out.

    Args:
        tracks: tracks of all frames; neighbouring observations give their velocities.
        display: how players show the pictures.
        rate: frames per second; if None (unknown), the tracks are returned unchanged.
        camera: the read-out time, the model and given intrinsics.
        context: its clock gets the stage "shutter".

    Returns:
        The tracks, and the read-out time in milliseconds; None if nothing is corrected.
    """
    wanted = camera.rolling_shutter
    if wanted == "none" or rate is None or tracks.num_frames == 0:
        return tracks, None
    with context.clock.measure("shutter"):
        down = rows_down(display, (tracks.width, tracks.height))
        if wanted != "estimate":
            read_out = float(wanted) / 1000 * rate
        elif is_nearly_pinhole(camera.camera_model) and is_square(display.pixel_aspect):
            focal = _focal_length(camera)
            found = estimate_read_out(tracks, down, focal, context.seed)
            if isinstance(found, str):
                return tracks, None
            read_out = found.frames
        else:
            return tracks, None
        return correct_tracks(tracks, read_out, down), read_out / rate * 1000


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
