"""Measure: a number that a step yields; and the numbers that steps of several kinds share."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, slots=True)
class Measure:
    """A number of a step: its unit, and between what a limit on it makes sense."""

    unit: str
    least: float = 0.0
    most: float = float("inf")
    meaning: str = ""  # for the page of the step kinds


COUNT, SHARE = Measure("", 0, 1e6), Measure("", 0, 1)
MM, FINE_MM = Measure("mm", 1e-4, 1000), Measure("mm", 1e-4, 50)
PX, DEG = Measure("px", 1e-3, 50), Measure("°", 0, 360)

LAYOUT = {
    "layout_margin_mm": FINE_MM, "layout_margin_of_five_mm": FINE_MM, "layout_margin_sigma_mm": FINE_MM,
    "layout_depth_mm": MM, "layout_gap_deg": DEG, "layout_problems": COUNT,
}  # fmt: skip
SPHERES = {
    "spheres_found": COUNT, "radius_residual_max_mm": Measure("mm", 1e-3, 5),
    "sphere_rms_max_mm": Measure("mm", 1e-3, 5), "sphere_sigma_max_mm": Measure("mm", 1e-4, 5),
    "sphere_change_max_mm": Measure("mm", 1e-3, 20), "sphere_change_rms_mm": Measure("mm", 1e-3, 20), **LAYOUT,
}  # fmt: skip
CAPTURE = {
    "viewpoints_planned": COUNT, "viewpoints_captured": COUNT, "viewpoints_given_up": COUNT,
    "settings_departures": COUNT, "moved_during_exposure": COUNT, "optics_departures": COUNT,
}  # fmt: skip
PREDICTED = {"predicted_target_error_mm": Measure("mm", 1e-3, 20), "specimen_coverage": SHARE}
CALIBRATION = {
    **CAPTURE,
    "views": COUNT, "views_without_board": COUNT, "views_partial": COUNT, "views_excluded": COUNT,
    "boards_unseen": COUNT, "rms_px": PX, "five_fold_rms_px": PX, "leave_one_out_rms_px": PX,
    "corner_sigma_px": PX, "coverage": SHARE, "tilt_deg": Measure("°", 0, 90),
    "uncertainty_px": PX, "uncertainty_mm": Measure("mm", 1e-4, 10),
    "uncertainty_centre_mm": Measure("mm", 1e-4, 10),
    "hand_eye_sigma_mm": Measure("mm", 1e-4, 20), "hand_eye_sigma_deg": Measure("°", 1e-5, 10),
    "hand_eye_held_out_mm": Measure("mm", 1e-3, 50), "hand_eye_held_out_deg": Measure("°", 1e-4, 10),
    "hand_eye_uncorrected_held_out_mm": Measure("mm", 1e-3, 50), "hand_eye_arm_corrected": SHARE,
    "hand_eye_excluded": COUNT, "hand_eye_methods_spread_mm": MM, "hand_eye_condition": Measure("", 1, 1e6),
    "rotation_spread_deg": Measure("°", 0, 180), "robot_noise_mm": Measure("mm", 1e-4, 50),
    "robot_noise_deg": Measure("°", 1e-5, 10),
}  # fmt: skip
SCAN = {
    f"scan_{name}": COUNT
    for name in (
        "vertices", "faces", "holes", "boundary_edges", "non_manifold_edges", "components", "degenerate_faces",
        "unreferenced_vertices", "normals_computed",
    )
}  # fmt: skip
REGISTERED = {
    "rms_px": PX, "chi2_reduced": Measure("", 0, 1e4), "markers": COUNT, "images": COUNT, "missing": COUNT,
    "excluded_outlines": COUNT, "predicted_error_mm": Measure("mm", 1e-3, 20), "reprojection_px": PX,
    "leave_one_out_mm": Measure("mm", 1e-3, 20),
}  # fmt: skip
EVALUATED = {"mean_radial_error_mm": Measure("mm", 1e-3, 20), "mean_reprojection_error_px": PX}
