"""Front-ends and mapper of the comparison, and measurement of their time and memory."""

import csv
import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pycolmap
import pytest
from conftest import AV1, PROJECT
from sequences import measure_frontend, model_poses, prepare_footage
from track_metrics import database_tracks, track_statistics

from colmap_av1 import build_tracks, match, read_motion
from colmap_av1.errors import DatabaseError, EvaluationError, VideoError
from colmap_av1.evaluate import (
    densify_model,
    measure_mapper,
    model_figures,
    pose_errors,
    run_measured,
)
from colmap_av1.options import CameraOptions, DensityOptions, MapOptions, MatchOptions, TrackOptions

EXAMPLES = PROJECT / "examples"


def _work(megabytes, seconds):
    """Use memory and CPU time, and return the process id."""
    block = np.ones(megabytes << 17)
    end = time.process_time() + seconds
    while time.process_time() < end:
        block[0] += 1
    print("worked")
    return os.getpid()


def _fail(error):
    raise error


def test_call_is_measured_in_its_own_process(tmp_path):
    """Memory of this process, 300 MiB here, must not count."""
    ballast = np.ones(300 << 17)
    small = run_measured(_work, 1, 0.3, log=tmp_path / "log")
    large = run_measured(_work, 200, 0.3, log=tmp_path / "log")
    assert small.result != os.getpid()
    assert 0.28 <= small.cpu_seconds < 1.0
    assert small.seconds >= 0.28
    assert (tmp_path / "log").read_text() == "worked\nworked\n"
    if small.peak_memory is not None:
        assert 150 << 20 < large.peak_memory - small.peak_memory < 250 << 20
        assert large.peak_memory < ballast.nbytes + (200 << 20)


def test_failing_call_raises_its_error_and_writes_a_log(tmp_path):
    log = tmp_path / "log"
    with pytest.raises(VideoError, match="no such video"):
        run_measured(_fail, VideoError("no such video"), log=log)
    with pytest.raises(EvaluationError, match="KeyError: 7"):
        run_measured(_fail, KeyError(7), log=log)
    assert "Traceback" in log.read_text()
    with pytest.raises(EvaluationError, match="status 3"):
        run_measured(os._exit, 3, log=log)


def _write_to_log_of_colmap(text):
    pycolmap.logging.warning(text)


def test_log_of_colmap_is_written_to_the_log_alone(tmp_path, monkeypatch):
    temporary = tmp_path / "temporary"
    temporary.mkdir()
    monkeypatch.setenv("TMPDIR", str(temporary))
    run_measured(_write_to_log_of_colmap, "no pairs", log=tmp_path / "log")
    assert "no pairs" in (tmp_path / "log").read_text()
    assert list(temporary.iterdir()) == []


def _start(path):
    """Start a process that sleeps, write its id to a file, and wait for it."""
    child = subprocess.Popen([sys.executable, "-c", "import time; time.sleep(60)"])
    path.write_text(str(child.pid))
    child.wait()


@pytest.mark.skipif(not hasattr(os, "killpg"), reason="needs process groups")
def test_interrupt_ends_the_children_of_the_process(tmp_path):
    path = tmp_path / "pid"

    def interrupt():
        while not (path.exists() and path.read_text()):
            time.sleep(0.05)
        os.kill(os.getpid(), signal.SIGINT)

    # Processes in the background of a shell ignore interrupts by default.
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    thread = threading.Thread(target=interrupt)
    thread.start()
    try:
        with pytest.raises(KeyboardInterrupt):
            run_measured(_start, path, log=tmp_path / "log")
    finally:
        thread.join()
        signal.signal(signal.SIGINT, before)
    pid, end = int(path.read_text()), time.monotonic() + 10
    while _is_alive(pid) and time.monotonic() < end:
        time.sleep(0.05)
    assert not _is_alive(pid)


