"""The base of every section of the configuration."""

from __future__ import annotations

from pydantic import BaseModel, ConfigDict


class Section(BaseModel):
    """A part of the configuration: unknown keys are errors, values are checked and fixed."""

    model_config = ConfigDict(extra="forbid", frozen=True)
