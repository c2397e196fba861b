"""What `orthocapture register` says of inputs that are wrong, and of clean ones: true error, stated sigma, verdict.

Each row is one fault of a laboratory on a rendered scene with ground truth. A row is good if the true error is within
three stated sigmas, or if the command refuses and names the case.
"""

from __future__ import annotations

import argparse
import csv
import datetime
import functools
import json
import shutil
import statistics
import tempfile
from collections.abc import Callable, Generator, Iterable, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from typer.testing import CliRunner

from bench.machine import RESULTS, commit, machine
from service.cli.main import app
from service.core.geometry import apply
from tests.support.scenes.rendered_scene import CACHE, render_image, render_scene

_ASIDE = np.array([0.6, 0.7, -0.39]) / np.linalg.norm([0.6, 0.7, -0.39])
_WIDTH = 1920  # for which lengths in pixels below are meant


@dataclass(slots=True)
class Inputs:
    """The inputs of one call, which a fault changes; `scratch` is for files that it makes."""

    images: Path
    camera: dict[str, Any]
    poses: dict[str, list[float]]
    spheres: dict[str, Any]
    scratch: Path
    foreign: Callable[[str], Path]  # the image of this name of another scene
    options: list[str] = field(default_factory=list[str])

    @property
    def pixels(self) -> float:
        """Pixels of these images for one of images 1920 px wide."""
        return float(self.camera["width"]) / _WIDTH

    def own_images(self, change: Callable[[Path, Path], object]) -> None:
        """Copy the images, each by `change` (from, to)."""
        folder = self.scratch / "images"
        folder.mkdir()
        for file in sorted(self.images.glob("*.jpg")):
            change(file, folder / file.name)
        self.images = folder


@dataclass(frozen=True, slots=True)
class Case:
    """One fault; `named` are words of which the command must say one if the error is not covered by its sigma."""

    name: str
    change: Callable[[Inputs], None]
    named: tuple[str, ...] = ()


def _nothing(_inputs: Inputs) -> None:
    """Leave the inputs as they are."""


def _control(by_mm: float) -> Callable[[Inputs], None]:
    return _moved("control_mm", by_mm)


def _moved(key: str, by_mm: float) -> Callable[[Inputs], None]:
    def change(inputs: Inputs) -> None:
        inputs.spheres[key][1] = (np.array(inputs.spheres[key][1]) + by_mm * _ASIDE).tolist()

    return change


def _added(key: str) -> Callable[[Inputs], None]:
    def change(inputs: Inputs) -> None:
        """List a sphere half-way between two, where nothing is."""
        known = np.array(inputs.spheres["registration_mm"])
        inputs.spheres[key].append((0.5 * (known[0] + known[1])).tolist())

    return change


def _mirrored(inputs: Inputs) -> None:
    for key in ("registration_mm", "control_mm"):
        inputs.spheres[key] = (np.array(inputs.spheres[key]) * [1, -1, 1]).tolist()


def _radius(factor: float) -> Callable[[Inputs], None]:
    def change(inputs: Inputs) -> None:
        inputs.spheres["radius_mm"] *= factor

    return change


def _scaled_list(factor: float, *, with_radius: bool = False) -> Callable[[Inputs], None]:
    def change(inputs: Inputs) -> None:
        for key in ("registration_mm", "control_mm"):
            inputs.spheres[key] = (factor * np.array(inputs.spheres[key])).tolist()
        inputs.spheres["radius_mm"] *= factor if with_radius else 1.0

    return change


def _scaled_positions(factor: float) -> Callable[[Inputs], None]:
    def change(inputs: Inputs) -> None:
        for pose in inputs.poses.values():
            pose[:3] = [factor * value for value in pose[:3]]

    return change


def _focal(fx: float, fy: float) -> Callable[[Inputs], None]:
    def change(inputs: Inputs) -> None:
        inputs.camera["fx"] *= fx
        inputs.camera["fy"] *= fy

    return change


def _principal_point(inputs: Inputs) -> None:
    inputs.camera["cx"] += 2.0 * inputs.pixels


def _copied(before: Path, after: Path) -> None:
    shutil.copy(before, after)


def _foreign(inputs: Inputs) -> None:
    inputs.own_images(_copied)
    names = sorted(file.name for file in inputs.images.iterdir())
    shutil.copy(inputs.foreign(names[5]), inputs.images / names[5])


def _swapped(inputs: Inputs) -> None:
    names = sorted(inputs.poses)
    inputs.poses[names[3]], inputs.poses[names[12]] = inputs.poses[names[12]], inputs.poses[names[3]]


