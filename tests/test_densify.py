from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import pycolmap
import pytest
import render_scene
from conftest import Ffmpeg
from dense_scene import SCENE, Truth

from colmap_av1.densify import densify
from colmap_av1.errors import ImageError, ModelError, OptionError, VideoError
from colmap_av1.geometry.colmap_model import ModelImage, write_model
from colmap_av1.geometry.model_points import ModelPoints
from colmap_av1.options import DensifyOptions, ImageOptions, MatchOptions, TriangulateOptions
from colmap_av1.video.decoding import decode_frames


def true_model(folder: Path, truth: Truth, frames: range, *, shuffle: int = 1) -> Path:
    """A model without points with the true poses, or with those of other frames if shuffled."""
    folder.mkdir()
    images = [
        ModelImage(100 - i, f"{frame:04d}.png", 7, truth.cam_from_world[frame * shuffle % 60])
        for i, frame in enumerate(frames)
    ]
    write_model(folder, {7: truth.camera}, images, ModelPoints.empty())
    return folder


@pytest.fixture(scope="module")
def dense(truth: Truth, tmp_path_factory: pytest.TempPathFactory) -> pycolmap.Reconstruction:
    """A dense model with the true poses of the clip."""
    folder = tmp_path_factory.mktemp("dense")
    model = true_model(folder / "model", truth, range(60))
    options = DensifyOptions(
        match=MatchOptions(images=ImageOptions(first_number=0)),
        triangulate=TriangulateOptions(points="survey"),
    )
    report = densify(model, SCENE, folder / "dense", options=options)
    made = pycolmap.Reconstruction(folder / "dense")
    assert report.num_images == 60
    assert report.agreement > 0.9
    assert report.num_points == made.num_points3D()
    assert sorted(made.images) == sorted(pycolmap.Reconstruction(model).images)
    return made


def test_densify_gives_correct_depths_and_colours(
    truth: Truth, dense: pycolmap.Reconstruction
) -> None:
    """Depths and colours agree with those of the rendered clip."""
    assert list(dense.cameras) == [7]
    fx, fy, cx, cy = truth.camera.params
    wrong, num_checked = [], 0
    for image in list(dense.images.values())[::4]:
        frame = int(Path(image.name).stem)
        assert np.allclose(image.cam_from_world().matrix(), truth.cam_from_world[frame])
        ids = [p.point3D_id for p in image.points2D]
        xyz = np.array([dense.points3D[i].xyz for i in ids])
        x, y, z = truth.cam_from_world[frame] @ np.column_stack([xyz, np.ones(len(xyz))]).T
        column = np.abs((fx * x / z + cx)[:, None] - truth.depth_x).argmin(axis=1)
        row = np.abs((fy * y / z + cy)[:, None] - truth.depth_y).argmin(axis=1)
        # The true depth is known on a grid, so only compare where it is smooth.
        padded = np.pad(truth.depth[frame], 1, mode="edge")
        around = np.stack([padded[row + i, column + j] for i in range(3) for j in range(3)])
        smooth = around.max(axis=0) / around.min(axis=0) < 1.1
        depth = truth.depth[frame][row, column]
        wrong.append(np.abs(z / depth - 1)[smooth])
        num_checked += smooth.sum()
    assert num_checked > 10_000
    assert np.median(np.concatenate(wrong)) < 0.02
    assert np.mean(np.concatenate(wrong) > 0.1) < 0.05
    picture = next(decode_frames(SCENE))[1]
    first = next(i for i in dense.images.values() if i.name == "0000.png")
    off = [
        dense.points3D[p.point3D_id].color.astype(int) - picture[int(p.xy[1]), int(p.xy[0]), ::-1]
        for p in first.points2D
    ]
    assert np.median(np.abs(off)) < 10


def test_list_of_frames_may_have_images_that_the_model_lacks(truth: Truth, tmp_path: Path) -> None:
    model = true_model(tmp_path / "model", truth, range(0, 40, 4))
    listed = tmp_path / "frames.txt"
    listed.write_text("".join(f"{frame} {frame:04d}.png\n" for frame in range(0, 60, 4)))
    options = DensifyOptions(match=MatchOptions(images=ImageOptions(frame_list=listed)))
    assert densify(model, SCENE, tmp_path / "dense", options=options).num_images == 10
    listed.write_text("0 0000.png\n4 0004.png\n")
    with pytest.raises(ImageError, match="list"):
        densify(model, SCENE, tmp_path / "few", options=options)


