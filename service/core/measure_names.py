"""The name of every measure for people: one table for pages, terminals, reports and documents.

A measure is called `layout_margin_mm` in protocols, events and gates, and stays so. People read the name that stands
here; its unit stands beside the number. What a measure means is one sentence where its step kind declares it, and
docs/reference/steps.md prints it beside the name.
"""

from __future__ import annotations

import re
from collections.abc import Mapping

MEASURE_NAMES: Mapping[str, str] = {
    # capture by the robot, by hand, and imported photographs
    "viewpoints_planned": "Viewpoints planned",
    "viewpoints_captured": "Viewpoints captured",
    "viewpoints_given_up": "Viewpoints given up",
    "settings_departures": "Images with wrong camera settings",
    "settings_not_stated": "Images without camera settings",
    "moved_during_exposure": "Images taken while the arm moved",
    "optics_departures": "Images with another lens, zoom or focus",
    "images_spoilt": "Spoilt images",
    "images_unexamined": "Images not examined",
    "live_images": "Images in the prediction",
    "predicted_target_error_mm": "Predicted error at the specimen",
    "outline_limited_error_mm": "Predicted error with exact camera poses",
    "specimen_coverage": "Coverage of the specimen",
    "images_taken": "Photographs taken",
    "images_used": "Usable photographs",
    "images_not_used": "Unusable photographs",
    "hemisphere_coverage": "Coverage of the hemisphere",
    "images_imported": "Photographs imported",
    "raw_files": "Raw files imported",
    "photographs_used": "Photographs used",
    # calibration of the camera and of its mounting on the arm
    "views": "Board images used",
    "views_without_board": "Images without the board",
    "views_partial": "Images with a part of the board",
    "views_excluded": "Board images excluded as outliers",
    "boards_unseen": "Board images found at the second search",
    "rms_px": "RMS reprojection error",
    "five_fold_rms_px": "RMS reprojection error in cross-validation",
    "leave_one_out_rms_px": "RMS reprojection error, leave-one-out",
    "corner_sigma_px": "Noise of the corners",
    "coverage": "Coverage of the image area",
    "tilt_deg": "Largest tilt of the board",
    "uncertainty_px": "Uncertainty of a projected point",
    "uncertainty_mm": "Uncertainty of a projected point at the board",
    "uncertainty_centre_mm": "Uncertainty in the image centre, at the board",
    "board_bow_mm": "Bow of the board",
    "hand_eye_sigma_mm": "Uncertainty of the camera's position on the flange",
    "hand_eye_sigma_deg": "Uncertainty of the camera's rotation on the flange",
    "hand_eye_held_out_mm": "Hand-eye position error, held-out images",
    "hand_eye_held_out_deg": "Hand-eye rotation error, held-out images",
    "hand_eye_uncorrected_held_out_mm": "Hand-eye position error without the arm's correction",
    "hand_eye_arm_corrected": "Correction of the arm found",
    "hand_eye_excluded": "Hand-eye images excluded as outliers",
    "hand_eye_methods_spread_mm": "Spread between hand-eye methods",
    "hand_eye_condition": "Condition number of the hand-eye equations",
    "hand_eye_board_size_percent": "Size of the board by the robot, above the stated one",
    "hand_eye_findings": "Contradictions between robot and images",
    "rotation_spread_deg": "Largest rotation between two images",
    "robot_noise_mm": "Remaining position error of the arm",
    "robot_noise_deg": "Remaining rotation error of the arm",
    # work by hand
    "checklist_items_open": "Checklist items open",
    "checklist_items_ticked": "Checklist items ticked",
    "applications": "Applications of the coat",
    "since_application_min": "Age of the coat at the scan",
    # spheres, and how well they can be distinguished
    "spheres_seen": "Spheres seen",
    "spheres_found": "Spheres found",
    "layout_margin_mm": "Margin against confusing four spheres",
    "layout_margin_of_five_mm": "Margin against confusing five spheres",
    "layout_margin_sigma_mm": "Uncertainty of the margin of four spheres",
    "layout_depth_mm": "Depth of the sphere layout",
    "layout_gap_deg": "Largest angle without a sphere",
    "layout_problems": "Problems of the sphere layout",
    "radius_residual_max_mm": "Largest deviation of a sphere's radius",
    "sphere_radius_mm": "Mean radius of the spheres",
    "sphere_rms_max_mm": "Worst RMS distance of a sphere's surface",
    "sphere_sigma_max_mm": "Largest uncertainty of a sphere's centre",
    "sphere_change_max_mm": "Largest displacement of a sphere",
    "sphere_change_rms_mm": "RMS displacement of the spheres",
    "spheres_compared": "Spheres compared",
    "spheres_moved": "Spheres that moved",
    "spheres_rms_mm": "RMS distance between the spheres of CT and scan",
    "sphere_scale_percent": "Difference in scale between two scans",
    "sphere_scale_sigma_percent": "Uncertainty of the difference in scale",
    "sphere_distance_change_max_mm": "Largest change of a distance between spheres",
    "sphere_distance_change_rms_mm": "RMS change of the distances between spheres",
    "loop_closure_chi2": "Chi-squared of the loop closure, reduced",
    "loop_closure_mm": "Loop closure, largest displacement",
    "loop_closure_rms_mm": "Loop closure, RMS displacement",
    "loop_closure_deg": "Loop closure, rotation",
    # CT
    "slices": "Slices of the series",
    "images_elsewhere": "Images of the acquisition outside the series",
    "cut_by_ends_mm2": "Area cut off by the first and the last slice",
    "slice_spacing_mm": "Distance between slices",
    "voxel_mm": "Longest side of a voxel",
    "label_voxels": "Voxels of the segmentation",
    "label_contrast_hu": "Least contrast of a segmented sphere",
    "surface_faces": "Faces of the CT surface",
    # scan
    "scan_vertices": "Vertices of the scan",
    "scan_faces": "Faces of the scan",
    "scan_holes": "Holes in the scan",
    "scan_boundary_edges": "Boundary edges of the scan",
    "scan_non_manifold_edges": "Non-manifold edges of the scan",
    "scan_components": "Separate parts of the scan's surface",
    "scan_degenerate_faces": "Degenerate faces of the scan",
    "scan_unreferenced_vertices": "Unreferenced vertices of the scan",
    "scan_polygons_in_doubt": "Ambiguous polygons of the scan",
    "scan_normals_computed": "Normals of the scan computed",
    "scan_textures": "Textures of the scan",
    "scan_parts": "Merged exports of the scan",
    "part_spheres_shared": "Spheres shared by merged exports",
    "part_residual_rms_mm": "RMS residual of the merging",
    "part_residual_max_mm": "Largest residual of the merging",
    "faces": "Faces of the mesh used",
    # registration and its evaluation on the control spheres
    "outlines": "Sphere outlines found",
    "outlines_an_image": "Sphere outlines in an image, on average",
    "images_searched_whole": "Images searched without a predicted place",
    "outlines_not_in_raw": "Outlines missing in the raw files",
    "further_views": "Images that locate a further camera",
    "further_excluded": "Excluded images of further cameras",
    "further_consistency_mm": "Consistency of a further camera's position",
    "further_consistency_mrad": "Consistency of a further camera's rotation",
    "best_mean_radial_error_mm": "Mean radial error of the registration used",
    "best_predicted_error_mm": "Predicted error of the registration used",
    "control_normalised_chi2": "Chi-squared of the control spheres, reduced",
    "control_spheres": "Control spheres measured",
    "control_spheres_expected": "Control spheres expected",
    "control_outlines_share": "Least share of a control sphere's outlines found",
    "worst_control_sphere_mm": "Radial error of the worst control sphere",
    # ground truth
    "chamfer_ct_scan_mm": "Chamfer distance between CT and scan",
    "chamfer_floor_mm": "Chamfer distance of equal surfaces",
    "ct_to_scan_mm": "Mean distance from CT to scan",
    "scan_to_ct_mm": "Mean distance from scan to CT",
    "ct_to_scan_median_mm": "Median distance from CT to scan",
    "scan_to_ct_median_mm": "Median distance from scan to CT",
    "ct_above_scan_mm": "Median height of the CT above the scan",
    "ct_spread_mm": "Spread of the CT's height above the scan",
    "ct_share": "Share of vertices from the CT",
    "scan_share": "Share of vertices from the scan",
    "blend_share": "Share of blended vertices",
    "wound_share": "Share of vertices in the wound",
    "sigma_median_mm": "Median uncertainty of the vertices",
    "ground_truth_vertices": "Vertices of the ground truth",
    "ground_truth_faces": "Faces of the ground truth",
    "folded_faces": "Folded faces of the ground truth",
}

