"""Pictures of what the package sees: motion and tracks over frames, matches, models."""

from __future__ import annotations

import math
import os
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import av.error
import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_av1.database import (
    image_ids_from_pair_id,
    keypoints_from_row,
    matches_from_row,
    pair_id_from_image_ids,
)
from colmap_av1.database_file import check_layout, open_unaltered
from colmap_av1.errors import DatabaseError, ImageError, OptionError, cannot_write
from colmap_av1.files import remove_leftovers, whole_file
from colmap_av1.images import image_file, read_image
from colmap_av1.model import read_model
from colmap_av1.motion import read_motion
from colmap_av1.options import ReadOptions, TrackOptions, ViewOptions
from colmap_av1.progress import Progress, no_progress
from colmap_av1.tracks import Tracks, build_tracks, order_by_frame, show_tracks
from colmap_av1.unchanged import unchanged
from colmap_av1.video import decode_frames, open_stream, presented_frames, read_display

_Image = NDArray[np.uint8]

# Tracks are one to a unit of 4x4 pixels at most.
_UNIT = 4
_GREY = 128
# Quantile of the motion that is drawn in full colour: the few fastest would pale the rest.
_FULL_COLOUR_QUANTILE = 0.95
_DEFAULT_FRAME_RATE = 25.0
# Set, because x264's output depends on their number.
_ENCODER_THREADS = 4
# Fractional bits of the coordinates that OpenCV draws at.
_SHIFT = 4
_WHEEL_SIZE = 48
_MAX_LINES = 300
_BACKGROUND = 24
# Quantiles between which points are shown.
_SHOWN = (0.02, 0.98)
_NO_COLOUR = 190
_PATH_COLOUR = (30, 60, 230)  # BGR
# Motion below this many pixels a frame is never drawn in full colour.
_LEAST_FULL_SPEED = 0.25
# Frames within which one track is drawn for each cell.
_FRAMES_PER_CHOICE = 8
# Frames after which a track is drawn in the colour of an old one.
_OLD_AGE = 32
_LAST_PORT = 65535


def view_video(
    video: str | os.PathLike[str],
    output: str | os.PathLike[str],
    *,
    options: ViewOptions | None = None,
    tracks: TrackOptions | None = None,
    read: ReadOptions | None = None,
    progress: Progress | None = None,
) -> int:
    """Draw motion and tracks over the frames of a video.

    Motion: each 4x4 unit that a track runs through is coloured by the direction in which it
    moves, deeper where it moves faster; the wheel in the corner is the key. Units whose motion
    is not trusted, and so carries no track, are grey. Tracks: a dot where each is, and a tail to
    where it was in the frames before, blue for a young track, red for an old one.

    Args:
        video: an AV1 video.
        output: an .mp4 file, or a folder that gets a PNG for each frame.
        options: what is drawn.
        tracks: how the motion is chained.
        read: how the bitstream is read.
        progress: called with a stage's name, what is done, and of how much where known.

    Returns:
        The number of frames drawn.

    Raises:
        OptionError: an option has a value that cannot work, or the output cannot be written.
        VideoError: the file cannot be read as a video, is not AV1, or changes meanwhile.
        BitstreamError: the stream is damaged before its second frame, or with strict.
    """
    options = options if options is not None else ViewOptions()
    _check_view_options(options)
    report = progress if progress is not None else no_progress
    path, operating_point = Path(output), read.operating_point if read is not None else 0
    count = 0
    with unchanged(Path(video)) as check_video:
        with open_stream(video) as stream:
            num_packets = stream.num_frames
            frame_rate = stream.frame_rate or _DEFAULT_FRAME_RATE
        if path.suffix and path.suffix.lower() != ".mp4" and not path.is_dir():
            raise OptionError(
                f"{path}: give an output that ends in .mp4, or a folder for PNG files"
            )
        chained = build_tracks(
            read_motion(video, read), tracks, lambda done: report("tracks", done, num_packets)
        )
        chained = show_tracks(chained, read_display(video), presented_frames(video))
        drawing = _prepare(chained, options)
        draw = [d for d in (_draw_motion, _draw_tracks) if options.draw in ("both", _NAMES[d])]
        check_video()
        with _open_pictures(path, frame_rate) as write:
            for index, picture in decode_frames(video, operating_point=operating_point):
                if index >= chained.num_frames:
                    break
                write(_side_by_side([panel(picture, drawing, index) for panel in draw]))
                count += 1
                report("pictures", count, chained.num_frames)
            check_video()
    return count


