"""The uncertainties of the measures of a layout, for all steps that measure spheres."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from service.core.records.events import Uncertainty


def layout_uncertainties(layout: Mapping[str, Any]) -> dict[str, Uncertainty]:
    """The uncertainty of each measure in a layout's record (service.compute.layout.ambiguity.layout_record)."""
    return {name: Uncertainty.model_validate(bounds) for name, bounds in layout.get("bounds", {}).items()}
