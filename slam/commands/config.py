"""``slam config``: every key of the configuration."""

from __future__ import annotations

import typer


def config() -> None:
    """Print every key of the configuration with its default and meaning, as YAML."""
    from slam.commands.config_text import config_lines  # noqa: PLC0415

    for line in config_lines():
        typer.echo(line)
