"""Commands in random order, killed at random times, with files damaged in between.

No temporary file is left, no file of the user is lost, and the final outputs have the same bytes as
those of undisturbed commands. COLMAP_AV1_MACHINE_SECONDS sets the run time; by default, there are
only a few examples.
"""

from __future__ import annotations

import hashlib
import os
import shutil
import signal
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import pytest
from command_server import CommandServer, Outcome
from conftest import AV1, PROJECT, Ffmpeg
from hypothesis import HealthCheck, Phase, settings
from hypothesis import strategies as st
from hypothesis.stateful import (
    RuleBasedStateMachine,
    initialize,
    invariant,
    precondition,
    rule,
    run_state_machine_as_test,
)

pytestmark = pytest.mark.skipif(sys.platform != "linux", reason="processes are forked")

SECONDS = float(os.environ.get("COLMAP_AV1_MACHINE_SECONDS", "0"))
QUICK = settings(
    max_examples=4,
    stateful_step_count=10,
    derandomize=True,
    deadline=None,
    database=None,
    suppress_health_check=list(HealthCheck),
)


@dataclass(frozen=True)
class Command:
    """A command with its inputs and outputs.

    Attributes:
        words: its command line.
        outputs: files and folders that it writes.
        inputs: files and folders that it reads.
        resumes: whether it replaces damaged files of its output. Other commands refuse to run if
            their output exists.
    """

    words: str
    outputs: tuple[str, ...]
    inputs: tuple[str, ...]
    resumes: bool = False


COMMANDS = {
    "match": Command(
        "match --database a.db --video v.mp4 --image_path frames --every 2",
        outputs=("a.db", "frames"),
        inputs=("v.mp4", "frames"),
    ),
    "convert": Command(
        "match --database h.db --video h.mp4",
        outputs=("h.db",),
        inputs=("h.mp4",),
    ),
    "motion": Command(
        "motion --video v.mp4 --output motion.npz",
        outputs=("motion.npz",),
        inputs=("v.mp4",),
    ),
    "draw": Command(
        "view --video v.mp4 --output drawn.mp4",
        outputs=("drawn.mp4",),
        inputs=("v.mp4",),
    ),
    "export": Command(
        "export --database a.db --output hloc",
        outputs=("hloc",),
        inputs=("a.db",),
    ),
    "pair": Command(
        "view --database a.db --image_path frames --output pair.png",
        outputs=("pair.png",),
        inputs=("a.db", "frames"),
    ),
    "map": Command(
        "map --database a.db --image_path frames --output model --num_threads 1",
        outputs=("model",),
        inputs=("a.db", "frames"),
    ),
    "densify": Command(
        "densify --model model/0 --video v.mp4 --output dense",
        outputs=("dense",),
        inputs=("model", "v.mp4"),
    ),
    "reconstruct": Command(
        "reconstruct --video v.mp4 --output out --every 2",
        outputs=("out",),
        inputs=("v.mp4",),
        resumes=True,
    ),
}
VIDEOS = ("v.mp4", "h.mp4")
# The user may put files here, where commands write theirs.
PLACES = (
    "a.db",
    "frames/frame_000004.png",
    "frames/notes.txt",
    "hloc/pairs.txt",
    "hloc/notes.txt",
    "motion.npz",
    "drawn.mp4",
    "pair.png",
    "model/notes.txt",
    "dense/cameras.bin",
    "out/notes.txt",
    "h.db",
)
# These files have times and differ between equal runs, as do those in `.stages`.
VARYING = {"report.json", "mapper.log"}


def digest_of(path: Path) -> str:
    return hashlib.sha256(path.read_bytes()).hexdigest()


def contents(folder: Path, *roots: str) -> dict[str, str]:
    """Digests by path of files and of all files in folders, if equal runs write the same bytes."""
    found = {}
    for root in roots:
        top = folder / root
        for path in sorted(top.rglob("*")) if top.is_dir() else [top]:
            name = path.relative_to(folder)
            if path.is_file() and ".stages" not in name.parts and name.name not in VARYING:
                found[name.as_posix()] = digest_of(path)
    return found