def view_database(
    database: str | os.PathLike[str],
    image_path: str | os.PathLike[str],
    pair: Sequence[str] | None = None,
) -> _Image:
    """Draw the matches between two images of a COLMAP database.

    Args:
        database: any COLMAP database; it is not altered.
        image_path: folder of its images.
        pair: names of two images; None: the pair with the most inliers.

    Returns:
        uint8 BGR picture with the images beside each other, wide ones above each other, their
        inlier matches drawn as lines; the matches, where the pair was not verified.

    Raises:
        DatabaseError: the file is no COLMAP database, or has no matches of the pair.
        ImageError: an image is missing or unreadable.
    """
    path = Path(database)
    names, keypoints, matches = _read_pair(path, pair)
    pictures = []
    for name, xy in zip(names, keypoints, strict=True):
        picture = read_image(image_file(Path(image_path), name))
        if len(xy) and np.any(xy.max(axis=0) > [picture.shape[1], picture.shape[0]]):
            raise ImageError(
                f"{Path(image_path) / name}: is smaller than its keypoints say: give the "
                "images that were matched"
            )
        pictures.append(picture)
    return _draw_matches(pictures[0], pictures[1], keypoints[0], keypoints[1], matches)


def _read_pair(
    path: Path, pair: Sequence[str] | None
) -> tuple[tuple[str, str], list[NDArray[np.float32]], NDArray[np.uint32]]:
    """Names of a pair, keypoints [n, 2] of both images, and matches [m, 2] between them."""
    with open_unaltered(path) as connection:
        check_layout(connection, path)
        images = dict(connection.execute("SELECT name, image_id FROM images").fetchall())
        if pair is None:
            row = connection.execute(
                "SELECT pair_id FROM two_view_geometries ORDER BY rows DESC, pair_id LIMIT 1"
            ).fetchone()
            if row is None:
                raise DatabaseError(f"{path}: holds no verified pair: run 'colmap-av1 match' first")
            ids = image_ids_from_pair_id(row[0])
        else:
            missing = next((name for name in pair if name not in images), None)
            if missing is not None:
                raise DatabaseError(f"{path}: lists no image {missing!r}: give two it lists")
            ids = (images[pair[0]], images[pair[1]])
        pair_id = pair_id_from_image_ids(*ids)
        matches = np.empty((0, 2), dtype=np.uint32)
        for table in ("two_view_geometries", "matches"):
            row = connection.execute(
                f"SELECT rows, data FROM {table} WHERE pair_id = ?", (pair_id,)
            ).fetchone()
            if row is not None and row[0] > 0:
                matches = matches_from_row(path, pair_id, *row)
                break
        name_of = {image_id: name for name, image_id in images.items()}
        names = (name_of[ids[0]], name_of[ids[1]])
        if len(matches) == 0:
            raise DatabaseError(
                f"{path}: has no matches of {names[0]!r} and {names[1]!r}: give another pair"
            )
        keypoints = []
        for image_id in ids:
            row = connection.execute(
                "SELECT rows, cols, data FROM keypoints WHERE image_id = ?", (image_id,)
            ).fetchone()
            keypoints.append(keypoints_from_row(path, image_id, *(row or (0, 2, None)))[:, :2])
    if ids[0] > ids[1]:
        matches = matches[:, ::-1]
    if np.any(matches.max(axis=0) >= [len(k) for k in keypoints]):
        raise DatabaseError(
            f"{path}: {names[0]!r} and {names[1]!r} match keypoints that are not there: "
            "'colmap-av1 check' says what else is wrong"
        )
    return names, keypoints, matches


