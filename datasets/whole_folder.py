"""A folder that appears whole or not at all, whenever the process that writes it ends."""

from __future__ import annotations

import fcntl
import os
import re
import secrets
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from datasets.errors import InputError

Replaceable = Callable[[Path], bool]


def check_target(target: Path, *, force: bool, replaceable: Replaceable) -> None:
    """Raise InputError if ``whole_folder`` could not make this target: at the start of a run.

    Also takes away what killed processes left beside it. With ``force`` an existing folder may
    be replaced if it is empty or ``replaceable(target)`` says that it is one of our kind: nobody
    shall lose a home directory to a slip.
    """
    target = Path(os.path.realpath(target))
    _sweep(target)
    if target.exists():
        if not force:
            raise InputError(
                "this folder exists already",
                where=str(target),
                remedy="Give another one, or --force to replace it.",
            )
        if not target.is_dir() or (any(target.iterdir()) and not replaceable(target)):
            raise InputError(
                "this is not a folder that an earlier run wrote, it is not replaced",
                where=str(target),
                remedy="Give another folder, or remove it yourself.",
            )
    ancestor = target.parent
    while not ancestor.exists():
        ancestor = ancestor.parent
    if not ancestor.is_dir() or not os.access(ancestor, os.W_OK | os.X_OK):
        raise InputError(
            f"nothing can be written in {ancestor}",
            where=str(target),
            remedy="Give a folder in a place where you may write.",
        )


@contextmanager
def whole_folder(target: Path, *, force: bool, replaceable: Replaceable) -> Iterator[Path]:
    """Give an empty folder to write into, and rename it to ``target`` when the block has ended.

    Until then it is a hidden sibling, ``.NAME.writing-xxxxxxxx``. An exception, Ctrl-C among
    them, takes it away; what a killed process leaves is swept by the next one with the same
    target. An existing target (``force``) is moved aside only when the new folder is on disk,
    and brought back by the next sweep should the process die between the two renames.

    Raises InputError as ``check_target``, and for every OSError on the way (disk full, ...).
    """
    check_target(target, force=force, replaceable=replaceable)
    target = Path(os.path.realpath(target))
    staging = _sibling(target, "writing")
    lock: int | None = None
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
        staging.mkdir()
        lock = os.open(staging, os.O_RDONLY)
        # Held as long as this process lives: what can be locked by others is left over.
        with suppress(OSError):  # file systems without locks: then nobody sweeps
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        yield staging
        _sync_tree(staging)
        check_target(target, force=force, replaceable=replaceable)
        _swap(staging, target)
    except OSError as error:
        raise InputError(
            f"cannot write this folder ({error.strerror or error})",
            where=str(target),
            remedy="Make room, or give a folder in a place where you may write.",
        ) from error
    finally:
        # After the renames there is nothing of this name any more.
        shutil.rmtree(staging, ignore_errors=True)
        if lock is not None:
            os.close(lock)


def _sibling(target: Path, what: str) -> Path:
    return target.with_name(f".{target.name}.{what}-{secrets.token_hex(4)}")


def _swap(staging: Path, target: Path) -> None:
    old = _sibling(target, "old")
    try:
        if target.exists():
            os.rename(target, old)
        os.rename(staging, target)
    except BaseException:
        if old.exists() and not target.exists():
            os.rename(old, target)
        raise
    _sync(target.parent)
    shutil.rmtree(old, ignore_errors=True)


def _sweep(target: Path) -> None:
    """Remove or bring back what killed processes left beside the target."""
    if not target.parent.is_dir():
        return
    left_over = re.compile(rf"\.{re.escape(target.name)}\.(writing|old)-[0-9a-f]{{8}}")
    for sibling in sorted(target.parent.iterdir()):
        match = left_over.fullmatch(sibling.name)
        if match is None:
            continue
        if match[1] == "old" and not target.exists():
            with suppress(OSError):
                os.rename(sibling, target)
        elif match[1] == "old" or _is_abandoned(sibling):
            shutil.rmtree(sibling, ignore_errors=True)


def _is_abandoned(staging: Path) -> bool:
    try:
        handle = os.open(staging, os.O_RDONLY)
    except OSError:
        return False
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    finally:
        os.close(handle)
    return True


def _sync_tree(folder: Path) -> None:
    for root, _, files in os.walk(folder):
        for name in sorted(files):
            _sync(Path(root) / name)
        _sync(Path(root))


def _sync(path: Path) -> None:
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