@dataclass
class World:
    """A folder with the videos and the outputs of undisturbed commands, shared by all examples.

    Attributes:
        server: runs the commands.
        folder: the folder.
        seconds: how long each command took.
    """

    server: CommandServer
    folder: Path
    seconds: dict[str, float]

    def made(self, *roots: str) -> dict[str, str]:
        return contents(self.folder, *roots)


class CommandMachine(RuleBasedStateMachine):
    """A folder of a user, in which commands run and files are damaged.

    Files of the user are in `mine`, as digests by path.
    """

    world: World

    @initialize()
    def begin(self) -> None:
        self.folder = Path(tempfile.mkdtemp(dir=self.world.folder.parent))
        for video in VIDEOS:
            shutil.copyfile(self.world.folder / video, self.folder / video)
        self.mine = contents(self.folder, *VIDEOS)

    @rule(name=st.sampled_from(sorted(COMMANDS)))
    def run(self, name: str) -> None:
        command = COMMANDS[name]
        reference = self.world.made(*command.inputs)
        inputs = contents(self.folder, *command.inputs)
        are_inputs_intact = inputs.items() <= reference.items() and (
            name == "match" or inputs.keys() == reference.keys()
        )
        in_the_way = self.in_the_way(command)
        before = contents(self.folder, *command.outputs)
        outcome = self.call(command.words)
        assert outcome.status in (0, 2), outcome.output
        if outcome.status == 0:
            if are_inputs_intact:
                assert self.made_by(command) == self.world.made(*command.outputs)
            assert not self.leftovers(command), os.listdir(self.folder)
        else:
            after = contents(self.folder, *command.outputs)
            assert before.items() <= after.items() or command.resumes
            assert not are_inputs_intact or in_the_way, outcome.output

    @rule(
        name=st.sampled_from(sorted(COMMANDS)),
        share=st.floats(0.0, 1.0),
        number=st.sampled_from([signal.SIGKILL, signal.SIGKILL, signal.SIGTERM, signal.SIGINT]),
    )
    def kill(self, name: str, share: float, number: signal.Signals) -> None:
        command = COMMANDS[name]
        after = share * self.world.seconds[name]
        outcome = self.world.server.run(self.folder, f"{command.words} --quiet", number, after)
        self.check_output(outcome)
        killed = {signal.SIGTERM: 143, signal.SIGINT: 130, signal.SIGKILL: -9}[number]
        assert outcome.status in (0, 2, killed), outcome
        if number == signal.SIGTERM and outcome.status == 143:
            assert outcome.output == ""
        if number == signal.SIGINT and outcome.status == 130:
            assert outcome.output in ("", "colmap-av1: interrupted\n")

    @precondition(lambda self: self.derived())
    @rule(
        data=st.data(),
        how=st.sampled_from(["cut", "flip", "empty", "extend", "delete", "folder"]),
    )
    def damage(self, data: st.DataObject, how: str) -> None:
        path = self.folder / data.draw(st.sampled_from(self.derived()), label="file")
        content = path.read_bytes()
        place = data.draw(st.integers(0, max(len(content) - 1, 0)), label="place")
        if how == "cut":
            os.truncate(path, place)
        elif how == "flip" and content:
            changed = bytearray(content)
            changed[place] ^= 1 << place % 8
            path.write_bytes(changed)
        elif how == "extend":
            path.write_bytes(content + content[:place])
        elif how == "empty":
            path.write_bytes(b"")
        elif how in ("delete", "folder"):
            path.unlink()
            if how == "folder":
                path.mkdir()

    @rule(place=st.sampled_from(PLACES))
    def put(self, place: str) -> None:
        path = self.folder / place
        if not os.path.lexists(path):
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(f"mine: {place}\n")
            self.mine[place] = digest_of(path)

    @rule(name=st.sampled_from(sorted(COMMANDS)))
    def clean(self, name: str) -> None:
        """The user removes the outputs of a command, and own files among them."""
        for output in COMMANDS[name].outputs:
            self.remove(output)

    @invariant()
    def files_of_the_user_are_unchanged(self) -> None:
        for name, digest in getattr(self, "mine", {}).items():
            path = self.folder / name
            assert path.is_file(), name
            assert digest_of(path) == digest, name

    def teardown(self) -> None:
        """Run all commands again, after removing the files that keep them from running."""
        if not hasattr(self, "folder"):
            return
        try:
            for name in [n for n in self.mine if n not in VIDEOS]:
                self.remove(name)
            for command in COMMANDS.values():
                reference = self.world.made(*command.outputs)
                if not command.resumes and self.made_by(command) != reference:
                    for output in command.outputs:
                        self.remove(output)
                if command.resumes and (self.folder / "out/report.json").is_dir():
                    self.remove("out/report.json")
                if command.resumes or self.made_by(command) != reference:
                    outcome = self.call(command.words)
                    assert outcome.status == 0, outcome.output
                assert self.made_by(command) == reference
                assert not self.leftovers(command), os.listdir(self.folder)
        finally:
            shutil.rmtree(self.folder)

    def call(self, words: str) -> Outcome:
        outcome = self.world.server.run(self.folder, f"{words} --quiet")
        self.check_output(outcome)
        return outcome

    def check_output(self, outcome: Outcome) -> None:
        lines = outcome.output.splitlines()
        assert all(line.startswith("colmap-av1: ") for line in lines), outcome.output
        errors = [line for line in lines if line.startswith("colmap-av1: error: ")]
        assert len(errors) == (outcome.status == 2), outcome.output

    def made_by(self, command: Command) -> dict[str, str]:
        made = contents(self.folder, *command.outputs)
        return {name: digest for name, digest in made.items() if name not in self.mine}

    def in_the_way(self, command: Command) -> bool:
        """Whether files of the user, earlier outputs or folders keep the command from writing."""
        exists = bool(contents(self.folder, *command.outputs))
        folders = any((self.folder / name).is_dir() for name in self.files_made(command))
        mine = any(place.split("/")[0] in command.outputs for place in self.mine)
        return (exists and not command.resumes) or folders or mine

    def files_made(self, command: Command) -> list[str]:
        return [*self.world.made(*command.outputs), "out/report.json"]

    def derived(self) -> list[str]:
        """Paths of files that commands wrote."""
        roots = sorted({output for command in COMMANDS.values() for output in command.outputs})
        files: list[str] = []
        for root in roots:
            top = self.folder / root
            found = sorted(top.rglob("*")) if top.is_dir() else [top]
            files += [p.relative_to(self.folder).as_posix() for p in found if p.is_file()]
        return [f for f in files if f not in self.mine and not f.endswith(".lock")]

    def leftovers(self, command: Command) -> list[str]:
        """Temporary files that killed runs of a command left."""
        places = {Path(output).name for output in command.outputs}
        hidden = [p.name for p in self.folder.iterdir() if p.name.endswith(".partial")]
        inside = [
            str(p) for output in command.outputs for p in (self.folder / output).rglob("*.partial")
        ]
        return [n for n in hidden if any(n.startswith(f".{place}.") for place in places)] + inside

    def remove(self, name: str) -> None:
        path = self.folder / name
        for mine in [
            m for m in self.mine if Path(m) == Path(name) or Path(name) in Path(m).parents
        ]:
            del self.mine[mine]
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)


