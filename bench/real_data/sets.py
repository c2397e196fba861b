"""The public data sets of bench/real_data/__main__.py: sources, licences, and how each is measured."""

from __future__ import annotations

import csv
import json
import subprocess
import sys
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from bench.machine import REPOSITORY
from drivers.dicom_folder import DicomFolderConfig
from drivers.dicom_folder.folder import DicomFolder
from drivers.errors import UnreadableFileError
from drivers.photos.photo_file import read_exif
from service.compute.camera_model import CameraModel
from service.compute.markers.detect import detect_spheres, options_for
from service.compute.poses.pose_files import read_poses
from service.core.errors import ComputeError
from service.core.geometry import Array, align_points

Measure = Callable[[Path, Path], tuple[str, bool]]


@dataclass(frozen=True, slots=True)
class PublicSet:
    """A public data set.

    `measure` takes the set's folder and a folder to write to; None if only the command to try is known.
    """

    name: str
    folder: str  # relative to --data
    what: str
    where: str
    licence: str
    expected: str
    measure: Measure | None = None


def command(*words: object) -> dict[str, Any]:
    """Run `orthocapture WORDS --json` and return its answer.

    Raises:
        ComputeError: the command refused; has its message.
    """
    line = [sys.executable, "-m", "service.cli.main", *map(str, words), "--json"]
    done = subprocess.run(line, cwd=REPOSITORY, capture_output=True, text=True, check=False)
    answer = json.loads(done.stdout.splitlines()[-1]) if done.stdout.strip() else {}
    if done.returncode:
        raise ComputeError(answer.get("error", {}).get("what", done.stderr.strip()[-300:]))
    return answer


# --- boards ---------------------------------------------------------------------------------------------


def _opencv_rms(objects: Sequence[Array], corners: Sequence[Array], size: tuple[int, int]) -> float:
    """RMS reprojection error (px) of OpenCV's calibration with k1 k2 p1 p2, the command's default model."""
    held = [np.asarray(points, dtype=np.float32) for points in objects]
    seen = [np.asarray(points, dtype=np.float32) for points in corners]
    return float(cv2.calibrateCamera(held, seen, size, np.eye(3), np.zeros(5), flags=cv2.CALIB_FIX_K3)[0])


def _chessboards(pattern: str, columns: int, rows: int, square_mm: float) -> Measure:
    def measure(folder: Path, out: Path) -> tuple[str, bool]:
        chosen = out / "images"
        chosen.mkdir(exist_ok=True)
        grid = np.column_stack([np.mgrid[:columns, :rows].T.reshape(-1, 2), np.zeros(columns * rows)]) * square_mm
        objects: list[Array] = []
        corners: list[Array] = []
        size = (0, 0)
        for file in sorted(folder.glob(pattern)):
            (chosen / file.name).write_bytes(file.read_bytes())
            grey = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
            assert grey is not None
            size = (grey.shape[1], grey.shape[0])
            found, points = cv2.findChessboardCornersSB(grey, (columns, rows))
            if found:
                objects.append(grid)
                corners.append(np.asarray(points, dtype=np.float64))
        theirs = _opencv_rms(objects, corners, size)
        record = command(
            "calibrate", "intrinsics", "--images", chosen, "--board", f"{columns}x{rows}", "--square-mm", square_mm,
            "--out", out / "camera.json",
        )  # fmt: skip
        ours = record["rms_px"]
        words = (
            f"{record['n_views']} views, {ours:.3f} px, fx {record['fx']:.1f} ± {record['sigma']['fx']:.1f}; "
            f"OpenCV {len(objects)} views, {theirs:.3f} px"
        )
        return words, ours <= 1.05 * theirs and record["n_views"] >= 0.9 * len(objects)

    return measure


_DOOSAN = (
    "--board",
    "6x4",
    "--square-mm",
    30,
    "--pattern",
    "charuco",
    "--marker-mm",
    22,
    "--dictionary",
    "DICT_4X4_50",
)


