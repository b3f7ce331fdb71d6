"""Publishing a folder loses nothing, at whatever operation it ends; no command touches the user's files."""

import builtins
import errno
import gc
import importlib
import json
import os
import random
import shutil
import signal
import time
from contextlib import suppress
from itertools import count
from pathlib import Path

import pytest
from helpers import folders
from helpers.cli import invoke

import scan2albedo
from scan2albedo.errors import OutputError
from scan2albedo.io.leftovers import is_hidden_path, remove_leftovers
from scan2albedo.io.publication import PENDING, check_whole
from scan2albedo.io.records import read_record
from scan2albedo.io.result_records import RunRecord
from scan2albedo.io.run_folder import OwnFiles, RunFolder, Staging


class Note(RunRecord):
    text: str
    files: tuple[str, ...] = ()


PAGE = OwnFiles("page.json", Note, ("line_*.txt",))
FILES = OwnFiles("result.json", Note, ("a.txt", "b.txt", "only_*.txt"), inside=PAGE)
MINE = {"mine.txt": "mine", "sub/deep/mine.txt": "mine", "page/mine.txt": "mine", "sub/mine.txt": "mine"}


def contents(folder):
    return {
        path.relative_to(folder).as_posix(): path.read_text()
        for path in sorted(folder.rglob("*"))
        if path.is_file() and path.suffix != ".json" and ".part/" not in path.as_posix()
    }


def run(folder, text):
    with RunFolder(folder, FILES).publishing() as staging:
        for name in ("a.txt", "b.txt", f"only_{text}.txt"):
            (staging.folder / name).write_text(text)
        page = Staging(staging.folder / "page", PAGE)
        page.folder.mkdir()
        (page.folder / f"line_{text}.txt").write_text(text)
        page.write_record(text=text)
        staging.write_record(text=text)


def result(text):
    """Return what `contents` finds after a run."""
    return dict.fromkeys(("a.txt", "b.txt", f"only_{text}.txt", f"page/line_{text}.txt"), text)


@pytest.fixture
def folder(tmp_path):
    """A folder with an old result and files of the user's."""
    folder = tmp_path / "out" / "scan"
    run(folder, "old")
    for name, text in MINE.items():
        (folder / name).parent.mkdir(exist_ok=True, parents=True)
        (folder / name).write_text(text)
    (folder / "link").symlink_to("mine.txt")
    return folder


def which(folder):
    """Return whose result is in a folder, which the next writer finds whole."""
    RunFolder(folder, FILES).check()
    text = RunFolder(folder, FILES).read().text
    remove_leftovers(folder.parent, folder)
    assert contents(folder) == MINE | {"link": "mine"} | result(text)
    assert read_record(folder / "page" / "page.json", Note).text == text
    assert sorted(json.loads((folder / "result.json").read_text())["files"]) == sorted(
        name for name in [*result(text), "result.json"] if "/" not in name
    )
    for path in [*folder.parent.iterdir(), *folder.iterdir()]:
        if is_hidden_path(path):  # of this process: it could not be removed
            shutil.rmtree(path)
    assert [path.name for path in folder.parent.iterdir()] == [folder.name]
    return text


OPERATIONS = (
    "mkdir",
    "rename",
    "replace",
    "link",
    "symlink",
    "unlink",
    "rmdir",
    "open",
    "chown",
    "utime",
    "scandir",
)


def interrupt_at(step, interruption, patch):
    """Make file operation number `step` end by an interruption; return the list of operations that ran."""
    ran = []

    def stepping(function, name):
        def called(*args, **options):
            ran.append(name)
            if len(ran) == step:
                interruption()
            return function(*args, **options)

        return called

    for name in OPERATIONS:
        patch.setattr(os, name, stepping(getattr(os, name), name))
    patch.setattr(builtins, "open", stepping(open, "open"))
    return ran


def ctrl_c():
    raise KeyboardInterrupt


def full_disk():
    raise OSError(errno.ENOSPC, "No space left on device")


def assert_old_or_new(folder, new_run):
    """Check what is found after runs that end at each operation; `new_run` tells whether one did."""
    found = set()
    for step in count(1):
        ended_early = new_run(step)
        found.add(text := which(folder))
        if not ended_early:
            break
        if text == "new":
            run(folder, "old")
    assert step > 30
    assert found == {"old", "new"}


