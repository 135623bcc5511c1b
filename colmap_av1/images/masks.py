"""Masks of frames and images: black pixels are ignored."""

from __future__ import annotations

import hashlib
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath

import cv2
import numpy as np
from numpy.typing import NDArray

from colmap_av1.errors import ImageError
from colmap_av1.geometry.masks import Mask, make_mask, valid_at
from colmap_av1.images.choosing import ChosenImages
from colmap_av1.images.files import READABLE
from colmap_av1.images.names import natural_key, pattern_regex
from colmap_av1.options.images import ImageOptions
from colmap_av1.tracks.tracks import Tracks
from colmap_av1.util.arrays import Ints
from colmap_av1.util.files import is_hidden
from colmap_av1.util.threads import map_on_threads

_SUFFIX = ".png"
# A frame with a smaller share of unmasked pixels is treated as if it had no motion.
_MIN_SHARE = 0.05
_LAYOUTS = (
    "give one PNG for all frames, or a folder with a PNG for every frame or with IMAGE.png for "
    "every image"
)


@dataclass(frozen=True)
class VideoMasks:
    """The masks of a video.

    Attributes:
        path: the file or folder of the masks, for messages.
        everywhere: the mask of all frames.
        of_frames: a mask for each frame, in order.
        of_images: masks of images, by their names in the video's folder, with or without extension.
    """

    path: str
    everywhere: Mask | None = None
    of_frames: tuple[Mask, ...] = ()
    of_images: Mapping[str, Mask] | None = None

    def check(
        self,
        sizes: Sequence[tuple[int, int]],
        names: Sequence[str] | None,
        options: ImageOptions,
    ) -> None:
        """Check masks against a video before any work.

        Args:
            sizes: valid (width, height): of the images, and of the video.
            names: names of the images; None if they are not known yet.
            options: how images are named if `names` is None.

        Raises:
            ImageError: a mask has another size, or no mask belongs to an image.
        """
        one = [self.everywhere] if self.everywhere is not None else []
        for mask in [*one, *self.of_frames, *(self.of_images or {}).values()]:
            if mask.size not in sizes:
                wanted = " or ".join("{}x{}".format(*s) for s in dict.fromkeys(sizes))
                raise ImageError(
                    f"{self.path}: a mask is {mask.size[0]}x{mask.size[1]}, the pictures are "
                    f"{wanted}: give masks of that size"
                )
        if self.of_images is None:
            return
        if names is not None:
            self._named(names)
        elif options.frame_list is None:
            stem = PurePosixPath(options.file_name).stem
            named = pattern_regex(stem + _SUFFIX)
            found = (str(PurePosixPath(n).with_suffix(_SUFFIX)) for n in self.of_images)
            if not any(named.fullmatch(name) for name in found):
                raise ImageError(
                    f"{self.path}: none of its {len(self.of_images)} masks is named like an image "
                    f"({options.file_name}{_SUFFIX}), and the video has a different number of "
                    f"frames: {_LAYOUTS}"
                )

    def on_tracks(self, tracks: Tracks, chosen: ChosenImages, min_length: int) -> Tracks:
        """Apply all masks to tracks, see `mask_tracks`.

        Raises:
            ImageError: an image has no mask.
        """
        return self.on_images(self.on_frames(tracks, min_length), chosen, min_length)

    def on_frames(self, tracks: Tracks, min_length: int) -> Tracks:
        """Apply the masks of frames to tracks, see `mask_tracks`."""
        if self.everywhere is not None:
            return mask_tracks(tracks, self.everywhere, min_length)
        if not self.of_frames:
            return tracks
        return mask_tracks(tracks, dict(enumerate(self.of_frames)), min_length)

    def on_motion(self, inter_share: NDArray[np.float32]) -> NDArray[np.float32]:
        """Shares of inter units [num_frames], set to 0 in frames that are almost fully masked."""
        nothing_left = [frame for frame, m in enumerate(self.of_frames) if m.share < _MIN_SHARE]
        found = inter_share.copy()
        found[[frame for frame in nothing_left if frame < len(found)]] = 0.0
        return np.asarray(found)

    def on_images(self, tracks: Tracks, chosen: ChosenImages, min_length: int) -> Tracks:
        """Apply the masks of images to tracks, see `mask_tracks`.

        Raises:
            ImageError: an image has no mask.
        """
        if self.of_images is None:
            return tracks
        found = zip(chosen.frames.tolist(), self._named(chosen.names), strict=True)
        return mask_tracks(tracks, dict(found), min_length)

    def of(self, chosen: ChosenImages) -> list[Mask]:
        """The masks of images.

        Raises:
            ImageError: an image has no mask.
        """
        if self.everywhere is not None:
            return [self.everywhere] * len(chosen.names)
        if self.of_images is not None:
            return self._named(chosen.names)
        return [self.of_frames[frame] for frame in chosen.frames.tolist()]

    def _named(self, names: Sequence[str]) -> list[Mask]:
        masks = self.of_images or {}
        found = {name: _mask_name(name, masks) for name in names}
        missing = [name for name, mask in found.items() if mask is None]
        if missing:
            raise ImageError(
                f"{self.path}: holds {len(masks)} masks, but lacks those of {len(missing)} of "
                f"{len(names)} images, such as '{missing[0]}{_SUFFIX}': {_LAYOUTS}"
            )
        return [masks[mask] for mask in found.values() if mask is not None]


