"""`orthocapture benchmark run`: one method of reconstruction on one split of a data set."""

from __future__ import annotations

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from service.cli.common import (
    JsonOption,
    console,
    print_json,
    progress_bar,
    reporting_errors,
    require_writable_folder,
)
from service.core.units import metres

DEFAULT_OUT = Path("benchmark")


class _Scenario(StrEnum):
    DENSE = "dense"
    SPARSE = "sparse"


def run_command(
    dataset: Annotated[Path, typer.Argument(help="Folder written by `orthocapture export --format hdf5`.")],
    method: Annotated[
        str,
        typer.Option(
            "--method",
            metavar="NAME",
            help="stereo, colmap, pycolmap, openmvs, instant-ngp, neus2, sugar, gsplat, or that of a plug-in.",
        ),
    ],
    scenario: Annotated[_Scenario, typer.Option("--scenario", help="All images, or the split of a few.")],
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder of the results.")] = DEFAULT_OUT,
    mesh: Annotated[
        Path | None, typer.Option("--mesh", help="Score this mesh of the method, which was made elsewhere.")
    ] = None,
    width: Annotated[
        int, typer.Option(min=0, metavar="PX", help="Width of the images; 0: that of the data set.")
    ] = 0,
    spacing_mm: Annotated[
        float, typer.Option("--spacing-mm", min=0.01, help="Spacing to which both meshes are sampled.")
    ] = 0.1,
    json: JsonOption = False,
) -> None:
    """Reconstruct the specimen with a method, and compare its mesh with the ground truth.

    The method gets images, poses and the extent of the scene in the format that it reads. Its mesh is brought back
    into the frame of the data set, cut to the box of the ground truth, and scored as `evaluate chamfer` does. If the
    method is not installed, the command says what is expected; run it elsewhere and give its mesh with --mesh.
    """
    with reporting_errors(json), progress_bar(quiet=json) as progress:
        # These load the numerics, which take seconds.
        from service.benchmark.methods import method_named  # noqa: PLC0415
        from service.benchmark.running import Trial, run_trial  # noqa: PLC0415
        from service.compute.ground_truth.distances.chamfer import ChamferSettings  # noqa: PLC0415
        from service.dataset.exported import data_set_of_folder  # noqa: PLC0415

        how = method_named(method)
        require_writable_folder(out)
        progress("reading the data set", 0, 0)
        whole = data_set_of_folder(dataset)
        trial = Trial(how, scenario.value, out, mesh, width, ChamferSettings(metres(spacing_mm)))
        result = run_trial(trial, whole, progress)
    if json:
        print_json(result.model_dump(mode="json"))
    elif result.score is None:
        console.print(f"{how.words}, {scenario.value}: no mesh. {result.failure}")
    else:
        score = result.score
        console.tell(
            f"{how.words}, {scenario.value}, {result.views} images: ",
            (f"Chamfer distance {score.chamfer_mm:.3f} mm", "bold"),
            f" (accuracy {score.accuracy_mm:.3f} mm, "
            f"completeness {score.completeness_mm:.3f} mm; equal surfaces would give {score.floor_mm:.3f} mm)",
        )
        console.print(f"  written: {trial.folder!s}")