@pytest.mark.parametrize("interruption", [ctrl_c, full_disk])
def test_an_error_at_any_operation_leaves_the_old_or_the_new_result(folder, interruption, monkeypatch):

    def new_run(step):
        with monkeypatch.context() as patch, suppress(OutputError, KeyboardInterrupt):
            ran = interrupt_at(step, interruption, patch)
            run(folder, "new")
        return len(ran) >= step

    assert_old_or_new(folder, new_run)


def in_a_child(work):
    """Run `work` in a forked process, which ends without unwinding, and return its number."""
    child = os.fork()
    if child == 0:
        gc.disable()  # what other tests left is of libraries whose threads a fork does not have
        with suppress(BaseException):
            work()
        os._exit(0)
    return child


def test_a_process_that_ends_at_any_operation_leaves_the_old_or_the_new_result(folder, monkeypatch):

    def new_run(step):
        def work():
            interrupt_at(step, lambda: os._exit(1), monkeypatch)
            run(folder, "new")

        _, status = os.waitpid(in_a_child(work), 0)
        return os.waitstatus_to_exitcode(status)

    assert_old_or_new(folder, new_run)


# Slow, over all parameters: a thousand kills and a thousand pairs.
@pytest.mark.parametrize("kills", [40, pytest.param(500, marks=pytest.mark.slow)])
def test_signals_at_random_moments_leave_the_old_or_the_new_result(folder, kills):
    moments = random.Random(kills)
    found = {"old": 0, "new": 0}
    begin = time.perf_counter()
    run(folder, "old")
    length = time.perf_counter() - begin
    for number in range(kills):
        ready, go = os.pipe()

        def work(go=go):
            from scan2albedo.cli.common import stop_cleanly_on_interrupt

            os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
            stop_cleanly_on_interrupt(None)
            os.write(go, b"1")
            run(folder, "new")

        child = in_a_child(work)
        os.read(ready, 1)
        time.sleep(moments.random() * 1.3 * length)
        kind = (signal.SIGINT, signal.SIGTERM, signal.SIGKILL)[number % 3]
        os.kill(child, kind)
        _, status = os.waitpid(child, 0)
        os.close(ready)
        os.close(go)
        end = os.waitstatus_to_exitcode(status)
        assert end in {0, -kind if kind == signal.SIGKILL else 128 + kind}
        if kind != signal.SIGKILL:  # "nothing half-written was left behind"
            assert [path.name for path in folder.parent.iterdir()] == [folder.name]
            left = [path for path in folder.rglob("*") if is_hidden_path(path) or path.name == PENDING]
            assert not left, [path.name for path in folder.rglob("*")]
        text = which(folder)
        found[text] += 1
        # Towards moments that half of the runs survive, however slow a child of a busy machine is.
        length *= 0.9 if text == "new" else 1.1
        if text == "new":
            run(folder, "old")
    assert min(found.values()) > 0, found


@pytest.mark.parametrize("pairs", [12, pytest.param(250, marks=pytest.mark.slow)])
@pytest.mark.parametrize("first", [True, False])
def test_two_writers_never_mix_their_files(tmp_path, pairs, first):
    for number in range(pairs):
        folder = tmp_path / str(number) / "scan"
        if not first:
            run(folder, "old")
        folder.parent.mkdir(exist_ok=True)
        ready, go = os.pipe()

        def work(text, ready=ready, folder=folder):
            os.read(ready, 1)
            run(folder, text)

        children = [in_a_child(lambda text=text: work(text)) for text in ("A", "B")]
        os.write(go, b"12")
        for child in children:
            os.waitpid(child, 0)
        os.close(ready)
        os.close(go)
        text = RunFolder(folder, FILES).read().text
        assert text in "AB"
        found = contents(folder)
        assert {name: found[name] for name in found if "/" not in name} == {
            name: text for name in result(text) if "/" not in name
        }
        assert set(found.values()) <= {"A", "B"}
        assert [path.name for path in folder.parent.iterdir()] == ["scan"]


