"""Reads and writes camera.json, spheres.json and camera poses: CSV, trajectories, transforms.json, COLMAP folders."""

from __future__ import annotations

import csv
import json
import math
import re
import unicodedata
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path, PurePosixPath
from typing import Any, cast

import numpy as np
from scipy.spatial.transform import Rotation

from service.compute.camera_model import CameraModel
from service.compute.images.photographs import ImageFolder, strict_refusal
from service.compute.scene import ScanSpheres
from service.compute.sfm import colmap_process as colmap_files
from service.core.errors import DataError
from service.core.geometry import Array, Transform, from_quaternion, transform
from service.core.text_files import TextTable, csv_rows, file_bytes, file_text, is_number, parse_json, read_table
from service.core.units import metres

_CAMERA_KEYS = ("width", "height", "fx", "fy", "cx", "cy")
_DISTORTION = (
    "k1",
    "k2",
    "p1",
    "p2",
    "k3",
    "k4",
    "k5",
    "k6",
)  # missing ones are zero
#: Keys that `calibrate intrinsics` writes into the same file beside the camera.
_CALIBRATION_KEYS = (
    "model", "board", "n_views", "images", "rms_px", "per_view_rms_px", "excluded", "sigma", "sigma_independent",
    "sigma_by_image", "sigma_corner_px", "inflation", "covariance", "coverage", "tilt", "cross_validation",
    "residuals", "uncertainty", "warnings", "optics",
)  # fmt: skip
_SIMULATED = "simulated"  # of a camera that a simulated rig had


def read_camera_json(path: Path) -> CameraModel:
    """Read a camera from {"width","height","fx","fy","cx","cy"} and, if not zero, "k1" … "k6", "p1", "p2" (OpenCV).

    A file written by `calibrate intrinsics` also holds the calibration's results, and one of a simulated data set
    says so. Any other key is refused, since it could change the meaning of the numbers.

    Raises:
        DataError: a key is missing, unknown or not a number.
    """
    document = json_object(path)
    _check_keys(document, set(_CAMERA_KEYS), {*_DISTORTION, *_CALIBRATION_KEYS, _SIMULATED}, path)
    values: dict[str, float] = {}
    for key in (*_CAMERA_KEYS, *_DISTORTION):
        value = document.get(key, 0.0)
        if isinstance(value, bool) or not isinstance(value, int | float) or not math.isfinite(value):
            raise DataError(f"{key} is {value!r}, not a number", where=str(path), remedy=f"Correct {key}")
        values[key] = value
    if min(values["fx"], values["fy"]) <= 0 or any(values[k] < 1 or values[k] % 1 for k in ("width", "height")):
        raise DataError(
            "width, height, fx and fy must be positive, width and height whole numbers",
            where=str(path),
            remedy="Correct them",
        )
    size = (int(values["width"]), int(values["height"]))
    return CameraModel(*size, *(float(values[k]) for k in (*_CAMERA_KEYS, *_DISTORTION)[2:]))


def write_camera_json(path: Path, camera: CameraModel, *, simulated: bool = False) -> None:
    """Write a camera in the format that `read_camera_json` reads."""
    mark = {_SIMULATED: True} if simulated else {}
    path.write_text(json.dumps(mark | camera.record(), indent=2) + "\n", encoding="utf-8")


