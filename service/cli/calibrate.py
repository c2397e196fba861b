"""`orthocapture calibrate`: the group, and `hand-eye`, the camera's pose on the robot's flange."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, cast

import numpy as np
import typer

from service.cli.common import (
    JsonOption,
    StrictOption,
    console,
    print_json,
    reporting_errors,
    require_writable,
    write_whole,
)
from service.cli.intrinsics import (
    DEFAULT_DICTIONARY,
    DEFAULT_SIZE_TOLERANCE_PERCENT,
    BoardOption,
    DictionaryOption,
    LegacyOption,
    MarkerOption,
    PatternOption,
    SizeToleranceOption,
    SquareOption,
    described_board,
    intrinsics_command,
    searched,
)
from service.computations.calibration import BoardSeen, HandEye
from service.computations.conversion import hand_eye_record, seen_board
from service.computations.kind import JobRecord
from service.computations.records import Matrix, matrix
from service.compute.arm_kinematics import active_tool, matching_arm, solve_joints
from service.compute.calibration.board import Board
from service.compute.calibration.board_search import UsableViews
from service.compute.calibration.hand_eye import HandEyeResult, HandEyeViews, calibrate_hand_eye
from service.compute.calibration.hand_eye_fit import Method
from service.compute.calibration.hand_eye_setup import PoseReading, PosesAsRead, Setup
from service.compute.calibration.intrinsics import locate_view
from service.compute.calibration.next_poses import SuggestedPose, draw_board_plan, suggest_board_poses
from service.compute.calibration.reprojection import BoardCorners, board_corners
from service.compute.camera_model import CameraModel, read_camera_covariance
from service.compute.images.photographs import ImageFolder, image_folder
from service.compute.poses.pose_files import only_posed, posed_images, read_camera_json
from service.compute.poses.robot_files import (
    RobotPoseTable,
    RotationForm,
    matched_rows,
    other_orders,
    read_joints_csv,
    read_robot_poses,
)
from service.core.arms import ArmModel, arm_model
from service.core.errors import ConfigurationError
from service.core.geometry import Array, Transform
from service.core.text_files import file_text, parse_json
from service.core.units import LengthUnit, mm
from service.core.words import counted

_BESIDE = {"T_flange_camera": "T_base_camera", "T_base_board": "T_flange_board"}


class SuggestedBoardPose(JobRecord):
    """A further pose of the arm for an image of the board, and the fit's standard deviation with it."""

    T_base_flange: Matrix
    T_base_camera: Matrix
    predicted_sigma_mm: float
    predicted_sigma_deg: float


class HandEyeFile(HandEye):
    """The content of a file hand_eye.json.

    Attributes:
        left_out: reason, by file of the folder that was not searched.
        images_without_board: reason, by image in which the board was not found.
        suggested_poses: further poses, the most useful first.
        suggestions_reachable: true if it was checked that the arm reaches them.
    """

    left_out: dict[str, str]
    images_without_board: dict[str, str]
    suggested_poses: tuple[SuggestedBoardPose, ...]
    suggestions_reachable: bool

    @property
    def not_used(self) -> dict[str, str]:
        """Reason, by file that the calibration does not use."""
        return {**self.left_out, **self.excluded, **self.images_without_board}

    def text(self) -> str:
        """Return the file's text. For a camera beside the robot it has T_base_camera and T_flange_board.

        So nothing that expects T_flange_camera can read such a file by mistake.
        """
        return json.dumps(self.printed(), indent=1, allow_nan=False) + "\n"

    def printed(self) -> Any:
        """Return the content of the file as plain data, as `--json` prints it."""
        record = self.plain()
        return record if self.setup == "eye-in-hand" else _renamed(record)


def _renamed(value: Any) -> Any:
    if isinstance(value, dict):
        named = cast("dict[str, Any]", value)
        return {_BESIDE.get(key, key): _renamed(part) for key, part in named.items()}
    return value


_VAGUE_SIZE = 0.01  # relative standard deviation of the board's size by the robot


