"""A file that appears whole or not at all."""

from __future__ import annotations

import os
import secrets
from pathlib import Path

from datasets.errors import InputError


def write_whole(path: Path, content: bytes) -> None:
    """Write a file, or replace one; until it is whole it is a hidden sibling.

    Raises OSError, and then leaves nothing new behind and an old file as it was.
    """
    partial = path.with_name(f".{path.name}.writing-{secrets.token_hex(4)}")
    try:
        partial.write_bytes(content)
        os.replace(partial, path)
    finally:
        partial.unlink(missing_ok=True)


def check_target(path: Path, *, force: bool) -> None:
    """Raise InputError if a file could not be written there."""
    if path.exists() and (not force or not path.is_file()):
        raise InputError(
            "this exists already",
            where=str(path),
            remedy="Give another name, or --force to replace a file.",
        )
    if not path.parent.is_dir() or not os.access(path.parent, os.W_OK | os.X_OK):
        raise InputError(
            "nothing can be written here",
            where=str(path),
            remedy="Give a file in a folder that exists, where you may write.",
        )


def write_new(path: Path, content: bytes, *, force: bool) -> None:
    """Write a file whole or not at all. Raises InputError."""
    check_target(path, force=force)
    try:
        write_whole(path, content)
    except OSError as error:
        raise InputError(
            f"cannot write this file ({error.strerror or error})",
            where=str(path),
            remedy="Make room, or give a place where you may write.",
        ) from error
