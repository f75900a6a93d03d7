"""The knob of correlative matching, apart from it: its kernels load only where they are used."""

from __future__ import annotations

from pydantic import Field

from datasets.section import Section
from frontend.tracker import SEARCH_PENALTY


class CorrelativeConfig(Section):
    """How strongly the prediction holds a pose."""

    penalty: float = Field(
        SEARCH_PENALTY,
        ge=0.0,
        description="loss of score, of 1, one standard deviation away from the prediction",
    )