@pytest.mark.parametrize(
    "name", ["a.txt", "only_mine.txt", "result.json", "page/line_1.txt", "page/page.json"]
)
def test_a_file_of_the_users_under_one_of_our_names_is_never_touched(tmp_path, name):
    (tmp_path / "page").mkdir()
    (tmp_path / name).write_text("mine")
    with pytest.raises(OutputError, match=rf"holds {Path(name).name}, which no run of scan2albedo wrote"):
        run(tmp_path, "new")
    assert (tmp_path / name).read_text() == "mine"
    assert [path.as_posix() for path in tmp_path.rglob("*") if path.is_file()] == [str(tmp_path / name)]


def test_an_edited_record_names_only_files_that_such_a_run_writes(folder, tmp_path):
    (tmp_path / "out" / "only_1.txt").write_text("mine")
    record = json.loads((folder / "result.json").read_text())
    record["files"] += ["mine.txt", "../only_1.txt", "sub/mine.txt", "page/mine.txt", str(folder / "link")]
    (folder / "result.json").write_text(json.dumps(record))
    run(folder, "new")
    (tmp_path / "out" / "only_1.txt").unlink()
    assert which(folder) == "new"


def test_the_folder_keeps_its_mode_and_what_is_added_meanwhile(folder, monkeypatch):
    (folder / "sub").chmod(0o751)
    folder.chmod(0o710)
    rename = os.rename

    def and_somebody_saves(a, b, **folders):
        if Path(b).name == PENDING:
            (folder / "sub" / "late.txt").write_text("late")
            (folder / "mine.txt").unlink()
            (folder / "mine.txt").write_text("mine, saved late")
        rename(a, b, **folders)

    monkeypatch.setattr(os, "rename", and_somebody_saves)
    run(folder, "new")
    assert folder.stat().st_mode & 0o777 == 0o710
    assert (folder / "sub").stat().st_mode & 0o777 == 0o751
    late = {"sub/late.txt": "late", "mine.txt": "mine, saved late", "link": "mine, saved late"}
    assert contents(folder) == MINE | result("new") | late


@pytest.mark.parametrize("where", ["current folder", "no space beside it", "a mount point"])
def test_a_folder_keeps_its_place(folder, monkeypatch, where):
    place = folder.stat().st_ino
    if where == "current folder":
        monkeypatch.chdir(folder / "sub")
    elif where == "no space beside it":
        mkdir = os.mkdir

        def refused(path, *mode):
            if Path(path).parent == folder.parent:
                raise PermissionError(errno.EACCES, "Permission denied")
            mkdir(path, *mode)

        monkeypatch.setattr(os, "mkdir", refused)
    else:
        rename = os.rename

        def other_file_system(a, b, **folders):
            if Path(a).parent == folder.parent:
                raise OSError(errno.EXDEV, "Invalid cross-device link")
            rename(a, b, **folders)

        monkeypatch.setattr(os, "rename", other_file_system)
    run(folder, "new")
    assert folder.stat().st_ino == place
    assert which(folder) == "new"


HOSTILE = {
    "a list cut short": "[",
    "a path up": '["../a.txt"]',
    "an absolute path": '["/a.txt"]',
    "a file of the user's": '["mine.txt"]',
    "a folder of the user's": '["sub"]',
    "a file of the user's in a folder": '["page/mine.txt"]',
    "a file in a linked folder": '["elsewhere/page.json"]',
    "numbers": "[1]",
    "a new file under another name": "[]",
    "a new file in a linked folder": "[]",
    "a new file that is a link": "[]",
    "a list that is a link": None,
    "a list that is a pipe": None,
    "a folder that is a link": None,
    "a folder of another user": "[]",
}
"""Publications that were cut off, of which nothing may be believed, and their lists of files that go."""


