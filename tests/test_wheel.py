"""A wheel of the checkout is installed and used without a compiler."""

from __future__ import annotations

import os
import subprocess
import sys
import sysconfig
import venv
import zipfile
from pathlib import Path

import pytest
from conftest import PROJECT

from colmap_av1.database.reading import read_images

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(sys.platform == "win32", reason="needs the programs of a Unix system"),
]


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("wheel")
    build = [sys.executable, "-m", "pip", "wheel", "--quiet", "--no-deps", "--wheel-dir", "."]
    run = subprocess.run(
        [*build, str(PROJECT)], cwd=folder, capture_output=True, text=True, check=False
    )
    if "No matching distribution found for scikit-build-core" in run.stderr:
        pytest.skip("the build requirements cannot be downloaded")
    assert run.returncode == 0, run.stderr
    (made,) = folder.glob("*.whl")
    return made


def test_wheel_contains_the_package_without_sources(wheel: Path) -> None:
    with zipfile.ZipFile(wheel) as archive:
        sizes = {entry.filename: entry.file_size for entry in archive.infolist()}
    outside = [name for name in sizes if name.split("/")[0].partition("-")[0] != "colmap_av1"]
    assert outside == []
    assert {Path(name).suffix for name in sizes if ".dist-info" not in name} == {
        ".html",
        ".py",
        ".pyi",
        ".so",
        ".typed",
    }
    assert "colmap_av1/py.typed" in sizes
    (extension,) = (name for name in sizes if name.endswith(".so"))
    assert sizes[extension] < 1_500_000  # stripped
    stable = sys.version_info >= (3, 12)
    tag = "abi3" if stable else f"cp{sys.version_info.major}{sys.version_info.minor}"
    assert wheel.name.split("-")[3] == tag
    assert extension.endswith(".abi3.so" if stable else sysconfig.get_config_var("EXT_SUFFIX"))


def test_wheel_matches_the_example_without_a_compiler(wheel: Path, tmp_path: Path) -> None:
    venv.create(tmp_path / "venv", with_pip=True)
    scripts = tmp_path / "venv" / "bin"
    environment = {
        **{name: os.environ[name] for name in ("HOME", "LANG", "TMPDIR") if name in os.environ},
        **{"PATH": str(scripts), "CC": "/bin/false", "CXX": "/bin/false"},
    }

    def run(*words: str) -> str:
        done = subprocess.run(
            words, cwd=tmp_path, env=environment, capture_output=True, text=True, check=False
        )
        assert done.returncode == 0, done.stderr
        return done.stdout

    run(str(scripts / "pip"), "install", "--quiet", "--no-deps", "--no-index", str(wheel))
    # Use the dependencies of this run; packages installed with the wheel come first.
    packages = Path(
        run(str(scripts / "python"), "-c", "import site; print(site.getsitepackages()[0])").strip()
    )
    (packages / "dependencies.pth").write_text(f"{sysconfig.get_path('purelib')}\n")
    where = run(
        str(scripts / "python"), "-c", "from colmap_av1 import _core; print(_core.__file__)"
    )
    assert Path(where.strip()).is_relative_to(packages)

    options = ["--database", "demo.db", "--image_path", "demo_frames", "--every", "4"]
    video = str(PROJECT / "examples" / "scene.mp4")
    run(str(scripts / "colmap-av1"), "match", "--video", video, *options)
    assert len(read_images(tmp_path / "demo.db")) == 15
    assert len(list((tmp_path / "demo_frames").iterdir())) == 15
