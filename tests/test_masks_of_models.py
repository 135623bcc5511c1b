"""Masks in models: masked pixels have no points, and trainers get masks."""

from __future__ import annotations

import shutil
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from conftest import Encode
from numpy.typing import NDArray

from colmap_av1.densify import densify
from colmap_av1.options import (
    CameraOptions,
    DensifyOptions,
    ImageOptions,
    MaskOptions,
    MatchOptions,
    ReconstructOptions,
)
from colmap_av1.reconstruct import ReconstructReport, reconstruct
from colmap_av1.video.decoding import decode_frames

SCENE = Path(__file__).resolve().parents[1] / "examples" / "scene.mp4"
SIZE = (320, 180)
# With a distorted lens, masks are undistorted like images.
MATCH = MatchOptions(
    images=ImageOptions(every=2, image_name="frame_%06d.jpg"),
    camera=CameraOptions(camera_model="SIMPLE_RADIAL", camera_params="260,160,90,0.05"),
)
# The masked region moves from frame to frame.
NUM_FRAMES, STEP = 18, 5


@dataclass(frozen=True)
class Scene:
    video: Path
    masks: Path


@pytest.fixture(scope="module")
def scene(encode: Encode, tmp_path_factory: pytest.TempPathFactory) -> Scene:
    folder = tmp_path_factory.mktemp("masked")
    shown = [cv2.resize(picture, SIZE) for _, picture in decode_frames(SCENE)][:NUM_FRAMES]
    masks = folder / "masks"
    masks.mkdir()
    for i in range(NUM_FRAMES):
        mask = np.full(SIZE[::-1], 255, np.uint8)
        mask[60:140, 60 + STEP * i : 140 + STEP * i] = 0
        cv2.imwrite(str(masks / f"{i}.png"), mask)
    return Scene(encode(np.array(shown), folder / "scene.mp4"), masks)


@pytest.fixture(scope="module")
def made(scene: Scene, tmp_path_factory: pytest.TempPathFactory) -> ReconstructReport:
    options = ReconstructOptions(match=masked(scene))
    return reconstruct(scene.video, tmp_path_factory.mktemp("made") / "out", options=options)


def masked(scene: Scene) -> MatchOptions:
    return replace(MATCH, masks=MaskOptions(mask_path=scene.masks))


def seen_on_black(model: Path, masks: Path) -> tuple[int, int]:
    """Number of observations on black pixels of the masks, and of all observations."""
    reconstruction = pycolmap.Reconstruction(model)
    on_black = total = 0
    for image in reconstruction.images.values():
        mask = cv2.imread(str((masks / image.name).with_suffix(".png")), cv2.IMREAD_UNCHANGED)
        x, y = np.array([p.xy for p in image.points2D if p.has_point3D()]).astype(int).T
        on_black += int(np.count_nonzero(mask[y, x] == 0))
        total += len(x)
    return on_black, total


def test_no_point_is_observed_on_a_mask(made: ReconstructReport) -> None:
    on_black, total = seen_on_black(made.output / "sparse" / "0", made.output / "masks")
    assert total > 5_000
    # Undistorted masks have rounded edges.
    assert on_black <= 0.002 * total
    assert made.coverage > 0.9


def test_each_image_gets_a_mask_for_trainers(scene: Scene, made: ReconstructReport) -> None:
    """The masks have the size of the undistorted images and are black in the masked region."""
    (camera,) = pycolmap.Reconstruction(made.output / "sparse" / "0").cameras.values()
    images = sorted((made.output / "images").iterdir())
    masks = sorted((made.output / "masks").iterdir())
    assert [m.name for m in masks] == [i.with_suffix(".png").name for i in images]
    given = pycolmap.Camera(
        model="SIMPLE_RADIAL", width=SIZE[0], height=SIZE[1], params=[260, 160, 90, 0.05]
    )
    for i, path in enumerate(masks):
        mask = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        assert mask.shape == (camera.height, camera.width)
        assert set(np.unique(mask)) == {0, 255}
        y, x = np.mgrid[0 : camera.height, 0 : camera.width].reshape(2, -1) + 0.5
        rays = camera.cam_from_img(np.column_stack([x, y]))
        bent = given.img_from_cam(np.column_stack([rays, np.ones(len(rays))]))
        left = 60 + STEP * 2 * i
        black = (bent[:, 0] >= left) & (bent[:, 0] < left + 80)
        black &= (bent[:, 1] >= 60) & (bent[:, 1] < 140)
        assert np.mean((mask.ravel() == 0) == black) > 0.995