def _draw_matches(
    first: _Image,
    second: _Image,
    keypoints1: NDArray[np.float32],
    keypoints2: NDArray[np.float32],
    matches: NDArray[np.uint32],
) -> _Image:
    """Draw matches between two pictures: at most _MAX_LINES, spread over the first."""
    height, width = np.maximum(first.shape[:2], second.shape[:2])
    panels = [
        np.pad(image, ((0, height - image.shape[0]), (0, width - image.shape[1]), (0, 0)))
        for image in (first, second)
    ]
    picture = _side_by_side(panels)
    shift = np.array([picture.shape[1] - width, picture.shape[0] - height], dtype=np.float32)
    a, b = keypoints1[matches[:, 0]], keypoints2[matches[:, 1]]
    # In the order of a coarse raster, every n-th match is spread over the image.
    order = np.lexsort((a[:, 0], a[:, 1] // 16))
    chosen = order[:: max(1, math.ceil(len(order) / _MAX_LINES))]
    hue = np.linspace(0, 179, len(chosen)) if len(chosen) else np.empty(0)
    full = np.full(len(chosen), 255.0)
    ends = np.stack([a[chosen], b[chosen] + shift], axis=1)
    for line, colour in zip(_fixed_point(ends), _bgr(hue, full, full), strict=True):
        cv2.polylines(picture, [line], False, colour.tolist(), 1, cv2.LINE_AA, _SHIFT)
        for point in line:
            cv2.circle(
                picture, point.tolist(), 2 << _SHIFT, colour.tolist(), -1, cv2.LINE_AA, _SHIFT
            )
    return picture


def view_model(model: str | os.PathLike[str], *, size: tuple[int, int] = (1600, 1200)) -> _Image:
    """Draw the points and the camera path of a COLMAP model from three sides and obliquely.

    Args:
        model: folder of the model (cameras, images, points3D; .bin or .txt).
        size: (width, height) of the picture in pixels.

    Returns:
        uint8 [height, width, 3] BGR.

    Raises:
        ModelError: the folder holds no model, or one without poses.
    """
    scene = _read_scene(model)
    width, height = size[0] // 2, size[1] // 2
    right, up, back = scene.axes
    oblique = _normalised(back - 0.5 * right + 0.7 * up)
    oblique_right = _normalised(np.cross(up, oblique))
    views = [
        ("from behind and above", oblique_right, np.cross(oblique, oblique_right)),
        ("top", right, -back),
        ("front", right, up),
        ("side", -back, up),
    ]
    panels = [_draw_scene(scene, title, x, y, (width, height)) for title, x, y in views]
    rows = [np.concatenate(panels[i : i + 2], axis=1) for i in (0, 2)]
    return np.concatenate(rows, axis=0)


def serve_model(model: str | os.PathLike[str], *, port: int = 8080) -> Any:
    """Show a COLMAP model in the browser: points, cameras and their path.

    Args:
        model: folder of the model.
        port: TCP port on this computer only.

    Returns:
        The running server; `stop()` ends it.

    Raises:
        ModelError: the folder holds no model, or one without poses.
        OptionError: the viewer's package is not installed, or the port is none or taken.
    """
    if not 0 < port <= _LAST_PORT:
        raise OptionError(f"port is {port}: give 1 to {_LAST_PORT}")
    scene = _read_scene(model)
    try:
        import viser  # noqa: PLC0415 - an extra that only this function needs
    except ImportError as error:
        raise OptionError(
            "the interactive viewer is not installed: pip install 'colmap-av1[viewer]', or give "
            "--output for a picture"
        ) from error
    server = viser.ViserServer(host="127.0.0.1", port=port, verbose=False)
    if server.get_port() != port:
        taken_instead = server.get_port()
        server.stop()
        raise OptionError(f"port {port} is taken: give another --port, such as {taken_instead}")
    server.scene.set_up_direction(tuple(scene.axes[1]))
    extent = scene.extent
    server.scene.add_point_cloud("/points", scene.points, scene.colours, point_size=extent / 1000)
    for i, (centre, qvec) in enumerate(zip(scene.centres, scene.qvecs, strict=True)):
        server.scene.add_camera_frustum(
            f"/cameras/{i:06d}",
            fov=scene.fov,
            aspect=scene.aspect,
            scale=extent / 60,
            wxyz=qvec,
            position=centre,
        )
    if len(scene.centres) > 1:
        path = np.stack([scene.centres[:-1], scene.centres[1:]], axis=1)
        server.scene.add_line_segments("/path", path, colors=(230, 60, 30))
    return server


def write_picture(picture: _Image, output: str | os.PathLike[str]) -> None:
    """Write a picture as PNG or JPEG, by the extension; whole or not at all.

    Raises:
        OptionError: another extension, or the file cannot be written.
    """
    path = Path(output)
    if path.suffix.lower() not in (".png", ".jpg", ".jpeg"):
        raise OptionError(f"{path}: give an output that ends in .png or .jpg")
    _, encoded = cv2.imencode(path.suffix.lower(), picture)
    with _output(path) as partial:
        partial.write_bytes(encoded.tobytes())


@dataclass(frozen=True)
class _Drawing:
    """Tracks as they are drawn.

    Attributes:
        tracks: all of them.
        options: what is drawn.
        by_frame: int64 [num_observations] observations sorted by frame.
        bounds: int64 [num_frames + 1] bounds of the frames in `by_frame`.
        age: int64 [num_observations] observations of the track before this one.
        velocity: float32 [num_observations, 2] pixels per frame, from the observation before;
            at a track's start to the next.
        full_speed: pixels per frame that are drawn in full colour.
        has_tail: bool [num_observations] of a track that is drawn as such.
    """

    tracks: Tracks
    options: ViewOptions
    by_frame: NDArray[np.int64]
    bounds: NDArray[np.int64]
    age: NDArray[np.int64]
    velocity: NDArray[np.float32]
    full_speed: float
    has_tail: NDArray[np.bool_]

    def seen_in(self, frame: int) -> NDArray[np.int64]:
        """The observations in a frame."""
        return self.by_frame[self.bounds[frame] : self.bounds[frame + 1]]


def _prepare(tracks: Tracks, options: ViewOptions) -> _Drawing:
    length = np.diff(tracks.offsets)
    by_frame = order_by_frame(tracks.frame, tracks.num_frames)
    step = np.diff(tracks.xy, axis=0, prepend=tracks.xy[:1])
    interval = np.diff(tracks.frame, prepend=tracks.frame[:1])
    starts = tracks.offsets[:-1][length > 1]
    step[starts], interval[starts] = step[starts + 1], interval[starts + 1]
    velocity = (step / np.maximum(interval, 1)[:, None]).astype(np.float32)
    speed = np.hypot(velocity[:, 0], velocity[:, 1])
    full_speed = float(np.quantile(speed, _FULL_COLOUR_QUANTILE)) if speed.size else 0.0
    return _Drawing(
        tracks=tracks,
        options=options,
        by_frame=by_frame,
        bounds=np.searchsorted(tracks.frame[by_frame], np.arange(tracks.num_frames + 1)),
        age=np.arange(tracks.frame.size) - np.repeat(tracks.offsets[:-1], length),
        velocity=velocity,
        full_speed=max(full_speed, _LEAST_FULL_SPEED),
        has_tail=np.repeat(_is_spread(tracks, options.spacing), length),
    )


def _is_spread(tracks: Tracks, spacing: int) -> NDArray[np.bool_]:
    """Choose long tracks that start in different cells of `spacing` pixels: bool [num_tracks].

    Of the tracks that start in a cell within as many frames as tails are long, the longest.
    """
    length = np.diff(tracks.offsets)
    start = tracks.offsets[:-1]
    cell = np.floor(tracks.xy[start] / max(spacing, 1)).astype(np.int64)
    time = tracks.frame[start] // _FRAMES_PER_CHOICE
    key = np.lexsort((-length, cell[:, 0], cell[:, 1], time))
    place = np.column_stack([time, cell])[key]
    first = np.ones(len(key), dtype=bool)
    first[1:] = np.any(place[1:] != place[:-1], axis=1)
    chosen = np.zeros(len(key), dtype=bool)
    chosen[key[first]] = True
    return chosen


def _draw_motion(picture: _Image, drawing: _Drawing, frame: int) -> _Image:
    """Colour every unit that a track runs through by the direction of its motion."""
    height, width = picture.shape[:2]
    rows, cols = -(-height // _UNIT), -(-width // _UNIT)
    seen = drawing.seen_in(frame)
    unit = np.floor(drawing.tracks.xy[seen] / _UNIT).astype(np.int64)
    colours = np.full((rows, cols, 3), _GREY, dtype=np.uint8)
    row, col = np.clip(unit[:, 1], 0, rows - 1), np.clip(unit[:, 0], 0, cols - 1)
    colours[row, col] = _direction_colours(drawing.velocity[seen] / drawing.full_speed)
    wheel = _direction_wheel(min(_WHEEL_SIZE, height // 4, width // 4))
    overlay = colours.repeat(_UNIT, axis=0).repeat(_UNIT, axis=1)[:height, :width]
    grey = cv2.cvtColor(cv2.cvtColor(picture, cv2.COLOR_BGR2GRAY), cv2.COLOR_GRAY2BGR)
    opacity = drawing.options.opacity
    drawn = np.asarray(cv2.addWeighted(grey, 1 - opacity, overlay, opacity, 0), dtype=np.uint8)
    corner = drawn[: wheel.shape[0], : wheel.shape[1]]
    corner[...] = np.where(wheel.any(axis=2, keepdims=True), wheel, corner)
    return drawn


def _draw_tracks(picture: _Image, drawing: _Drawing, frame: int) -> _Image:
    """Draw a dot for each chosen track, and a tail to its places in the frames before."""
    drawn = picture.copy()
    seen = drawing.seen_in(frame)
    seen = seen[drawing.has_tail[seen]]
    tail = drawing.options.tail
    shade = np.minimum(drawing.age[seen] * 255 // _OLD_AGE, 255).astype(np.uint8)
    table = np.asarray(cv2.applyColorMap(np.arange(256, dtype=np.uint8)[None], cv2.COLORMAP_TURBO))
    steps = np.minimum(drawing.age[seen], tail)
    points = _fixed_point(drawing.tracks.xy)
    for last, count, colour in zip(seen, steps, table[0, shade].tolist(), strict=True):
        line = points[last - count : last + 1]
        cv2.polylines(drawn, [line], False, colour, 1, cv2.LINE_AA, _SHIFT)
        cv2.circle(drawn, line[-1].tolist(), 1 << _SHIFT, colour, -1, cv2.LINE_AA, _SHIFT)
    return np.asarray(drawn)


# What each value of ViewOptions.draw stands for; both for both.
_NAMES = {_draw_motion: "motion", _draw_tracks: "tracks"}


def _side_by_side(panels: Sequence[_Image]) -> _Image:
    """Pictures of one size beside each other, wide ones above each other."""
    wide = panels[0].shape[1] > panels[0].shape[0]
    return np.asarray(np.concatenate(panels, axis=0 if wide else 1), dtype=np.uint8)


def _fixed_point(xy: NDArray[np.float32]) -> NDArray[np.int32]:
    """COLMAP's pixel coordinates as OpenCV draws them: pixel centres at whole numbers."""
    return np.asarray(np.round((xy - 0.5) * (1 << _SHIFT)), dtype=np.int32)


def _direction_colours(velocity: NDArray[np.floating[Any]]) -> NDArray[np.uint8]:
    """Colours [n, 3] of velocities [n, 2]: hue by direction, saturated at length 1."""
    angle = np.degrees(np.arctan2(velocity[:, 1], velocity[:, 0])) % 360
    saturation = 255 * np.minimum(np.hypot(velocity[:, 0], velocity[:, 1]), 1)
    return _bgr(angle / 2, saturation, np.full(len(angle), 255.0))


def _direction_wheel(size: int) -> _Image:
    """The key to `_direction_colours`: [size, size, 3], black outside the wheel."""
    y, x = np.mgrid[:size, :size]
    offset = np.stack([x, y], axis=-1).reshape(-1, 2) * (2 / max(size - 1, 1)) - 1
    colours = _direction_colours(offset)
    colours[np.hypot(offset[:, 0], offset[:, 1]) > 1] = 0
    return colours.reshape(size, size, 3)


def _bgr(
    hue: NDArray[np.floating[Any]],
    saturation: NDArray[np.floating[Any]],
    value: NDArray[np.floating[Any]],
) -> NDArray[np.uint8]:
    """BGR colours [n, 3] of OpenCV's hue (0 to 180), saturation and value (0 to 255)."""
    hsv = np.stack([hue, saturation, value], axis=-1).astype(np.uint8)
    if len(hsv) == 0:  # OpenCV refuses empty arrays
        return hsv
    return np.asarray(cv2.cvtColor(hsv[None], cv2.COLOR_HSV2BGR)[0], dtype=np.uint8)


@contextmanager
def _open_pictures(path: Path, frame_rate: float) -> Iterator[Callable[[_Image], None]]:
    """Write pictures to an .mp4 file, or numbered to a folder."""
    if path.suffix.lower() != ".mp4":
        count = 0

        def write_file(picture: _Image) -> None:
            nonlocal count
            write_picture(picture, path / f"frame_{count:06d}.png")
            count += 1

        try:
            path.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise OptionError(
                f"{path}: cannot be made: {error.strerror}: mend that, or give another path"
            ) from error
        yield write_file
        return
    with _output(path) as partial, av.open(str(partial), "w", "mp4") as container:
        rate = Fraction(frame_rate).limit_denominator(1001)
        stream: Any = container.add_stream("libx264", rate, options={"crf": "18"})
        stream.pix_fmt = "yuv420p"
        stream.codec_context.thread_count = _ENCODER_THREADS
        size: tuple[int, int] | None = None

        def write_frame(picture: _Image) -> None:
            nonlocal size
            # 4:2:0 has no odd sizes; a video has one size.
            if size is None:
                size = (picture.shape[1] + 1 & ~1, picture.shape[0] + 1 & ~1)
                stream.width, stream.height = size
            fitted = cv2.copyMakeBorder(
                picture[: size[1], : size[0]],
                *(0, max(0, size[1] - picture.shape[0]), 0, max(0, size[0] - picture.shape[1])),
                cv2.BORDER_CONSTANT,
            )
            container.mux(stream.encode(av.VideoFrame.from_ndarray(fitted, format="bgr24")))

        yield write_frame
        if size is not None:
            container.mux(stream.encode(None))


@contextmanager
def _output(path: Path) -> Iterator[Path]:
    """A `whole_file`, whose errors become ours."""
    try:
        remove_leftovers(path.parent, path.name)
        with whole_file(path) as partial:
            yield partial
    except (OSError, av.error.FFmpegError) as error:
        raise OptionError(cannot_write(path, error)) from error


@dataclass(frozen=True)
class _Scene:
    """A model as it is drawn.

    Attributes:
        points: float32 [n, 3].
        colours: uint8 [n, 3] RGB.
        centres: float64 [m, 3] of the registered cameras, in the order of the images' names.
        qvecs: float64 [m, 4] (w, x, y, z) rotations from camera to world.
        axes: float64 [3, 3] unit vectors to the right, up and back as most cameras see them.
        extent: length of the diagonal of most of the scene.
        fov: vertical field of view of the first camera in radians.
        aspect: its width by its height.
    """

    points: NDArray[np.float32]
    colours: NDArray[np.uint8]
    centres: NDArray[np.float64]
    qvecs: NDArray[np.float64]
    axes: NDArray[np.float64]
    extent: float
    fov: float
    aspect: float


def _read_scene(model: str | os.PathLike[str]) -> _Scene:
    reconstruction = read_model(model)
    points = list(reconstruction.points3D.values())
    images = sorted(
        (reconstruction.images[i] for i in reconstruction.reg_image_ids()), key=lambda i: i.name
    )
    rotations = np.array([i.cam_from_world().rotation.matrix().T for i in images])
    # Cameras look along their third axis with the second pointing down.
    back = _normalised(-rotations[:, :, 2].mean(axis=0))
    up = -rotations[:, :, 1].mean(axis=0)
    up = _normalised(up - back * (up @ back))
    xyz = np.array([p.xyz for p in points], dtype=np.float32).reshape(-1, 3)
    centres = np.array([i.projection_center() for i in images])
    low, high = np.quantile(np.concatenate([xyz, centres]), _SHOWN, axis=0)
    colours = np.array([p.color for p in points], dtype=np.uint8).reshape(-1, 3)
    if not colours.any():  # mapped without images
        colours[:] = _NO_COLOUR
    camera = images[0].camera
    return _Scene(
        points=xyz,
        colours=colours,
        centres=centres,
        qvecs=np.array([np.roll(i.cam_from_world().inverse().rotation.quat, 1) for i in images]),
        axes=np.stack([np.cross(up, back), up, back]),
        extent=float(np.linalg.norm(high - low)),
        fov=2 * math.atan2(camera.height / 2, camera.mean_focal_length()),
        aspect=camera.width / camera.height,
    )


def _draw_scene(
    scene: _Scene,
    title: str,
    right: NDArray[np.float64],
    up: NDArray[np.float64],
    size: tuple[int, int],
) -> _Image:
    """An orthographic view, near points over far ones, and the camera path."""
    width, height = size
    towards = np.cross(right, up)
    plane = np.stack([right, -up])
    flat = scene.points @ plane.T
    path = scene.centres @ plane.T
    # All cameras, and most points: a few lie far away.
    low, high = np.quantile(flat, _SHOWN, axis=0) if len(flat) else (path[0], path[0])
    low, high = np.minimum(low, path.min(axis=0)), np.maximum(high, path.max(axis=0))
    scale = 0.9 * float(np.min(np.array(size) / np.maximum(high - low, 1e-9)))
    origin = np.array(size) / 2 - scale * (low + high) / 2
    picture = np.full((height, width, 3), _BACKGROUND, dtype=np.uint8)
    far_first = np.argsort(scene.points @ towards, kind="stable")
    x, y = np.floor(flat[far_first] * scale + origin).astype(np.int64).T
    colours = scene.colours[far_first, ::-1]
    inside = (x >= 0) & (x < width - 1) & (y >= 0) & (y < height - 1)
    for dx, dy in ((0, 0), (1, 0), (0, 1), (1, 1)):
        picture[y[inside] + dy, x[inside] + dx] = colours[inside]
    line = _fixed_point(np.asarray(path * scale + origin, dtype=np.float32))
    cv2.polylines(picture, [line], False, _PATH_COLOUR, 2, cv2.LINE_AA, _SHIFT)
    for centre in line:
        cv2.circle(picture, centre.tolist(), 2 << _SHIFT, _PATH_COLOUR, -1, cv2.LINE_AA, _SHIFT)
    text = f"{title}: {len(flat)} points, {len(path)} cameras"
    cv2.putText(picture, text, (8, 18), cv2.FONT_HERSHEY_SIMPLEX, 0.5, (255,) * 3, 1, cv2.LINE_AA)
    return picture


def _normalised(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(vector / max(float(np.linalg.norm(vector)), 1e-12))


def _check_view_options(options: ViewOptions) -> None:
    if options.draw not in ("motion", "tracks", "both"):
        raise OptionError(f"draw is {options.draw!r}: give 'motion', 'tracks' or 'both'")
    if not 0 <= options.opacity <= 1:
        raise OptionError(f"opacity is {options.opacity}: give a share from 0 to 1")
    if options.tail < 0:
        raise OptionError(f"tail is {options.tail}: give 0 or more frames")
    if options.spacing < 1:
        raise OptionError(f"spacing is {options.spacing}: give 1 or more pixels")
