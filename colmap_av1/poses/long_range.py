"""Whether views from far apart in time agree with the poses, by what the pictures show."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from colmap_av1.errors import ImageError
from colmap_av1.geometry.colmap_model import ModelImage, camera_centres, posed_images
from colmap_av1.geometry.masks import Mask
from colmap_av1.images.files import read_image
from colmap_av1.images.names import image_file, natural_order
from colmap_av1.matching.features.overlays import without_overlays
from colmap_av1.matching.features.sift import Features, extract_features, masked_features
from colmap_av1.matching.links import match_pairs
from colmap_av1.matching.two_view_models import essential_of_poses, sampson_error
from colmap_av1.options import VerifyOptions
from colmap_av1.util.progress import Progress, no_progress
from colmap_av1.util.run_context import RunContext
from colmap_av1.util.spread import evenly_spread

_Floats = NDArray[np.float64]
_Image = NDArray[np.uint8]

# Images between two views that are far apart: neighbours agree whatever the model is like.
GAP = 10
# Two images see the same where this share of the points of one lie in the other, seen from no
# more than this angle aside, in degrees, and at no more than this times the distance.
_MIN_OVERLAP = 0.5
_MAX_ANGLE = 30.0
_MAX_SCALE = 2.0
# Points of an image that are asked.
_NUM_POINTS = 200
_NUM_PAIRS = 12
_NUM_FEATURES = 1500
# Images that pairs are made of, evenly spread: features take a twentieth of a second of each.
_NUM_IMAGES = 16
# Pixels that views from far apart in time may disagree by before it is said: the surfaces of
# models that hold together agree to less than one, or two with long focal lengths.
_FAR_APART = 4.0
# Pairs without a match from which on it is said that there is none.
_FEWEST_TRIED = 3


@dataclass(frozen=True)
class FarViews:
    """How far apart views from far apart in time are.

    Attributes:
        pairs: (name, name) of the images of each pair that has matches.
        error: float64 [num_pairs] median distance in pixels of a pair's matched features from
            their epipolar lines, by the poses.
        num_tried: pairs that by the poses see the same, whose pictures were matched.
        num_features: median number of features of these pictures; 0 without any.
    """

    pairs: tuple[tuple[str, str], ...]
    error: _Floats
    num_tried: int
    num_features: int

    @property
    def median(self) -> float | None:
        """Median over the pairs; None where no two views from far apart show the same."""
        return float(np.median(self.error)) if len(self.error) else None

    @property
    def worst(self) -> tuple[str, str] | None:
        """The images of the pair that is farthest apart."""
        return self.pairs[int(self.error.argmax())] if len(self.error) else None

    @property
    def largest(self) -> float | None:
        """The 90 % quantile over the pairs; None as for the median."""
        return float(np.quantile(self.error, 0.9)) if len(self.error) else None

    @property
    def are_apart(self) -> bool:
        """Whether the model does not hold together."""
        return self.largest is not None and self.largest > _FAR_APART

    def warning(self, *, linked: bool = False) -> str | None:
        """What the user should know of a model that does not hold together, or of its pictures.

        Args:
            linked: pictures of places seen again have been matched.
        """
        if not self.pairs and self.num_tried >= _FEWEST_TRIED:
            return (
                f"the pictures of {self.num_tried} pairs of images far apart in time, which by "
                f"the poses see the same, show nothing in common, with {self.num_features} "
                "features each, sharp ones have hundreds: they are blurred or plain, or the poses "
                "are wrong"
            )
        if not self.are_apart or self.worst is None:
            return None
        first, second = self.worst
        return (
            f"what images far apart in time show in common is up to {self.largest:.1f} px from "
            f"where the poses put it, most between '{first}' and '{second}': surfaces may be "
            f"doubled there{'' if linked else '; --links sift matches more pictures'}"
        )


class FarViewCheck:
    """Collects features of a few images and holds their matches against the poses.

    Args:
        images: the images with their poses, in display order.
        cameras: pycolmap.Camera by id, of any model.
        points_of: gives float64 [n, 3] positions of the points that an image sees, by its index.
    """

    def __init__(
        self,
        images: Sequence[ModelImage],
        cameras: Mapping[int, Any],
        points_of: Callable[[int], _Floats],
    ) -> None:
        self._images = images
        self._cameras = [cameras[image.camera_id] for image in images]
        self._pairs = _far_pairs(images, self._cameras, points_of)
        self._wanted = set(self._pairs.ravel().tolist())
        self._features: dict[int, Features] = {}

    @property
    def wanted(self) -> list[int]:
        """Indices of the images whose pictures are needed, ascending."""
        return sorted(self._wanted)

    def add(self, index: int, picture: _Image, mask: Mask | None = None) -> None:
        """Take the picture of an image: uint8 [height, width, 3], BGR, as its camera says.

        `mask` says what of it counts.
        """
        if index in self._wanted:
            features = extract_features(picture, _NUM_FEATURES)
            self._features[index] = masked_features(features, picture, mask)

    def result(self) -> FarViews:
        """What the pictures say; all that are needed have been added."""
        features = without_overlays(self._features, self._cameras)
        # Each pair is freed of outliers by a geometry of its own, not by the poses.
        found = match_pairs(
            self._pairs,
            features,
            self._cameras,
            VerifyOptions(),
            RunContext(),
        )
        names, errors = [], []
        for (i, j), geometry in zip(found.pairs.tolist(), found.geometries, strict=True):
            a, b = geometry.inlier_matches.T
            error = self._errors(i, j, features[i].xy[a], features[j].xy[b])
            if len(error):
                names.append((self._images[i].name, self._images[j].name))
                errors.append(float(np.median(error)))
        sizes = [len(own.xy) for own in features.values()]
        return FarViews(
            tuple(names),
            np.array(errors),
            num_tried=len(self._pairs),
            num_features=int(np.median(sizes)) if sizes else 0,
        )

    def _errors(self, i: int, j: int, xa: NDArray[Any], xb: NDArray[Any]) -> _Floats:
        """Symmetric epipolar distance in pixels of matches [n, 2] by the poses of two images."""
        a, b = self._images[i].cam_from_world, self._images[j].cam_from_world
        normalised = [
            np.asarray(camera.cam_from_img(xy.astype(np.float64))).T
            for camera, xy in ((self._cameras[i], xa), (self._cameras[j], xb))
        ]
        focal = np.mean([self._cameras[k].mean_focal_length() for k in (i, j)])
        # Per image: each has a part of the distance.
        distance = np.sqrt(2) * focal * sampson_error(essential_of_poses(a, b), *normalised)
        # A distorted position may have no ray.
        return np.asarray(distance[np.isfinite(distance)])


def model_far_views(
    reconstruction: Any, image_path: Path, progress: Progress = no_progress
) -> FarViews:
    """Hold the pictures of a model's images against its poses, for a few pairs far apart.

    Args:
        reconstruction: pycolmap.Reconstruction; the order of its images' names is that of time.
        image_path: folder of the images.
        progress: called for the stage "far views".

    Raises:
        ImageError: an image is missing, unreadable or of another size than its camera.
    """
    posed = posed_images(reconstruction)
    names = list(posed)
    images = [posed[names[k]] for k in natural_order(names)]

    def points_of(index: int) -> _Floats:
        seen = reconstruction.images[images[index].image_id].points2D
        ids = [p.point3D_id for p in seen if p.has_point3D()]
        points = [reconstruction.points3D[point_id].xyz for point_id in ids]
        return np.array(points, dtype=np.float64).reshape(-1, 3)

    check = FarViewCheck(images, reconstruction.cameras, points_of)
    for done, index in enumerate(check.wanted, start=1):
        image = images[index]
        picture = read_image(image_file(image_path, image.name))
        camera = reconstruction.cameras[image.camera_id]
        size, wanted = picture.shape[1::-1], (camera.width, camera.height)
        if size != wanted:
            raise ImageError(
                f"{image_file(image_path, image.name)}: is {size[0]}x{size[1]}, but its camera in "
                f"the model {wanted[0]}x{wanted[1]}: give the folder of the model's images"
            )
        check.add(index, picture)
        progress("far views", done, len(check.wanted))
    return check.result()


def _far_pairs(
    images: Sequence[ModelImage],
    cameras: Sequence[Any],
    points_of: Callable[[int], _Floats],
) -> NDArray[np.int32]:
    """Choose pairs of images that by their poses see the same though many images lie between.

    Returns:
        int32 [n, 2], first < second; few, spread over the images, with the longest spans first.
    """
    num_images = len(images)
    if num_images <= GAP:
        return np.empty((0, 2), np.int32)
    poses = np.array([image.cam_from_world for image in images])
    chosen = evenly_spread(num_images, _NUM_IMAGES)
    found = []
    for i in chosen:
        points = points_of(i)
        points = points[:: max(1, len(points) // _NUM_POINTS)]
        later = (j for j in reversed(chosen) if j >= i + GAP)
        partner = next((j for j in later if _sees_same(points, poses[[i, j]], cameras[j])), None)
        if partner is not None:
            found.append((i, partner))
    found.sort(key=lambda pair: (pair[0] - pair[1], pair[0]))
    half = _NUM_PAIRS // 2
    # Half of them the longest spans, half spread over the rest.
    rest = sorted(found[half:])
    spread = rest[:: max(1, -(-len(rest) // half))] if rest else []
    return np.array(found[:half] + spread[:half], dtype=np.int32).reshape(-1, 2)


def _sees_same(points: _Floats, poses: _Floats, camera: Any) -> bool:
    """Whether an image sees most of the points [n, 3] of another much as that one does.

    Args:
        points: those that the other image sees.
        poses: [2, 3, 4] of the other image and of the one that is asked.
        camera: of the one that is asked.
    """
    local = points @ poses[1, :, :3].T + poses[1, :, 3]
    local = local[local[:, 2] > 0]
    if len(local) < _MIN_OVERLAP * len(points) or len(local) == 0:
        return False
    x, y = np.asarray(camera.img_from_cam(local)).T
    inside = (x >= 0) & (x < camera.width) & (y >= 0) & (y < camera.height)
    if np.count_nonzero(inside) < _MIN_OVERLAP * len(points):
        return False
    rays = [points - centre for centre in camera_centres(poses)]
    near, far = (np.linalg.norm(ray, axis=1) for ray in rays)
    cosine = np.median(np.sum(rays[0] * rays[1], axis=1) / np.maximum(near * far, 1e-12))
    scale = np.median(near / np.maximum(far, 1e-12))
    return bool(cosine >= np.cos(np.radians(_MAX_ANGLE)) and 1 / _MAX_SCALE <= scale <= _MAX_SCALE)