def test_masks_without_undistortion_are_the_given_ones(
    scene: Scene, made: ReconstructReport, tmp_path: Path
) -> None:
    output = tmp_path / "out"
    shutil.copytree(made.output, output)
    options = ReconstructOptions(match=masked(scene), undistort=False)
    reconstruct(scene.video, output, options=options)
    for image in sorted((output / "images").iterdir()):
        mask = cv2.imread(str(output / "masks" / f"{image.stem}.png"), cv2.IMREAD_UNCHANGED)
        given = cv2.imread(str(scene.masks / f"{int(image.stem[6:])}.png"), cv2.IMREAD_UNCHANGED)
        np.testing.assert_array_equal(mask, given)
    on_black, total = seen_on_black(output / "sparse" / "0", output / "masks")
    assert total > 5_000
    assert on_black == 0


def test_colmap_reads_the_masks_of_png_images(made: ReconstructReport, tmp_path: Path) -> None:
    """COLMAP extracts no features on black pixels."""
    images = tmp_path / "images"
    images.mkdir()
    names = [f"{path.stem}.png" for path in sorted((made.output / "images").iterdir())[:2]]
    for name in names:
        picture = cv2.imread(str((made.output / "images" / name).with_suffix(".jpg")))
        cv2.imwrite(str(images / name), picture)
    reader = pycolmap.ImageReaderOptions()
    reader.mask_path = made.output / "masks"
    pycolmap.extract_features(
        tmp_path / "a.db",
        images,
        image_names=names,
        reader_options=reader,
        device=pycolmap.Device.cpu,
    )
    with pycolmap.Database.open(tmp_path / "a.db") as database:
        found = {i.name: database.read_keypoints(i.image_id) for i in database.read_all_images()}
    for name in names:
        mask: NDArray[np.uint8] = cv2.imread(str(made.output / "masks" / name), 0)
        x, y = found[name][:, :2].astype(int).T
        assert len(x) > 50
        assert (mask[y, x] > 0).all()


def test_densify_respects_masks(scene: Scene, made: ReconstructReport, tmp_path: Path) -> None:
    """Uses the masks of the images that `reconstruct` wrote."""
    output = Path(shutil.copytree(made.output, tmp_path / "out"))
    options = ReconstructOptions(match=masked(scene), undistort=False)
    reconstruct(scene.video, output, options=options)
    match = MatchOptions(
        images=ImageOptions(first_number=0), masks=MaskOptions(mask_path=output / "masks")
    )
    model = output / "sparse" / "0"
    densify(model, scene.video, tmp_path / "dense", options=DensifyOptions(match=match))
    on_black, total = seen_on_black(tmp_path / "dense", output / "masks")
    assert total > 5_000
    assert on_black == 0


def test_changed_masks_change_the_model(
    scene: Scene, made: ReconstructReport, tmp_path: Path
) -> None:
    """A resumed run compares the content of masks; without masks, trainers' masks are removed."""
    assert not made.resumed
    options = ReconstructOptions(match=masked(scene))
    again = reconstruct(scene.video, made.output, options=options)
    assert "tracks" in again.resumed
    without = reconstruct(scene.video, made.output, options=ReconstructOptions(match=MATCH))
    assert "tracks" not in without.resumed
    assert not (made.output / "masks").exists()
    assert without.num_observations > made.num_observations
