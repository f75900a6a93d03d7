"""The configuration for people: YAML with a comment at every key."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any, get_args

import yaml
from pydantic import BaseModel
from pydantic.fields import FieldInfo

from slam.config import Config

SIGNS = (("gt", ">"), ("ge", ">="), ("lt", "<"), ("le", "<="))
COMMENT_COLUMN = 32


def config_lines() -> Iterator[str]:
    """All keys with their defaults; ``load_config`` reads it back as it is."""
    yield "# slam run --config FILE reads this; what is left out keeps its default."
    yield from _lines(Config(), depth=0)


def _lines(section: BaseModel, depth: int) -> Iterator[str]:
    indent = "  " * depth
    for key, field in type(section).model_fields.items():
        value = getattr(section, key)
        if isinstance(value, BaseModel):
            yield ""
            yield from (
                f"{indent}# {line}" for line in (type(value).__doc__ or "").splitlines()[:1]
            )
            yield f"{indent}{key}:"
            yield from _lines(value, depth + 1)
            continue
        shown = yaml.safe_dump({key: value}, default_flow_style=False).strip()
        comment = "; ".join(filter(None, (field.description, _bounds(field), _choices(field))))
        yield f"{indent}{shown:<{COMMENT_COLUMN}} # {comment}" if comment else indent + shown


def _bounds(field: FieldInfo) -> str:
    limits: list[str] = []
    for rule in field.metadata:
        limits += [f"{sign} {getattr(rule, name):g}" for name, sign in SIGNS if hasattr(rule, name)]
    return ", ".join(limits)


def _choices(field: FieldInfo) -> str:
    choices: tuple[Any, ...] = get_args(field.annotation)
    return " or ".join(map(str, choices)) if all(isinstance(c, str) for c in choices) else ""
