"""`orthocapture benchmark`: compare methods on an exported data set."""

from __future__ import annotations

import typer

from service.cli.benchmark.matching import matching_command
from service.cli.benchmark.run import run_command
from service.cli.benchmark.table import table_command

benchmark_app = typer.Typer(
    help="Compare methods on an exported data set.", no_args_is_help=True, pretty_exceptions_enable=False
)
benchmark_app.command("run")(run_command)
benchmark_app.command("table")(table_command)
benchmark_app.command("matching")(matching_command)
