from __future__ import annotations

import errno
import importlib
import json
import shutil
import struct
from dataclasses import dataclass, replace
from pathlib import Path

import cv2
import numpy as np
import pycolmap
import pytest
from conftest import PROJECT, Encode

from colmap_av1 import mapper as mapper_module
from colmap_av1.cli import main
from colmap_av1.densify import densify
from colmap_av1.errors import ImageError, ModelError, OptionError
from colmap_av1.evaluate.poses import model_poses, pose_errors
from colmap_av1.model import ModelImage, ModelPoints, read_model, write_model
from colmap_av1.options import (
    CameraOptions,
    DensifyOptions,
    ImageOptions,
    MapperOptions,
    MatchOptions,
    ReconstructOptions,
    TriangulateOptions,
)
from colmap_av1.reconstruct import ReconstructReport, reconstruct
from colmap_av1.undistort import on_pinhole, pinhole_camera, undistortion
from colmap_av1.video import decode_frames

SCENE = PROJECT / "examples" / "scene.mp4"
EVERY = 3
NUM_IMAGES = 20
OPTIONS = ReconstructOptions(
    match=MatchOptions(images=ImageOptions(every=EVERY)),
    mapping=MapperOptions(pose_tracks_per_image=300, pose_spacing=24.0),
)
OPTIONS_OF_ALL_FRAMES = replace(OPTIONS, match=MatchOptions())
NO_POINTS = ModelPoints(
    np.empty((0, 3)),
    np.empty((0, 3), np.uint8),
    np.empty(0),
    np.zeros(1, np.int64),
    np.empty(0, np.int64),
    np.empty((0, 2)),
)


@dataclass(frozen=True)
class Truth:
    """The rendered clip's exact cameras and depth."""

    camera: pycolmap.Camera
    cam_from_world: np.ndarray
    depth: np.ndarray
    depth_x: np.ndarray
    depth_y: np.ndarray


@pytest.fixture(scope="session")
def truth() -> Truth:
    with np.load(PROJECT / "examples" / "scene_truth.npz") as file:
        params = [float(file[name]) for name in ("fx", "fy", "cx", "cy")]
        size = {"width": int(file["width"]), "height": int(file["height"])}
        camera = pycolmap.Camera(camera_id=7, model="PINHOLE", params=params, **size)
        depth = [file[name] for name in ("depth", "depth_x", "depth_y")]
        return Truth(camera, file["cam_from_world"], *depth)


@pytest.fixture(scope="session")
def made(tmp_path_factory: pytest.TempPathFactory) -> ReconstructReport:
    return reconstruct(SCENE, tmp_path_factory.mktemp("made") / "scene", options=OPTIONS)


def true_model(folder: Path, truth: Truth, frames: range, *, shuffle: int = 1) -> Path:
    """A model without points that has the true poses, or those of other frames."""
    folder.mkdir()
    images = [
        ModelImage(100 - i, f"{frame:04d}.png", 7, truth.cam_from_world[frame * shuffle % 60])
        for i, frame in enumerate(frames)
    ]
    write_model(folder, {7: truth.camera}, images, NO_POINTS)
    return folder


# The model's files as the trainers' own readers see them, byte by byte.


@dataclass(frozen=True)
class RawCamera:
    model_id: int
    width: int
    height: int
    params: tuple[float, ...]


@dataclass(frozen=True)
class RawImage:
    qvec: tuple[float, ...]
    tvec: tuple[float, ...]
    camera_id: int
    name: str
    xy: np.ndarray
    point_ids: np.ndarray


@dataclass(frozen=True)
class RawPoint:
    xyz: tuple[float, ...]
    rgb: tuple[int, ...]
    error: float
    track: tuple[tuple[int, int], ...]


class Bytes:
    def __init__(self, path: Path) -> None:
        self._data = path.read_bytes()
        self._at = 0

    def take(self, layout: str) -> tuple:
        values = struct.unpack_from("<" + layout, self._data, self._at)
        self._at += struct.calcsize("<" + layout)
        return values

    def text(self) -> str:
        end = self._data.index(b"\0", self._at)
        text = self._data[self._at : end].decode()
        self._at = end + 1
        return text

    def check_end(self) -> None:
        assert self._at == len(self._data)