def _pose_off(inputs: Inputs) -> None:
    pose = inputs.poses[sorted(inputs.poses)[7]]
    pose[:3] = (np.array(pose[:3]) + 5e-3 * _ASIDE).tolist()


_Picture = NDArray[np.uint8]


def _pictures(change: Callable[[_Picture, float], _Picture], quality: int = 94) -> Callable[[Inputs], None]:
    def rewrite(inputs: Inputs) -> None:
        def one(before: Path, after: Path) -> None:
            picture = change(np.asarray(cv2.imread(str(before)), dtype=np.uint8), inputs.pixels)
            cv2.imwrite(str(after), picture, [cv2.IMWRITE_JPEG_QUALITY, quality])

        inputs.own_images(one)

    return rewrite


def _motion_blur(picture: _Picture, pixels: float) -> _Picture:
    """A shift by 5 px along a diagonal during the exposure."""
    length, size = 5.0 * pixels, 2 * int(np.ceil(5 * pixels)) + 1
    kernel = np.zeros((size, size))
    for step in np.linspace(-length / 2, length / 2, 101):
        x, y = size // 2 + 0.8 * step, size // 2 + 0.6 * step
        i, j, a, b = int(y), int(x), y - int(y), x - int(x)
        for k, m, w in (
            (i, j, (1 - a) * (1 - b)),
            (i + 1, j, a * (1 - b)),
            (i, j + 1, (1 - a) * b),
            (i + 1, j + 1, a * b),
        ):
            kernel[k, m] += w
    return _in_light(picture, lambda light: cv2.filter2D(light, -1, kernel / kernel.sum()))


def _motion_blur_of_codes(picture: _Picture, pixels: float) -> _Picture:
    """The same along a row, of the coded values, as a program that processes images makes it: edges move outward."""
    length = max(2, round(5 * pixels))
    return np.asarray(cv2.blur(picture, (length, 1)), dtype=np.uint8)


def _in_light(picture: _Picture, change: Callable[[NDArray[np.float32]], Any]) -> _Picture:
    """A picture whose light is changed, not its codes; one colour at a time, which 60 MP have room for."""
    light_of_code = ((np.arange(256) / 255) ** 2.2).astype(np.float32)
    colours: list[_Picture] = []
    for k in range(picture.shape[2]):
        light = np.clip(np.asarray(change(light_of_code[picture[:, :, k]]), dtype=np.float32), 0, 1)
        colours.append(np.rint(255 * light ** np.float32(1 / 2.2)).astype(np.uint8))
    return np.dstack(colours)


def _defocus(picture: _Picture, pixels: float) -> _Picture:
    return _in_light(picture, lambda light: cv2.GaussianBlur(light, (0, 0), 2.5 * pixels))


def _same(picture: _Picture, _pixels: float) -> _Picture:
    return picture


CASES = (
    Case("clean", _nothing),
    *(
        Case(f"control sphere displaced by {by:g} mm", _control(by), ("control sphere 1",))
        for by in (0.5, 0.7, 1.0, 2.0, 5.0, 8.0, 10.0, 30.0)
    ),
    Case("control sphere that is not there", _added("control_mm"), ("found in none",)),
    Case("sphere list mirrored in y", _mirrored, ("mirrored",)),
    Case("registration sphere that is not there", _added("registration_mm"), ("sphere 10",)),
    Case("registration sphere moved by 2 mm", _moved("registration_mm", 2.0), ("sphere 1 ",)),
    Case("an image of another scene", _foreign, ("_005.jpg",)),
    Case("two images exchanged", _swapped, ("exchanged",)),
    Case("one pose of all 5 mm off", _pose_off, ("_007.jpg",)),
    Case("radius 1 % wrong", _radius(1.01), ("radius",)),
    Case("focal length 0.1 % wrong", _focal(1.001, 1.001), ("focal length",)),
    Case("fx alone 0.1 % wrong", _focal(1.001, 1.0), ("focal length",)),
    Case("principal point 2 px off", _principal_point, ("principal point",)),
    Case("sphere list 0.1 % too large", _scaled_list(1.001), ("larger than the camera positions",)),
    Case("sphere list 1 % too large", _scaled_list(1.01), ("list is wrong",)),
    Case("sphere list 5 % too small", _scaled_list(0.95), ("multiplied by about 1.05", "multiplied by about 1.06")),
    Case("sphere list in inches", _scaled_list(1 / 25.4), ("inches taken as millimetres",)),
    Case("sphere list and radius in inches", _scaled_list(1 / 25.4, with_radius=True), ("different units",)),
    Case("camera positions 1 % too large", _scaled_positions(1.01), ("positions are wrong",)),
    Case("camera positions in millimetres", _scaled_positions(1000.0), ("different units",)),
    Case("motion blur of 5 px", _pictures(_motion_blur), ("blur",)),
    Case("motion blur of 5 px of the coded values", _pictures(_motion_blur_of_codes), ("blur",)),
    Case("out of focus by 2.5 px", _pictures(_defocus), ("blur",)),
    Case("JPEG quality 60", _pictures(_same, 60)),
)


