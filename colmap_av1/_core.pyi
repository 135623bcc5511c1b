"""Types of the C++ core (csrc/bindings)."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_av1.motion.frame_motion import FrameMotion

_TrackArrays = tuple[
    int,
    int,
    int,
    NDArray[np.int64],
    NDArray[np.int32],
    NDArray[np.float32],
    NDArray[np.float32],
]

class BitstreamError(Exception): ...
class LimitError(Exception): ...

class Event:
    decode_index: int
    shown_decode_index: int
    temporal_unit: int
    num_units: int
    num_wrong_trailing_bits: int
    is_repeated: bool
    is_shown: bool
    is_shown_key_frame: bool
    def header(self) -> dict[str, Any]: ...
    def take_blocks(self) -> tuple[NDArray[np.uint8], NDArray[np.int32], NDArray[np.int32]]: ...
    def tile_sizes(self) -> NDArray[np.int32]: ...
    def ref_decode_index(self) -> NDArray[np.int32]: ...
    def ref_size(self) -> NDArray[np.int32]: ...
    def slot_decode_index(self) -> NDArray[np.int32]: ...

class RestartPoint: ...

class Parser:
    def __init__(
        self,
        operating_point: int = 0,
        headers_only: bool = False,
        num_threads: int = 1,
        strict: bool = False,
        max_frame_size: int = 268435456,
    ) -> None: ...
    def parse(self, data: bytes | memoryview, position: int = 0) -> tuple[Event | None, int]: ...
    def finish(self) -> None: ...
    def restart_point(self) -> RestartPoint: ...
    def restart(self, point: RestartPoint) -> None: ...
    def sequence_header(self) -> dict[str, int] | None: ...

class TrackBuilderOptions:
    min_length: int
    cosine: float | None
    cosine_relative_to_dominant: bool
    cosine_scale: float
    max_interval: int | None
    max_block_area: int | None
    max_uncoded_block_area: int | None
    smoothness: float | None
    border: float | None
    interpolation: float | None
    bridge: float | None
    cells: int
    seeding: int
    stored_frames: list[int] | None
    tracks_per_sample: int
    def __init__(self) -> None: ...

class TrackBuilder:
    def __init__(self, options: TrackBuilderOptions) -> None: ...
    def add(self, frame: FrameMotion) -> None: ...
    def finish(self) -> tuple[_TrackArrays, _TrackArrays]: ...

def select_spread(
    *,
    num_frames: int,
    offsets: NDArray[np.int64],
    frame: NDArray[np.int32],
    xy: NDArray[np.float32],
    order: NDArray[np.int64],
    spacing: float,
    max_tracks_per_image: int,
    min_length: int,
) -> NDArray[np.uint8]: ...
def block_dtype() -> np.dtype[np.void]: ...
def displacement(frame: FrameMotion, list_index: int) -> NDArray[np.float32]: ...
def correlate_patches(
    one: NDArray[np.uint8],
    at_one: NDArray[np.float32],
    two: NDArray[np.uint8],
    at_two: NDArray[np.float32],
    *,
    min_deviation: float,
) -> NDArray[np.float32]: ...
def find_patches(
    patches: NDArray[np.uint8],
    index: NDArray[np.int64],
    *,
    middle: NDArray[np.float32],
    change: NDArray[np.float32],
    target: NDArray[np.uint8],
    start: NDArray[np.float32],
    max_move: float,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]: ...
def reprojection_errors(
    *,
    cam_from_world: NDArray[np.float64],
    focal: NDArray[np.float64],
    view: NDArray[np.int64],
    rays: NDArray[np.float64],
    xyz: NDArray[np.float64],
    offsets: NDArray[np.int64],
    observation: NDArray[np.int64],
) -> NDArray[np.float64]: ...
def widest_angles(
    *,
    centres: NDArray[np.float64],
    xyz: NDArray[np.float64],
    offsets: NDArray[np.int64],
    view: NDArray[np.int64],
) -> NDArray[np.float64]: ...
def floater_observations(
    *,
    cam_from_world: NDArray[np.float64],
    focal: NDArray[np.float64],
    view: NDArray[np.int64],
    rays: NDArray[np.float64],
    xyz: NDArray[np.float64],
    offsets: NDArray[np.int64],
    observation: NDArray[np.int64],
    distance_share: float,
    near_ratio: float,
    support: int,
    square_width: float,
    fewest_in_square: int,
) -> NDArray[np.int64]: ...
def points_in_view(
    cam_from_world: NDArray[np.float64],
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    xyz: NDArray[np.float64],
) -> tuple[NDArray[np.int64], NDArray[np.float64]]: ...
def points_in_picture(
    cam_from_world: NDArray[np.float64],
    pinhole: NDArray[np.float64],
    width: float,
    height: float,
    xyz: NDArray[np.float64],
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]: ...
def nearest_in_cells(
    xy: NDArray[np.float64],
    depth: NDArray[np.float64],
    *,
    cell: int,
    columns: int,
    rows: int,
) -> NDArray[np.float64]: ...
def best_at_spacings(
    xy: NDArray[np.float64],
    depth: NDArray[np.float64],
    rank: NDArray[np.int64],
    *,
    width: int,
    height: int,
    spacings: NDArray[np.int64],
    steps_per_octave: float,
    most_steps: int,
) -> NDArray[np.int64]: ...
def triangulate(
    *,
    cam_from_world: NDArray[np.float64],
    focal: NDArray[np.float64],
    offsets: NDArray[np.int64],
    view: NDArray[np.int64],
    rays: NDArray[np.float64],
    sigma: NDArray[np.float32],
    first: int,
    last: int,
    min_observations: int,
    max_reprojection_error: float,
    min_angle: float,
    max_depth_error: float | None,
    sigma_floor: float,
    error_to_sigma: float,
) -> tuple[
    NDArray[np.float64],
    NDArray[np.float64],
    NDArray[np.int64],
    NDArray[np.int64],
    int,
    int,
]: ...