def hand_eye_command(
    images: Annotated[Path, typer.Option("--images", help="Folder of the board images.")],
    robot_poses: Annotated[
        Path,
        typer.Option(
            "--robot-poses",
            help="T_base_flange of each image: image,x,y,z,qx,qy,qz,qw in metres, or a UR's x y z rx ry rz, "
            "with or without header and names.",
        ),
    ],
    camera: Annotated[Path, typer.Option("--camera", help="camera.json of a calibrated camera.")],
    board: BoardOption,
    square_mm: SquareOption,
    out: Annotated[Path, typer.Option("--out", help="The hand_eye.json to write.")],
    pattern: PatternOption = "checkerboard",
    marker_mm: MarkerOption = None,
    dictionary: DictionaryOption = DEFAULT_DICTIONARY,
    legacy: LegacyOption = False,
    size_tolerance_percent: SizeToleranceOption = DEFAULT_SIZE_TOLERANCE_PERCENT,
    setup: Annotated[
        Setup,
        typer.Option("--setup", help="eye-to-hand: the camera stands beside the robot, the board is on its flange."),
    ] = "eye-in-hand",
    rotation: Annotated[
        RotationForm | None,
        typer.Option("--rotation", help="How the file writes rotations; default: by its header and its numbers."),
    ] = None,
    length: Annotated[
        LengthUnit | None,
        typer.Option("--length", help="Unit of the file's positions; default: by its header, or m."),
    ] = None,
    method: Annotated[Method, typer.Option("--method", help="The method that gives the result.")] = "weighted",
    joints: Annotated[
        Path | None,
        typer.Option("--joints", help="CSV image,q1,…,qN in radians; the arm's own error is then estimated too."),
    ] = None,
    arm: Annotated[
        str | None,
        typer.Option("--arm", help="Arm model, such as UR10e, UR5e, UR3e, LBR Med 14; default: found by the joints."),
    ] = (None),
    suggest: Annotated[int, typer.Option("--suggest", help="Number of further board poses to suggest.", min=0)] = 6,
    preview: Annotated[
        Path | None, typer.Option("--preview", help="PNG to write of the suggested poses and those taken.")
    ] = None,
    strict: StrictOption = False,
    json: JsonOption = False,
) -> None:
    """Calibrate the camera's pose on the robot's flange, with its uncertainty."""
    with reporting_errors(json):
        target = described_board(
            board,
            square_mm,
            pattern,
            marker_mm,
            dictionary,
            legacy=legacy,
            size_tolerance_percent=size_tolerance_percent,
        )
        _require_possible(setup, joints, arm, preview)
        model, target = read_camera_json(camera), _with_bow(target, camera)
        folder = image_folder(images, size=(model.width, model.height), strict=strict)
        poses, folder = _robot_poses(robot_poses, folder, images, rotation, length, strict=strict)
        files = folder.files
        for file in filter(None, (out, preview)):
            require_writable(file)
        usable = searched(files, target, quiet=json)
        session = _session(usable, [files[k].name for k in usable.indices], poses.known, target, model)
        joints_rad, kinematics = _arm(joints, arm, session)
        result = calibrate_hand_eye(
            HandEyeViews(
                session.T_base_flange,
                session.T_camera_board,
                corners=session.corners,
                joints_rad=joints_rad,
                arm=kinematics,
                board=target,
                poses=poses.as_read(session.names),
            ),
            method=method,
            T_board_turned=target.half_turn(),
            setup=setup,
            camera_covariance=read_camera_covariance(camera),
        )
        reach = None if kinematics is None or joints_rad is None else _Reachable(kinematics, joints_rad, session)
        # A camera that stands still has no poses to suggest.
        suggested = _suggested(result, session, reach, suggest if setup == "eye-in-hand" else 0)
        record = HandEyeFile(
            **hand_eye_record(result, session.names, setup).set_fields(),
            left_out=dict(folder.left_out),
            images_without_board={files[k].name: reason for k, reason in sorted(usable.excluded.items())},
            suggested_poses=tuple(_as_recorded(pose) for pose in suggested),
            suggestions_reachable=kinematics is not None,
        )
        write_whole(out, record.text())
        if preview is not None:
            write_whole(preview, _drawn(result, session, suggested))
        if json:
            print_json(record.printed())
            return
        if poses.table is not None and not poses.table.plain:
            console.print(f"{robot_poses.name} was read with {poses.table.words}")
        _tell(result, record)
        console.print(f"written: {out}")