def _is_alive(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    # A process that has ended is a zombie until its parent waits for it.
    stat = Path(f"/proc/{pid}/stat")
    return not stat.exists() or stat.read_text().rpartition(")")[2].split()[0] != "Z"


def test_tracks_of_a_database_are_the_written_ones(clip, tmp_path):
    # Only verification can split a track, because all pairs of images are written.
    options = MatchOptions(
        tracks=TrackOptions(min_length=3), density=DensityOptions(preset="dense")
    )
    match(tmp_path / "a.db", clip, options=options)
    tracks = build_tracks(read_motion(clip), options.tracks)
    before = (tmp_path / "a.db").read_bytes()
    found = database_tracks(tmp_path / "a.db", 16)
    assert (tmp_path / "a.db").read_bytes() == before
    assert (found.num_frames, found.width, found.height) == (16, 192, 128)
    assert found.offsets[0] == 0
    assert found.lengths.min() >= 2
    assert found.offsets[-1] == found.num_observations == len(found.xy)
    written = {(f, *xy) for f, xy in zip(tracks.frame, tracks.xy.tolist(), strict=True)}
    assert {(f, *xy) for f, xy in zip(found.frame, found.xy.tolist(), strict=True)} <= written
    assert found.num_observations > 0.7 * tracks.num_observations
    track_of = {}
    for t in range(tracks.num_tracks):
        for i in range(*tracks.offsets[t : t + 2]):
            track_of[(tracks.frame[i], *tracks.xy[i].tolist())] = t
    for start, end in zip(found.offsets[:-1], found.offsets[1:], strict=True):
        assert (np.diff(found.frame[start:end]) > 0).all()
        own = {track_of[(found.frame[i], *found.xy[i].tolist())] for i in range(start, end)}
        assert len(own) == 1


def test_tracks_leave_out_contradicting_matches(tmp_path):
    """The matches lead to both keypoints of image 4: to 0 from image 3 and to 1 from image 2."""
    path = tmp_path / "a.db"
    with pycolmap.Database.open(path) as database:
        camera = pycolmap.Camera(model="PINHOLE", width=64, height=48, params=[50, 50, 32, 24])
        camera_id = database.write_camera(camera)
        for i in range(4):
            image = pycolmap.Image(name=f"{i}.png", camera_id=camera_id)
            image_id = database.write_image(image)
            database.write_keypoints(image_id, np.float32([[i, 1], [i, 9]]))
        for a, b, row in ((1, 2, [0, 0]), (2, 3, [0, 0]), (2, 4, [0, 1]), (3, 4, [0, 0])):
            geometry = pycolmap.TwoViewGeometry()
            geometry.inlier_matches = np.uint32([row])
            database.write_two_view_geometry(a, b, geometry)
    tracks = database_tracks(path, 5)
    assert tracks.offsets.tolist() == [0, 3]
    assert tracks.frame.tolist() == [0, 1, 2]
    assert tracks.xy.tolist() == [[0, 1], [1, 1], [2, 1]]

    pycolmap.Database.open(tmp_path / "empty.db").close()
    with pytest.raises(DatabaseError, match="0 sizes"):
        database_tracks(tmp_path / "empty.db", 5)


@pytest.fixture(scope="module")
def scene_footage(ffmpeg, tmp_path_factory):
    """Footage of the rendered clip at three quarters of the size."""
    folder = tmp_path_factory.mktemp("scene")
    words = ["-vf", "scale=480:270:flags=area", "-pix_fmt", "yuv420p", *AV1]
    video = tmp_path_factory.mktemp("smaller") / "smaller.mp4"
    ffmpeg("-i", EXAMPLES / "scene.mp4", *words, video)
    camera = CameraOptions(camera_model="PINHOLE", camera_params="390,390,240,135")
    return prepare_footage(video, folder, num_frames=60, image_step=8, camera=camera)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["av1-dense", "sift-sequential"])