def _doosan_camera(folder: Path, out: Path) -> tuple[str, bool]:
    images = folder / "data" / "intrinsics_images"
    board = cv2.aruco.CharucoBoard((7, 5), 30.0, 22.0, cv2.aruco.getPredefinedDictionary(cv2.aruco.DICT_4X4_50))
    detector = cv2.aruco.CharucoDetector(board)
    objects: list[Array] = []
    corners: list[Array] = []
    size = (0, 0)
    for file in sorted(images.glob("*.png")):
        grey = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
        assert grey is not None
        size = (grey.shape[1], grey.shape[0])
        found, ids, _, _ = detector.detectBoard(grey)
        # None if no board is visible, despite what the stubs say.
        shown = np.atleast_1d(np.array([] if len(np.shape(ids)) == 0 else np.ravel(ids), dtype=np.int64))
        if len(shown) >= 8:
            objects.append(np.asarray(board.getChessboardCorners(), dtype=np.float64)[shown])
            corners.append(np.asarray(found, dtype=np.float64))
    theirs = _opencv_rms(objects, corners, size)
    record = command("calibrate", "intrinsics", "--images", images, *_DOOSAN, "--out", out / "camera.json")
    ours = record["rms_px"]
    words = (
        f"{record['n_views']} views, {ours:.3f} px, fx {record['fx']:.1f} ± {record['sigma']['fx']:.1f}; "
        f"OpenCV {len(objects)} views, {theirs:.3f} px"
    )
    return words, ours <= 1.05 * theirs and record["n_views"] >= 0.9 * len(objects)


def _doosan_hand_eye(folder: Path, out: Path) -> tuple[str, bool]:
    camera = out.parent / "doosan-charuco" / "camera.json"
    if not camera.is_file():
        camera.parent.mkdir(parents=True, exist_ok=True)
        _doosan_camera(folder, camera.parent)
    with (out / "poses.csv").open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(["image", "x", "y", "z", "qx", "qy", "qz", "qw"])
        for pose in sorted((folder / "data" / "poses").glob("pose_*.txt")):
            image = f"img_{pose.stem[-3:]}.png"
            if (folder / "data" / "images" / image).is_file():
                T = np.loadtxt(pose)
                turn = Rotation.from_matrix(T[:3, :3]).as_quat()
                writer.writerow([image, *(1e-3 * T[:3, 3]), *turn])
    words = (
        "calibrate", "hand-eye", "--images", folder / "data" / "images", "--robot-poses", out / "poses.csv",
        "--camera", camera, *_DOOSAN, "--out", out / "hand_eye.json",
    )  # fmt: skip
    try:
        record = command(*words)
    except ComputeError as refusal:
        return f"refused: {refusal.what}", "views for the hand-eye calibration" in refusal.what
    return f"± {record['sigma']['mm']:.2f} mm", False


# --- structure from motion ------------------------------------------------------------------------------


def _strecha(folder_name: str, most_mm: float) -> Measure:
    def measure(folder: Path, out: Path) -> tuple[str, bool]:
        place = folder / "Benchmarking_Camera_Calibration_2008" / folder_name
        truth: dict[str, Array] = {}
        k, size = np.eye(3), (0, 0)
        for file in sorted((place / "gt_dense_cameras").glob("*.camera")):
            numbers = [float(word) for word in file.read_text().split()]
            k, size = np.reshape(numbers[:9], (3, 3)), (int(numbers[24]), int(numbers[25]))
            truth[file.name.removesuffix(".camera")] = np.array(numbers[21:24])
        camera = {"width": size[0], "height": size[1], "fx": k[0, 0], "fy": k[1, 1], "cx": k[0, 2], "cy": k[1, 2]}
        (out / "camera.json").write_text(json.dumps(camera))
        record = command(
            "sfm", "--images", place / "images", "--camera", out / "camera.json", "--out", out / "model",
            "--effort", "quick",
        )  # fmt: skip
        names = record["registered"]
        found = read_poses(out / "model", names)
        theirs = np.array([truth[name] for name in names])
        ours = np.array([found[name][:3, 3] for name in names])
        T, scale = align_points(theirs, ours, with_scale=True)
        off = np.linalg.norm(scale * ours @ T[:3, :3].T + T[:3, 3] - theirs, axis=1)
        words = f"{len(names)} of {len(truth)} cameras, centres off by {1e3 * np.mean(off):.1f} mm (mean)"
        return words, len(names) == len(truth) and 1e3 * float(np.mean(off)) < most_mm

    return measure


# --- spheres in photographs ------------------------------------------------------------------------------


