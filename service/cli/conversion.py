"""`orthocapture import-ros` and `develop`: a ROS 2 recording and raw files become files for the other commands."""

from __future__ import annotations

import hashlib
import json as json_module
import shutil
from collections import Counter
from collections.abc import Generator, Mapping
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from service.cli.common import (
    JsonOption,
    console,
    print_json,
    reporting_errors,
    require_writable_folder,
    tell_left_out,
    write_whole,
)
from service.compute.photography import PARAMETERS
from service.compute.poses.pose_files import write_camera_json, write_poses_csv
from service.compute.poses.ros_messages import StampedImage, StampedTransform
from service.compute.poses.ros_recording import (
    FoundPose,
    FrameTree,
    NoPoseError,
    Recording,
    Timing,
    read_recording,
    recording_file,
)
from service.core.errors import ConfigurationError, DataError
from service.core.geometry import Transform
from service.core.picture_files import kind_of
from service.core.units import ms, nanoseconds, seconds_of_ms, seconds_of_ns
from service.core.words import counted

if TYPE_CHECKING:
    from service.computations.further_cameras.compute import DevelopedFile

# --- `import-ros`: images, robot poses, camera and mount of a ROS 2 recording -------------------------------------

_SUFFIXES = {"JPEG": ".jpg", "PNG": ".png"}
_HAND_EYE_NOTE = "from the static transforms of the recording; no uncertainty is stated there"


@dataclass(frozen=True, slots=True)
class _Images:
    """Images that were written, with their stamps, and those that were not, with the reason."""

    stamps_ns: dict[str, int]
    left_out: dict[str, str]


def import_ros_command(
    recording: Annotated[Path, typer.Argument(help="An MCAP file of ROS 2, or the folder of rosbag2 with one.")],
    out: Annotated[Path, typer.Option("--out", help="A new folder for images/, poses.csv and camera.json.")],
    base: Annotated[str, typer.Option("--base", help="Frame of the robot's base.")],
    flange: Annotated[
        str, typer.Option("--flange", help="Frame of the robot's flange, or with --pose-topic its name.")
    ] = "",
    pose_topic: Annotated[
        str, typer.Option("--pose-topic", help="Topic of PoseStamped: the flange in the base; instead of /tf.")
    ] = "",
    image_topic: Annotated[
        str, typer.Option("--image-topic", help="Topic of compressed images.", show_default="the only one")
    ] = "",
    camera_frame: Annotated[
        str, typer.Option("--camera-frame", help="Optical frame of the camera: writes hand_eye.json from /tf_static.")
    ] = "",
    within_ms: Annotated[
        float, typer.Option("--within-ms", help="How far the nearest pose may be from an image.", min=0.0)
    ] = 0.0,
    interpolate_ms: Annotated[
        float,
        typer.Option(
            "--interpolate-ms", help="Interpolate between poses that are not farther apart. Default: never.", min=0.0
        ),
    ] = 0.0,
    json: JsonOption = False,
) -> None:
    """Take images, robot poses, camera and mount from a ROS 2 recording; the files fit the other commands.

    Writes T_base_flange of every image. Poses are interpolated only with --interpolate-ms.
    """
    with reporting_errors(json):
        _require_one_source(flange, pose_topic, camera_frame)
        file = recording_file(recording)
        with _new_folder(out) as part:
            images: dict[str, dict[str, int]] = {}
            refused: dict[str, dict[str, str]] = {}

            def keep(topic: str, image: StampedImage) -> None:
                if image_topic in ("", topic):
                    keep_image(part, image, images.setdefault(topic, {}), refused.setdefault(topic, {}))

            found = read_recording(file, keep)
            topic = _image_topic(found, image_topic, file)
            taken = _Images(images.get(topic, {}), refused.get(topic, {}))
            timing = Timing(
                nanoseconds(seconds_of_ms(within_ms)),
                interpolate=interpolate_ms > 0,
                most_ns=nanoseconds(seconds_of_ms(interpolate_ms)),
            )
            tree, body = (found.frames, flange) if flange else (_of_topic(found, pose_topic, base, file), pose_topic)
            poses, left_out = _poses(tree, base, body, taken.stamps_ns, timing)
            left_out |= taken.left_out
            if not poses:
                raise _nothing(left_out, file)
            written = _write_recording(part, found, tree, poses, flange=flange, camera_frame=camera_frame)
            record = {
                "recording": str(file),
                "image_topic": topic,
                "base": base,
                "flange": body,
                "written": written,
                "poses": _how_found(taken, poses),
                "left_out": left_out,
                "not_read": found.other,
            }
            _write_record(part / "import.json", record)
        if json:
            print_json(record)
            return
        tell_left_out(left_out)
        console.print(_words(poses))
        console.print(f"written: {', '.join(written)} in {out!s}")


def _require_one_source(flange: str, pose_topic: str, camera_frame: str) -> None:
    """Raise BadParameter unless the options name one source of poses."""
    if bool(flange) == bool(pose_topic):
        raise typer.BadParameter("give --flange, for poses in /tf, or --pose-topic")
    if camera_frame and not flange:
        raise typer.BadParameter("--camera-frame needs --flange: both are frames of /tf_static")