def raw_model(folder: Path) -> tuple[dict, dict, dict]:
    num_params = {0: 3, 1: 4, 2: 4, 3: 5, 4: 8}
    file = Bytes(folder / "cameras.bin")
    cameras = {}
    for _ in range(file.take("Q")[0]):
        camera_id, model_id, width, height = file.take("iiQQ")
        params = file.take(f"{num_params[model_id]}d")
        cameras[camera_id] = RawCamera(model_id, width, height, params)
    file.check_end()
    file = Bytes(folder / "images.bin")
    images = {}
    for _ in range(file.take("Q")[0]):
        image_id, *pose, camera_id = file.take("idddddddi")
        name = file.text()
        count = file.take("Q")[0]
        rows = np.array(file.take("ddq" * count)).reshape(-1, 3)
        images[image_id] = RawImage(
            tuple(pose[:4]), tuple(pose[4:]), camera_id, name, rows[:, :2], rows[:, 2].astype(int)
        )
    file.check_end()
    file = Bytes(folder / "points3D.bin")
    points = {}
    for _ in range(file.take("Q")[0]):
        values = file.take("QdddBBBd")
        length = file.take("Q")[0]
        flat = file.take("ii" * length)
        track = tuple(zip(flat[::2], flat[1::2], strict=True))
        points[values[0]] = RawPoint(values[1:4], values[4:7], values[7], track)
    file.check_end()
    return cameras, images, points


def test_files_agree(made: ReconstructReport) -> None:
    """Both files tell the same of every observation, and the errors are those of the poses."""
    cameras, images, points = raw_model(made.output / "sparse" / "0")
    ((camera_id, camera),) = cameras.items()
    assert {image.camera_id for image in images.values()} == {camera_id}
    fx, fy, cx, cy = camera.params
    assert len(points) == made.num_points
    assert sum(len(i.point_ids) for i in images.values()) == made.num_observations
    assert sum(len(p.track) for p in points.values()) == made.num_observations
    rotation = {
        i: pycolmap.Rotation3d(np.array([*image.qvec[1:], image.qvec[0]])).matrix()
        for i, image in images.items()
    }
    for point_id in list(points)[::101]:
        point = points[point_id]
        assert len({image_id for image_id, _ in point.track}) >= 3
        errors = []
        for image_id, index in point.track:
            image = images[image_id]
            assert image.point_ids[index] == point_id
            x, y, z = rotation[image_id] @ point.xyz + image.tvec
            assert z > 0
            at = np.array([fx * x / z + cx, fy * y / z + cy])
            errors.append(np.linalg.norm(at - image.xy[index]))
        assert max(errors) <= 2.0 + 1e-6
        assert np.mean(errors) == pytest.approx(point.error, abs=1e-6)


def test_graphdeco(made: ReconstructReport) -> None:
    """One of two pinhole models, flat names without more dots, colours, and no stale cloud."""
    cameras, images, points = raw_model(made.output / "sparse" / "0")
    assert all(camera.model_id in (0, 1) for camera in cameras.values())
    for image in images.values():
        assert Path(image.name).name == image.name
        # It takes for the stem what comes before the first dot.
        assert image.name.split(".")[0] == Path(image.name).stem
        camera = cameras[image.camera_id]
        picture = cv2.imread(str(made.output / "images" / image.name))
        assert picture.shape == (camera.height, camera.width, 3)
    assert not list(made.output.glob("**/*.ply"))
    rgb = np.array([point.rgb for point in points.values()])
    assert rgb.min() >= 0
    assert rgb.max() > 100
    assert rgb.std() > 10


def test_gsplat(made: ReconstructReport) -> None:
    """Files and images in their sorted order stand for each other."""
    _, images, _ = raw_model(made.output / "sparse" / "0")
    names = sorted(image.name for image in images.values())
    assert names == sorted(p.name for p in (made.output / "images").iterdir())
    assert len(names) == made.num_registered == NUM_IMAGES
    reconstruction = pycolmap.Reconstruction(made.output / "sparse" / "0")
    assert reconstruction.num_points3D() == made.num_points
    assert reconstruction.compute_mean_reprojection_error() == pytest.approx(made.mean_error)