@contextmanager
def _inputs(folder: Path, foreign: Callable[[str], Path]) -> Generator[Inputs]:
    with tempfile.TemporaryDirectory(prefix="orthocapture-faults-") as scratch, (folder / "poses.csv").open() as file:
        poses = {row[0]: [float(v) for v in row[1:]] for row in list(csv.reader(file))[1:]}
        yield Inputs(
            folder / "images", json.loads((folder / "camera.json").read_text()), poses,
            json.loads((folder / "spheres.json").read_text()), Path(scratch), foreign,
        )  # fmt: skip


def measured(case: Case, folder: Path, foreign: Callable[[str], Path], workers: int) -> dict[str, Any]:
    """One row: the fault on a scene, and what the command makes of it."""
    truth = np.array(json.loads((folder / "truth.json").read_text())["T_world_scan"])
    true_m = 1e-3 * np.array(json.loads((folder / "spheres.json").read_text())["registration_mm"])
    with _inputs(folder, foreign) as inputs:
        case.change(inputs)
        scratch = inputs.scratch
        (scratch / "camera.json").write_text(json.dumps(inputs.camera))
        (scratch / "spheres.json").write_text(json.dumps(inputs.spheres))
        with (scratch / "poses.csv").open("w", newline="") as file:
            csv.writer(file).writerows(
                [["image", "x", "y", "z", "qx", "qy", "qz", "qw"], *([n, *v] for n, v in inputs.poses.items())]
            )
        words = ["register", "--images", inputs.images, "--camera", scratch / "camera.json"]
        words += ["--poses", scratch / "poses.csv", "--spheres", scratch / "spheres.json"]
        words += ["--out", scratch / "result.json", "--workers", workers, *inputs.options]
        answer = CliRunner().invoke(app, [str(word) for word in words])
        said = " ".join(answer.output.replace(f"{scratch}/", "").split())
        row: dict[str, Any] = {"case": case.name, "scene": folder.name, "status": answer.exit_code, "said": said}
        row["named"] = not case.named or any(word in said.lower() for word in case.named)
        if not (scratch / "result.json").is_file():
            return {**row, "good": bool(case.named) and row["named"]}
        result = json.loads((scratch / "result.json").read_text())
    centre = true_m.mean(axis=0)
    gap = apply(np.array(result["T_world_scan"]), true_m) - apply(truth, true_m)
    off = apply(np.array(result["T_world_scan"]), centre) - apply(truth, centre)
    row["true_error_mm"] = 1e3 * float(np.linalg.norm(off))
    row["worst_error_mm"] = 1e3 * float(np.linalg.norm(gap, axis=1).max())
    row["sigma_mm"] = float(result["predicted_error_mm"])
    row["errors_in_sigma"] = row["true_error_mm"] / row["sigma_mm"]
    row["worst_control_mm"] = max((c["radial_error_mm"] or 0.0 for c in result["control_spheres"]), default=None)
    row["findings"] = [one["what"] for one in result["findings"]]
    row["findings"] += [c["finding"] for c in result["control_spheres"] if c["finding"]]
    # One that is refused by name may have any error; one that passes may not.
    refused = answer.exit_code != 0 and row["named"]
    clean = case.change is _nothing
    row["good"] = (row["errors_in_sigma"] <= 3 and (not clean or answer.exit_code == 0)) or (refused and not clean)
    return row


def clean_scenes(folders: Iterable[Path], workers: int) -> dict[str, Any]:
    """Clean scenes: how many are refused, or have a finding, and the median stated sigma."""
    rows = [measured(CASES[0], folder, folder.joinpath, workers) for folder in folders]
    for row in rows:
        print(_line(row), flush=True)
    return {
        "scenes": len(rows),
        "refused": sum(row["status"] != 0 for row in rows),
        "with_findings": sum(bool(row.get("findings")) for row in rows),
        "median_sigma_mm": statistics.median(row["sigma_mm"] for row in rows),
        "median_true_error_mm": statistics.median(row["true_error_mm"] for row in rows),
        "worst_errors_in_sigma": max(row["errors_in_sigma"] for row in rows),
        "rows": rows,
    }


