"""A folder appears whole or not at all: refusals, failures, and death at every step."""

from __future__ import annotations

import errno
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from datasets.errors import InputError
from datasets.whole_folder import check_target, whole_folder

FILES = ("a.txt", "b.txt", "marker")


def ours(folder: Path) -> bool:
    return (folder / "marker").exists()


def write(target: Path, content: str, *, force: bool = False) -> None:
    with whole_folder(target, force=force, replaceable=ours) as staging:
        for name in FILES:
            (staging / name).write_text(content)


def content(target: Path) -> str:
    """What a whole folder holds; fails if it is not whole."""
    assert sorted(path.name for path in target.iterdir()) == sorted(FILES)
    texts = {(target / name).read_text() for name in FILES}
    assert len(texts) == 1
    return texts.pop()


def test_a_new_folder_appears_with_its_parents_and_nothing_beside_it(tmp_path: Path) -> None:
    write(tmp_path / "deep" / "er" / "run", "one")
    assert content(tmp_path / "deep" / "er" / "run") == "one"
    assert [path.name for path in (tmp_path / "deep" / "er").iterdir()] == ["run"]


def test_nothing_is_there_before_the_end(tmp_path: Path) -> None:
    target = tmp_path / "run"
    with whole_folder(target, force=False, replaceable=ours) as staging:
        (staging / "marker").write_text("x")
        assert not target.exists()
        assert staging.parent == tmp_path
    assert target.exists()


def test_an_existing_folder_is_refused_without_force_and_kept(tmp_path: Path) -> None:
    write(tmp_path / "run", "one")
    with pytest.raises(InputError, match="--force") as caught:
        write(tmp_path / "run", "two")
    assert caught.value.where == str(tmp_path / "run")
    assert content(tmp_path / "run") == "one"
    write(tmp_path / "run", "two", force=True)
    assert content(tmp_path / "run") == "two"
    assert len(list(tmp_path.iterdir())) == 1


def test_force_replaces_no_folder_of_another_kind(tmp_path: Path) -> None:
    home = tmp_path / "home"
    home.mkdir()
    (home / "thesis.tex").write_text("years of work")
    with pytest.raises(InputError, match="not replaced"):
        write(home, "one", force=True)
    assert (home / "thesis.tex").read_text() == "years of work"
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match="not replaced"):
        write(tmp_path / "file", "one", force=True)
    (tmp_path / "empty").mkdir()
    write(tmp_path / "empty", "one", force=True)
    assert content(tmp_path / "empty") == "one"


def test_a_link_stays_a_link(tmp_path: Path) -> None:
    write(tmp_path / "real", "one")
    (tmp_path / "link").symlink_to("real")
    write(tmp_path / "link", "two", force=True)
    assert (tmp_path / "link").is_symlink()
    assert content(tmp_path / "real") == "two"


@pytest.mark.parametrize("error", [KeyboardInterrupt, ValueError, SystemExit])
def test_an_exception_leaves_nothing_new_and_the_old(
    tmp_path: Path, error: type[BaseException]
) -> None:
    write(tmp_path / "run", "one")

    def fail() -> None:
        with whole_folder(tmp_path / "run", force=True, replaceable=ours) as staging:
            (staging / "a.txt").write_text("two")
            raise error

    with pytest.raises(error):
        fail()
    assert content(tmp_path / "run") == "one"
    assert len(list(tmp_path.iterdir())) == 1


@pytest.mark.parametrize("step", ["fsync", "rename"])
def test_a_full_disk_is_an_input_error_that_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, step, full)
    with pytest.raises(InputError, match="No space left on device"):
        write(tmp_path / "run", "one")
    assert list(tmp_path.iterdir()) == []


