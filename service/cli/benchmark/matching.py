"""`orthocapture benchmark matching`: a method of feature matching on the pairs of a data set."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from service.cli.common import (
    JsonOption,
    console,
    print_json,
    print_table,
    progress_bar,
    reporting_errors,
    require_writable_folder,
)


def matching_command(
    dataset: Annotated[Path, typer.Argument(help="Folder that `export --format matching` wrote.")],
    method: Annotated[str, typer.Option(metavar="NAME", help="sift, loftr, lightglue, or that of a plug-in.")],
    out: Annotated[
        Path, typer.Option("--out", metavar="DIR", help="Folder for the result; several methods may share one.")
    ],
    weights: Annotated[
        Path | None, typer.Option(metavar="FILE", help="The weights of a learned method; nothing is downloaded.")
    ] = None,
    pairs_per_class: Annotated[
        int, typer.Option("--pairs-per-class", min=0, help="Pairs of each difficulty at most; 0: all.")
    ] = 50,
    json: JsonOption = False,
) -> None:
    """Score a method of feature matching on image pairs: pose error, precision and epipolar error by difficulty.

    The method is given two images and nothing else. Poses, depth and occlusion only judge its matches. The folder
    gets METHOD.json, pictures of matches, and table.md and curves.png of all methods in it.
    """
    with reporting_errors(json), progress_bar(quiet=json) as progress:
        # These load the numerics, which take seconds.
        from service.benchmark.matching import MatchingTask, run_matching  # noqa: PLC0415
        from service.benchmark.matching_results import (  # noqa: PLC0415
            HEADER,
            record,
            rows,
        )
        from service.compute.matching.methods.method import matcher  # noqa: PLC0415

        how = matcher(method)
        require_writable_folder(out)
        out.mkdir(exist_ok=True)
        results = run_matching(MatchingTask(dataset, how, weights, pairs_per_class, out), progress)
        if json:
            own = next(result for result in results if result.method == how.name)
            print_json(record(own))
            return
    table = Table(*HEADER)
    for row in rows(results):
        table.add_row(*row)
    print_table(table)
    console.print(f"Written to {out!s}: {how.name}.json, table.md, curves.png")
    if any(result.simulated for result in results):
        console.print("  The data set is simulated.")