@pytest.fixture
def world(ffmpeg: Ffmpeg, tmp_path: Path) -> Iterator[World]:
    folder = tmp_path / "world"
    folder.mkdir()
    small = ["-i", PROJECT / "examples" / "scene.mp4", "-vf", "scale=160:90"]
    ffmpeg(*small, "-frames:v", "20", *AV1, folder / "v.mp4")
    ffmpeg(*small, "-frames:v", "12", "-c:v", "libx264", folder / "h.mp4")
    with CommandServer() as server:
        seconds = {}
        for name, command in COMMANDS.items():
            outcome = server.run(folder, f"{command.words} --quiet")
            assert outcome.status == 0, outcome.output
            seconds[name] = outcome.seconds
        yield World(server, folder, seconds)


@pytest.mark.slow
def test_killed_commands_and_damaged_files_lose_nothing(world: World) -> None:
    machine = type("Machine", (CommandMachine,), {"world": world})
    if not SECONDS:
        run_state_machine_as_test(machine, settings=QUICK)
        return
    # Shrinking a failing example would take too long.
    long = settings(
        QUICK,
        max_examples=20,
        stateful_step_count=20,
        derandomize=False,
        phases=(Phase.generate,),
    )
    end = time.monotonic() + SECONDS
    while time.monotonic() < end:
        run_state_machine_as_test(machine, settings=long)
