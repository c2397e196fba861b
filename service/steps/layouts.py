"""The uncertainties of the measures of a layout, for all steps that measure spheres."""

from __future__ import annotations

from service.core.records.events import Uncertainty
from service.jobs.records import JudgedLayout


def layout_uncertainties(layout: JudgedLayout | None) -> dict[str, Uncertainty]:
    """The uncertainty of each measure of a layout; empty where it was not judged (None)."""
    return {} if layout is None else dict(layout.bounds)
