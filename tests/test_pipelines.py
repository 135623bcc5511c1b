"""The pipeline scripts run with COLMAP's command and stand-ins for tools without a package."""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import stat
import subprocess
import sys
import textwrap
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pycolmap
import pytest
from conftest import AV1, PROJECT, Ffmpeg

PIPELINES = PROJECT / "examples" / "pipelines"
NUM_IMAGES = 8
FEW = ("--preset", "sparse", "--max_tracks_per_image", "500")

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(shutil.which("colmap") is None, reason="no colmap command on PATH"),
    pytest.mark.skipif(os.name == "nt", reason="the scripts need a Unix shell"),
]


@pytest.fixture(scope="module")
def video(ffmpeg: Ffmpeg, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Every seventh frame of the example clip, at three quarters of the size."""
    every = [
        "-vf",
        "select=not(mod(n\\,7)),setpts=N/25/TB,scale=480:270:flags=area",
        "-frames:v",
        str(NUM_IMAGES),
    ]
    output = tmp_path_factory.mktemp("video") / "every seventh.mp4"
    clip = PROJECT / "examples" / "scene.mp4"
    return ffmpeg("-i", clip, *every, "-pix_fmt", "yuv420p", *AV1, output)


@pytest.fixture
def tools(tmp_path: Path) -> Path:
    """A folder of commands: this package, this Python, ffmpeg, and stand-ins for other tools."""
    folder = tmp_path / "tools"
    folder.mkdir()
    # Without the working folder on the path, which would hide the installed package.
    path = "import sys; sys.path[:] = filter(None, sys.path)"
    program = f"{path}; from colmap_av1.cli import main; sys.exit(main())"
    add_command(folder, "colmap-av1", f'exec "{sys.executable}" -c "{program}" "$@"')
    add_command(folder, "python", f'exec "{sys.executable}" "$@"')
    add_command(folder, "ffmpeg", f'exec "{imageio_ffmpeg.get_ffmpeg_exe()}" "$@"')
    return folder


def add_command(folder: Path, name: str, script: str) -> None:
    path = folder / name
    path.write_text(f"#!/bin/sh\n{textwrap.dedent(script)}\n")
    path.chmod(path.stat().st_mode | stat.S_IXUSR)


def run(name: str, tools: Path, *words: object, **more: str) -> None:
    """Run a script with the tools first on the path."""
    result = subprocess.run(
        [str(PIPELINES / name), *map(str, words)],
        env={
            **os.environ,
            "PATH": f"{tools}{os.pathsep}{os.environ['PATH']}",
            "PYTHONPATH": os.pathsep.join([str(tools), *sys.path]),
            "QT_QPA_PLATFORM": "offscreen",
            **more,
        },
        capture_output=True,
        text=True,
        check=False,
    )
    assert result.returncode == 0, result.stdout[-2000:] + result.stderr[-2000:]


def largest_model(folder: Path) -> pycolmap.Reconstruction:
    models = [pycolmap.Reconstruction(path) for path in folder.iterdir() if path.is_dir()]
    return max(models, key=lambda model: model.num_reg_images())


def check_model(model: pycolmap.Reconstruction, folder: Path, least_points: int = 500) -> None:
    assert model.num_reg_images() == NUM_IMAGES
    assert model.num_points3D() > least_points
    assert model.compute_mean_reprojection_error() < 1
    assert {i.name for i in model.images.values()} == {p.name for p in folder.iterdir()}


def test_colmap(tmp_path: Path, tools: Path, video: Path) -> None:
    run("colmap.sh", tools, video, tmp_path / "my work", *FEW)
    check_model(largest_model(tmp_path / "my work/sparse"), tmp_path / "my work/images")


def test_colmap_with_sift(tmp_path: Path, tools: Path, video: Path) -> None:
    """The model has points from tracks and from SIFT."""
    run(
        *("colmap_with_sift.sh", tools, video, tmp_path / "work", *FEW),
        EXTRACTOR_OPTIONS="--SiftExtraction.use_gpu 0 --SiftExtraction.max_num_features 600 "
        "--SiftExtraction.first_octave 0",
        MATCHER_OPTIONS="--SiftMatching.use_gpu 0 --SequentialMatching.overlap 4",
    )
    model = largest_model(tmp_path / "work/sparse")
    check_model(model, tmp_path / "work/images")
    with pycolmap.Database.open(tmp_path / "work/database.db") as database:
        num_sift = {
            image.image_id: int((np.asarray(d.data).sum(axis=1) > 0).sum())
            for image in database.read_all_images()
            for d in [database.read_descriptors(image.image_id)]
        }
    of_sift = [
        all(e.point2D_idx < num_sift[e.image_id] for e in point.track.elements)
        for point in model.points3D.values()
    ]
    assert 50 < sum(of_sift) < len(of_sift) - 500


def test_colmap_dense(tmp_path: Path, tools: Path, video: Path) -> None:
    """The dense model has the poses of the mapper and many more points."""
    run("colmap_dense.sh", tools, video, tmp_path / "my work", "--preset", "sparse")
    sparse = largest_model(tmp_path / "my work/sparse")
    dense = pycolmap.Reconstruction(tmp_path / "my work/dense")
    check_model(dense, tmp_path / "my work/images", 3 * sparse.num_points3D())
    poses = {i.name: i.cam_from_world().matrix() for i in sparse.images.values()}
    for image in dense.images.values():
        assert np.allclose(image.cam_from_world().matrix(), poses[image.name], atol=1e-6)


# A stand-in for convert.py with --skip_matching: undistorts the images and moves the model.
CONVERT = """
    import argparse, pathlib, subprocess
    parser = argparse.ArgumentParser()
    parser.add_argument("-s", dest="source", type=pathlib.Path, required=True)
    parser.add_argument("--skip_matching", action="store_true", required=True)
    source = parser.parse_args().source
    subprocess.run(
        ["colmap", "image_undistorter", "--image_path", source / "input", "--output_path", source,
         "--input_path", source / "distorted/sparse/0", "--output_type", "COLMAP"],
        check=True,
    )
    files = list((source / "sparse").iterdir())
    (source / "sparse/0").mkdir()
    for file in files:
        file.rename(source / "sparse/0" / file.name)
"""


def test_gaussian_splatting(tmp_path: Path, tools: Path, video: Path) -> None:
    (tools / "convert.py").write_text(textwrap.dedent(CONVERT))
    run(
        *("gaussian_splatting.sh", tools, video, tmp_path / "source", *FEW),
        CONVERT=str(tools / "convert.py"),
    )
    dense = tmp_path / "source/distorted/sparse/0"
    model = pycolmap.Reconstruction(tmp_path / "source/sparse/0")
    assert [camera.model_name for camera in model.cameras.values()] == ["PINHOLE"]
    check_model(model, tmp_path / "source/images", least_points=3000)
    # COLMAP's undistortion also keeps points that fill holes.
    assert model.num_points3D() == pycolmap.Reconstruction(dense).num_points3D()
    assert largest_model(tmp_path / "source/distorted/mapped").num_points3D() < 3000


# A stand-in for ns-process-data with --skip-colmap: copies the images under new names and writes
# the cameras of the model with these names.
NERFSTUDIO = """
    import argparse, json, pathlib, shutil
    import numpy, pycolmap
    parser = argparse.ArgumentParser()
    parser.add_argument("kind", choices=["images"])
    parser.add_argument("--data", type=pathlib.Path, required=True)
    parser.add_argument("--output-dir", dest="output", type=pathlib.Path, required=True)
    parser.add_argument("--skip-colmap", action="store_true", required=True)
    arguments = parser.parse_args()
    names = {}
    (arguments.output / "images").mkdir()
    for number, path in enumerate(sorted(arguments.data.iterdir()), 1):
        names[path.name] = f"frame_{number:05d}{path.suffix}"
        shutil.copy(path, arguments.output / "images" / names[path.name])
    model = pycolmap.Reconstruction(arguments.output / "colmap/sparse/0")
    frames = [{"file_path": f"images/{names[i.name]}"} for i in model.images.values()]
    (camera,) = model.cameras.values()
    transforms = {"camera_model": camera.model_name, "frames": frames}
    (arguments.output / "transforms.json").write_text(json.dumps(transforms))
"""


def test_nerfstudio(tmp_path: Path, tools: Path, video: Path) -> None:
    (tools / "process.py").write_text(textwrap.dedent(NERFSTUDIO))
    add_command(tools, "ns-process-data", f'exec "{sys.executable}" "{tools}/process.py" "$@"')
    run("nerfstudio.sh", tools, video, tmp_path / "data", *FEW)
    model = pycolmap.Reconstruction(tmp_path / "data/colmap/sparse/0")
    check_model(model, tmp_path / "data/frames", least_points=3000)
    assert largest_model(tmp_path / "data/colmap/mapped").num_points3D() < 3000
    transforms = json.loads((tmp_path / "data/transforms.json").read_text())
    assert transforms["camera_model"] == "OPENCV"
    files = [tmp_path / "data" / frame["file_path"] for frame in transforms["frames"]]
    assert len(set(files)) == NUM_IMAGES
    assert all(file.is_file() for file in files)


# A stand-in for hloc.reconstruction: imports images, features and matches, verifies and maps.
HLOC = """
    import argparse, pathlib
    import h5py, numpy, pycolmap
    parser = argparse.ArgumentParser()
    for name in ("sfm_dir", "image_dir", "pairs", "features", "matches"):
        parser.add_argument(f"--{name}", type=pathlib.Path, required=True)
    parser.add_argument("--camera_mode", choices=["SINGLE"], required=True)
    arguments = parser.parse_args()
    arguments.sfm_dir.mkdir()
    path = arguments.sfm_dir / "database.db"
    pycolmap.Database.open(path).close()
    pycolmap.import_images(path, arguments.image_dir, pycolmap.CameraMode.SINGLE)
    with (
        pycolmap.Database.open(path) as database,
        h5py.File(arguments.features) as features,
        h5py.File(arguments.matches) as matches,
    ):
        ids = {image.name: image.image_id for image in database.read_all_images()}
        for name, image_id in ids.items():
            database.write_keypoints(image_id, features[name]["keypoints"][()] + 0.5)
        for line in arguments.pairs.read_text().splitlines():
            a, b = line.split()
            matches0 = matches[a][b]["matches0"][()]
            assert len(matches0) == len(features[a]["keypoints"])
            assert matches[a][b]["matching_scores0"].shape == matches0.shape
            (index,) = numpy.nonzero(matches0 != -1)
            rows = numpy.stack([index, matches0[index]], axis=1).astype(numpy.uint32)
            database.write_matches(ids[a], ids[b], rows)
    pycolmap.verify_matches(path, arguments.pairs)
    models = pycolmap.incremental_mapping(path, arguments.image_dir, arguments.sfm_dir)
    max(models.values(), key=lambda m: m.num_reg_images()).write(arguments.sfm_dir)
"""


def test_hloc(tmp_path: Path, tools: Path, video: Path) -> None:
    if importlib.util.find_spec("hloc") is None:
        (tools / "hloc").mkdir()
        (tools / "hloc" / "reconstruction.py").write_text(textwrap.dedent(HLOC))
    run("hloc.sh", tools, video, tmp_path / "outputs", *FEW)
    model = pycolmap.Reconstruction(tmp_path / "outputs/sfm")
    check_model(model, tmp_path / "outputs/images")