def _write_record(path: Path, record: Mapping[str, object]) -> None:
    text = json_module.dumps(record, indent=1, allow_nan=False, ensure_ascii=False)
    path.write_text(f"{text}\n", encoding="utf-8")


@contextmanager
def _new_folder(out: Path) -> Generator[Path]:
    """Yield a folder beside `out` that gets its name when the block ends without an error, and is removed otherwise.

    Raises DataError if `out` exists, or cannot be made.
    """
    if out.exists():
        raise DataError("the folder exists already", where=str(out), remedy="Name a new one; nothing is overwritten")
    require_writable_folder(out)
    part = out.with_name(f".{out.name}.part")
    try:
        shutil.rmtree(part, ignore_errors=True)
        (part / "images").mkdir(parents=True)
    except OSError as error:
        raise DataError(
            f"the folder cannot be made: {error.strerror}", where=str(out), remedy="Name another one"
        ) from error
    try:
        yield part
        part.replace(out)
    finally:
        shutil.rmtree(part, ignore_errors=True)


def keep_image(out: Path, image: StampedImage, stamps: dict[str, int], left_out: dict[str, str]) -> None:
    """Write one image under the name of its stamp. What it holds decides its kind: messages may state another."""
    kind = kind_of(image.data)
    suffix = _SUFFIXES.get(kind)
    name = f"{image.stamp_ns}{suffix or ''}"
    if suffix is None:
        left_out[name] = f"its format {image.form[:40]!r} is not jpeg or png" + (f", but {kind}" if kind else "")
    elif name in stamps:
        left_out[f"{name} again"] = "another image has this stamp"
    else:
        (out / "images" / name).write_bytes(image.data)
        stamps[name] = image.stamp_ns


def _image_topic(found: Recording, wanted: str, file: Path) -> str:
    topics = sorted(found.image_topics)
    if wanted in topics or (not wanted and len(topics) == 1):
        return wanted or topics[0]
    raw = [topic for topic, kind in found.other.items() if kind == "sensor_msgs/msg/Image"]
    also = f"; {', '.join(raw)} is not compressed: record it through image_transport" if raw else ""
    count = f"{counted(len(topics), 'topic')} of compressed images ({', '.join(topics) or 'none'})"
    raise DataError(
        f"the recording has {count}{also}",
        where=str(file),
        remedy="Name one with --image-topic",
    )


def _of_topic(found: Recording, topic: str, base: str, file: Path) -> FrameTree:
    """Return the poses of a topic as a tree of two frames."""
    if topic not in found.poses:
        raise DataError(
            f"there is no topic {topic} of poses; there is {', '.join(sorted(found.poses)) or 'none'}",
            where=str(file),
            remedy="Name one of these with --pose-topic",
        )
    tree = FrameTree(str(file))
    other = Counter(one.parent for one in found.poses[topic] if one.parent.lstrip("/") != base.lstrip("/"))
    if other:
        raise DataError(
            f"poses of {topic} are in the frame {next(iter(other))!r}, not in {base!r}",
            where=str(file),
            remedy="Name that frame with --base, if it is the robot's base",
        )
    for one in found.poses[topic]:
        tree.add(StampedTransform(one.stamp_ns, base, topic, one.T_parent_child), static=False)
    return tree


def _poses(
    tree: FrameTree, base: str, flange: str, stamps_ns: dict[str, int], timing: Timing
) -> tuple[dict[str, FoundPose], dict[str, str]]:
    """Return T_base_flange of every image that has one, and why the others have none."""
    poses: dict[str, FoundPose] = {}
    left_out: dict[str, str] = {}
    for name, stamp_ns in sorted(stamps_ns.items()):
        try:
            poses[name] = tree.pose(base, flange, stamp_ns, timing)
        except NoPoseError as error:
            left_out[name] = str(error)
    return poses, left_out


def _write_recording(
    out: Path, found: Recording, tree: FrameTree, poses: dict[str, FoundPose], *, flange: str, camera_frame: str
) -> list[str]:
    """Write poses, camera and mount; returns the names of the files."""
    written = ["images/", "poses.csv"]
    write_poses_csv(out / "poses.csv", {name: one.T_a_b for name, one in poses.items()})
    if len(found.cameras) == 1:
        write_camera_json(out / "camera.json", next(iter(found.cameras.values())))
        written.append("camera.json")
    if camera_frame:
        T = _mount(tree, flange, camera_frame)
        document = {"setup": "eye-in-hand", "T_flange_camera": T.tolist(), "note": _HAND_EYE_NOTE}
        (out / "hand_eye.json").write_text(json_module.dumps(document, indent=1) + "\n", encoding="utf-8")
        written.append("hand_eye.json")
    return written


def _mount(tree: FrameTree, flange: str, camera_frame: str) -> Transform:
    if not tree.is_static(flange, camera_frame):
        raise ConfigurationError(
            f"{camera_frame!r} moves against {flange!r}, so there is no mount between them",
            where="--camera-frame",
            remedy="Name the frame of a camera on the flange",
        )
    return tree.pose(flange, camera_frame, 0, Timing()).T_a_b