@dataclass(frozen=True)
class Masks:
    """The masks of videos and photos.

    Attributes:
        path: the file or folder of the masks.
        everywhere: the mask of all frames of all videos.
        of_frames: for videos with a mask for each frame, these masks by the folder of the video's
            images in the folder of all images.
        of_images: all other masks of videos, by their path in the folder without the extension
            .png.
        of_photos: the masks of photos, by the name of the photo.
        digest: digest of all masks.
    """

    path: Path
    everywhere: Mask | None
    of_frames: Mapping[str, tuple[Mask, ...]]
    of_images: Mapping[str, Mask]
    of_photos: Mapping[str, Mask]
    digest: str

    def of_video(self, label: str) -> VideoMasks | None:
        """The masks of the video whose images lie in a folder; None if it has no masks."""
        if self.everywhere is not None:
            return VideoMasks(str(self.path), self.everywhere)
        own_path = str(self.path / label)
        if label in self.of_frames:
            return VideoMasks(own_path, of_frames=self.of_frames[label])
        start = f"{label}/" if label else ""
        own = {n.removeprefix(start): m for n, m in self.of_images.items() if n.startswith(start)}
        return VideoMasks(own_path, of_images=own) if own else None

    def of_photo(self, name: str, size: tuple[int, int]) -> Mask | None:
        """The mask of a photo; None if it has no mask.

        Raises:
            ImageError: the mask has another size.
        """
        mask = self.of_photos.get(name)
        if mask is not None and mask.size != size:
            raise ImageError(
                f"{self.path}: the mask of '{name}' is {mask.size[0]}x{mask.size[1]}, the photo "
                f"{size[0]}x{size[1]}: give a mask of that size"
            )
        return mask


def _mask_name(image: str, masks: Collection[str]) -> str | None:
    """Name of the mask of 'a.jpg': 'a.jpg' as in COLMAP, else 'a' as in trainers; None if missing.

    The extension .png of masks is left out. COLMAP's masks of 'a.png' are accepted, too: `match`
    and `reconstruct` write images of different formats by default.
    """
    stem = str(PurePosixPath(image).with_suffix(""))
    names = (image, stem, *(stem + extension for extension in sorted(READABLE)))
    return next((name for name in names if name in masks), None)


def read_masks(
    path: Path, labels: Sequence[str], num_frames: Sequence[int], photos: Sequence[str] = ()
) -> Masks:
    """Read the masks of videos and photos: one for all frames, of frames, or of images.

    Args:
        path: a PNG for all frames; or a folder with a PNG for every frame, in the order of their
            names, with a subfolder for each of several videos; or a folder with masks of images in
            COLMAP's layout, `NAME.png`, or in that of trainers, where .png replaces the extension.
        labels: the folder of each video's images in the folder of all images.
        num_frames: number of frames of each video.
        photos: names of the photos.

    Raises:
        ImageError: there is no such file or folder, a mask cannot be read, or all are black.
    """
    if path.is_file():
        if path.suffix.lower() != _SUFFIX:
            raise ImageError(f"{path}: is not a PNG: {_LAYOUTS}")
        files = [path]
    elif path.is_dir():
        found = (p for p in path.rglob("*") if p.suffix.lower() == _SUFFIX and p.is_file())
        visible = [p for p in found if not is_hidden(p.relative_to(path))]
        files = sorted(visible, key=lambda p: natural_key(p.relative_to(path).as_posix()))
        if not files:
            raise ImageError(f"{path}: holds no PNG: {_LAYOUTS}")
    else:
        raise ImageError(f"{path}: no such file or folder of masks: {_LAYOUTS}")
    masks = list(map_on_threads(_read_mask, files))
    if not any(mask.share for mask in masks):
        what = "the mask is" if len(masks) == 1 else f"all {len(masks)} masks are"
        raise ImageError(
            f"{path}: {what} black, which leaves nothing of the pictures: black pixels are "
            "ignored; invert the masks if black marks the pixels to use"
        )
    digest = hashlib.sha256()
    for file, mask in zip(files, masks, strict=True):
        name = "" if file == path else file.relative_to(path).as_posix()
        digest.update(f"{name} {mask.size} {len(mask.packed)} ".encode() + mask.packed)
    if path.is_file():
        return Masks(path, masks[0], {}, {}, {}, digest.hexdigest())
    return _in_folder(
        path,
        {
            file.relative_to(path).as_posix()[: -len(_SUFFIX)]: mask
            for file, mask in zip(files, masks, strict=True)
        },
        dict(zip(labels, num_frames, strict=True)),
        photos,
        digest.hexdigest(),
    )