def _twelve_lights(kind: str, least: int) -> Measure:
    def measure(folder: Path, out: Path) -> tuple[str, bool]:
        del out
        place = folder / "psmImages" / kind
        mask = np.asarray(Image.open(place / f"{kind}.mask.tga").convert("L")) > 128
        ys, xs = np.nonzero(mask)
        centre, radius = np.array([xs.mean(), ys.mean()]), float(np.sqrt(mask.sum() / np.pi))
        height, width = mask.shape
        # The camera is unknown; from far away only the outline's position in the image matters.
        camera = CameraModel(width, height, 5 * width, 5 * width, (width - 1) / 2, (height - 1) / 2)
        right, wrong, radii = 0, 0, list[float]()
        for light in range(12):
            shown = np.asarray(Image.open(place / f"{kind}.{light}.tga").convert("RGB"))
            image = np.ascontiguousarray(shown[..., ::-1])
            for outline in detect_spheres(image, camera, options_for(None, 0.3)):
                away = float(np.linalg.norm(np.array(outline.centre_px) - centre))
                if away < 0.03 * radius and abs(outline.semi_axes_px[0] - radius) < 0.03 * radius:
                    right += 1
                    radii.append(outline.semi_axes_px[0])
                elif away < radius and outline.semi_axes_px[0] > 0.3 * radius:
                    wrong += 1
        spread = f", radius {np.mean(radii):.2f} ± {np.std(radii):.2f} px (mask {radius:.1f})" if radii else ""
        return f"{right} of 12 lights, {wrong} of another size{spread}", right >= least and wrong == 0

    return measure


# --- files ------------------------------------------------------------------------------------------------


def _dicom(folder: Path, out: Path) -> tuple[str, bool]:
    del out
    series = DicomFolder(DicomFolderConfig(folder=folder, stable_s=0.0)).series()
    problems = [problem for one in series for problem in one.problems]
    lacking = sum("no decoder is installed" in problem for problem in problems)
    return f"{len(series)} series read, {len(problems)} problems told, {lacking} without a decoder", len(series) > 0


def _exif(folder: Path, out: Path) -> tuple[str, bool]:
    del out
    told: Counter[str] = Counter()
    for file in sorted(folder.rglob("*")):
        if file.suffix.lower() not in {".jpg", ".jpeg", ".tif", ".tiff"}:
            continue
        try:
            record = read_exif(file)
        except UnreadableFileError:
            told["no picture"] += 1
            continue
        told["read"] += 1
        for name in ("model", "focal_length_mm", "exposure_s", "taken", "focus_mode", "focus_position"):
            told[name] += bool(getattr(record, name))
    return ", ".join(f"{name} {count}" for name, count in told.items()), told["read"] > told["no picture"]