def test_nerfstudio(made: ReconstructReport) -> None:
    """A perspective model, by way of `--colmap-path sparse/0 --images-path images`."""
    cameras, images, points = raw_model(made.output / "sparse" / "0")
    assert {camera.model_id for camera in cameras.values()} <= {0, 1, 2, 3, 4, 5}
    assert all((made.output / "images" / image.name).is_file() for image in images.values())
    assert min(len(point.track) for point in points.values()) >= 3


def test_opensplat(made: ReconstructReport) -> None:
    """Binary files alone; an image is found by the file name of its path."""
    folder = made.output / "sparse" / "0"
    assert {"cameras.bin", "images.bin", "points3D.bin"} <= {p.name for p in folder.iterdir()}
    cameras, images, _ = raw_model(folder)
    assert {camera.model_id for camera in cameras.values()} <= {0, 1, 2, 4}
    # Unit quaternions, w first.
    for image in images.values():
        assert np.linalg.norm(image.qvec) == pytest.approx(1)


def test_brush(made: ReconstructReport) -> None:
    """The only cameras.bin below the folder is the model's, with its images in `images`."""
    (cameras,) = [p for p in made.output.glob("**/cameras.bin") if ".stages" not in p.parts]
    assert cameras.parent == made.output / "sparse" / "0"
    assert all(0 <= camera.model_id <= 10 for camera in raw_model(cameras.parent)[0].values())


def test_poses_are_true(made: ReconstructReport, truth: Truth) -> None:
    model = read_model(made.output / "sparse" / "0")
    errors = pose_errors(model_poses(model, 60), truth.cam_from_world)
    assert errors.num_poses == NUM_IMAGES
    assert errors.ate < 0.01 * errors.extent
    assert errors.rotation < 0.3
    assert made.num_points > 10_000
    assert made.mean_error < 0.5


def test_report(made: ReconstructReport) -> None:
    report = json.loads((made.output / "report.json").read_text())
    assert report["num_points"] == made.num_points
    assert report["mapper"] == "global"
    assert set(report["seconds"]) >= {"motion", "poses", "points", "images"}
    with pycolmap.Database.open(made.database) as database:
        assert database.num_images() == NUM_IMAGES
        assert database.num_verified_image_pairs() > NUM_IMAGES


def test_goes_on_after_finished_stages(made: ReconstructReport) -> None:
    files = {p: p.stat().st_mtime_ns for p in made.output.glob("[is]*/**/*.*")}
    again = reconstruct(SCENE, made.output, options=OPTIONS)
    assert again.resumed == ("tracks", "matches", "poses", "adjustment", "model")
    assert {p: p.stat().st_mtime_ns for p in made.output.glob("[is]*/**/*.*")} == files
    assert replace(again, resumed=(), seconds=made.seconds) == made


def test_changed_option_redoes_what_depends_on_it(made: ReconstructReport) -> None:
    before = (made.output / "sparse" / "0" / "points3D.bin").read_bytes()
    strict = replace(OPTIONS, triangulate=TriangulateOptions(min_observations=6))
    fewer = reconstruct(SCENE, made.output, options=strict)
    assert fewer.resumed == ("tracks", "matches", "poses", "adjustment")
    assert fewer.num_points < made.num_points
    assert reconstruct(SCENE, made.output, options=OPTIONS).num_points == made.num_points
    assert (made.output / "sparse" / "0" / "points3D.bin").read_bytes() == before


def test_stopped_run(made: ReconstructReport, monkeypatch: pytest.MonkeyPatch) -> None:
    """An interrupt and a full disk leave the old output whole and are gone on after."""
    before = {p: p.read_bytes() for p in made.output.glob("[is]*/**/*.*")}
    other = replace(OPTIONS, triangulate=TriangulateOptions(min_angle=2.0))

    def interrupt(stage: str, done: int, total: int | None) -> None:
        if stage == "images" and done > 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        reconstruct(SCENE, made.output, options=other, progress=interrupt)
    assert {p: p.read_bytes() for p in made.output.glob("[is]*/**/*.*")} == before

    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, "No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr(importlib.import_module("colmap_av1.reconstruct_stages"), "write_model", full)
        with pytest.raises(ModelError, match="No space left on device: the stages before are kept"):
            reconstruct(SCENE, made.output, options=other)
    assert {p: p.read_bytes() for p in made.output.glob("[is]*/**/*.*")} == before
    assert not list((made.output / ".stages").glob("*.partial"))
    assert reconstruct(SCENE, made.output, options=OPTIONS).resumed[-1] == "model"