def read_spheres_json(path: Path) -> ScanSpheres:
    """Read scan-frame spheres from {"radius_mm": 15, "registration_mm": [[x,y,z],…], "control_mm": [[x,y,z],…]}.

    `details`, which the `spheres` command adds for each sphere, is ignored.

    Raises:
        DataError: a key is missing or unknown, there is no registration sphere, or numbers are malformed.
    """
    document = json_object(path)
    _check_keys(document, {"radius_mm", "registration_mm"}, {"control_mm", "details"}, path)
    radius = document["radius_mm"]
    if isinstance(radius, bool) or not isinstance(radius, int | float) or not 0 < radius < math.inf:
        raise DataError(
            f"radius_mm is {radius!r}, not a positive number", where=str(path), remedy="Correct radius_mm"
        )
    centres: list[Array] = []
    for key in ("registration_mm", "control_mm"):
        rows = finite_numbers(document.get(key, []), f"{path}: {key}")
        if rows.size == 0:
            rows = np.empty((0, 3))
        if rows.ndim != 2 or rows.shape[1] != 3:
            raise DataError(f"{key} is not a list of [x, y, z]", where=str(path), remedy=f"Correct {key}")
        centres.append(metres(rows))
    if len(centres[0]) == 0:
        raise DataError("registration_mm is empty", where=str(path), remedy="Give at least three spheres")
    return ScanSpheres(centres[0], metres(float(radius)), control_m=centres[1])


def _check_keys(document: Mapping[str, Any], needed: set[str], optional: set[str], path: Path) -> None:
    missing = sorted(needed - set(document))
    unknown = sorted(set(document) - needed - optional)
    if missing or unknown:
        parts = [f"missing {', '.join(missing)}"] * bool(missing) + [f"unknown {', '.join(unknown)}"] * bool(unknown)
        allowed = ", ".join(sorted(needed | optional))
        raise DataError(f"wrong keys: {'; '.join(parts)}", where=str(path), remedy=f"The keys are {allowed}")


def json_object(path: Path) -> dict[str, Any]:
    """Return the object in a JSON file.

    Raises:
        DataError: the file is not JSON, or holds no object.
    """
    document = parse_json(file_text(path), name=str(path))
    if not isinstance(document, dict):
        raise DataError("the file does not hold a JSON object", where=str(path), remedy="Begin it with {")
    return cast("dict[str, Any]", document)


def finite_numbers(value: object, where: str) -> Array:
    """Return an array of finite numbers from parsed JSON.

    Raises:
        DataError: it is none; `where` names the place.
    """
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        raise DataError("not an array of numbers", where=where, remedy="Correct the numbers") from None
    if not np.isfinite(array).all():
        raise DataError("a number is not finite", where=where, remedy="Correct the numbers")
    return array


_HEADER = ("image", "x", "y", "z", "qx", "qy", "qz", "qw")
_UNIT = 1e-3  # tolerance of a quaternion's length from 1, so that files with four decimals pass
OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])  # T_camera_openglcamera: x right, y up, z backward
_COLMAP_IMAGES = ("images.txt", "images.bin")
HALF_PIXEL = 0.5  # in formats whose first pixel has its corner, not its centre, at 0


def read_poses(path: Path, images: Sequence[str] | None = None) -> dict[str, Transform]:
    """Read T_world_camera by image name from a CSV, a TUM trajectory, a transforms.json or a COLMAP model folder.

    Args:
        path: file or folder; its kind determines the format.
        images: names that must have a pose, matched as `matched_names` does; only these are returned. None returns
            all.

    Raises:
        DataError: unknown format, malformed content (with file:line), or an image without a pose.
    """
    if path.is_dir():
        transforms = _transforms_in(path)
        poses = read_transforms_json(transforms) if transforms is not None else read_colmap_model(path)
    elif path.name in _COLMAP_IMAGES and path.is_file():
        poses = read_colmap_model(path.parent)
    elif not path.is_file():
        raise DataError("the pose file does not exist", where=str(path), remedy="Check the path")
    elif path.suffix.lower() == ".json":
        poses = read_transforms_json(path)
    elif path.suffix.lower() in {".csv", ".txt", ".tum", ".tsv"}:
        table = read_table(file_bytes(path), str(path))
        poses = _trajectory_poses(table, path) if _is_trajectory(table) else read_poses_csv(path)
    else:
        raise DataError(
            "unknown kind of pose file",
            where=str(path),
            remedy="Give a .csv, a trajectory of TUM (.txt), a transforms.json or a COLMAP model folder",
        )
    return poses if images is None else _select(poses, images, path)


