"""Reads what robots and their programs write: poses in any convention, joint angles, stations, T_flange_camera."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np
from scipy.spatial.transform import Rotation

from service.compute.poses.pose_files import matched_names
from service.core.errors import DataError
from service.core.geometry import Array, Transform
from service.core.text_files import csv_rows, file_text, parse_json
from service.core.units import METRES_PER, LengthUnit
from service.core.words import counted

RotationForm = Literal[
    "quaternion",
    "wxyz",
    "rotvec",
    "rotvec-deg",
    "rpy",
    "rpy-deg",
    "ypr",
    "ypr-deg",
    "xyz",
    "xyz-deg",
    "zyz",
    "zyz-deg",
]
_UNIT = 1e-3  # tolerance of a quaternion's length from 1, so that files with four decimals pass
_TURN = 2 * np.pi + 0.1  # no component of a rotation vector in radians is larger
_WORDS: dict[RotationForm, str] = {
    "quaternion": "as quaternions x, y, z, w",
    "wxyz": "as quaternions w, x, y, z",
    "rotvec": "as rotation vectors in radians",
    "rotvec-deg": "as rotation vectors in degrees",
    "rpy": "as roll, pitch, yaw in radians",
    "rpy-deg": "as roll, pitch, yaw in degrees",
    "ypr": "as yaw, pitch, roll in radians",
    "ypr-deg": "as yaw, pitch, roll in degrees, such as KUKA's A, B, C",
    "xyz": "as angles about the turning x, y and z axes in radians",
    "xyz-deg": "as angles about the turning x, y and z axes in degrees",
    "zyz": "as angles about the turning z, y and z axes in radians",
    "zyz-deg": "as angles about the turning z, y and z axes in degrees, such as O, A, T",
}
_NAMES = {"image", "name", "file", "filename", "image_name", "frame", "label"}
_POSITIONS = (("x", "y", "z"), ("tx", "ty", "tz"), ("px", "py", "pz"))
#: Names of a rotation's columns, the form that they mean, and the unit of length that comes with them.
_ROTATIONS: tuple[tuple[tuple[str, ...], RotationForm, LengthUnit], ...] = (
    (("qx", "qy", "qz", "qw"), "quaternion", "m"),
    (("rx", "ry", "rz"), "rotvec", "m"),
    (("roll", "pitch", "yaw"), "rpy", "m"),
    (("a", "b", "c"), "ypr-deg", "mm"),
    (("w", "p", "r"), "rpy-deg", "mm"),
    (("o", "a", "t"), "zyz-deg", "mm"),
)
_RTDE = tuple(f"actual_tcp_pose_{k}" for k in range(6))


@dataclass(frozen=True, slots=True)
class RobotPoseTable:
    """The rows of a file of poses.

    Attributes:
        names: names of the images; None if the file has none.
        position: (M, 3) positions as written.
        rotation: (M, 3 or 4) rotations as written.
        form: format of `rotation`.
        unit: unit of `position`.
        plain: the file says itself what it holds: names, and quaternions in metres.
    """

    names: tuple[str, ...] | None
    position: Array
    rotation: Array
    form: RotationForm
    unit: LengthUnit
    plain: bool

    def poses(self, form: RotationForm | None = None) -> Array:
        """Return (M, 4, 4) poses with positions in metres, with the rotations in this format or the file's."""
        out = np.tile(np.eye(4), (len(self.position), 1, 1))
        out[:, :3, :3] = _matrices(self.rotation, form or self.form)
        out[:, :3, 3] = METRES_PER[self.unit] * self.position
        return out

    def other_readings(self) -> Iterator[tuple[Array, str, str]]:
        """Yield (M, 4, 4) poses by each other format of rotation, a text after "they fit", and the advice."""
        for form in _forms(self.rotation.shape[1]):
            if form != self.form:
                yield self.poses(form), f"with the rotations {_WORDS[form]}", f"Give --rotation {form}"
        both: tuple[RotationForm, ...] = ("quaternion", "wxyz")
        for form in both if self.form in both else (self.form,):
            turned = self.poses(form)
            turned[:, :3, :3] = np.swapaxes(turned[:, :3, :3], 1, 2)
            words = f"with the rotations {_WORDS[form]} and inverted (conjugated), the positions as they are"
            yield turned, words, "Invert the rotations in the file: they turn the base into the flange"

    @property
    def words(self) -> str:
        """How the file was read."""
        rows = "" if self.names is not None else ", its rows in the order of the images' numbers"
        return f"positions in {self.unit}, rotations {_WORDS[self.form]}{rows}"