@dataclass(frozen=True, slots=True)
class _RobotPoses:
    """T_base_flange by image, and the table and its row of each image where the poses come from a table."""

    known: Mapping[str, Transform]
    table: RobotPoseTable | None = None
    rows: Mapping[str, int] = field(default_factory=dict[str, int])

    def as_read(self, images: Sequence[str]) -> PosesAsRead | None:
        """Return the file as a check against the images needs it: all its rows, and how else it could be read."""
        if self.table is None:
            return None
        rows, every = np.array([self.rows[image] for image in images]), self.table.poses()
        readings = [PoseReading(poses[rows], words, remedy) for poses, words, remedy in self.table.other_readings()]
        for order, words in other_orders(self.rows):
            moved = every[[order[image] for image in images]]
            readings.append(PoseReading(moved, words, "Give each image its own pose: count names with leading zeros"))
        return PosesAsRead(every, rows, tuple(images), tuple(readings))


def _robot_poses(
    path: Path,
    folder: ImageFolder,
    images: Path,
    rotation: RotationForm | None,
    length: LengthUnit | None,
    *,
    strict: bool,
) -> tuple[_RobotPoses, ImageFolder]:
    """Return the robot's poses, and the images that have one."""
    if path.is_dir() or path.suffix.lower() == ".json" or not path.is_file():
        if rotation is not None or length is not None:
            raise typer.BadParameter("--rotation and --length are for tables of poses")
        known, folder = posed_images(path, folder, images, strict=strict)
        return _RobotPoses(known), folder
    table = read_robot_poses(path, form=rotation, unit=length)
    rows = matched_rows(table, [file.name for file in folder.files], path)
    folder = only_posed(folder, rows, path, images, strict=strict)
    every = table.poses()
    return _RobotPoses({image: every[row] for image, row in rows.items()}, table, rows), folder


@dataclass(frozen=True, slots=True)
class _BoardSession:
    """The N images in which the board was found: their names, corners, and poses (N, 4, 4)."""

    names: list[str]
    corners: BoardCorners
    T_base_flange: Array
    T_camera_board: Array


def _session(
    usable: UsableViews, names: list[str], poses: Mapping[str, Transform], board: Board, camera: CameraModel
) -> _BoardSession:
    return _BoardSession(
        names,
        board_corners(usable.views, board, camera),
        np.array([poses[name] for name in names]),
        np.array([locate_view(view, board, camera)[0] for view in usable.views]),
    )


def _with_bow(board: Board, camera: Path) -> Board:
    """Return the board as bent as the calibration of the camera has found it, if camera.json says so."""
    record = parse_json(file_text(camera), name=str(camera), remedy="Give a camera.json")
    seen = record.get("board")
    return seen_board(board, BoardSeen.model_validate(seen) if isinstance(seen, dict) and "bow_mm" in seen else None)


def _require_possible(setup: Setup, joints: Path | None, arm: str | None, preview: Path | None) -> None:
    """Refuse options that exclude each other, and an unknown arm, before the images are searched."""
    if setup == "eye-to-hand" and (joints is not None or arm is not None):
        raise typer.BadParameter("--joints and --arm are for a camera on the flange, not for --setup eye-to-hand")
    if setup == "eye-to-hand" and preview is not None:
        raise typer.BadParameter("--preview shows suggested poses of a camera that the robot moves")
    if arm is not None:
        arm_model(arm)


class _Reachable:
    """A check whether an arm can reach a pose from the joint positions of the nearest recorded pose."""

    def __init__(self, arm: ArmModel, joints_rad: Array, session: _BoardSession) -> None:
        self._arm, self._joints, self._poses = arm, joints_rad, session.T_base_flange

    def __call__(self, T_base_flange: Transform) -> bool:
        turn = np.trace(np.swapaxes(self._poses[:, :3, :3], 1, 2) @ T_base_flange[:3, :3], axis1=1, axis2=2)
        away = np.linalg.norm(self._poses[:, :3, 3] - T_base_flange[:3, 3], axis=1)
        nearest = int(np.argmin(away + 0.5 * np.arccos(np.clip((turn - 1) / 2, -1, 1))))
        return solve_joints(self._arm, T_base_flange, self._joints[nearest]) is not None


def _arm(joints: Path | None, arm: str | None, session: _BoardSession) -> tuple[Array | None, ArmModel | None]:
    """Return the joints of each image, and the arm's model; None where no joints are given."""
    if joints is None:
        if arm is not None:
            raise typer.BadParameter("--arm needs --joints")
        return None, None
    rows = read_joints_csv(joints, session.names)
    values = np.array([rows[name] for name in session.names])
    if arm is not None:
        return values, arm_model(arm)
    found = matching_arm(values, session.T_base_flange)
    if found is None:
        tool = active_tool(values, session.T_base_flange)
        if tool is not None:
            x, y, z = mm(tool[1][:3, 3])
            raise ConfigurationError(
                f"the poses are those of a tool at {x:.1f}, {y:.1f}, {z:.1f} mm on the flange of a {tool[0].name}",
                where=str(joints),
                remedy="Set the active tool (TCP) to zero at the controller, or write the flange's poses",
            )
        raise ConfigurationError(
            "no known arm has these poses at these joint angles",
            where=str(joints),
            remedy="Check that angles are in radians and poses are of the flange, or name the model with --arm",
        )
    return values, found