_STRECHA = "git clone https://github.com/openMVG/SfM_quality_evaluation"
_STRECHA_LICENCE = "for research; Strecha et al., CVPR 2008"
SETS = (
    PublicSet(
        "gray-sphere", "photometric-stereo", "a grey ball of 21 % of the width under twelve lights (S. Seitz, UW)",
        "git clone https://github.com/xiumingzhang/photometric-stereo", "none stated; courtesy of S. Seitz",
        "12 of 12 lights, radius within 3 %", _twelve_lights("gray", 12),
    ),
    PublicSet(
        "chrome-sphere", "photometric-stereo", "a mirror ball in the dark, twelve lights (S. Seitz, UW)",
        "git clone https://github.com/xiumingzhang/photometric-stereo", "none stated; courtesy of S. Seitz",
        "its outline is not seen: nothing of another size is taken for it", _twelve_lights("chrome", 0),
    ),
    PublicSet(
        "opencv-chessboards", "opencv", "13 images left01 … left14, 9 × 6 corners",
        "git clone --depth 1 https://github.com/opencv/opencv", "Apache-2.0",
        "rms within 5 % of OpenCV's own", _chessboards("samples/data/left[0-9][0-9].jpg", 9, 6, 25),
    ),
    PublicSet(
        "stereo-chessboards", "stereoCalibrate", "25 images of a webcam, 640 × 512, 9 × 6 corners",
        "git clone https://github.com/Barry-Liang/stereoCalibrate", "none stated",
        "rms within 5 % of OpenCV's own", _chessboards("left*.jpg", 9, 6, 25),
    ),
    PublicSet(
        "doosan-charuco", "Hand-Eye-Calibration-Doosan-A0509-IntelRealSenseA457-ChArUco",
        "28 ChArUco images of a RealSense D435, 1280 × 720",
        "git clone https://github.com/jpjp210202/Hand-Eye-Calibration-Doosan-A0509-IntelRealSenseA457-ChArUco", "MIT",
        "rms within 5 % of OpenCV's own", _doosan_camera,
    ),
    PublicSet(
        "doosan-hand-eye", "Hand-Eye-Calibration-Doosan-A0509-IntelRealSenseA457-ChArUco",
        "29 images and flange poses of a Doosan A0509; its authors' detector painted over the markers",
        "as doosan-charuco", "MIT",
        "refused: too few boards can be read", _doosan_hand_eye,
    ),
    PublicSet(
        "fountain-P11", "SfM_quality_evaluation", "11 images, 3072 × 2048, laser ground truth", _STRECHA,
        _STRECHA_LICENCE, "all cameras, centres within 10 mm", _strecha("fountain-P11", 10),
    ),
    PublicSet(
        "Herz-Jesu-P8", "SfM_quality_evaluation", "8 images, 3072 × 2048, laser ground truth", _STRECHA,
        _STRECHA_LICENCE, "all cameras, centres within 15 mm", _strecha("Herz-Jesus-P8", 15),
    ),
    PublicSet(
        "castle-P19", "SfM_quality_evaluation", "19 images, 3072 × 2048, laser ground truth", _STRECHA,
        _STRECHA_LICENCE, "all cameras, centres within 100 mm", _strecha("castle-P19", 100),
    ),
    PublicSet(
        "dicom", "pydicom-data", "85 DICOM files of many makers and compressions",
        "git clone https://github.com/pydicom/pydicom-data", "MIT, data as stated there",
        "every file read or told of by name, no traceback", _dicom,
    ),
    PublicSet(
        "exif", "exif-samples", "photographs of many cameras and phones, damaged ones among them",
        "git clone https://github.com/ianare/exif-samples", "CC BY-SA 4.0",
        "every file read or refused, no traceback", _exif,
    ),
    PublicSet(
        "hand-eye, KUKA", "kuka", "30 images and poses, checkerboard of 17 × 28 squares of 20 mm",
        "described in https://github.com/VitalyVorobyev/calibration-rs; "
        "`calibrate hand-eye --board 16x27 --square-mm 20`",
        "as stated there", "a verdict with held-out errors; as OpenCV's Park or better",
    ),
    PublicSet(
        "hand-eye, JAKA", "3Ddata", "224 images and poses, squares of 30 mm",
        "git clone https://github.com/MatthewJin001/3Ddata (700 MB); `calibrate hand-eye`", "none stated",
        "a verdict with held-out errors; as OpenCV's Park or better",
    ),
    PublicSet(
        "hand-eye, Tabb", "tabb", "robot-world hand-eye sets, checkerboards",
        "Ag Data Commons, 'Data from: Solving the Robot-World Hand-Eye(s) Calibration Problem with Iterative "
        "Methods'; `calibrate hand-eye`", "CC0", "a verdict with held-out errors; as OpenCV's Park or better",
    ),
    PublicSet(
        "laser-scan spheres", "laser-spheres", "reference spheres in terrestrial laser scans",
        "registration targets of the makers' sample scans; `spheres --mesh SCAN --radius-mm R --mesh-unit m`",
        "of the scan", "every whole sphere, radius within 4 % or the radius that was seen",
    ),
    PublicSet(
        "Artec scans", "artec", "scans of a hand scanner", "https://www.artec3d.com/3d-models; `spheres --mesh SCAN`",
        "CC BY 3.0", "no sphere on fillets; large scans with --mesh-unit",
    ),
    PublicSet(
        "balls, phone", "balls", "photographs of balls, glossy and orange ones",
        "your own; `register --full-search --largest-sphere 0.4 --sphere-colour orange`", "yours",
        "the outermost outline, or none; bench/markers/hard_spheres.py simulates them",
    ),
    PublicSet(
        "hospital DICOM", "tcia", "CT series of hospitals", "https://www.cancerimagingarchive.net; `import`",
        "as stated with each collection", "imported, or what lacks is said before",
    ),
)  # fmt: skip