def test_a_write_that_really_fails_is_an_input_error(tmp_path: Path) -> None:
    """A process that may write files of 4096 bytes only, writes more."""
    code = """
import resource, sys
from pathlib import Path
from datasets.errors import InputError
from datasets.whole_folder import whole_folder
resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))
try:
    with whole_folder(Path(sys.argv[1]), force=False, replaceable=Path.is_dir) as staging:
        (staging / "small").write_bytes(bytes(4000))
        (staging / "large").write_bytes(bytes(9000))
except InputError as error:
    sys.exit(7 if "File too large" in str(error) else 8)
"""
    done = subprocess.run([sys.executable, "-c", code, str(tmp_path / "run")], check=False)
    assert done.returncode == 7
    assert list(tmp_path.iterdir()) == []


def test_a_place_without_the_right_to_write_is_refused_at_the_start(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("x")
    with pytest.raises(InputError, match=r"nothing can be written in .*file"):
        check_target(tmp_path / "file" / "run", force=False, replaceable=ours)
    # By mode bits this could not be tried as root.
    monkeypatch.setattr(os, "access", lambda path, mode: Path(path) != tmp_path)
    with pytest.raises(InputError, match="may write"):
        check_target(tmp_path / "new" / "run", force=False, replaceable=ours)
    assert not (tmp_path / "new").exists(), "checking makes nothing"


def die_at(step: int, target: Path) -> bool:
    """Write "two" with force in a child that dies at its n-th change on disk; did it live?"""
    child = os.fork()
    if child == 0:
        count = 0

        def deadly(call):  # type: ignore[no-untyped-def]  # noqa: ANN001, ANN202
            def counted(*args, **kwargs):  # type: ignore[no-untyped-def]  # noqa: ANN002, ANN003, ANN202
                nonlocal count
                count += 1
                if count == step:
                    os._exit(9)
                return call(*args, **kwargs)

            return counted

        for module, name in (
            (os, "rename"), (os, "fsync"), (os, "mkdir"), (os, "unlink"), (os, "rmdir"),
            (shutil, "rmtree"), (Path, "write_text"),
        ):  # fmt: skip
            setattr(module, name, deadly(getattr(module, name)))
        try:
            write(target, "two", force=True)
            os._exit(0)
        except BaseException:
            os._exit(1)
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


def test_death_at_any_step_leaves_a_whole_folder_or_none(tmp_path: Path) -> None:
    target = tmp_path / "run"
    seen, gone = set(), 0
    for step in range(1, 60):
        shutil.rmtree(target, ignore_errors=True)
        write(target, "one")
        lived = die_at(step, target)
        gone += not target.exists()
        if target.exists():
            seen.add(content(target))
        # The next run sweeps, and finds a whole folder again in every case.
        with pytest.raises(InputError, match="exists already"):
            check_target(target, force=False, replaceable=ours)
        assert content(target) in {"one", "two"}
        assert [path.name for path in tmp_path.iterdir()] == ["run"]
        if lived:
            break
    assert lived
    assert step > 10
    assert seen == {"one", "two"}
    assert gone == 1, "between the two renames"


def test_a_folder_that_is_being_written_is_not_swept(tmp_path: Path) -> None:
    target = tmp_path / "run"
    with whole_folder(target, force=True, replaceable=ours) as staging:
        (staging / "marker").write_text("first")
        write(target, "second", force=True)
        assert staging.exists()
    assert (target / "marker").read_text() == "first"


def test_only_our_own_left_overs_are_swept(tmp_path: Path) -> None:
    foreign = [".run.writing-xyz", ".run.old", "run.writing-01234567", ".runs.writing-01234567"]
    for name in [*foreign, ".run.writing-01234567"]:
        (tmp_path / name).mkdir()
    write(tmp_path / "run", "one")
    assert {path.name for path in tmp_path.iterdir()} == {*foreign, "run"}


def test_the_folder_has_the_usual_permissions(tmp_path: Path) -> None:
    write(tmp_path / "run", "one")
    (tmp_path / "usual").mkdir()
    assert (tmp_path / "run").stat().st_mode == (tmp_path / "usual").stat().st_mode