def _transforms_in(folder: Path) -> Path | None:
    """Return the transforms.json of a folder, by this name or another that NeuS2 and Blender's data sets give it.

    Raises:
        DataError: there are several.
    """
    if (folder / "transforms.json").is_file():
        return folder / "transforms.json"
    found = sorted(folder.glob("transform*.json"))
    if len(found) > 1:
        raise DataError(
            f"several files of poses: {', '.join(file.name for file in found)}",
            where=str(folder),
            remedy="Name one of them instead of the folder",
        )
    return found[0] if found else None


def posed_images(
    path: Path, images: ImageFolder, folder: Path, *, strict: bool = False
) -> tuple[dict[str, Transform], ImageFolder]:
    """Read T_world_camera by name for the images that have a pose; return these images too, without the others.

    Raises:
        DataError: `read_poses` fails; no image has a pose; or, with `strict`, one has none.
    """
    chosen, _ = _matched(read_poses(path), [file.name for file in images.files], path)
    return chosen, only_posed(images, chosen, path, folder, strict=strict)


def only_posed(
    images: ImageFolder, posed: Collection[str], path: Path, folder: Path, *, strict: bool = False
) -> ImageFolder:
    """Return the images whose names are among those with a pose in the file `path`; the others are left out.

    Raises:
        DataError: no image has a pose; or, with `strict`, one has none.
    """
    names = [file.name for file in images.files]
    missing = [name for name in names if name not in posed]
    if len(missing) == len(names):
        raise _without_pose(missing, names, path)
    reasons = dict.fromkeys(missing, f"no pose in {path.name}")
    if reasons and strict:
        raise strict_refusal(reasons, folder)
    return images.without(reasons)


def _select(poses: Mapping[str, Transform], images: Sequence[str], path: Path) -> dict[str, Transform]:
    chosen, missing = _matched(poses, images, path)
    if missing:
        raise _without_pose(missing, images, path)
    return chosen


def _matched(
    poses: Mapping[str, Transform], images: Sequence[str], path: Path
) -> tuple[dict[str, Transform], list[str]]:
    """Match poses to images; return the names of the images without one too.

    Raises:
        DataError: `matched_names` fails, or none of the images has one.
    """
    names = matched_names(images, poses, str(path))
    if images and not names:
        raise DataError(
            f"no image has a pose: the images are named {some_names(images)}, those of the poses "
            f"{some_names(list(poses))}",
            where=str(path),
            remedy="Give the poses of these images, or name them alike",
        )
    return {image: poses[name] for image, name in names.items()}, [name for name in images if name not in names]


def _without_pose(missing: Sequence[str], images: Sequence[str], path: Path) -> DataError:
    return DataError(
        f"{len(missing)} of {len(images)} images have no pose: {', '.join(missing[:5])}",
        where=str(path),
        remedy="Add their poses, or leave the images out",
    )


# --- CSV ------------------------------------------------------------------------------------------------


def read_poses_csv(path: Path) -> dict[str, Transform]:
    """Read T_world_camera from a CSV with the header image,x,y,z,qx,qy,qz,qw (metres, scalar last).

    Raises:
        DataError: the file has another format; the message names file:line.
    """
    poses: dict[str, Transform] = {}
    rows = csv_rows(path)
    header = tuple(cell.strip() for cell in next(rows, (1, []))[1])
    if header != _HEADER:
        raise DataError(
            f"the first line is {','.join(header)!r}", where=f"{path}:1", remedy=f"It must be {','.join(_HEADER)}"
        )
    for line, row in rows:
        where = f"{path}:{line}"
        if not any(cell.strip() for cell in row):
            continue
        if len(row) != len(_HEADER):
            raise DataError(f"{len(row)} fields instead of {len(_HEADER)}", where=where, remedy="Correct the line")
        name = row[0].strip()
        try:
            values = np.array([float(cell) for cell in row[1:]])
        except ValueError:
            raise DataError("a field is not a number", where=where, remedy="Correct the line") from None
        if not name or not np.isfinite(values).all():
            raise DataError("the name is empty or a number is not finite", where=where, remedy="Correct the line")
        length = float(np.linalg.norm(values[3:]))
        if abs(length - 1) > _UNIT:
            raise DataError(
                f"the quaternion's length is {length:.4f}, not 1", where=where, remedy="Check the order qx,qy,qz,qw"
            )
        if name in poses:
            raise DataError(f"image {name} has two poses", where=where, remedy="Remove one of them")
        poses[name] = from_quaternion(values[:3], values[3:])
    if not poses:
        raise DataError("the file holds no pose", where=str(path), remedy="Write one line per image")
    return poses