def _in_folder(
    path: Path,
    masks: dict[str, Mask],
    num_frames: dict[str, int],
    photos: Sequence[str],
    digest: str,
) -> Masks:
    """Distinguish masks of photos, of frames and of images, by their names and number."""
    of_photos = {}
    for photo in photos:
        mask = _mask_name(photo, masks)
        if mask is not None:
            of_photos[photo] = masks.pop(mask)
    of_frames = {}
    for label, count in num_frames.items():
        own = [name for name in masks if PurePosixPath(name).parent == PurePosixPath(label)]
        for_images = any(PurePosixPath(name).suffix in READABLE for name in own)
        if len(own) == count and not for_images:
            of_frames[label] = tuple(masks.pop(name) for name in own)
    found = Masks(path, None, of_frames, masks, of_photos, digest)
    if all(found.of_video(label) is None for label in num_frames):
        folders = ", ".join(f"'{label}'" for label in num_frames)
        raise ImageError(
            f"{path}: holds no mask of a video: put the masks in folders {folders}, like the "
            "images, or give one PNG for all frames"
        )
    return found


def _read_mask(path: Path) -> Mask:
    try:
        data = np.frombuffer(path.read_bytes(), np.uint8)
        # In grey, the darkest colours would become black.
        picture = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if len(data) else None
    except (OSError, cv2.error):
        picture = None
    if picture is None:
        raise ImageError(f"{path}: cannot be read as a mask: {_LAYOUTS}")
    if picture.ndim == 3:
        # COLMAP ignores transparency, too.
        kept = picture[:, :, :3].any(axis=2)
        if picture.shape[2] == 4 and kept.all() and np.ptp(picture[:, :, 3]) > 0:
            raise ImageError(
                f"{path}: has its mask in the alpha channel, which is ignored: save it in grey, "
                "black where pixels are excluded"
            )
        picture = kept
    return make_mask(picture > 0)


def mask_tracks(
    tracks: Tracks, masks: Mask | Mapping[int, Mask], min_length: int, *, scaled: bool = True
) -> Tracks:
    """Remove observations on masked pixels, and split tracks there.

    A track that leaves a masked area is a new track, since it may be on another surface than
    before. In frames without an observation, between two with one, its position is interpolated
    linearly.

    Args:
        tracks: any tracks.
        masks: by frame, or one for all.
        min_length: smallest number of observations of a track.
        scaled: masks may differ in size from the pictures; otherwise each has the size of its own
            picture, and these sizes may differ.
    """
    size = (tracks.width, tracks.height)
    of_all, by_frame = (masks.kept, {}) if isinstance(masks, Mask) else (None, masks)
    kept = np.ones(tracks.num_observations, dtype=np.bool_)
    begins = np.zeros(tracks.num_observations, dtype=np.bool_)
    unseen = _Unseen(tracks)
    for frame, own in enumerate(tracks.by_frame()):
        pixels = by_frame[frame].kept if frame in by_frame else of_all
        if pixels is None:
            continue
        passing, between = unseen.at(frame)
        own_size = size if scaled else (pixels.shape[1], pixels.shape[0])
        kept[own] = valid_at(pixels, tracks.xy[own], own_size)
        begins[passing] |= ~valid_at(pixels, between, own_size)
    if kept.all() and not begins.any():
        return tracks
    return tracks.split_at_removed(kept, begins).keep_long(min_length)


class _Unseen:
    """Interpolates tracks in frames without an observation, between two with one."""

    def __init__(self, tracks: Tracks) -> None:
        self._tracks = tracks
        apart = np.diff(tracks.frame)
        apart[tracks.offsets[1:-1] - 1] = 1
        after = np.flatnonzero(apart > 1) + 1
        self._longest = int(apart.max(initial=1))
        # By the frame before each gap.
        self._after = after[np.argsort(tracks.frame[after - 1], kind="stable")]
        self._start = tracks.frame[self._after - 1]

    def at(self, frame: int) -> tuple[Ints, NDArray[np.float32]]:
        """The observations after the gaps that cover a frame, and positions [n, 2] in the frame."""
        tracks = self._tracks
        first, last = np.searchsorted(self._start, [frame - self._longest + 1, frame])
        after = self._after[first:last]
        after = after[tracks.frame[after] > frame]
        start, end = tracks.frame[after - 1], tracks.frame[after]
        share = ((frame - start) / (end - start)).astype(np.float32)[:, None]
        return after, tracks.xy[after - 1] * (1 - share) + tracks.xy[after] * share