def read_robot_poses(
    path: Path, *, form: RotationForm | None = None, unit: LengthUnit | None = None
) -> RobotPoseTable:
    """Read the table of poses in a file of delimited text.

    Args:
        path: the file.
        form: format of the rotations; None: by the header, the number of columns and the size of the numbers.
        unit: unit of the positions; None: by the header, else metres.

    Raises:
        DataError: there is no pose, or a row has another format; the message names file:line.
    """
    lines = [(line, _cells(row)) for line, row in csv_rows(path)]
    if not lines:
        raise DataError("the file holds no pose", where=str(path), remedy="Write one line per image")
    columns = _columns(lines[0][1], path, lines[0][0])
    rows = lines[1:] if columns.header else lines
    names: list[str] = []
    values: list[list[float]] = []
    for line, cells in rows:
        where = f"{path}:{line}"
        if len(cells) != columns.count:
            raise DataError(f"{len(cells)} fields instead of {columns.count}", where=where, remedy="Correct the line")
        try:
            numbers = [float(cells[k]) for k in columns.numbers]
        except ValueError:
            raise DataError("a field is not a number", where=where, remedy="Correct the line") from None
        name = cells[columns.name] if columns.name is not None else ""
        if not np.isfinite(numbers).all() or (columns.name is not None and not name):
            raise DataError("the name is empty or a number is not finite", where=where, remedy="Correct the line")
        length = float(np.linalg.norm(numbers[3:]))
        if len(numbers) == 7 and abs(length - 1) > _UNIT:
            raise DataError(
                f"the quaternion's length is {length:.4f}, not 1", where=where, remedy="Check the order qx,qy,qz,qw"
            )
        if name and name in names:
            raise DataError(f"image {name} has two poses", where=where, remedy="Remove one of them")
        names.append(name)
        values.append(numbers)
    if not values:
        raise DataError("the file holds no pose", where=str(path), remedy="Write one line per image")
    table = np.array(values)
    rotation = table[:, 3:]
    plain = columns.name is not None and rotation.shape[1] == 4 and form is None and unit is None
    return RobotPoseTable(
        names=None if columns.name is None else tuple(names),
        position=table[:, :3],
        rotation=rotation,
        form=_form(rotation, form, columns.form, path),
        unit=unit or columns.unit,
        plain=plain,
    )


def matched_rows(table: RobotPoseTable, images: Sequence[str], path: Path) -> dict[str, int]:
    """Find the row of each image that has one: by name, or, without names, by the order of the numbers in the names.

    Raises:
        DataError: the table has no names, and more or fewer rows than images; or `matched_names` fails.
    """
    if table.names is None:
        if len(table.position) != len(images):
            raise DataError(
                f"{counted(len(table.position), 'row')} without names of images, {counted(len(images), 'image')}",
                where=str(path),
                remedy="Begin each row with the image's file name, under the header image,x,y,z,rx,ry,rz",
            )
        return {name: row for row, name in enumerate(sorted(images, key=natural))}
    rows = {name: row for row, name in enumerate(table.names)}
    return {image: rows[name] for image, name in matched_names(images, rows, str(path)).items()}


def other_orders(rows: Mapping[str, int]) -> Iterator[tuple[dict[str, int], str]]:
    """Yield the rows of the images if the poses followed another order of names, and the text for that order."""
    counted_up, spelt = sorted(rows, key=natural), sorted(rows)
    if counted_up != spelt:
        words = "if they were put to the images in the order {}"
        lexical, numeric = "1, 10, 2 in which a folder lists its files", "1, 2, 10 of the images' numbers"
        yield {image: rows[other] for image, other in zip(counted_up, spelt, strict=True)}, words.format(lexical)
        yield {image: rows[other] for image, other in zip(spelt, counted_up, strict=True)}, words.format(numeric)


def natural(name: str) -> list[tuple[int, int, str]]:
    """Return a key that sorts names by the numbers in them: 2 before 10."""
    return [
        (0, int(part), "") if part.isdigit() else (1, 0, part.lower()) for part in re.split(r"(\d+)", name) if part
    ]


