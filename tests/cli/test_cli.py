from __future__ import annotations

import os
import pty
import shlex
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest
from conftest import HANDLE_INTERRUPTS, PROJECT, Encode, Ffmpeg, make_frames

from colmap_av1.cli import main
from colmap_av1.database.reading import read_cameras, read_images

COMMAND = [sys.executable, "-m", "colmap_av1"]


def read_table(text: str) -> dict[str, str]:
    return dict(line.split("\t") for line in text.splitlines())


@pytest.mark.parametrize("words", ["--version", "--help", "match --help", "info --video {clip}"])
def test_short_commands_import_no_large_libraries(words: str, clip: Path, tmp_path: Path) -> None:
    listing = (
        "import sys\nfrom colmap_av1.cli import main\ntry: main(sys.argv[1:])\nfinally: "
        "print(*{name.split('.')[0] for name in sys.modules})"
    )
    run = subprocess.run(
        [sys.executable, "-c", listing, *words.format(clip=clip).split()],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    loaded = set(run.stdout.splitlines()[-1].split())
    assert not loaded & {"pycolmap", "cv2", "scipy", "h5py", "rich"}


def test_match_command(clip: Path, tmp_path: Path) -> None:
    words = ["match", "--database", "a.db", "--video", str(clip), "--image_path", "my frames"]
    run = subprocess.run(
        [*COMMAND, *words], cwd=tmp_path, capture_output=True, text=True, check=True
    )
    table = read_table(run.stdout)
    assert run.stderr == ""
    assert table["frames"] == "16 shown, 16 coded"
    assert table["images"] == "16, 16 written"
    assert int(table["tracks"]) > 300
    assert float(table["seconds, total"]) > 0
    assert len(list((tmp_path / "my frames").iterdir())) == 16
    assert len(read_images(tmp_path / "a.db")) == 16
    make_folder, mapper = table["next"].split(" && ")
    assert shlex.split(make_folder) == ["mkdir", "-p", "a_model"]
    assert shlex.split(mapper)[:2] == ["colmap", "mapper"]
    assert shlex.split(mapper)[2:] == [
        *("--database_path", "a.db", "--image_path", "my frames", "--output_path", "a_model"),
    ]
    assert shlex.split(table["or"]) == [
        *("colmap-av1", "map", "--database", "a.db", "--image_path", "my frames"),
        *("--output", "a_model"),
    ]
    assert shlex.split(table["then, for splats"]) == [
        *("colmap-av1", "densify", "--model", "a_model/0", "--video", str(clip)),
        *("--image_path", "my frames", "--output", "a_splats"),
    ]


def test_refine_option(clip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = ["match", "--database", str(tmp_path / "a.db"), "--video", str(clip), "--refine", "lk"]
    assert main(words) == 0
    assert float(read_table(capsys.readouterr().out)["seconds, refinement"]) > 0


def test_options_have_several_spellings(clip: Path, tmp_path: Path) -> None:
    words = [
        *("match", f"--database_path={tmp_path / 'a.db'}", "--video-path", str(clip)),
        *("--ImageReader.camera_model", "PINHOLE", "--camera-params=200,200,96,64"),
        *("--ImageReader.single_camera", "0", "--min-length", "6", "--cosine", "none"),
        *("--offsets", "1,2", "--growth=1", "--random-seed", "3", "--num_threads", "1", "--quiet"),
    ]
    assert main(words) == 0
    cameras = read_cameras(tmp_path / "a.db")
    assert len(cameras) == 16
    assert all(c.model_name == "PINHOLE" for c in cameras.values())
    assert cameras[1].params.tolist() == [200, 200, 96, 64]


def test_dashes_and_underscores_in_values_are_kept(clip: Path, tmp_path: Path) -> None:
    assert main(["match", f"--database={tmp_path}/a-b_c.db", "--video", str(clip), "--quiet"]) == 0
    assert (tmp_path / "a-b_c.db").exists()


BAD = [
    (["--video", "none.mp4"], "none.mp4: no such file"),
    (["--video", "text.mp4"], "text.mp4: not a video"),
    (["--video", "empty.mp4"], "empty.mp4: "),
    (["--video", "tone.mp4"], "tone.mp4: "),
    (["--video", "unfinished.mp4"], "incomplete"),
    (["--video", "h264.mp4", "--encoder", "x264"], "encoder"),
    (["--video", "h264.mp4", "--keep_stream", "text.mp4"], "text.mp4: "),
    (["--video", "h264.mp4", "--keep_stream", "absent/s.mp4"], "absent: "),
    (["--camera_params", "1,2"], "camera_params"),
    (["--min_length", "many"], "--min_length"),
    (["--offsets", "1,two"], "--offsets"),
    (["--spacing", "wide"], "--spacing"),
    (["--single_camera", "maybe"], "--single_camera"),
    (["--no_such_option", "1"], "--no_such_option"),
    (["--image_path", "text.mp4"], "text.mp4: "),
    (["--image_path", "small"], "small/frame_000002.png: "),
    (["--database", "text.mp4"], "COLMAP"),
    (["--database", "absent/a.db"], "absent"),
]


@pytest.fixture(scope="module")
def bad_files(
    tmp_path_factory: pytest.TempPathFactory, clip: Path, ffmpeg: Ffmpeg, encode: Encode
) -> Path:
    folder = tmp_path_factory.mktemp("bad")
    (folder / "clip.mp4").symlink_to(clip)
    (folder / "text.mp4").write_text("this is not a video\n" * 100)
    (folder / "empty.mp4").touch()
    ffmpeg("-f", "lavfi", "-i", "sine=duration=0.2", folder / "tone.mp4")
    h264 = encode(make_frames(3), folder / "h264.mp4", "-c:v", "libx264")
    (folder / "unfinished.mp4").write_bytes(h264.read_bytes()[:-3000])
    small = encode(make_frames(3, 96, 64), folder / "small.mp4")
    (folder / "small").mkdir()
    ffmpeg("-i", small, "-start_number", "0", folder / "small/frame_%06d.png")
    for name in ("frame_000000.png", "frame_000001.png"):
        (folder / "small" / name).unlink()
    return folder


@pytest.mark.parametrize(("words", "message"), BAD, ids=lambda v: v if isinstance(v, str) else "")
def test_invalid_input_gives_one_line_and_status_2(
    bad_files: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    words: list[str],
    message: str,
) -> None:
    monkeypatch.chdir(bad_files)
    before = sorted(bad_files.rglob("*"))
    video = [] if "--video" in words else ["--video", "clip.mp4"]
    try:
        status: object = main(["match", "--database", "a.db", *video, *words])
    except SystemExit as error:  # raised by argparse
        status = error.code
    out, err = capsys.readouterr()
    assert status == 2
    assert out == ""
    assert err.startswith("colmap-av1: error: ")
    assert err.count("\n") == 1
    assert message in err
    assert sorted(bad_files.rglob("*")) == before


def test_damage_is_reported(
    clip: Path, ffmpeg: Ffmpeg, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    whole = ffmpeg("-i", clip, "-c", "copy", "-movflags", "+faststart", tmp_path / "whole.mp4")
    cut = tmp_path / "cut.mp4"
    cut.write_bytes(whole.read_bytes()[: int(whole.stat().st_size * 0.9)])
    words = ["match", "--database", str(tmp_path / "a.db"), "--video", str(cut)]
    assert main([*words, "--strict"]) == 2
    assert "cut off" in capsys.readouterr().err
    assert not (tmp_path / "a.db").exists()
    assert main(words) == 0
    _, err = capsys.readouterr()
    assert err.startswith("colmap-av1: warning: ")
    assert "cut off" in err
    assert len(read_images(tmp_path / "a.db")) < 16
    assert main(["info", "--video", str(cut)]) == 0
    assert capsys.readouterr().err.startswith("colmap-av1: warning: ")
    assert main(["info", "--video", str(cut), "--strict"]) == 2


def test_info_command(clip: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["info", "--video", str(clip)]) == 0
    table = read_table(capsys.readouterr().out)
    assert table["codec"] == "av1"
    assert table["size"] == "192x128"
    assert table["frames"].startswith("16 shown, 16 coded, 0 never shown, 1 intra")
    assert table["for matching"] == "good"


@pytest.mark.parametrize("ending", ["npz", "h5"])
def test_motion_command(
    clip: Path, tmp_path: Path, ending: str, capsys: pytest.CaptureFixture[str]
) -> None:
    output = tmp_path / f"m.{ending}"
    assert main(["motion", "--video", str(clip), "--output", str(output)]) == 0
    assert read_table(capsys.readouterr().out) == {"coded frames": "16", "output": str(output)}
    assert list(tmp_path.iterdir()) == [output]


def test_path_refused_by_the_system_is_reported(
    clip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    database = str(tmp_path / ("a" * 300))
    assert main(["match", "--video", str(clip), "--database", database]) == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert "File name too long: " in line


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no such names")
def test_file_names_may_be_invalid_text_or_several_lines(clip: Path, tmp_path: Path) -> None:
    name = os.fsdecode(b"\xff.mp4")
    (tmp_path / name).symlink_to(clip)
    strict = {**os.environ, "PYTHONIOENCODING": "utf-8:strict"}
    words = [*COMMAND, "info", "--video", name]
    run = subprocess.run(words, cwd=tmp_path, env=strict, capture_output=True, check=True)
    assert run.stdout.startswith(b"video\t\xff.mp4\n")
    run = subprocess.run(
        [*COMMAND, "info", "--video", "a\nb"], cwd=tmp_path, capture_output=True, check=False
    )
    assert run.stderr.startswith(b"colmap-av1: error: a\\nb: no such file")
    assert run.stderr.count(b"\n") == 1


@pytest.mark.skipif(sys.platform != "linux", reason="other systems have no such names")
def test_control_characters_in_names_are_escaped(
    clip: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    odd = "\x1b]0;x\x07 \x1b[2J\rok\tb\nc\x9b\u2028\u202e\u3000.mp4"
    (tmp_path / odd).symlink_to(clip)
    video = ["--video", str(tmp_path / odd)]
    assert main(["info", *video]) == 0
    out = capsys.readouterr().out
    table = [line.split("\t") for line in out.splitlines()]
    assert {len(row) for row in table} == {2}
    assert "\\x1b[2J\\rok\\tb\\nc\\x9b\\u2028\\u202e\u3000.mp4" in table[0][1]
    assert main(["match", *video, "--database", str(tmp_path / f"{odd}.db")]) == 0
    out += capsys.readouterr().out
    batch = ["batch", "--task", "info", "--output", str(tmp_path / "out")]
    broken = tmp_path / "\x1b[2J\r.mp4"
    broken.write_text("no video")
    assert main([*batch, "--inputs", str(broken)]) == 1
    for words in ([f"--{odd}"], [odd], ["--operating_point", odd]):
        with pytest.raises(SystemExit):
            main(["info", *video, *words])
    assert main(["info", "--video", odd]) == 2
    printed = capsys.readouterr()
    shown = out + printed.out + printed.err
    assert all(c == "\n" or ord(c) >= 32 for c in shown.replace("\t", ""))
    assert not {"\x7f", "\x9b", "\u2028", "\u202e"} & set(shown)
    assert len(printed.err.splitlines()) == printed.err.count("colmap-av1: ")


@pytest.mark.skipif(sys.platform == "win32", reason="pipes are closed differently there")
def test_closed_output_ends_the_command(clip: Path, tmp_path: Path) -> None:
    words = [sys.executable, "-m", "colmap_av1", "info", "--video", str(clip)]
    with subprocess.Popen(
        words, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=tmp_path
    ) as process:
        assert process.stdout is not None
        assert process.stderr is not None
        process.stdout.close()
        assert process.stderr.read() == ""
    assert process.returncode == 141


def test_interrupt_exits_with_130(tmp_path: Path) -> None:
    scene = PROJECT / "examples" / "scene.mp4"
    words = ["match", "--database", "a.db", "--video", str(scene), "--image_path", "frames"]
    words += ["--offsets", "1", "--growth", "1"]
    process = subprocess.Popen(
        [sys.executable, "-c", HANDLE_INTERRUPTS, *words],
        cwd=tmp_path,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    while not (tmp_path / "frames").exists() and process.poll() is None:
        time.sleep(0.005)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=60)
    assert process.returncode == 130
    assert out == ""
    assert err == "colmap-av1: interrupted\n"
    assert {p.name for p in tmp_path.iterdir()} <= {"frames"}
    assert all(p.suffix == ".png" and p.name[0] != "." for p in tmp_path.glob("frames/*"))


def test_terminal_shows_progress_and_a_table(clip: Path, tmp_path: Path) -> None:
    words = ["match", "--database", "a.db", "--video", str(clip), "--image_path", "frames"]
    ours, theirs = pty.openpty()
    process = subprocess.Popen(
        [*COMMAND, *words],
        cwd=tmp_path,
        stdin=theirs,
        stdout=theirs,
        stderr=theirs,
        env={**os.environ, "TERM": "xterm", "COLUMNS": "200"},
    )
    os.close(theirs)
    shown = b""
    try:
        while block := os.read(ours, 65536):
            shown += block
    except OSError:  # the terminal is gone when the process ends
        pass
    assert process.wait(timeout=60) == 0
    text = shown.decode()
    assert "verification" in text
    assert "16/16" in text
    assert "│ frames" in text
    assert "colmap mapper --database_path a.db" in text