# The measures of each registration: the name of its camera poses stands before them, as in `colmap_rms_px`.
REGISTRATION_MEASURE_NAMES: Mapping[str, str] = {
    "rms_px": "RMS outline residual",
    "chi2_reduced": "Chi-squared of the outlines, reduced",
    "markers": "Spheres in the registration",
    "images": "Images in the registration",
    "excluded_outlines": "Outlines excluded as outliers",
    "images_left_out": "Images excluded as contradictory",
    "contradictions": "Contradictions between the inputs",
    "predicted_error_mm": "Predicted error at the centre of the spheres",
    "leave_one_out_mm": "Mean radial error, leave-one-out",
    "mean_radial_error_mm": "Mean radial error",
    "mean_reprojection_error_px": "Mean reprojection error",
}

_SOURCE_NAMES: Mapping[str, str] = {
    "robot": "robot poses",
    "robot_corrected": "corrected robot poses",
    "triangulated": "triangulated poses",
    "colmap": "COLMAP poses",
    "glomap": "GLOMAP poses",
    "hybrid": "hybrid poses",
    "spheres": "poses from the spheres",
}
_REDUCED = re.compile(r"(\w+?)_(\d+)x(\d+)")  # the source, and the size of the reduced images
_UNITS = frozenset({"px", "mm", "mm2", "deg", "mrad", "min", "m", "s", "rad", "percent"})
_ACRONYMS: Mapping[str, str] = {"rms": "RMS", "ct": "CT", "colmap": "COLMAP", "glomap": "GLOMAP", "hu": "HU"}


def measure_name(measure: str) -> str:
    """Return the name of a measure for people: `Mean radial error (COLMAP poses)` for colmap_mean_radial_error_mm.

    A measure that a plug-in declares is named by its identifier with spaces, without the unit.
    """
    if measure in MEASURE_NAMES:
        return MEASURE_NAMES[measure]
    for ending, name in REGISTRATION_MEASURE_NAMES.items():
        source = measure.removesuffix(f"_{ending}")
        if source != measure and (known := _source_name(source)):
            return f"{name} ({known})"
    return _in_words(measure)


def _source_name(source: str) -> str:
    reduced = _REDUCED.fullmatch(source)
    if reduced is None:
        return _SOURCE_NAMES.get(source, "")
    name = _SOURCE_NAMES.get(reduced[1])
    return f"{name}, images of {reduced[2]} × {reduced[3]} px" if name else ""


def _in_words(measure: str) -> str:
    parts = measure.split("_")
    while len(parts) > 1 and parts[-1] in _UNITS:
        parts.pop()
    words = " ".join(_ACRONYMS.get(part, part) for part in parts)
    return words[:1].upper() + words[1:]