@dataclass(frozen=True, slots=True)
class _Columns:
    """The columns in which a table has its numbers, and their meaning."""

    header: bool
    count: int
    name: int | None
    numbers: tuple[int, ...]
    form: RotationForm | None
    unit: LengthUnit


def _cells(row: Sequence[str]) -> list[str]:
    """Return the cells of a row without p[ … ], as URScript writes a pose."""
    return [re.sub(r"^\s*(p?\[)|\]\s*$", "", cell).strip() for cell in row]


def _columns(first: Sequence[str], path: Path, line: int) -> _Columns:
    if not _is_header(first):
        return _without_header(first, path, line)
    known = [_bare(cell) for cell in first]
    name = next((k for k, cell in enumerate(known) if cell in _NAMES), None)
    if set(_RTDE) <= set(known):
        return _Columns(True, len(first), name, tuple(known.index(cell) for cell in _RTDE), "rotvec", "m")
    for place in _POSITIONS:
        for turn, form, unit in _ROTATIONS:
            if set(place) | set(turn) <= set(known):
                numbers = tuple(known.index(cell) for cell in (*place, *turn))
                return _Columns(True, len(first), name, numbers, form, _unit_in_heading(first[numbers[0]]) or unit)
    raise DataError(
        f"the first line is {','.join(first)!r}",
        where=f"{path}:{line}",
        remedy="It must be image,x,y,z,qx,qy,qz,qw, or image,x,y,z,rx,ry,rz for rotation vectors in radians",
    )


def _without_header(first: Sequence[str], path: Path, line: int) -> _Columns:
    named = _number(first[0]) is None
    count = len(first) - named
    if count not in (6, 7):
        raise DataError(
            f"{counted(count, 'number')} in the first line",
            where=f"{path}:{line}",
            remedy="A pose has x y z rx ry rz (rotation vector) or x y z qx qy qz qw; a header may say so",
        )
    return _Columns(False, len(first), 0 if named else None, tuple(range(int(named), len(first))), None, "m")


def _is_header(first: Sequence[str]) -> bool:
    return len([cell for cell in first if _number(cell) is None]) > 1


def _number(cell: str) -> float | None:
    try:
        return float(cell)
    except ValueError:
        return None


def _bare(cell: str) -> str:
    """Return a column's name without its unit: `X [mm]`, `x_mm` and `x(m)` are x."""
    return re.sub(r"([\s_]*[\[(].*|_(mm|cm|m|in|deg|rad))$", "", cell.strip().lower())


def _unit_in_heading(cell: str) -> LengthUnit | None:
    unit = re.search(r"[\s_\[(](mm|cm|m|in)[\])]?$", cell.strip().lower())
    units: tuple[LengthUnit, ...] = get_args(LengthUnit)
    return next((known for known in units if unit is not None and unit[1] == known), None)


def _form(rotation: Array, wanted: RotationForm | None, stated: RotationForm | None, path: Path) -> RotationForm:
    possible = _forms(rotation.shape[1])
    if wanted is not None and wanted not in possible:
        raise DataError(
            f"rotations of {rotation.shape[1]} numbers are not {wanted}",
            where=str(path),
            remedy=f"Give --rotation {', '.join(possible)}",
        )
    form: RotationForm = wanted or stated or possible[0]
    if wanted is None and form in ("rotvec", "rpy") and np.abs(rotation).max() > _TURN:
        return "rpy-deg"  # of the formats in degrees the one that most programs write; the images decide
    return form


def _forms(numbers: int) -> tuple[RotationForm, ...]:
    every: tuple[RotationForm, ...] = get_args(RotationForm)
    return every[:2] if numbers == 4 else every[2:]


def _matrices(rotation: Array, form: RotationForm) -> Array:
    """Return (M, 3, 3) rotations."""
    return _MAKE[form.removesuffix("-deg")](np.radians(rotation) if form.endswith("-deg") else rotation).as_matrix()


_MAKE: dict[str, Callable[[Array], Rotation]] = {
    "quaternion": Rotation.from_quat,
    "wxyz": lambda q: Rotation.from_quat(q[:, [1, 2, 3, 0]]),
    "rotvec": Rotation.from_rotvec,
    "rpy": lambda angles: Rotation.from_euler("xyz", angles),
    "ypr": lambda angles: Rotation.from_euler("ZYX", angles),
    "xyz": lambda angles: Rotation.from_euler("XYZ", angles),
    "zyz": lambda angles: Rotation.from_euler("ZYZ", angles),
}