def test_interrupted_mapper_ends(made: ReconstructReport, tmp_path: Path) -> None:
    def interrupt(stage: str, done: int, total: int | None) -> None:
        if done >= 2:
            raise KeyboardInterrupt

    copy = tmp_path / "mapped.db"
    copy.write_bytes(made.database.read_bytes())
    with pytest.raises(KeyboardInterrupt):
        mapper_module.map_poses(
            copy,
            tmp_path / "poses",
            mapper="incremental",
            refine_intrinsics=True,
            forward_motion=False,
            seed=0,
            num_threads=1,
            log=tmp_path / "log",
            num_images=NUM_IMAGES,
            progress=interrupt,
        )
    assert not list((tmp_path / "poses").glob("*.bin"))


def test_mapper_that_fails(tmp_path: Path) -> None:
    (tmp_path / "no.db").write_bytes(b"no database")
    with pytest.raises(ModelError, match="log tells where"):
        mapper_module.map_poses(
            tmp_path / "no.db",
            tmp_path / "poses",
            mapper="global",
            refine_intrinsics=True,
            forward_motion=False,
            seed=0,
            num_threads=1,
            log=tmp_path / "log",
            num_images=3,
            progress=lambda *_: None,
        )
    assert (tmp_path / "log").stat().st_size > 0


def test_adjustment_mends_poses(made: ReconstructReport, truth: Truth, tmp_path: Path) -> None:
    model = read_model(made.output / ".stages" / "adjusted")
    rng = np.random.default_rng(0)
    for frame in model.frames.values():
        pose = frame.rig_from_world
        turn = pycolmap.Rotation3d(rng.normal(0.0, 0.004, 3)) * pose.rotation
        frame.rig_from_world = pycolmap.Rigid3d(turn, pose.translation + rng.normal(0.0, 0.02, 3))
    bent = pose_errors(model_poses(model, 60), truth.cam_from_world)
    focal_length = model.cameras[1].mean_focal_length()
    model.write_binary(tmp_path)
    mapper_module.adjust_model(
        tmp_path,
        refine_intrinsics=False,
        loss_scale=0.5,
        seed=0,
        num_threads=1,
        log=tmp_path / "log",
    )
    adjusted = read_model(tmp_path)
    errors = pose_errors(model_poses(adjusted, 60), truth.cam_from_world)
    before = pose_errors(
        model_poses(read_model(made.output / "sparse" / "0"), 60), truth.cam_from_world
    )
    assert errors.rotation < min(bent.rotation / 3, before.rotation + 0.05)
    assert errors.ate < min(bent.ate / 3, before.ate * 1.5)
    assert adjusted.cameras[1].mean_focal_length() == focal_length


def test_without_adjustment(made: ReconstructReport, tmp_path: Path) -> None:
    shutil.copytree(made.output, tmp_path / "plain")
    options = replace(OPTIONS, mapping=replace(OPTIONS.mapping, adjust=False))
    plain = reconstruct(SCENE, tmp_path / "plain", options=options)
    assert plain.resumed == ("tracks", "matches", "poses")
    mapped = read_model(plain.output / ".stages" / "poses")
    poses = model_poses(read_model(plain.output / "sparse" / "0"), 60)
    np.testing.assert_allclose(poses, model_poses(mapped, 60), atol=1e-9)
    adjusted = model_poses(read_model(made.output / "sparse" / "0"), 60)
    assert np.nanmax(np.abs(poses - adjusted)) > 1e-4


