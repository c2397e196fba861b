"""What a signature, a sign-in and a tick cost as a site grows older: `python -m bench.record.signature_cost`.

A site is given so many signatures, one for each event, and copies of it are measured by this program and, with
`--before`, by an earlier one from its checkout.
"""

from __future__ import annotations

import argparse
import datetime
import json
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

AGES = (10, 250, 1000, 10_000)
_SELF = Path(__file__).resolve()


def main(words: Sequence[str] | None = None) -> int:
    """Make the sites, measure them, print and write the table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--before", type=Path, help="checkout of an earlier program to compare with")
    parser.add_argument("--repeat", type=int, default=21)
    parser.add_argument("--work", type=Path, help="folder in which the sites are kept for another time")
    parser.add_argument("--measure", type=Path, help=argparse.SUPPRESS)
    options = parser.parse_args(words)
    if options.measure is not None:
        sys.stdout.write(json.dumps(measure(options.measure, options.repeat)) + "\n")
        return 0
    from bench.machine import REPOSITORY, RESULTS, commit, machine  # noqa: PLC0415 - of the program that is measured now

    programs = {"now": REPOSITORY} | ({} if options.before is None else {"before": options.before.resolve()})
    found: dict[str, dict[str, Any]] = {name: {} for name in programs}
    memory = Path("/dev/shm")  # where no disk that others use is waited for
    with tempfile.TemporaryDirectory(dir=memory if memory.is_dir() else None) as folder:
        for age, site in grown(options.work or Path(folder)):
            for name, checkout in programs.items():
                found[name][str(age)] = _measured(checkout, site, options.repeat)
                sys.stderr.write(f"{age} signatures, {name}: {found[name][str(age)]}\n")
    about: dict[str, Any] = {
        "date": datetime.datetime.now(datetime.UTC).date().isoformat(),
        "commit": commit(),
        "machine": machine(),
        "load": [round(load, 1) for load in os.getloadavg()],
        "repeat": options.repeat,
        "median_cpu_ms": found,
    }
    sys.stdout.write(table(about))
    stem = RESULTS / f"signature_cost-{about['date']}"
    stem.with_suffix(".md").write_text(table(about))
    stem.with_suffix(".json").write_text(json.dumps(about, indent=1) + "\n")
    return 0


def grown(folder: Path) -> list[tuple[int, Path]]:
    """Folders of one site at each age."""
    from service.core.records.events import SignInRecorded  # noqa: PLC0415 - of the program that is measured now
    from service.store.records import SITE  # noqa: PLC0415
    from service.store.signatures.signing import checkpoint  # noqa: PLC0415
    from tests.support.pages.web import web_site  # noqa: PLC0415

    folders: list[tuple[int, Path]] = []
    growing = folder / "growing"
    growing.mkdir(exist_ok=True, parents=True)
    for age in AGES:
        if (folder / str(age)).exists():
            folders.append((age, folder / str(age)))
            continue
        with web_site(growing) as web:
            for _ in range(age - len(web.store.checkpoints(SITE))):
                web.store.record_site([SignInRecorded(account="ada", outcome="signed_out")], actor="ada")
                checkpoint(web.store, SITE)
        shutil.copytree(growing, folder / str(age))
        folders.append((age, folder / str(age)))
    return folders


def _measured(checkout: Path, site: Path, repeat: int) -> dict[str, float]:
    copy = site.with_name("measured")
    shutil.copytree(site, copy)
    try:
        words = [sys.executable, str(_SELF), "--measure", str(copy), "--repeat", str(repeat)]
        environment = os.environ | {"PYTHONPATH": str(checkout)}
        done = subprocess.run(words, env=environment, cwd=checkout, capture_output=True, text=True, check=True)
        measured: dict[str, float] = json.loads(done.stdout.splitlines()[-1])
        return measured
    finally:
        shutil.rmtree(copy)


def measure(folder: Path, repeat: int) -> dict[str, float]:
    """Median milliseconds of a processor on a site, by the program whose modules are imported.

    The processor's time, because other programs on the machine make no difference to it.
    """
    from service.core.records.events import SignInRecorded  # noqa: PLC0415 - of another checkout
    from service.core.records.run_events import StepNote  # noqa: PLC0415
    from service.store.records import SITE  # noqa: PLC0415
    from service.store.signatures.signing import checkpoint  # noqa: PLC0415
    from tests.support.pages.web import web_site  # noqa: PLC0415
    from tests.support.runs.bench_run import PROTOCOL  # noqa: PLC0415

    with web_site(folder) as web:
        store = web.store
        run = web.begin_run(PROTOCOL)
        item = run_item(PROTOCOL)

        def sign_site() -> None:
            checkpoint(store, SITE)

        def event_of_site() -> None:
            store.record_site([SignInRecorded(account="ada", outcome="signed_out")], actor="ada")

        def event_of_run() -> None:
            store.record(run.run_id, [StepNote(step="fixation", attempt=1, note="seen")], actor="runner")

        event_of_site()
        found = {"first_signature_of_a_process": _ms(sign_site)}
        found["signature_of_the_site"] = _median(sign_site, event_of_site, repeat)
        found["signature_of_a_run"] = _median(lambda: checkpoint(store, run.run_id), event_of_run, repeat)
        screen = web.browser()
        found["sign_in"] = _median(lambda: screen.sign_in("grace"), lambda: None, repeat)
        technician = web.browser("technician")
        web.take_control(run.run_id, technician)
        step = web.site.run(run.run_id).state.step
        ticked = [False]

        def tick() -> None:
            ticked[0] = not ticked[0]
            fields: dict[str, Any] = {
                "step": step.step,
                "attempt": step.attempt,
                "item": item,
                "ticked": str(ticked[0]).lower(),
            }
            answer = technician.send_form(f"/runs/{run.run_id}/ticks", **fields)
            if answer.status_code != 303:
                raise RuntimeError(answer.text)

        found["tick"] = _median(tick, lambda: None, repeat)
        # A runner beside the pages signs, so that each request finds an event of the site to sign.
        found["tick_while_others_act"] = _median(tick, event_of_site, repeat)
    return found


def run_item(protocol: str) -> str:
    """The first item of a protocol's first checklist."""
    from service.core.protocol import parse_protocol  # noqa: PLC0415 - of another checkout
    from service.steps import params_models  # noqa: PLC0415

    loaded = parse_protocol(protocol.encode(), params_models(), name="bench.yaml")
    return next(item for step in loaded.protocol.steps for item in step.checklist)


