"""The planned board images of a run's calibration step: as recorded, or before the step as they will be planned."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from service.core.errors import ConfigurationError, OrthocaptureError
from service.core.text.words import counted
from service.rig import Rig
from service.run_record import RunRecord
from service.steps.board_plan import describe_prediction
from service.steps.context import StationLayout
from service.steps.kinds.calibration import Params
from service.steps.notes import BOARD_POSES, board_plans
from service.steps.plan_preview import preview_board_poses
from service.web.calibration.board_plan_drawing import board_plan_svg
from service.web.record.pictures import cached
from service.web.record.planned_poses import station_of
from service.web.record.recorded_rig import recorded_rig_section


def board_plan_of(log: RunRecord, step_id: str, data: Path) -> bytes:
    """The plan as an SVG document, computed once for each recorded state of a step.

    Raises:
        ProtocolError: no such step.
        ConfigurationError: the software plans no board images in it.
    """
    step = log.protocol.step(step_id)
    wanted = step.params.board_poses if isinstance(step.params, Params) else None
    if wanted is None:
        raise ConfigurationError("no board images are planned in this step", where=f"step {step_id}")
    solve = step.params_as(Params).solve
    state = log.state.steps[step_id]
    plans = board_plans(state)

    def layout(name: str) -> StationLayout:
        station = station_of(log, name)
        if station is None:
            raise ConfigurationError(f"the rig has no station {name!r}", where=f"step {step_id}")
        return station.layout

    def make() -> bytes:
        approach = np.array(layout(wanted.station).approach)
        if plans:
            poses = np.array([pose.T_base_camera for plan in plans for pose in plan.poses])
            predicted = plans[-1].prediction
            text = f"{counted(len(poses), 'board pose')} so far; predicted {describe_prediction(predicted, solve)}"
            return board_plan_svg(text, predicted.coverage_map, poses, approach).encode()
        try:
            found = preview_board_poses(log.protocol, step, Rig(recorded_rig_section(log), Path(), b""), layout)
        except OrthocaptureError as error:
            return board_plan_svg(str(error), [[0] * 12] * 8, np.zeros((0, 4, 4)), approach).encode()
        assert found is not None  # the step plans board images
        return board_plan_svg(found.text, found.prediction.coverage_map, found.T_base_camera, approach).encode()

    newest = max((note.seq for note in state.notes if note.note == BOARD_POSES), default=0)
    return cached(data, f"board plan {log.state.run_id} {step_id} {newest}", ".svg", make).read_bytes()
