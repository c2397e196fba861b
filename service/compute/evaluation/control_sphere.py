"""What the images show of one control sphere; computed with a registration, and recorded with its evaluation."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class ControlSphere:
    """The evaluation of one control sphere.

    Attributes:
        index: its index in the list of control spheres.
        expected: number of images that should show it.
        measured: number of images in which it was measured.
        radial_error_mm: mean radial error over its outlines; None if it was not measured.
        reprojection_error_px: mean reprojection error over its outlines.
        displacement_mm: distance from where scan and registration put it to where the images see it; None below three
            images.
        displacement_sigma_mm: standard deviation of the displacement, as far as the outlines determine it.
        finding: the fault, and the remedy; "" if there is none.
    """

    index: int
    expected: int
    measured: int
    radial_error_mm: float | None = None
    reprojection_error_px: float | None = None
    displacement_mm: float | None = None
    displacement_sigma_mm: float | None = None
    finding: str = ""

    @property
    def share(self) -> float:
        """Share of the expected outlines that were measured, 1 if none was expected."""
        return min(1.0, self.measured / self.expected) if self.expected else 1.0
