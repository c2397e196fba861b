"""The numbers of a layout of spheres as gates take them: the same in every step that measures spheres."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from service.core.records.events import Uncertainty


def layout_uncertainties(layout: Mapping[str, Any]) -> dict[str, Uncertainty]:
    """Of the measures of a layout's record (service.compute.layout.ambiguity.layout_record)."""
    return {name: Uncertainty.model_validate(bounds) for name, bounds in layout.get("bounds", {}).items()}