_REMEDY = "Give the file that `orthocapture calibrate hand-eye` wrote"


def read_hand_eye(path: Path) -> Transform:
    """Read T_flange_camera (4, 4), metres, from a hand_eye.json.

    Raises:
        DataError: the file holds no valid T_flange_camera.
    """
    document = parse_json(file_text(path), name=str(path), remedy=_REMEDY)
    try:
        T_flange_camera = np.array(document["T_flange_camera"], dtype=np.float64)
    except (ValueError, KeyError, TypeError, IndexError) as error:
        raise DataError("no T_flange_camera can be read", where=str(path), remedy=_REMEDY) from error
    if T_flange_camera.shape != (4, 4) or not np.isfinite(T_flange_camera).all():
        raise DataError("T_flange_camera is not 4 × 4 finite numbers", where=str(path), remedy=_REMEDY)
    return T_flange_camera


def read_stations(path: Path, images: Iterable[str]) -> dict[str, str]:
    """Read the station by image name, from a CSV with the columns image and station.

    Raises:
        DataError: the columns are missing, or an image has no station.
    """
    rows = csv_rows(path)
    header = [cell.strip() for cell in next(rows, (1, []))[1]]
    if not {"image", "station"} <= set(header):
        raise DataError("no columns image and station", where=f"{path}:1", remedy="Begin the file with image,station")
    image, station = header.index("image"), header.index("station")
    found: dict[str, str] = {}
    for line, row in rows:
        if not any(cell.strip() for cell in row):
            continue
        if len(row) <= max(image, station):
            raise DataError("the line has no image or no station", where=f"{path}:{line}", remedy="Correct the line")
        found[row[image].strip()] = row[station].strip()
    wanted = list(images)
    names = matched_names(wanted, found, str(path), what="station")
    missing = sorted(set(wanted) - set(names))
    if missing:
        raise DataError(
            f"no station for {counted(len(missing), 'image')}: {', '.join(missing[:5])}",
            where=str(path),
            remedy="Add their lines",
        )
    return {image: found[name] for image, name in names.items()}


_AXES = range(1, 17)  # no arm has more
_LARGEST_RAD = 4 * np.pi  # beyond any arm's range: the file is in degrees


def read_joints_csv(path: Path, images: Sequence[str]) -> dict[str, Array]:
    """Read the joints (N,) in radians by image name; N is the number of columns q1, q2, …

    Raises:
        DataError: the file is missing or malformed (with file:line), in degrees, or has no row for an image.
    """
    rows = csv_rows(path)
    header = tuple(cell.strip() for cell in next(rows, (1, []))[1])
    axes = len(header) - 1
    if axes not in _AXES or header != ("image", *(f"q{k}" for k in range(1, axes + 1))):
        raise DataError(
            f"the first line is {','.join(header)!r}",
            where=f"{path}:1",
            remedy="It must be image,q1,q2,… with a column for each of the arm's axes",
        )
    joints: dict[str, Array] = {}
    for line, row in rows:
        if not any(cell.strip() for cell in row):
            continue
        where = f"{path}:{line}"
        try:
            values = np.array([float(cell) for cell in row[1:]])
        except ValueError:
            raise DataError("a field is not a number", where=where, remedy="Correct the line") from None
        if values.shape != (axes,) or not np.isfinite(values).all():
            raise DataError(f"not {axes} finite numbers after the name", where=where, remedy="Correct the line")
        if np.abs(values).max() > _LARGEST_RAD:
            raise DataError(
                f"{np.abs(values).max():.0f} rad is not a joint angle", where=where, remedy="Write radians"
            )
        if row[0].strip() in joints:
            raise DataError(f"image {row[0].strip()} has two rows", where=where, remedy="Remove one of them")
        joints[row[0].strip()] = values
    names = matched_names(images, joints, str(path), what="row of joints")
    missing = [image for image in images if image not in names]
    if missing:
        raise DataError(
            f"no joints for {counted(len(missing), 'image')}: {', '.join(missing[:5])}",
            where=str(path),
            remedy="Add their rows, or leave the images out",
        )
    return {image: joints[names[image]] for image in images}