def test_databases_of_frontends_can_be_mapped(name, scene_footage, tmp_path):
    run = measure_frontend(name, scene_footage, tmp_path / name)
    again = measure_frontend(name, scene_footage, tmp_path / name)
    assert again == run  # with the same times, because the first run is reused
    assert run.cpu_seconds > 0.1
    assert sum(run.seconds.values()) > 0.1
    with pycolmap.Database.open(run.database) as database:
        assert [i.name for i in database.read_all_images()] == scene_footage.names
        assert database.num_cameras() == 1
        (camera,) = database.read_all_cameras()
    assert camera.params.tolist() == [390, 390, 240, 135]
    statistics = track_statistics(database_tracks(run.database, 60), scene_footage.frames)
    assert statistics.num_images == 8
    assert statistics.num_tracks > 1000
    assert statistics.coverage[0] > 0.5

    settings = MapOptions(refine_intrinsics=False)
    arguments = (run.database, scene_footage.image_path, tmp_path / "model", settings)
    mapper = measure_mapper(*arguments)
    assert measure_mapper(*arguments) == mapper
    figures = model_figures(pycolmap.Reconstruction(mapper.model))
    assert figures.num_registered == 8
    assert figures.num_points > 1000
    assert figures.focal_lengths == (390, 390)
    assert 0 < figures.median_error < figures.mean_error < 1
    model = pycolmap.Reconstruction(mapper.model)
    assert figures.mean_error == pytest.approx(model.compute_mean_reprojection_error())
    with np.load(EXAMPLES / "scene_truth.npz") as truth:
        errors = pose_errors(model_poses(model, 60), truth["cam_from_world"])
    assert errors.num_poses == 8
    assert errors.ate < 0.01
    assert errors.rotation < 0.2

    dense = densify_model(mapper.model, scene_footage, tmp_path / "dense")
    assert densify_model(mapper.model, scene_footage, tmp_path / "dense") == dense
    again = pycolmap.Reconstruction(dense.model)
    np.testing.assert_allclose(model_poses(again, 60), model_poses(model, 60), atol=1e-12)
    assert model_figures(again).num_points > 3000
    assert model_figures(again).mean_error < 1


def test_mapper_reports_that_a_database_gives_no_model(clip, tmp_path):
    footage = prepare_footage(
        clip, tmp_path / "footage", num_frames=16, image_step=8, camera=CameraOptions()
    )
    assert sorted(p.name for p in footage.image_path.iterdir()) == footage.names
    run = measure_frontend("sift-exhaustive", footage, tmp_path / "run")
    with pycolmap.Database.open(run.database) as database:
        database.clear_two_view_geometries()
    mapper = measure_mapper(run.database, footage.image_path, tmp_path / "model")
    assert (mapper.model, mapper.num_models) == (None, 0)


@pytest.mark.slow
def test_benchmark_prints_its_tables(tmp_path):
    script = EXAMPLES / "benchmarks" / "tracks.py"
    results = tmp_path / "tracks.csv"
    words = ["--cache", tmp_path, "--sequences", "scene", "--frontends", "av1-sparse"]
    words += ["--results", results, "--no_mapping"]
    done = subprocess.run(
        [sys.executable, script, *words], check=True, capture_output=True, text=True
    )
    header, _, row = [line for line in done.stdout.splitlines() if line.startswith("|")]
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    assert len(cells) == header.count("|") - 1
    assert cells[0] == "av1-sparse"
    tracks = int(cells[1].replace(",", ""))
    assert sum(int(cell.replace(",", "")) for cell in cells[2:7]) == tracks > 1000
    exact = [float(value) for value in cells[-2].split("/")]
    assert all(0 < value < 0.5 for value in exact)
    (kept,) = csv.DictReader(results.read_text().splitlines())
    assert (int(kept["tracks"]), kept["frontend"]) == (tracks, "av1-sparse")
    assert kept["commit"]
    assert kept["machine"]
