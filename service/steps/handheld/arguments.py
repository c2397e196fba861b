"""The arguments that all jobs of a manual capture share."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from service.core.errors import ConfigurationError
from service.core.jobs.references import Reference
from service.core.units import metres, rad_of_mrad
from service.jobs.calibration import calibrate
from service.jobs.capture import hand_board, hand_view
from service.jobs.records import Limits, Point
from service.jobs.surfaces import layout
from service.steps.capture.live_numbers import COVERAGE, ERROR
from service.steps.context import StepContext
from service.steps.handheld.records import Params
from service.steps.inputs import earlier_answer, intrinsics_covariance_of


@dataclass(frozen=True, slots=True)
class CommonArguments:
    """The arguments that all jobs of the step share, and the references that are recorded in their place."""

    values: hand_board.BoardArguments | hand_view.SpecimenArguments
    references: Mapping[str, Reference | None]


def common_arguments(context: StepContext, params: Params) -> CommonArguments:
    """The arguments that all jobs of the step have in common.

    Raises:
        ConfigurationError: the protocol lacks the board, the calibration or the spheres that the images need.
    """
    return _of_board(context, params) if params.purpose == "calibration" else _of_specimen(context, params)


def _places(params: Params) -> tuple[hand_view.PlannedPlace, ...]:
    """The places of the hemisphere."""
    return tuple(
        hand_view.PlannedPlace(
            name=f"{ring.tilt_deg:02.0f}/{k + 1}",
            tilt_deg=ring.tilt_deg,
            azimuth_deg=azimuth,
            distance_m=ring.distance_m,
            walk_round=params.purpose != "calibration",
            aim_m=(ring.aim_spread_m * float(np.cos(2.4 * k)), ring.aim_spread_m * float(np.sin(2.4 * k)), 0.0),
        )
        for ring in params.hemisphere
        for k, azimuth in enumerate(ring.azimuths_deg())
    )


def _first_words(params: Params, what: str) -> str:
    height_cm = 100 * params.hemisphere[0].distance_m
    return (
        f"hold the camera {height_cm:.0f} cm above the middle of the {what}, looking straight down, "
        "and release the shutter"
    )


def _limits(params: Params) -> Limits:
    return Limits.model_validate(params.coverage.model_dump())


def _of_board(context: StepContext, params: Params) -> CommonArguments:
    board = context.protocol.board
    if board is None:
        raise ConfigurationError(
            "the protocol describes no calibration board",
            where=f"step {context.step.id}",
            remedy="Add a section `board`",
        )
    values = hand_board.BoardArguments(
        places=_places(params),
        within_deg=9.0,
        first_words=_first_words(params, "calibration board"),
        limits=_limits(params),
        columns=board.columns,
        rows=board.rows,
        square_m=metres(board.square_mm),
        sensor_width_mm=params.sensor_width_mm,
    )
    return CommonArguments(values, {})


def _of_specimen(context: StepContext, params: Params) -> CommonArguments:
    if params.calibration is None:
        raise ConfigurationError(
            "images of the specimen need the calibrated camera",
            where=f"step {context.step.id}",
            remedy="Name the calibration step in `calibration`",
        )
    error, covers = (next((g for g in context.step.gates if g.measure == m), None) for m in (ERROR, COVERAGE))
    calibration = earlier_answer(context, params.calibration, calibrate.KIND)
    spheres, rough, spheres_from = _spheres(context, params)
    values = hand_view.SpecimenArguments(
        places=_places(params),
        within_deg=14.0,
        first_words=_first_words(params, "specimen"),
        limits=_limits(params),
        rough=rough,
        camera=calibration.answer.camera,
        spheres_m=spheres,
        radius_m=metres(context.protocol.spheres.radius_mm),
        pose_sigma_m=metres(params.pose_sigma_mm),
        pose_sigma_rad=rad_of_mrad(params.pose_sigma_mrad),
        limit_m=metres(error.max if error and error.max is not None else 0.35),
        min_coverage=covers.min if covers and covers.min is not None else 0.0,
        scan_sigma_m=metres(params.scan_sigma_mm),
    )
    references = {"camera": calibration.reference("camera"), "spheres_m": spheres_from}
    lens = intrinsics_covariance_of(calibration)
    if lens is not None:
        values = values.model_copy(update={"intrinsics_covariance": lens})
        references["intrinsics_covariance"] = calibration.reference("details/intrinsics/covariance")
    colour = context.protocol.spheres.colour
    if colour is not None:  # a field that is not set is not recorded
        values = values.model_copy(update={"colour": colour})
    return CommonArguments(values, references)


def _spheres(context: StepContext, params: Params) -> tuple[tuple[Point, ...], bool, Reference | None]:
    """The spheres of the first step in `spheres_of` that has them, whether they are rough, and the reference to them.

    Spheres that were located in photographs alone are rough.
    """
    for name in params.spheres_of:
        state = context.run.steps.get(name)
        if state is not None and state.result.get("spheres_m"):
            found = earlier_answer(context, name, layout.KIND)
            rough = context.protocol.step(name).gives == "rough_spheres"
            return found.answer.spheres_m, rough, found.reference("spheres_m")
    raise ConfigurationError(
        f"the spheres have not been located by {' or '.join(params.spheres_of) or 'any step'}",
        where=f"step {context.step.id}, spheres_of",
        remedy="Name the CT import, or the layout check from photographs",
    )
