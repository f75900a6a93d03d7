"""A file that appears whole or not at all."""

from __future__ import annotations

import os
import secrets
from pathlib import Path


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
