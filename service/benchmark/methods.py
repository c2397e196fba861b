"""Declares the methods of reconstruction: their format, commands and mesh, and which version is installed."""

from __future__ import annotations

import contextlib
import importlib
import importlib.util
import os
import shutil
import subprocess
import sys
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Annotated

import numpy as np
from pydantic import BaseModel, Field, FiniteFloat, ValidationError

from service.core.errors import DataError
from service.core.geometry import Array
from service.core.loading import declared_kinds, kind_named

_ANSWER_S = 120.0


def of_packages(*names: str) -> Callable[[], str]:
    """Return a function that gives the versions of those of these distributions that are installed."""

    def versions() -> str:
        found: list[str] = []
        for name in names:
            with contextlib.suppress(PackageNotFoundError):
                found.append(f"{name} {version(name)}")
        return ", ".join(found)

    return versions


def commit_in(variable: str) -> Callable[[], str]:
    """Return a function that gives the commit of the source folder that an environment variable names."""

    def head() -> str:
        return first_line("git", "-C", os.environ.get(variable, ""), "rev-parse", "HEAD")

    return head


def first_line(*command: str) -> str:
    """Return the first line that a program prints; "" if it does not answer."""
    try:
        printed = subprocess.run(command, capture_output=True, text=True, timeout=_ANSWER_S, check=True)
    except (OSError, subprocess.SubprocessError):
        return ""
    return next(iter(printed.stdout.strip().splitlines()), "")


GROUP = "orthocapture.reconstruction_methods"
Command = tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Workplace:
    """The folders and the interpreter with which a method works.

    Attributes:
        data: folder with the exported data set, which the method reads.
        work: folder for what it writes.
        checkout: folder of the method's source code; empty if it is found on the path.
        python: interpreter with the packages that the method needs.
    """

    data: Path
    work: Path
    checkout: Path = field(default_factory=Path)
    python: str = "python"


@dataclass(frozen=True, slots=True)
class Method:
    """A method of reconstruction.

    Attributes:
        name: its name on the command line.
        words: its label in the table.
        expects: program and version that the commands are written for, and what it needs.
        form: name of the export format that it reads.
        commands: the commands to run, one after the other; a pure function of the place.
        mesh: finds the mesh that the commands left. Raises DataError if there is none.
        to_world: transforms vertices (V, 3) of that mesh to the world frame, m; it may read the exported folder. Most
            methods' meshes are in the world frame already.
        programs: programs that are looked for on the path.
        variable: the environment variable with the folder of its source code; "" if it needs none.
        lacking: says what else is missing to run it on this machine; "" if nothing is.
        version: returns what is installed on this machine; "" if it is not known.
        random: it makes another mesh of the same images each time.
    """

    name: str
    words: str
    expects: str
    form: str
    commands: Callable[[Workplace], tuple[Command, ...]]
    mesh: Callable[[Workplace], Path]
    to_world: Callable[[Array, Path], Array] = lambda vertices, _data: vertices
    programs: tuple[str, ...] = ()
    variable: str = ""
    lacking: Callable[[], str] = lambda: ""
    version: Callable[[], str] = lambda: ""
    random: bool = False


def methods() -> dict[str, Method]:
    """Return every method by its name.

    Raises:
        ConfigurationError: two have the same name, or an entry point names something else.
    """
    return declared_kinds("service.benchmark.methods", GROUP, Method)


def method_named(name: str) -> Method:
    """Return the method of this name.

    Raises:
        ConfigurationError: there is none.
    """
    return kind_named(name, methods(), what="method", option="--method")


def missing(method: Method, environment: Mapping[str, str] = os.environ) -> str:
    """Describe what is missing to run a method here; "" if it can be run."""
    lacks = [program for program in method.programs if shutil.which(program, path=environment.get("PATH")) is None]
    if lacks:
        return f"{', '.join(lacks)} not found on the path"
    if method.variable and not environment.get(method.variable):
        return f"{method.variable} is not set"
    if method.variable and not Path(environment[method.variable]).is_dir():
        return f"{method.variable} names no folder"
    return method.lacking()


