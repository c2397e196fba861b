"""`orthocapture benchmark table`: the results of all methods beside one another."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from service.cli.benchmark.run import DEFAULT_OUT
from service.cli.common import JsonOption, print_document, print_json, reporting_errors, require_writable, write_whole


def table_command(
    out: Annotated[Path, typer.Option("--out", metavar="DIR", help="Folder of the results.")] = DEFAULT_OUT,
    markdown: Annotated[Path | None, typer.Option("--markdown", help="Write the table to this file too.")] = None,
    figure: Annotated[
        Path | None, typer.Option("--figure", help="Write the meshes with their heat maps, side by side, as PNG.")
    ] = None,
    json: JsonOption = False,
) -> None:
    """Print the table of the benchmark, as in the paper: dense and sparse, with times, memory and command lines.

    A method without a result is listed with what it expects and the commands that it would run.
    """
    with reporting_errors(json):
        # These load the numerics, which take seconds.
        from service.benchmark.methods import methods  # noqa: PLC0415
        from service.benchmark.records import read_results  # noqa: PLC0415
        from service.benchmark.table import (  # noqa: PLC0415
            figure_png,
            table_markdown,
            table_record,
        )

        results, known = read_results(out), methods()
        text = table_markdown(results, known)
        if markdown is not None:
            require_writable(markdown)
            write_whole(markdown, text)
        if figure is not None:
            require_writable(figure)
            write_whole(figure, figure_png(out, results, known))
        if json:
            print_json(table_record(results, known))
        else:
            print_document(f"{text}\n")