@pytest.mark.usefixtures("no_endless_reading")
@pytest.mark.parametrize("kind", HOSTILE)
def test_a_hostile_publication_is_refused_and_moves_nothing(folder, tmp_path, kind, monkeypatch):
    outside, pending = tmp_path / "outside", folder / PENDING
    outside.mkdir()
    for name in ("page.json", "a.txt", ".dropped.json"):
        (outside / name).write_text("[]")
    (folder / "elsewhere").symlink_to(outside)
    if kind == "a folder that is a link":
        pending.symlink_to(outside)
    else:
        pending.mkdir()
        (pending / "b.txt").write_text("hostile")
    if kind.endswith("pipe"):
        os.mkfifo(pending / ".dropped.json")
    elif kind == "a list that is a link":
        (pending / ".dropped.json").symlink_to(outside / ".dropped.json")
    elif HOSTILE[kind]:
        (pending / ".dropped.json").write_text(HOSTILE[kind])
    if kind.endswith("another name"):
        (pending / "mine.txt").write_text("hostile")
    elif kind == "a new file in a linked folder":
        (pending / "elsewhere").mkdir()
        (pending / "elsewhere" / "page.json").write_text("hostile")
    elif kind == "a new file that is a link":
        (pending / "a.txt").symlink_to(outside / "a.txt")
    elif kind.endswith("another user"):
        me = os.geteuid()
        monkeypatch.setattr(os, "geteuid", lambda: me + 1)
    before = folders.contents(tmp_path)
    for attempt in (lambda: run(folder, "new"), RunFolder(folder, FILES).check):
        with pytest.raises(OutputError, match=r"\.publishing was edited or cut short, or is not ours"):
            attempt()
        assert folders.contents(tmp_path) == before
    with pytest.raises(OSError, match="a run was ended while it wrote"):
        check_whole(folder)
    assert remove_leftovers(folder) == 0
    assert folders.contents(tmp_path) == before


def commands():
    """Return what every command of the package may write, found where it is declared."""
    root = Path(scan2albedo.__file__).parent
    found = {}
    for path in root.rglob("*.py"):
        if " OwnFiles(" in path.read_text(encoding="utf-8"):
            name = ".".join(path.relative_to(root.parent).with_suffix("").parts)
            for key, value in vars(importlib.import_module(name)).items():
                if isinstance(value, OwnFiles):
                    found[f"{name}.{key}"] = value
    return found


@pytest.mark.parametrize(("name", "files"), [pytest.param(*item, id=item[0]) for item in commands().items()])
def test_no_command_touches_files_of_the_users(tmp_path, name, files):
    for pattern in (files.record, *files.names):
        folder = tmp_path / pattern.replace("*", "_").replace("?", "_")
        folder.mkdir()
        (folder / pattern.replace("*", "007").replace("?", "7")).write_text("mine")
        with pytest.raises(OutputError, match=rf"no run of {files.command} wrote"):
            RunFolder(folder, files).check()
        assert not files.holds(f"sub/{pattern}")


COMMANDS = {
    "process scan.ply": "scan/albedo.png",
    "demo": "synthetic-0/albedo.png",
    "relight none --sweep 3": "frame_007.png",
    "swap a b": "albedo.exr",
    "blend a b": "picture.png",
    "transfer-expression a b c": "fitted.glb",
    "identify --gallery a.csv --probes b.csv": "cmc.png",
    "glasses canonicalize frame.obj": "frame/result.json",
    "glasses register a.obj --cameras b --labels c": "overview.png",
    "glasses lenses a.obj --cameras b --head c": "a_lenses.png",
    "glasses demo": "lenses/overview.png",
    "reflectance olat a.json": "olat.png",
    "reflectance fit a.json": "face.ply",
    "reflectance build a b": "model.png",
    "reflectance sample a": "samples.png",
    "reflectance fit-image a.json": "reflectance.npz",
    "reflectance finetune a b.json": "trace.csv",
}
"""Commands, and a file that each writes."""


@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("way", ["a file of the user's", "a publication"])
def test_every_command_refuses_what_is_not_its_own_before_the_work(tmp_path, monkeypatch, command, way):
    monkeypatch.chdir(tmp_path)
    mine, said = tmp_path / "OUT" / COMMANDS[command], "no run of scan2albedo"
    mine.parent.mkdir(parents=True)
    if way == "a publication":
        said = "was edited or cut short, or is not ours"
        for place in {mine.parent, tmp_path / "OUT"}:
            (place / PENDING).mkdir()
            (place / PENDING / "mine").write_text("hostile")
    else:
        mine.write_text("mine")
    before = folders.contents(tmp_path)
    done = invoke(*command.split(), "-o", "OUT")
    assert done.exit_code != 0
    assert said in f"{done.output} {done.exception}"
    assert folders.contents(tmp_path) == before