def lacking_here(name: str) -> str:
    """Describe what is missing to run the method of this name on this machine; "" if it can be run."""
    known = methods()
    return missing(known[name]) if name in known else f"there is no method {name!r}"


def place_of(method: Method, folder: Path, environment: Mapping[str, str] = os.environ) -> Workplace:
    """Return a method's places below a folder: `data` and `work`, with its checkout and interpreter.

    `VARIABLE_PYTHON` names the interpreter of a checkout with an environment of its own, `python` is the default;
    methods without a checkout run in this program's.
    """
    folder = folder.resolve()
    data, work = folder / "data", folder / "work"
    if not method.variable:
        return Workplace(data, work, python=sys.executable)
    python = environment.get(f"{method.variable}_PYTHON", "python")
    return Workplace(data, work, Path(environment.get(method.variable, f"${method.variable}")), python)


_Axis = Annotated[int, Field(ge=0, le=2)]
_DENSE, _FUSED, _MESH = "dense", "fused.ply", "mesh.ply"  # in the folder of what a method writes
_HELP_S = 120.0
_NEUS2_NAME, _NEUS2_STEPS = "orthocapture", 15_000
_OPENMVS_MESH = "scene_mesh_refined.ply"
_SUGAR_ITERATIONS = "7000"


def at(name: str) -> Callable[[Workplace], Path]:
    """Return a mesh of this name in the method's folder."""
    return newest(name)


def newest(pattern: str) -> Callable[[Workplace], Path]:
    """Return the youngest of the files in the method's folder that match a pattern."""

    def find(place: Workplace) -> Path:
        found = [path for path in place.work.glob(pattern) if path.is_file()]
        if not found:
            raise DataError(
                "the method ended without a mesh", where=str(place.work / pattern), remedy="Read its output"
            )
        return max(found, key=lambda path: path.stat().st_mtime_ns)

    return find


class _UnitBox(BaseModel):
    """The fields of `unit_box.json` that the benchmark reads."""

    mesh_axes: tuple[_Axis, _Axis, _Axis]
    centre_m: tuple[FiniteFloat, FiniteFloat, FiniteFloat]


def from_unit_box(vertices: Array, data: Path) -> Array:
    """Return world points (N, 3), in metres, of a mesh made from an export with `unit_box.json` in its folder.

    Raises:
        DataError: the file is not what the export wrote.
    """
    path = data / "unit_box.json"
    try:
        box = _UnitBox.model_validate_json(path.read_bytes())
    except (OSError, ValidationError) as error:
        raise DataError(
            "the extent of the scene cannot be read", where=str(path), remedy="Export it again"
        ) from error
    return vertices[:, box.mesh_axes] + np.array(box.centre_m)


def triangulation(place: Workplace, dense: Path) -> Command:
    """Return our command that makes COLMAP's workspace `dense` of the export `colmap-pinhole` in `place.data`."""
    return (place.python, "-m", "service.benchmark.programs", "triangulate", str(place.data), str(dense))


def _colmap_commands(place: Workplace) -> tuple[Command, ...]:
    """Features are triangulated with the given poses, as COLMAP's FAQ describes, since PatchMatch needs points."""
    dense = str(place.work / _DENSE)
    workspace = ("--workspace_path", dense, "--workspace_format", "COLMAP")
    fused, mesh = str(place.work / _FUSED), str(place.work / _MESH)
    return (
        triangulation(place, place.work / _DENSE),
        ("colmap", "patch_match_stereo", *workspace, "--PatchMatchStereo.geom_consistency", "true"),
        ("colmap", "stereo_fusion", *workspace, "--input_type", "geometric", "--output_path", fused),
        ("colmap", "poisson_mesher", "--input_path", fused, "--output_path", mesh),
    )