def _line(row: Mapping[str, Any]) -> str:
    if "true_error_mm" not in row:
        return f"| {row['case']} | – | – | – | – | {_verdict(row)} | {row['said']} |"
    control = row["worst_control_mm"]
    return (
        f"| {row['case']} | {row['true_error_mm']:.3f} | {row['sigma_mm']:.3f} | {row['errors_in_sigma']:.1f} | "
        f"{'–' if control is None else f'{control:.3f}'} | {_verdict(row)} | {'; '.join(row['findings'])} |"
    )


def _verdict(row: Mapping[str, Any]) -> str:
    said = "passed" if row["status"] == 0 else "refused" if "true_error_mm" not in row else "not passed"
    return said + ("" if row["named"] else ", not named") + ("" if row["good"] else " **wrong**")


def as_markdown(record: Mapping[str, Any]) -> str:
    """The record as a page."""
    lines = [
        f"# Faults of a laboratory, and what `register` says, {record['date']}",
        "",
        f"Commit {record['commit']}. True error and stated sigma (3D, mm) at the spheres' centre; the worst control "
        "sphere's radial error (mm).",
    ]
    for scene, rows in record["tables"].items():
        missing = [case.name for case in CASES if all(row["case"] != case.name for row in rows)]
        lines += [
            "",
            f"## {scene}",
            "",
            "| case | true error | sigma | error / sigma | worst control sphere | verdict | what it says |",
            "|---|---:|---:|---:|---:|---|---|",
            *map(_line, rows),
        ]
        if missing:
            lines += ["", f"Not measured here: {'; '.join(missing)}."]
    clean = record.get("clean")
    if clean:
        lines += [
            "",
            f"## {clean['scenes']} clean scenes",
            "",
            f"{clean['refused']} refused, {clean['with_findings']} with a finding; stated sigma "
            f"{clean['median_sigma_mm']:.4f} mm and true error {clean['median_true_error_mm']:.4f} mm in the median; "
            f"at most {clean['worst_errors_in_sigma']:.1f} sigmas.",
        ]
    return "\n".join(lines) + "\n"


def _write(record: Mapping[str, Any], stem: Path) -> None:
    stem.with_suffix(".json").write_text(json.dumps(record, indent=1) + "\n", encoding="utf-8")
    stem.with_suffix(".md").write_text(as_markdown(record), encoding="utf-8")


def main() -> None:
    """Print the table; with --record, write it to the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, nargs="*", default=[41], metavar="SEED", help="scenes of the table")
    parser.add_argument("--width", type=int, default=_WIDTH)
    parser.add_argument("--views", type=int, default=18)
    parser.add_argument("--cases", nargs="*", help="words: only cases whose name has one of them")
    parser.add_argument("--clean", type=int, nargs="*", default=[], metavar="SEED", help="clean scenes to count")
    parser.add_argument("--clean-width", type=int, default=960)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--cache", type=Path, default=CACHE)
    parser.add_argument("--record", action="store_true")
    parser.add_argument("--date", default=datetime.datetime.now(tz=datetime.UTC).date().isoformat(), help="today")
    parser.add_argument("--resume", action="store_true", help="keep the rows that --record wrote for this date")
    options = parser.parse_args()
    chosen = [c for c in CASES if not options.cases or any(word in c.name for word in options.cases)]
    stem = RESULTS / f"faults_table-{options.date}"
    record: dict[str, Any] = {"date": options.date, "commit": commit(), "machine": machine(), "tables": {}}
    if options.resume and stem.with_suffix(".json").is_file():
        record["tables"] = json.loads(stem.with_suffix(".json").read_text(encoding="utf-8"))["tables"]
    for seed in options.scenes:
        folder = render_scene(seed, options.width, options.views, cache=options.cache, workers=options.workers)
        other = functools.partial(render_image, seed + 1, options.width, options.views, cache=options.cache)
        rows = record["tables"].setdefault(folder.name, [])
        for case in chosen:
            if any(row["case"] == case.name for row in rows):
                continue
            rows.append({**measured(case, folder, other, options.workers), "commit": record["commit"]})
            rows.sort(key=lambda row: [c.name for c in CASES].index(row["case"]))
            print(_line(next(row for row in rows if row["case"] == case.name)), flush=True)
            if options.record:  # a table of large images takes an hour
                _write(record, stem)
    if options.clean:
        folders = (
            render_scene(s, options.clean_width, options.views, cache=options.cache, workers=options.workers)
            for s in options.clean
        )
        record["clean"] = clean_scenes(folders, options.workers)
    if options.record:
        _write(record, stem)
    print(as_markdown(record))


if __name__ == "__main__":
    main()