def test_images_may_be_stored_without_the_rotation_of_the_video(
    truth: Truth, ffmpeg: Ffmpeg, tmp_path: Path
) -> None:
    turned = ffmpeg(*("-display_rotation", "90", "-i", SCENE, "-c", "copy"), tmp_path / "t.mp4")
    model = true_model(tmp_path / "model", truth, range(0, 40, 4))
    options = DensifyOptions(
        match=MatchOptions(images=ImageOptions(first_number=0)),
        triangulate=TriangulateOptions(points="survey"),
    )
    upright = densify(model, SCENE, tmp_path / "upright", options=options)
    report = densify(model, turned, tmp_path / "turned", options=options)
    assert report.num_points == upright.num_points > 0
    colours = [
        [point.color.tolist() for point in pycolmap.Reconstruction(own.output).points3D.values()]
        for own in (report, upright)
    ]
    assert colours[0] == colours[1]


def test_points_lie_on_the_surfaces(truth: Truth, dense: pycolmap.Reconstruction) -> None:
    """Including points observed in three frames; errors are relative to the camera distance."""
    points = list(dense.points3D.values())
    length = np.array([p.track.length() for p in points])
    first = [Path(dense.images[p.track.elements[0].image_id].name).stem for p in points]
    pose = truth.cam_from_world[np.array(first, int)]
    centre = -np.einsum("nji,nj->ni", pose[:, :, :3], pose[:, :, 3])
    xyz = np.array([p.xyz for p in points])
    off = render_scene.surface_distance(render_scene.build_scene(), xyz)
    off /= np.linalg.norm(xyz - centre, axis=1)
    assert len(points) > 43_000
    assert (length == 3).sum() > 1000
    for error in (off, off[length == 3]):
        assert np.median(error) < 0.003
        assert np.quantile(error, 0.9) < 0.02
        assert np.mean(error > 0.05) < 0.035


def model_of_clip(folder: Path) -> Path:
    """A model for the clip, whose layers move by 2 and 4 px per frame."""
    folder.mkdir()
    camera = pycolmap.Camera(
        camera_id=1, model="PINHOLE", width=192, height=128, params=[200, 200, 96, 64]
    )
    images = [
        ModelImage(i + 1, f"{i}.png", 1, np.column_stack([np.eye(3), [-i, 0, 0]]))
        for i in range(16)
    ]
    write_model(folder, {1: camera}, images, ModelPoints.empty())
    return folder


@pytest.mark.parametrize("when", ["motion", "colours"])
def test_changed_video_is_refused(clip: Path, tmp_path: Path, when: str) -> None:
    model = model_of_clip(tmp_path / "model")
    video = tmp_path / "v.mp4"
    shutil.copyfile(clip, video)

    def change(stage: str, done: int, total: int | None) -> None:
        if stage == when and done == 9:
            video.touch()

    with pytest.raises(VideoError, match="changed"):
        densify(model, video, tmp_path / "dense", progress=change)
    assert {p.name for p in tmp_path.iterdir()} == {"model", "v.mp4"}
    assert densify(model, video, tmp_path / "dense").num_points > 500


def test_densify_refuses_mismatched_models(truth: Truth, clip: Path, tmp_path: Path) -> None:
    model = true_model(tmp_path / "model", truth, range(60))
    with pytest.raises(ImageError, match="640x360"):
        densify(model, clip, tmp_path / "dense")
    shuffled = true_model(tmp_path / "shuffled", truth, range(60), shuffle=7)
    with pytest.raises(ModelError, match="agree"):
        densify(shuffled, SCENE, tmp_path / "dense")
    with pytest.raises(ModelError, match="no COLMAP model"):
        densify(tmp_path, SCENE, tmp_path / "dense")
    (tmp_path / "empty").mkdir()
    write_model(tmp_path / "empty", {7: truth.camera}, [], ModelPoints.empty())
    with pytest.raises(ModelError, match="registered"):
        densify(tmp_path / "empty", SCENE, tmp_path / "dense")
    few = true_model(tmp_path / "few", truth, range(20))
    with pytest.raises(ImageError, match="frames"):
        densify(few, SCENE, tmp_path / "dense")
    with pytest.raises(OptionError, match=r"cameras\.bin"):
        densify(model, SCENE, model / "cameras.bin" / "dense")
    with pytest.raises(OptionError, match="not empty"):
        densify(model, SCENE, model)
    names = {p.name for p in tmp_path.iterdir()}
    assert names == {"model", "shuffled", "empty", "few"}