def write_poses_csv(path: Path, T_world_camera: Mapping[str, Transform]) -> None:
    """Write poses in the format that `read_poses_csv` reads."""
    with path.open("w", encoding="utf-8", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(_HEADER)
        for name, T in T_world_camera.items():
            quaternion = Rotation.from_matrix(T[:3, :3]).as_quat()
            writer.writerow([name, *(repr(float(v)) for v in (*T[:3, 3], *quaternion))])


# --- transforms.json ------------------------------------------------------------------------------------


def read_transforms_json(path: Path) -> dict[str, Transform]:
    """Read T_world_camera from a transforms.json of nerfstudio, Instant-NGP, Blender's data sets or NeuS2.

    Cameras look along -z, but those of NeuS2's own format and of Mitsuba along +z. Names are the frames' file_path
    without a leading "./". Where `unit_box.json` of our own export lies beside it, positions are taken back to the
    world.

    Raises:
        DataError: another kind of file, a matrix that is not rigid, or a duplicate image.
    """
    document = json_object(path)
    T_camera_file, centre_m = _camera_axes(document), _centre_beside(path)
    frames = document.get("frames")
    if not isinstance(frames, list) or not frames:
        raise DataError("no list of frames in the file", where=str(path), remedy="Give a nerfstudio transforms.json")
    poses: dict[str, Transform] = {}
    for index, frame in enumerate(cast("list[Any]", frames)):
        where = f"{path}: frames[{index}]"
        entry = cast("dict[str, Any]", frame) if isinstance(frame, dict) else {}
        name = entry.get("file_path")
        if not isinstance(name, str) or "transform_matrix" not in entry:
            raise DataError("a frame needs file_path and transform_matrix", where=where, remedy="Correct the frame")
        name = name.removeprefix("./")
        matrix = finite_numbers(entry["transform_matrix"], where)
        if matrix.shape not in {(4, 4), (3, 4)}:
            raise DataError(f"transform_matrix is {matrix.shape}, not 4 × 4", where=where, remedy="Correct the frame")
        if name in poses:
            raise DataError(f"image {name} has two poses", where=where, remedy="Remove one of them")
        poses[name] = transform(_rotation(matrix[:3, :3], where), matrix[:3, 3] + centre_m) @ T_camera_file
    return poses


def _camera_axes(document: Mapping[str, Any]) -> Transform:
    """Return the axes of a file's cameras, as `nerf_matrix_to_ngp` of NeuS2 and Instant-NGP takes them.

    They test only whether the keys are there: with `from_na` x is right, y down, z forward, with `normal_mts_args`
    (Mitsuba) x is left, y up, z forward.
    """
    if "from_na" in document:
        return np.eye(4)
    return np.diag([-1.0, -1.0, 1.0, 1.0]) if "normal_mts_args" in document else OPENGL


def _centre_beside(path: Path) -> Array:
    """Return the centre (3,), in metres, that our unit box exporters subtracted from the positions; else zero."""
    beside = path.parent / "unit_box.json"
    if not beside.is_file():
        return np.zeros(3)
    centre_m = finite_numbers(json_object(beside).get("centre_m"), str(beside))
    if centre_m.shape != (3,):
        raise DataError("centre_m is not [x, y, z]", where=str(beside), remedy="Export the data set again")
    return centre_m


def _rotation(matrix: Array, where: str) -> Array:
    """Return the rotation matrix nearest to one that was written with few digits."""
    if np.abs(matrix @ matrix.T - np.eye(3)).max() > 5 * _UNIT or np.linalg.det(matrix) < 0:
        raise DataError(
            "the matrix is not a rotation (scaled, sheared or mirrored)",
            where=where,
            remedy="Export rigid poses, without a scale",
        )
    U, _, Vt = np.linalg.svd(matrix)
    return U @ Vt


def write_transforms_json(
    path: Path, camera: CameraModel, T_world_camera: Mapping[str, Transform], *, simulated: bool = False
) -> None:
    """Write poses and camera as nerfstudio's transforms.json (OPENCV model, OpenGL camera axes).

    `simulated`: the file says so.

    Raises:
        DataError: the camera has rational distortion, which that format cannot hold.
    """
    document = {
        **({"simulated": True} if simulated else {}),
        "camera_model": "OPENCV",
        **transforms_intrinsics(camera, where=str(path), remedy="Calibrate with the model opencv4 or opencv5"),
        "frames": [
            {"file_path": name, "transform_matrix": (T @ OPENGL).tolist()} for name, T in T_world_camera.items()
        ],
    }
    path.write_text(json.dumps(document, indent=2) + "\n", encoding="utf-8")


def transforms_intrinsics(camera: CameraModel, *, where: str = "", remedy: str) -> dict[str, float]:
    """Return the keys of one camera in transforms.json; nerfstudio, like COLMAP, has the first pixel's corner at 0.

    Raises:
        DataError: the camera has the rational distortion k4, k5, k6, which the format cannot hold.
    """
    if camera.k4 or camera.k5 or camera.k6:
        raise DataError("transforms.json cannot hold the rational distortion k4, k5, k6", where=where, remedy=remedy)
    return {
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx + HALF_PIXEL,
        "cy": camera.cy + HALF_PIXEL,
        "k1": camera.k1,
        "k2": camera.k2,
        "p1": camera.p1,
        "p2": camera.p2,
        **({"k3": camera.k3} if camera.k3 else {}),
    }


# --- COLMAP ---------------------------------------------------------------------------------------------


def read_colmap_model(folder: Path) -> dict[str, Transform]:
    """Read T_world_camera from a COLMAP model (cameras, images, points3D as .bin or .txt), or a folder above it.

    Raises:
        DataError: the folder has no model, or it cannot be read.
    """
    below = ("", "sparse/0", "sparse", "0", "dslr_calibration_undistorted")  # the last is ETH3D's
    for place in (folder / name for name in below):
        if any((place / f"images{suffix}").is_file() for suffix in (".bin", ".txt")):
            return colmap_files.read_model(place)
    raise DataError(
        "no COLMAP model in the folder",
        where=str(folder),
        remedy="It must hold cameras, images and points3D (.bin or .txt)",
    )


_COLUMNS = 8


def _is_trajectory(table: TextTable) -> bool:
    """Return whether a table's first line is eight numbers separated by spaces, and so no header and no names."""
    if not table.rows or table.dialect.separator != " ":
        return False
    cells = table.rows[0].cells
    return len(cells) == _COLUMNS and all(map(is_number, cells))


def _trajectory_poses(table: TextTable, path: Path) -> dict[str, Transform]:
    """Return T_world_camera by timestamp, as the file writes it: images of such data sets are named by it.

    Raises:
        DataError: a line has another format, or a timestamp occurs twice; the message names file:line.
    """
    poses: dict[str, Transform] = {}
    for row in table.rows:
        where = f"{path}:{row.line}"
        if len(row.cells) != _COLUMNS or not all(map(is_number, row.cells)):
            raise DataError(
                "the line is not timestamp tx ty tz qx qy qz qw, as those before it",
                where=where,
                remedy="Correct the line",
            )
        stamp, *rest = row.cells
        values = np.array([float(cell) for cell in rest])
        length = float(np.linalg.norm(values[3:]))
        if not np.isfinite(values).all() or abs(length - 1) > _UNIT:
            raise DataError(
                f"the quaternion's length is {length:.4f}, not 1", where=where, remedy="Check the order qx qy qz qw"
            )
        if stamp in poses:
            raise DataError(f"timestamp {stamp} has two poses", where=where, remedy="Remove one of them")
        poses[stamp] = from_quaternion(values[:3], values[3:])
    return poses


# Matches the names of images in a table with the images of a folder, whatever program wrote it.
#
# Programs write paths of their own computer, with backslashes and drive letters, leave the extension out, and
# change the case or the Unicode form of letters. A name that fits only one image that way is that image's; one that
# fits several is refused.


_DRIVE = re.compile(r"[A-Za-z]:")
_PICTURES = frozenset({
    ".jpg", ".jpeg", ".jpe", ".jfif", ".png", ".tif", ".tiff", ".bmp", ".pgm", ".ppm", ".pnm", ".webp", ".exr",
    ".heic", ".heif", ".avif", ".jxl", ".jp2", ".arw", ".cr2", ".cr3", ".dng", ".nef", ".orf", ".pef", ".raf", ".rw2",
})  # fmt: skip
_NAMED = 3


def matched_names(images: Sequence[str], named: Collection[str], where: str, *, what: str = "pose") -> dict[str, str]:
    """Return, for each image that a file names, its name there.

    Args:
        images: names of image files.
        named: the names in the file.
        where: names the file in errors.
        what: content that the file has of each image, for errors.

    Raises:
        DataError: a name in the file can be several images, or several names one image.
    """
    found = {image: image for image in images if image in named}
    place = (where, what)
    for key in (_file, _composed, _caseless):
        _match(images, named, key, key, found, place)
    bare = [name for name in named if PurePosixPath(_composed(name)).suffix.lower() not in _PICTURES]
    for key in (_composed, _caseless):
        _match(images, bare, lambda image, key=key: _stem(key(image)), key, found, place)
    return found


def _match(
    images: Sequence[str],
    named: Collection[str],
    of_image: Callable[[str], str],
    of_name: Callable[[str], str],
    found: dict[str, str],
    place: tuple[str, str],
) -> None:
    """Add the images whose key is that of one name; those that were found before do not count."""
    used = set(found.values())
    names: dict[str, list[str]] = {}
    for name in named:
        if name not in used:
            names.setdefault(of_name(name), []).append(name)
    alike: dict[str, list[str]] = {}
    for image in images:
        if image not in found and of_image(image) in names:
            alike.setdefault(of_image(image), []).append(image)
    for key, those in alike.items():
        if len(those) > 1 or len(names[key]) > 1:
            raise DataError(
                f"it is not clear whose {place[1]} it is: {some_names(names[key])} can be {some_names(those)}",
                where=place[0],
                remedy="Name the images in the file as they are named in their folder",
            )
        found[those[0]] = names[key][0]


def _file(name: str) -> str:
    """Return the file's name without its folders, whichever system wrote the path."""
    return PurePosixPath(_DRIVE.sub("", name.strip().replace("\\", "/"), count=1)).name


def _composed(name: str) -> str:
    """Return the file's name with composed letters: macOS stores ä as a and two dots."""
    return unicodedata.normalize("NFC", _file(name))


def _caseless(name: str) -> str:
    return _composed(name).casefold()


def _stem(name: str) -> str:
    return PurePosixPath(name).stem


def some_names(names: Sequence[str]) -> str:
    """Return the first names of several, for messages."""
    return ", ".join(names[:_NAMED]) + (", …" if len(names) > _NAMED else "")