def _colmap_lacking() -> str:
    """COLMAP's help says how it was built; PatchMatch needs CUDA, which Debian's package is built without."""
    try:
        told = subprocess.run(("colmap", "-h"), capture_output=True, text=True, timeout=_HELP_S, check=False)
    except (OSError, subprocess.TimeoutExpired) as error:
        return f"colmap -h does not answer: {error}"
    return "colmap is built without CUDA" if "without CUDA" in told.stdout + told.stderr else ""


def _gsplat_commands(place: Workplace) -> tuple[Command, ...]:
    """A process of its own alone loads torch; depth maps are fused as those of the stereo method are."""
    return (
        (place.python, "-m", "service.benchmark.programs", "gaussians", str(place.data), str(place.work / _MESH)),
    )


def _gsplat_lacking() -> str:
    """Packages are looked for first: torch takes seconds to load, and much memory: so not in this process."""
    lacks = [name for name in ("torch", "gsplat") if importlib.util.find_spec(name) is None]
    if lacks:
        return f"{', '.join(lacks)} not installed"
    asked = first_line(sys.executable, "-c", "import torch; print(torch.cuda.is_available())")
    return "" if asked == "True" else "torch finds no CUDA GPU"


def _instant_ngp_commands(place: Workplace) -> tuple[Command, ...]:
    """One call of its script trains a radiance field, and extracts the surface of its density by marching cubes."""
    return (
        (
            place.python,
            str(place.checkout / "scripts" / "run.py"),
            *("--scene", str(place.data), "--n_steps", "35000", "--save_mesh", str(place.work / _MESH)),
            *("--marching_cubes_res", "512", "--marching_cubes_density_thresh", "2.5"),
        ),
    )


def _neus2_commands(place: Workplace) -> tuple[Command, ...]:
    """One call of its script trains a signed distance field; it saves the mesh in any case."""
    return (
        (
            place.python,
            str(place.checkout / "scripts" / "run.py"),
            *("--scene", str(place.data / "transform.json"), "--name", _NEUS2_NAME),
            *("--network", "dtu.json", "--n_steps", str(_NEUS2_STEPS)),
        ),
    )


def _openmvs_commands(place: Workplace) -> tuple[Command, ...]:
    """OpenMVS chooses neighbouring views by common points, so features are triangulated first."""
    work, dense = str(place.work), str(place.work / _DENSE)
    images = str(place.work / _DENSE / "images")
    return (
        triangulation(place, place.work / _DENSE),
        ("InterfaceCOLMAP", "-w", work, "-i", dense, "-o", "scene.mvs", "--image-folder", images),
        ("DensifyPointCloud", "-w", work, "-i", "scene.mvs", "-o", "scene_dense.mvs"),
        ("ReconstructMesh", "-w", work, "-i", "scene_dense.mvs", "-o", "scene_mesh.ply"),
        ("RefineMesh", "-w", work, "-i", "scene_dense.mvs", "-m", "scene_mesh.ply", "-o", _OPENMVS_MESH),
    )


def _pycolmap_commands(place: Workplace) -> tuple[Command, ...]:
    """The same steps as those of the program `colmap` run in a process of their own."""
    dense, fused, mesh = (str(place.work / name) for name in (_DENSE, _FUSED, _MESH))
    return (
        triangulation(place, place.work / _DENSE),
        (place.python, "-m", "service.benchmark.programs", "patch_match", dense, fused, mesh),
    )


def _pycolmap_lacking() -> str:
    """The build that is locked for this program is made for all machines, and has no CUDA."""
    return "" if importlib.import_module("pycolmap").has_cuda else "pycolmap is built without CUDA"


def _stereo_commands(place: Workplace) -> tuple[Command, ...]:
    """A process of its own, so that its time and memory are measured as those of the others."""
    return ((place.python, "-m", "service.benchmark.programs", "stereo", str(place.data), str(place.work / _MESH)),)