def test_folder_of_others(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("chapter 1")
    with pytest.raises(OptionError, match="not empty and not the output of an earlier run"):
        reconstruct(SCENE, tmp_path, options=OPTIONS)
    assert [p.name for p in tmp_path.iterdir()] == ["thesis.tex"]


@pytest.mark.parametrize(
    "options",
    [
        replace(OPTIONS, match=MatchOptions(camera=CameraOptions(single_camera=False))),
        replace(OPTIONS, match=MatchOptions(images=ImageOptions(image_name="a.b_%d.png"))),
        replace(OPTIONS, mapping=MapperOptions(mapper="best")),  # type: ignore[arg-type]
        replace(OPTIONS, mapping=MapperOptions(pose_tracks_per_image=1)),
        replace(OPTIONS, triangulate=TriangulateOptions(min_angle=-1)),
    ],
)
def test_options_that_cannot_work(options: ReconstructOptions, tmp_path: Path) -> None:
    with pytest.raises(OptionError):
        reconstruct(SCENE, tmp_path / "out", options=options)
    assert not (tmp_path / "out").exists()


def test_camera_that_only_turns(encode: Encode, tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    wall = cv2.resize(rng.integers(0, 256, (90, 120, 3), dtype=np.uint8), (960, 720))
    camera = np.array([[300.0, 0, 160], [0, 300, 120], [0, 0, 1]])
    frames = []
    for i in range(16):
        angle = np.radians(1.2 * (i - 8))
        turn = cv2.Rodrigues(np.array([0.2 * angle, angle, 0]))[0]
        shown = (
            camera
            @ turn
            @ np.linalg.inv(camera)
            @ np.array([[1, 0, -320], [0, 1, -240], [0, 0, 1]])
        )
        frames.append(cv2.warpPerspective(wall, shown, (320, 240)))
    frames = np.stack(frames)
    video = encode(frames, tmp_path / "flat.mp4")
    report = reconstruct(video, tmp_path / "out", options=OPTIONS_OF_ALL_FRAMES)
    assert any("the camera only turns or the scene is flat" in w for w in report.warnings)


def test_camera_that_stands_still(encode: Encode, tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    wall = cv2.resize(rng.integers(0, 256, (60, 80, 3), dtype=np.uint8), (320, 240))
    video = encode(np.stack([wall] * 8), tmp_path / "still.mp4")
    with pytest.raises(ModelError, match=r"finds no start: too little parallax, in \d+ of"):
        reconstruct(video, tmp_path / "out", options=OPTIONS_OF_ALL_FRAMES)
    assert (tmp_path / "out" / "database.db").is_file()
    assert not (tmp_path / "out" / "sparse").exists()


def test_densify_on_true_poses(truth: Truth, tmp_path: Path) -> None:
    """Points lie where the rendered clip's depth says, and in its colours."""
    model = true_model(tmp_path / "model", truth, range(0, 60, 4))
    options = DensifyOptions(match=MatchOptions(images=ImageOptions(first_number=0)))
    report = densify(model, SCENE, tmp_path / "dense", options=options)
    assert report.num_images == 15
    assert report.agreeing > 0.9
    dense = pycolmap.Reconstruction(tmp_path / "dense")
    assert dense.num_points3D() == report.num_points > 8_000
    assert sorted(dense.images) == sorted(pycolmap.Reconstruction(model).images)
    assert list(dense.cameras) == [7]
    fx, fy, cx, cy = truth.camera.params
    wrong, num_checked = [], 0
    for image in dense.images.values():
        frame = int(Path(image.name).stem)
        assert np.allclose(image.cam_from_world().matrix(), truth.cam_from_world[frame])
        ids = [p.point3D_id for p in image.points2D]
        xyz = np.array([dense.points3D[i].xyz for i in ids])
        x, y, z = truth.cam_from_world[frame] @ np.column_stack([xyz, np.ones(len(xyz))]).T
        column = np.abs((fx * x / z + cx)[:, None] - truth.depth_x).argmin(axis=1)
        row = np.abs((fy * y / z + cy)[:, None] - truth.depth_y).argmin(axis=1)
        # Depth is known on a grid: its neighbourhood tells where it is smooth.
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


def test_densify_refuses_what_does_not_fit(truth: Truth, clip: Path, tmp_path: Path) -> None:
    model = true_model(tmp_path / "model", truth, range(60))
    with pytest.raises(ImageError, match="640x360"):
        densify(model, clip, tmp_path / "dense")
    shuffled = true_model(tmp_path / "shuffled", truth, range(60), shuffle=7)
    with pytest.raises(ModelError, match="of the video's tracks agree with the model's poses"):
        densify(shuffled, SCENE, tmp_path / "dense")
    with pytest.raises(ModelError, match="holds no COLMAP model"):
        densify(tmp_path, SCENE, tmp_path / "dense")
    (tmp_path / "empty").mkdir()
    write_model(tmp_path / "empty", {7: truth.camera}, [], NO_POINTS)
    with pytest.raises(ModelError, match="no image of the model has a pose"):
        densify(tmp_path / "empty", SCENE, tmp_path / "dense")
    few = true_model(tmp_path / "few", truth, range(20))
    with pytest.raises(ImageError, match="do not say which frames"):
        densify(few, SCENE, tmp_path / "dense")
    with pytest.raises(OptionError, match="not empty"):
        densify(model, SCENE, model)
    names = {p.name for p in tmp_path.iterdir()}
    assert names == {"model", "shuffled", "empty", "few"}


def test_undistorted_picture_shows_the_same() -> None:
    for k in (-0.12, 0.1):
        camera = pycolmap.Camera(
            camera_id=3, model="SIMPLE_RADIAL", width=320, height=240, params=[250, 160, 120, k]
        )
        pinhole = pinhole_camera(camera)
        assert (pinhole.model_name, pinhole.width, pinhole.height) == ("PINHOLE", 320, 240)
        undistort = undistortion(camera, pinhole)
        assert undistort is not None
        assert undistort(np.full((240, 320, 3), 200, np.uint8)).min() == 200
        at = np.array([[60.5, 50.5], [250.5, 180.5]], np.float32)
        picture = np.zeros((240, 320, 3), np.uint8)
        for x, y in at:
            cv2.circle(picture, (int(x), int(y)), 3, (255, 255, 255), -1)
        flat = undistort(picture)[..., 0].astype(float)
        for x, y in on_pinhole(camera, pinhole, at):
            near = np.mgrid[int(y) - 8 : int(y) + 9, int(x) - 8 : int(x) + 9]
            weight = flat[near[0], near[1]]
            centre = [(weight * (n + 0.5)).sum() / weight.sum() for n in near[::-1]]
            assert np.allclose(centre, [x, y], atol=0.3)
        # As wide as can be: some edge pixel comes from the source's edge.
        wider = pycolmap.Camera(model="PINHOLE", width=320, height=240, params=pinhole.params * 1)
        wider.params = [p * 0.98 for p in pinhole.params[:2]] + list(pinhole.params[2:])
        undistort_wider = undistortion(camera, wider)
        ramp = np.zeros((240, 320, 3), np.uint8)
        ramp[2:-2, 2:-2] = 255
        assert undistort_wider is not None
        assert undistort_wider(ramp).min() == 0
    plain = pycolmap.Camera(
        camera_id=3, model="SIMPLE_PINHOLE", width=320, height=240, params=[250, 160, 120]
    )
    assert undistortion(plain, pinhole_camera(plain)) is None
    assert list(pinhole_camera(plain).params) == [250, 250, 160, 120]


def test_command_line(
    made: ReconstructReport, truth: Truth, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["reconstruct", "--video", str(SCENE), "--output", str(made.output)]
    words += ["--every", str(EVERY), "--pose_tracks_per_image", "300", "--pose-spacing", "24"]
    assert main(words) == 0
    told = capsys.readouterr()
    assert f"points\t{made.num_points}, " in told.out
    assert "finished before\ttracks, matches, poses, adjustment, model" in told.out
    model = made.output / "sparse" / "0"
    words = ["densify", "--model", str(model), "--video", str(SCENE), "--frame_list"]
    (tmp_path / "list.txt").write_text(
        "".join(f"{f} frame_{f:06d}.png\n" for f in range(0, 60, EVERY))
    )
    words += [str(tmp_path / "list.txt"), "--output", str(tmp_path / "dense")]
    assert main(words) == 0
    assert "agree with the poses" in capsys.readouterr().out
    assert main(words) == 2
    assert "error: " in capsys.readouterr().err