def _median(work: Callable[[], object], before: Callable[[], object], repeat: int) -> float:
    times: list[float] = []
    for _ in range(repeat):
        before()
        times.append(_ms(work))
    return round(statistics.median(times), 2)


def _ms(work: Callable[[], object]) -> float:
    from service.core.units import ms  # noqa: PLC0415 - of another checkout

    began_s = time.process_time()
    work()
    return round(ms(time.process_time() - began_s), 2)


def table(about: dict[str, Any]) -> str:
    """The findings as Markdown."""
    cpu, found = about["machine"], about["median_cpu_ms"]
    lines = [
        f"# What a signature costs as a site grows older ({about['date']})",
        "",
        f"`python -m bench.record.signature_cost`; medians of {about['repeat']} in milliseconds of a processor.",
        f"Commit {about['commit']}; {cpu['processor']}, {cpu['cores']} cores, Python {cpu['python']}; "
        f"load {about['load']}.",
        "The first signature of a process reads everything once; now that happens before the others have to wait.",
        "",
    ]
    for name, by_age in found.items():
        ages = list(by_age)
        lines += [f"## {'This program' if name == 'now' else 'The program before'}", ""]
        lines += [
            f"| signatures before | {' | '.join(ages)} | {ages[-1]} / {ages[0]} |",
            "|" + "---|" * (len(ages) + 2),
        ]
        for what in by_age[ages[0]]:
            row = [by_age[age][what] for age in ages]
            words = what.replace("_", " ")
            lines.append(f"| {words} | {' | '.join(f'{ms:.1f}' for ms in row)} | {row[-1] / row[0]:.2f} |")
        lines.append("")
    return "\n".join(lines).rstrip() + "\n"


if __name__ == "__main__":
    raise SystemExit(main())
