"""The files that trainers of 3D Gaussians read from a folder, by the rules in their sources."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pycolmap


@dataclass(frozen=True)
class Taken:
    """Files that a trainer reads.

    Attributes:
        model: the folder of the COLMAP model.
        pictures: the picture of each registered image, by the image's name.
        masks: files that the trainer may use as the mask of an image, by the image's name.
        points: the file of the initial points.
    """

    model: Path
    pictures: dict[str, Path]
    masks: dict[str, set[Path]]
    points: Path


def names_in(model: Path) -> list[str]:
    """Names of the registered images of a model."""
    reconstruction = pycolmap.Reconstruction(model)
    return sorted(reconstruction.images[i].name for i in reconstruction.reg_image_ids())


def brush(folder: Path) -> Taken:
    """Brush 1.0: the model with the most images anywhere below, hidden folders included.

    Of equally large models, the one with the smaller path is read
    (crates/brush-dataset/src/formats/colmap.rs). Pictures and masks are searched by name in the
    whole folder (formats/mod.rs).
    """
    files = sorted(p.relative_to(folder) for p in folder.rglob("*") if p.is_file())
    models = [p.parent for p in files if p.name.lower() in ("cameras.bin", "cameras.txt")]
    size = {model: len(names_in(folder / model)) for model in models}
    model = min(models, key=lambda own: (-size[own], own))
    pictures, masks = {}, {}
    for name in names_in(folder / model):
        parts = Path(name).parts
        ending = [p for p in files if p.parts[-len(parts) :] == parts and "masks" not in p.parts]
        pictures[name] = folder / ending[0]
        masks[name] = {folder / p for p in files if _is_mask_of(p, ending[0])}
    (points,) = (p for p in files if p.parent == model and p.name == "points3D.bin")
    return Taken(folder / model, pictures, masks, folder / points)


def _is_mask_of(file: Path, picture: Path) -> bool:
    if file.stem.lower() not in (
        picture.name.lower(),
        picture.stem.lower(),
        f"{picture.stem.lower()}.mask",
    ):
        return False
    lower = [part.lower() for part in file.parts]
    if "masks" not in lower[:-1]:
        return False
    below = file.parts[lower.index("masks") + 1 : -1]
    return not below or picture.parent.parts[-len(below) :] == below


def lichtfeld_studio(folder: Path) -> Taken:
    """LichtFeld Studio: the first of `sparse/0`, `sparse` and the folder that has each file."""
    places = (folder / "sparse" / "0", folder / "sparse", folder)
    cameras, _, points = (
        next(place / name for place in places if (place / name).is_file())
        for name in ("cameras.bin", "images.bin", "points3D.bin")
    )
    pictures = {name: folder / "images" / name for name in names_in(cameras.parent)}
    return Taken(cameras.parent, pictures, {}, points)


def gsplat(folder: Path) -> Taken:
    """gsplat's examples (examples/datasets/colmap.py): `sparse/0` or `sparse`, by pycolmap.

    The trainer pairs the sorted files of `images` with those of the folder of downscaled images, so
    `images` must contain the registered images and no other files.
    """
    model = folder / "sparse" / "0"
    model = model if model.exists() else folder / "sparse"
    images = folder / "images"
    files = sorted(p.relative_to(images).as_posix() for p in images.rglob("*") if p.is_file())
    assert files == names_in(model)
    return Taken(model, {name: images / name for name in files}, {}, model / "points3D.bin")


def nerfstudio(folder: Path) -> Taken:
    """nerfstudio's colmap dataparser with `--colmap-path sparse/0`: text files before binary."""
    model = folder / "sparse" / "0"
    suffix = ".txt" if (model / "cameras.txt").exists() else ".bin"
    points = model / "points3D.bin"
    points = points if points.exists() else model / "points3D.txt"
    assert (model / f"images{suffix}").is_file()
    pictures = {name: folder / "images" / name for name in names_in(model)}
    return Taken(model, pictures, {}, points)


def reference_implementation(folder: Path) -> Taken:
    """graphdeco's 3D Gaussian Splatting (scene/dataset_readers.py): binary files of `sparse/0`.

    A `points3D.ply` next to them is used instead of `points3D.bin`. Only the last part of an image
    name is used.
    """
    model = folder / "sparse" / "0"
    points = model / "points3D.ply"
    points = points if points.exists() else model / "points3D.bin"
    pictures = {name: folder / "images" / Path(name).name for name in names_in(model)}
    return Taken(model, pictures, {}, points)


Trainer = Callable[[Path], Taken]
TRAINERS: tuple[Trainer, ...] = (
    brush,
    lichtfeld_studio,
    gsplat,
    nerfstudio,
    reference_implementation,
)

# Camera models of COLMAP whose distortion the trainers support: Brush's `build_camera_model`
# (crates/brush-dataset/src/formats/colmap.rs), LichtFeld Studio's 3DGUT
# (docs/docs/features/gut.md) and gsplat's `_camera_distortion` (examples/datasets/colmap.py), whose
# example undistorts the pictures when it loads them.
_RADIAL = {"SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"}
_MORE = {"FULL_OPENCV", "SIMPLE_RADIAL_FISHEYE", "RADIAL_FISHEYE"}
RENDERED: dict[Trainer, set[str]] = {
    brush: {*_RADIAL, *_MORE, "THIN_PRISM_FISHEYE"},
    lichtfeld_studio: {*_RADIAL, *_MORE},
    gsplat: _RADIAL,
}