def _how_found(taken: _Images, poses: dict[str, FoundPose]) -> dict[str, dict[str, int | bool]]:
    """Return the stamp of each image with a pose, in ns, and how the pose was found."""
    return {
        name: {"stamp_ns": taken.stamps_ns[name], "away_ns": one.away_ns, "interpolated": one.interpolated}
        for name, one in poses.items()
    }


def _nothing(left_out: dict[str, str], file: Path) -> DataError:
    why = next(iter(left_out.items()), ("", "the topic has no image"))
    return DataError(
        f"no image has a pose: {' '.join(filter(None, why))}",
        where=str(file),
        remedy="Allow the nearest pose with --within-ms, or --interpolate-ms, if image and robot have one clock",
    )


def _words(poses: dict[str, FoundPose]) -> str:
    """Return how the poses were found."""
    between = [one for one in poses.values() if one.interpolated]
    near = [one for one in poses.values() if one.away_ns and not one.interpolated]
    text = f"{counted(len(poses), 'image')} with a pose: {len(poses) - len(between) - len(near)} of the same time"
    for kind, what in ((near, "nearest"), (between, "INTERPOLATED")):
        if kind:
            far = ms(seconds_of_ns(max(one.away_ns for one in kind)))
            text += f", {len(kind)} {what} (messages up to {far:.3f} ms away)"
    return text


# --- `develop`: linear TIFFs of 16 bits, with fixed parameters and a record beside each ---------------------------

_JPEGS = (".jpg", ".jpeg")


def develop_command(
    files: Annotated[list[Path], typer.Argument(help="Raw files that LibRaw reads: ARW, CR3, NEF, DNG.")],
    out: Annotated[Path, typer.Option("--out", help="Folder for the TIFFs and their records.", file_okay=False)],
    demosaic: Annotated[
        str, typer.Option("--demosaic", help="LibRaw's algorithm, as rawpy names it.")
    ] = PARAMETERS.demosaic,
    json: JsonOption = False,
) -> None:
    """Develop raw files to linear TIFFs of 16 bits, always in the same way; needs the extra `raw`.

    A JPEG of the same name beside a raw file gives the picture its size, and its place is checked against it.
    """
    from service.computations.further_cameras.compute import develop_file  # noqa: PLC0415 - the numerics, which `import-ros` does without

    with reporting_errors(json):
        _require_new(files, out)
        records: list[dict[str, Any]] = []
        for file in files:
            jpeg = _jpeg_of(file)
            parameters = replace(PARAMETERS, demosaic=demosaic)
            made = develop_file(file, jpeg, parameters)
            records.append(_write_developed(made, file, jpeg, out))
            if not json:
                _tell(records[-1], jpeg)
        if json:
            print_json(records)


def _require_new(files: list[Path], out: Path) -> None:
    """Require that nothing is overwritten, and that every raw file has a name of its own."""
    require_writable_folder(out)
    stems = [file.stem for file in files]
    twice = next((stem for stem in stems if stems.count(stem) > 1), None)
    if twice is not None:
        raise ConfigurationError(f"two raw files are called {twice}", where=str(out), remedy="Use a folder for each")
    there = next((path for stem in stems if (path := out / f"{stem}.tif").exists()), None)
    if there is not None:
        raise ConfigurationError("the file exists", where=str(there), remedy="Name another folder with --out")


def _jpeg_of(raw: Path) -> Path | None:
    """Return the JPEG of the same name, if there is one."""
    if not raw.is_file():
        raise DataError("the file does not exist", where=str(raw), remedy="Check the path")
    beside = (path for path in raw.parent.iterdir() if path.stem == raw.stem and path.suffix.lower() in _JPEGS)
    return min(beside, default=None)


def _write_developed(made: DevelopedFile, raw: Path, jpeg: Path | None, out: Path) -> dict[str, Any]:
    out.mkdir(exist_ok=True)
    write_whole(out / f"{raw.stem}.tif", made.tiff)
    record: dict[str, Any] = {
        "raw": _named(raw.name, raw.read_bytes()),
        "jpeg": None if jpeg is None else _named(jpeg.name, jpeg.read_bytes()),
        "tiff": _named(f"{raw.stem}.tif", made.tiff),
        **asdict(made.how),
    }
    write_whole(out / f"{raw.stem}.json", json_module.dumps(record, indent=1) + "\n")
    return record


def _named(name: str, data: bytes) -> dict[str, str]:
    return {"name": name, "sha256": hashlib.sha256(data).hexdigest()}


def _tell(record: dict[str, Any], jpeg: Path | None) -> None:
    crop, shift_px = record["crop"], record["largest_shift_px"]
    place = "no JPEG beside it: its place is not checked"
    if jpeg is not None:
        place = f"at most {shift_px:.2f} px from {jpeg.name}"
    console.print(f"{record['tiff']['name']}: {crop['width']} × {crop['height']} px, {place}")
