"""Find faults and properties of a database that matter to COLMAP's mappers."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import pycolmap

from colmap_av1.check.contents import Images, Pairs
from colmap_av1.check.parallax import Parallax
from colmap_av1.database.layout import columns
from colmap_av1.errors import ImageError
from colmap_av1.geometry.cameras import (
    MAPPER_FOCAL_RATIOS,
    MAPPER_MAX_DISTORTION,
    camera_fault,
    focal_length_warning,
)
from colmap_av1.matching.depth import DepthEvidence
from colmap_av1.matching.few_matches import few_matches_warning
from colmap_av1.matching.gaps import Gap
from colmap_av1.matching.mapper_limits import (
    FORWARD_MOTION,
    INITIAL_MIN_ANGLE,
    INITIAL_MIN_INLIERS,
    INITIAL_SMALL_ANGLE,
    MIN_INLIERS,
    SMALL_ANGLES,
)
from colmap_av1.matching.two_view_geometry import TwoViewConfig
from colmap_av1.util.texts import check_name

Severity = Literal["error", "warning", "note"]

# A smaller share of keypoints without a match is not reported.
_NOTED_SHARE = 0.01
# Keypoints up to this many pixels outside their image are accepted, because of rounding.
_MARGIN = 1.0


@dataclass(frozen=True)
class Finding:
    """One finding in a database that matters for mapping it.

    Attributes:
        severity: "error": mappers stop or find nothing; "warning": data is lost, or some program
            stops; "note": nothing is wrong.
        text: one line.
        damage: whether the file is damaged or mixes data of several databases.
    """

    severity: Severity
    text: str
    damage: bool = False


def _some(names: Sequence[str], what: str) -> str:
    """Count names and give an example, such as "3 images (a.png, ...)"."""
    plural = "s" if len(names) > 1 else ""
    # A name may contain any character, including line breaks.
    first = names[0] if names[0].isprintable() and names[0] else repr(names[0])
    return f"{len(names)} {what}{plural} ({first}{', ...' if plural else ''})"


def image_findings(images: Images, cameras: dict[int, pycolmap.Camera]) -> Iterator[Finding]:
    """Images without a camera, cameras without a focal length prior, sizes, order of names."""
    if len(images.ids) == 0:
        yield Finding("error", "lists no images")
        return
    lost = [n for n, c in zip(images.names, images.camera_ids, strict=True) if c not in cameras]
    if lost:
        yield Finding("error", f"{_some(lost, 'image')} without a camera: the mappers stop")
    unknown = sum(not camera.has_prior_focal_length for camera in cameras.values())
    if unknown:
        yield Finding(
            "note",
            f"{unknown} of {len(cameras)} cameras have no focal length prior: the stored value is "
            "only where the mappers start",
        )
    used = set(images.camera_ids)
    sizes = {(c.width, c.height) for i, c in cameras.items() if i in used}
    if len(sizes) > 1:
        yield Finding("note", f"images have {len(sizes)} sizes")
    if images.names != sorted(images.names):
        yield Finding(
            "note", "image ids do not follow the order of names: identify images by name, not id"
        )


def value_findings(
    images: Images, pairs: Pairs, cameras: dict[int, pycolmap.Camera]
) -> Iterator[Finding]:
    """Values that no program can use: names, cameras, positions, pairs."""
    yield from _name_findings(images)
    yield from _camera_findings(cameras)
    yield from _position_findings(images, cameras)
    for count, fault in (
        (pairs.num_with_itself, "of an image with itself"),
        (pairs.num_swapped, "stored under the larger image id first"),
    ):
        if count:
            yield Finding(
                "warning", f"{count} pairs are {fault}: mappers confuse their images", damage=True
            )


def _name_findings(images: Images) -> Iterator[Finding]:
    if "" in images.names:
        yield Finding("error", "an image has no name: programs find no file for it")
    unusable = [name for name in images.names if name and not _is_usable(name)]
    if unusable:
        yield Finding(
            "error",
            f"{_some(unusable, 'image')} with a name outside the image folder or an invalid file "
            "name: use the path within the folder",
        )


def _is_usable(name: str) -> bool:
    try:
        check_name(name)
    except ImageError:
        return False
    return True


def _camera_findings(cameras: dict[int, pycolmap.Camera]) -> Iterator[Finding]:
    faults = {i: camera_fault(camera) for i, camera in cameras.items()}
    for camera_id, fault in faults.items():
        if fault:
            yield Finding("error", f"camera {camera_id} has {fault}: mappers stop or find nothing")
            break
    warning = focal_length_warning(c for i, c in cameras.items() if not faults[i])
    if warning is not None:
        yield Finding("warning", warning)
    implausible = [
        str(i)
        for i, camera in cameras.items()
        if not faults[i] and camera.has_bogus_params(*MAPPER_FOCAL_RATIOS, MAPPER_MAX_DISTORTION)
    ]
    if implausible:
        yield Finding(
            "warning",
            f"{_some(implausible, 'camera')} with implausible parameters: mappers ignore their "
            "images unless they refine the parameters",
        )


def _position_findings(images: Images, cameras: dict[int, pycolmap.Camera]) -> Iterator[Finding]:
    unknown, outside = [], []
    for name, camera_id, xy in zip(images.names, images.camera_ids, images.keypoints, strict=True):
        if not np.isfinite(xy).all():
            unknown.append(name)
        elif len(xy) and camera_id in cameras:
            size = np.array([cameras[camera_id].width, cameras[camera_id].height], np.float64)
            if np.any(xy < -_MARGIN) or np.any(xy > size + _MARGIN):
                outside.append(name)
    if unknown:
        yield Finding(
            "error", f"{_some(unknown, 'image')} with keypoints that are not numbers: mappers hang"
        )
    if outside:
        yield Finding(
            "warning",
            f"{_some(outside, 'image')} with keypoints outside the image: compare the camera's "
            "size with that of the images",
            damage=True,
        )


def frame_findings(connection: sqlite3.Connection, images: Images) -> Iterator[Finding]:
    """Images without a frame, in layouts that have frames."""
    if not (columns(connection, "frames") and columns(connection, "frame_data")):
        return
    rigs = dict(
        connection.execute("SELECT rig_id, ref_sensor_id FROM rigs WHERE ref_sensor_type = 0")
    )
    framed = {
        row[0] for row in connection.execute("SELECT data_id FROM frame_data WHERE sensor_type = 0")
    }
    if framed or connection.execute("SELECT 1 FROM frames LIMIT 1").fetchone():
        bare = [
            name
            for image_id, name in zip(images.ids, images.names, strict=True)
            if int(image_id) not in framed
        ]
        if bare:
            yield Finding(
                "error",
                f"{_some(bare, 'image')} without a frame while others have one: mappers of COLMAP "
                "3.12 and later stop; 'colmap-av1 match' adds the missing frames",
            )
    elif rigs and any(rigs.get(camera_id) != camera_id for camera_id in images.camera_ids):
        yield Finding("error", "has rigs but no frames: mappers of COLMAP 3.12 and later stop")


def keypoint_findings(images: Images, pairs: Pairs) -> Iterator[Finding]:
    """Images without keypoints, keypoints without matches, unequal numbers of descriptors."""
    counts = [len(k) for k in images.keypoints]
    if counts and not any(counts):
        yield Finding("error", "no image has keypoints: extract and match features first")
        return
    in_pair = np.zeros(len(counts), dtype=np.bool_)
    in_pair[pairs.index[pairs.num_inliers >= MIN_INLIERS].ravel()] = True
    bare = [n for n, c, p in zip(images.names, counts, in_pair, strict=True) if p and not c]
    if bare:
        yield Finding(
            "error", f"{_some(bare, 'image')} with matches but without keypoints: most mappers stop"
        )
    elif pairs.num_astray:
        yield Finding(
            "warning",
            f"{pairs.num_astray} pairs match keypoints that do not exist: mappers ignore these "
            "matches, and the others may belong to the wrong keypoints",
            damage=True,
        )
    empty = [n for n, c in zip(images.names, counts, strict=True) if not c]
    if empty and not bare:
        yield Finding("warning", f"{_some(empty, 'image')} without keypoints")
    uneven = [
        name
        for name, count, described in zip(images.names, counts, images.num_descriptors, strict=True)
        if described not in (-1, count)
    ]
    if uneven:
        yield Finding(
            "warning",
            f"{_some(uneven, 'image')} with different numbers of descriptors and keypoints: guided "
            "matching and vocabulary trees stop, mappers ignore it",
        )
    total, matched = sum(counts), sum(int(np.count_nonzero(m)) for m in pairs.matched)
    if total - matched > _NOTED_SHARE * total:
        yield Finding("note", f"{(total - matched) / total:.1%} of the keypoints have no match")


def pair_findings(pairs: Pairs, images: Images) -> Iterator[Finding]:
    """Pairs that the mappers ignore, and why."""
    used = pairs.used
    unverified = np.count_nonzero((pairs.num_matches >= MIN_INLIERS) & (pairs.num_inliers < 0))
    if unverified:
        yield Finding(
            "warning",
            f"{unverified} pairs have matches that were never verified: mappers ignore them; run "
            "one of COLMAP's matchers, which verifies them",
        )
    if any(map(len, images.keypoints)) and not used.any():
        yield Finding("error", f"no pair has {MIN_INLIERS} verified matches: mappers find nothing")
    few = np.count_nonzero((pairs.num_inliers > 0) & (pairs.num_inliers < MIN_INLIERS))
    if few:
        yield Finding(
            "note", f"{few} pairs have fewer than {MIN_INLIERS} inliers: mappers ignore them"
        )
    for config, why in (
        (
            TwoViewConfig.UNDEFINED,
            "their geometry was never estimated: mappers of COLMAP 4.2 and later",
        ),
        (
            TwoViewConfig.DEGENERATE,
            "their geometry is degenerate: mappers of COLMAP 4.2 and later",
        ),
        (TwoViewConfig.WATERMARK, "they match a watermark: mappers"),
    ):
        count = np.count_nonzero((pairs.num_inliers >= MIN_INLIERS) & (pairs.config == config))
        if count:
            yield Finding(
                "note" if config == TwoViewConfig.WATERMARK else "warning",
                f"{count} pairs have inliers, but {why} ignore them",
            )
    multiple = np.count_nonzero(used & (pairs.config == TwoViewConfig.MULTIPLE))
    if multiple:
        yield Finding(
            "note", f"{multiple} pairs have several geometries: the global mapper ignores them"
        )
    unpaired = np.count_nonzero(used & (pairs.num_matches < 0))
    if unpaired:
        yield Finding(
            "warning",
            f"{unpaired} verified pairs have no row in 'matches': standalone GLOMAP ignores them, "
            "and COLMAP's matchers match them again",
        )
    empty = np.count_nonzero((pairs.num_inliers == 0) & (pairs.num_matches <= 0))
    if empty:
        yield Finding(
            "note",
            f"{empty} pairs were matched without result: COLMAP's matchers skip them, 'colmap-av1 "
            "match' replaces them",
        )


def motion_findings(
    pairs: Pairs, parallax: Parallax | None, depth: DepthEvidence, group: int, num_images: int
) -> Iterator[Finding]:
    """Connectivity, parallax and forward motion: whether a mapper finds an initial pair."""
    used = pairs.used
    if parallax is None:
        return
    if group < num_images:
        yield Finding(
            "warning",
            f"pairs connect at most {group} of {num_images} images: the others are not registered, "
            "or become separate models",
        )
    if pairs.num_inliers[used].max() < INITIAL_MIN_INLIERS:
        yield Finding(
            "warning",
            f"no pair has {INITIAL_MIN_INLIERS} inliers: the incremental mapper finds no initial "
            "pair unless --Mapper.init_min_num_inliers is lower",
        )
    if depth.warning is not None:
        yield Finding("warning" if depth.is_observable else "error", depth.warning)
    if parallax.angle is None:
        yield Finding("note", "parallax is unknown: the widest pairs have no stored model")
    elif parallax.angle < INITIAL_SMALL_ANGLE:
        yield Finding(
            "warning",
            f"parallax of {parallax.angle:.1f} degrees: the incremental mapper may find no initial "
            "pair; use the global mapper",
        )
    elif parallax.angle < INITIAL_MIN_ANGLE:
        yield Finding(
            "note",
            f"parallax of {parallax.angle:.1f} degrees: the incremental mapper starts sooner with "
            f"{' '.join(SMALL_ANGLES.words)}",
        )
    if parallax.is_forward:
        yield Finding(
            "warning",
            "the camera moves along its axis: the incremental mapper starts only with "
            f"{' '.join(FORWARD_MOTION.words)}, and the focal length is not observable",
        )


def gap_findings(gaps: Sequence[Gap]) -> Iterator[Finding]:
    """Gaps between images of a video with few matches across them, in one finding."""
    text = few_matches_warning(gaps)
    if text is not None:
        yield Finding("warning", text)


def orphan_findings(connection: sqlite3.Connection, pairs: Pairs) -> Iterator[Finding]:
    """Rows of images that are not listed."""
    if pairs.num_foreign:
        yield Finding(
            "error",
            f"{pairs.num_foreign} pairs have images that are not listed: mappers of COLMAP 3.12 "
            "and later stop",
        )
    for table in ("keypoints", "descriptors"):
        if not columns(connection, table):
            continue
        (count,) = connection.execute(
            f"SELECT COUNT(*) FROM {table} WHERE image_id NOT IN (SELECT image_id FROM images)"
        ).fetchone()
        if count:
            yield Finding("note", f"{count} rows of '{table}' belong to no image")