def _sugar_commands(place: Workplace) -> tuple[Command, ...]:
    """3D Gaussian splatting first, then SuGaR on its result with all images (its default keeps every eighth)."""
    data, first, out = str(place.data), str(place.work / "gaussians"), str(place.work / "sugar")
    splatting = str(place.checkout / "gaussian_splatting" / "train.py")
    return (
        (place.python, splatting, "-s", data, "-m", first, "--iterations", _SUGAR_ITERATIONS),
        (
            place.python,
            str(place.checkout / "train.py"),
            *("-s", data, "-c", first, "-i", _SUGAR_ITERATIONS, "-r", "density", "-o", out, "--eval", "False"),
        ),
    )


KINDS = (
    # Multi-view stereo: PatchMatch depth maps, fused, and a Poisson mesh.
    Method(
        "colmap",
        "COLMAP",
        "COLMAP 3.8 or later, built with CUDA (colmap -h says so), and a CUDA GPU",
        "colmap-pinhole",
        _colmap_commands,
        at(_MESH),
        programs=("colmap",),
        lacking=_colmap_lacking,
        version=lambda: first_line("colmap", "-h"),
        random=True,
    ),
    Method(
        "gsplat",
        "Gaussian splatting (gsplat)",
        "gsplat 1.5 and torch 2 with CUDA from PyPI in this program's environment, and a CUDA GPU",
        "sugar",
        _gsplat_commands,
        at(_MESH),
        lacking=_gsplat_lacking,
        version=of_packages("gsplat", "torch"),
        random=True,
    ),
    Method(
        "instant-ngp",
        "Instant-NGP",
        "github.com/NVlabs/instant-ngp, version 2.0 with its Python module built, and a CUDA GPU",
        "instant-ngp",
        _instant_ngp_commands,
        at(_MESH),
        from_unit_box,
        variable="ORTHOCAPTURE_INSTANT_NGP",
        version=commit_in("ORTHOCAPTURE_INSTANT_NGP"),
        random=True,
    ),
    Method(
        "neus2",
        "NeuS2",
        "github.com/19reborn/NeuS2, commit 61f9cbf with its Python module built, and a CUDA GPU",
        "neus2",
        _neus2_commands,
        at(f"output/{_NEUS2_NAME}/mesh/{_NEUS2_STEPS}.obj"),  # relative to the folder that it is run in
        from_unit_box,
        variable="ORTHOCAPTURE_NEUS2",
        version=commit_in("ORTHOCAPTURE_NEUS2"),
        random=True,
    ),
    # Depth maps, a Delaunay mesh, refined against the images.
    Method(
        "openmvs",
        "OpenMVS",
        "OpenMVS 2.3 (needs no GPU)",
        "colmap-pinhole",
        _openmvs_commands,
        at(_OPENMVS_MESH),
        programs=("InterfaceCOLMAP", "DensifyPointCloud", "ReconstructMesh", "RefineMesh"),
        random=True,
    ),
    # For machines without the program `colmap`.
    Method(
        "pycolmap",
        "COLMAP (pycolmap)",
        "pycolmap-cuda12 from PyPI in the place of pycolmap, in this program's environment, and a CUDA GPU",
        "colmap-pinhole",
        _pycolmap_commands,
        at(_MESH),
        lacking=_pycolmap_lacking,
        version=of_packages("pycolmap", "pycolmap-cuda12"),
        random=True,
    ),
    # Our own: semi-global matching of rectified pairs, fused in a distance field; it needs no GPU.
    Method(
        "stereo",
        "Stereo (CPU)",
        "nothing else",
        "colmap-pinhole",
        _stereo_commands,
        at(_MESH),
        version=of_packages("orthocapture"),
    ),
    # Gaussians aligned with the surface, and a mesh of them.
    Method(
        "sugar",
        "SuGaR",
        "github.com/Anttwo/SuGaR, commit 25f7ba6 with its submodules built, and a CUDA GPU",
        "sugar",
        _sugar_commands,
        newest("sugar/**/sugarfine_*.obj"),
        variable="ORTHOCAPTURE_SUGAR",
        version=commit_in("ORTHOCAPTURE_SUGAR"),
        random=True,
    ),
)