def _suggested(
    result: HandEyeResult, session: _BoardSession, reach: _Reachable | None, count: int
) -> tuple[SuggestedPose, ...]:
    corners = session.corners
    return suggest_board_poses(
        result.corrected or result,
        session.T_base_flange,
        corners.points_m,
        corners.camera,
        corner_sigma_px=result.corner_sigma_px or 0.0,
        count=count,
        reachable=reach,
    )


def _as_recorded(pose: SuggestedPose) -> SuggestedBoardPose:
    return SuggestedBoardPose(
        T_base_flange=matrix(pose.T_base_flange),
        T_base_camera=matrix(pose.T_base_camera),
        predicted_sigma_mm=pose.sigma_mm,
        predicted_sigma_deg=pose.sigma_deg,
    )


def _drawn(result: HandEyeResult, session: _BoardSession, suggested: Sequence[SuggestedPose]) -> bytes:
    best, corners = result.corrected or result, session.corners
    cameras = session.T_base_flange @ best.T_flange_camera
    return draw_board_plan(cameras, suggested, best.T_base_board, corners.points_m, corners.camera)


def _tell(result: HandEyeResult, record: HandEyeFile) -> None:
    x, y, z = mm(result.T_flange_camera[:3, 3])
    frame = "flange" if record.setup == "eye-in-hand" else "robot's base"
    console.print(
        f"{counted(len(result.held_out_mm), 'image')}: camera at {x:.2f}, {y:.2f}, {z:.2f} mm in the {frame} frame "
        f"± {result.sigma_mm:.3f} mm, ± {result.sigma_deg:.4f}° ({result.method})"
    )
    held_mm, held_deg = np.median(result.held_out_mm), np.median(result.held_out_deg)
    console.print(
        f"held-out images: {held_mm:.3f} mm, {held_deg:.4f}° (median); "
        f"other methods up to {result.spread_mm:.3f} mm away; condition {result.condition:.1f}"
    )
    console.print((result.corrected or result).size.words)
    if result.size.sigma > _VAGUE_SIZE:
        console.print("the images hardly tell the size of the squares: take more, from other distances and sides")
    for finding in result.findings:
        console.tell(("warning", "yellow"), f" {finding}")
    camera_mm, camera_deg = record.sigma.camera_mm, record.sigma.camera_deg
    if camera_mm and camera_deg is not None:
        console.print(f"of that ± {camera_mm:.3f} mm, ± {camera_deg:.4f}° from the uncertainty of the camera")
    else:
        console.print("camera.json states no covariance: the camera is taken as exactly known")
    if result.robot_noise_mm is not None and result.robot_noise_deg is not None:
        console.print(f"robot noise for each axis: {result.robot_noise_mm:.3f} mm, {result.robot_noise_deg:.4f}°")
    if result.corrected is not None:
        console.print(
            f"with the arm's own error estimated ({result.corrected.terms}): held-out images "
            f"{np.median(result.corrected.held_out_mm):.3f} mm, robot noise {result.corrected.robot_noise_mm:.3f} mm"
        )
    elif len(result.arm_held_out_mm) > 1:
        console.print("estimating the arm's own error does not improve held-out images: not used")
    for name, reason in record.not_used.items():
        console.print(f"not used: {name}: {reason}")
    if record.suggested_poses:
        checked = "" if record.suggestions_reachable else " (reach not checked: no joints)"
        console.print(
            f"{len(record.suggested_poses)} more board poses{checked} would bring the fit's own sigma to "
            f"{record.suggested_poses[-1].predicted_sigma_mm:.3f} mm"
        )


calibrate_app = typer.Typer(
    help="Calibrate a camera and its mounting from images of a board.",
    no_args_is_help=True,
    pretty_exceptions_enable=False,
)
calibrate_app.command("intrinsics")(intrinsics_command)
calibrate_app.command("hand-eye")(hand_eye_command)
