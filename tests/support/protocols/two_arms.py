"""A protocol for two arms: the camera is calibrated on the second one too, where that arm stands."""

from __future__ import annotations

from typing import Any

SECOND = "hand_eye_2"


def for_two_arms(record: dict[str, Any], calibration: str, removal: str, images: int) -> dict[str, Any]:
    """The protocol with a hand-eye calibration at station 2, after the camera went to the arm there.

    Args:
        record: of a protocol for one arm that is moved, whose board poses are planned.
        calibration: the step that solves hand_eye at station 1.
        removal: the step that takes the board away.
        images: of the board with the second arm.
    """
    by_id = {step["id"]: step for step in record["steps"]}
    change = {
        **by_id["station_change"],
        "title": "Mount the camera on the arm at station 2 and lay the calibration board",
        "instructions": "Move the camera to the second arm. Lay the calibration board over the scene.",
        "checklist": ["The camera is on the second arm", "Table, board and spheres were not touched"],
        "simulated_hands": [{"action": "move_robot", "station": "station_2"}, {"action": "place_board"}],
    }
    first = by_id[calibration]
    params = {key: value for key, value in first["params"].items() if key == "board_poses"}
    params = _at_station_2(params, images) | {"solve": ["hand_eye"], "intrinsics_of": calibration}
    judged = ("views", "settings_departures", "optics_departures", "hand_eye_sigma_mm", "hand_eye_held_out_mm")
    gates = [gate for gate in first["gates"] if gate["measure"] in judged]
    second = {
        **first,
        "id": SECOND,
        "title": "Hand-eye calibration of the second arm",
        "params": params,
        "gates": gates,
    }
    away = {**by_id[removal], "id": f"{removal}_2"}
    steps: list[dict[str, Any]] = []
    moved = False
    for step in record["steps"]:
        if step["id"] == "station_change":
            steps += [change, second, away]
            moved = True
        elif moved and "live" in step.get("params", {}):
            steps.append(
                {**step, "params": {**step["params"], "live": {**step["params"]["live"], "hand_eye": SECOND}}}
            )
        elif step["kind"] == "registration":
            steps.append({**step, "params": {**step["params"], "hand_eye": [calibration, SECOND]}})
        else:
            steps.append(step)
    return {**record, "steps": steps}


def _at_station_2(params: dict[str, Any], images: int) -> dict[str, Any]:
    """The same poses, but fewer, at the other station, under other names."""
    return {"board_poses": {**params["board_poses"], "station": "station_2", "prefix": "h", "count": images}}
