"""The uncertainties of the measures of a layout, for all steps that measure spheres."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel, Field

from service.core.records.events import Uncertainty


class _LayoutRecord(BaseModel):
    """The part of a layout's record (service.compute.layout.ambiguity.layout_record) that is read here."""

    bounds: dict[str, Uncertainty] = Field(default_factory=dict[str, Uncertainty])


def layout_uncertainties(layout: Mapping[str, Any] | None) -> dict[str, Uncertainty]:
    """The uncertainty of each measure in a layout's record; empty where the layout was not judged (None)."""
    return {} if layout is None else _LayoutRecord.model_validate(layout).bounds
