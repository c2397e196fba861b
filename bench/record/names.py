"""Names that imitate a person or the program, at every place where a name enters: `python -m bench.record.names`.

Every name is tried at every command and in every form of the pages, at a site with accounts and at one without
(tests/support/record/entered_names.py), and as the name of a site's first account. Nobody may act under a name that
is not theirs: where there are accounts only they act, with their password; where there are none, nobody acts under
a name that is no person's. Figures go to bench/results/names-DATE. Exit status: 1 if anybody acted.
"""

from __future__ import annotations

import json
import os
import sys
import tempfile
from collections import Counter, defaultdict
from collections.abc import Iterator, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from bench.machine import RESULTS, commit, machine
from service.store.store import Store
from tests.support.pages.web import web_site
from tests.support.record.entered_names import (
    COMMANDS,
    FORMS,
    HER_OWN,
    NAMES,
    OF_EVERYBODY,
    OF_NOBODY,
    PEOPLE,
    Attempt,
    set_up_as,
    site_with_accounts,
    site_without_accounts,
    typed,
)
from tests.support.record.stepped_clock import SteppedClock

# An account's owner, and the operator whom a technician names for a run, may have any person's name.
_TYPED = {"account": (*OF_NOBODY, *HER_OWN), "full name": (*OF_NOBODY, *HER_OWN), "operator": OF_NOBODY}
_REFUSALS = (400, 401, 403, 404, 409, 422)  # of pages


def main() -> int:
    """Try every name everywhere, print and write the table."""
    rows: list[tuple[Attempt, bool]] = []
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as work:
        for row in _attempts(Path(work)):
            rows.append(row)
            if not row[1]:
                sys.stderr.write(f"{row[0]}\n")
    about: dict[str, Any] = {
        "date": datetime.now(UTC).date().isoformat(),
        "commit": commit(),
        "machine": machine(),
        "attempts": [{**asdict(attempt), "as it should be": right} for attempt, right in rows],
    }
    text = _table(about, rows)
    sys.stdout.write(text)
    stem = RESULTS / f"names-{about['date']}"
    stem.with_suffix(".md").write_text(text, encoding="utf-8")
    stem.with_suffix(".json").write_text(json.dumps(about, indent=1) + "\n", encoding="utf-8")
    return int(not all(right for _, right in rows))


def _attempts(work: Path) -> Iterator[tuple[Attempt, bool]]:
    """Every attempt, and whether it ended as it should."""
    for folder in ("accounts", "none", "first"):
        (work / folder).mkdir()
    accounts, none = site_with_accounts(work / "accounts"), site_without_accounts(work / "none")
    for place in COMMANDS:
        for name in (*NAMES, *HER_OWN, *PEOPLE):
            attempt = accounts.attempt(place, name)
            yield attempt, attempt.refused_for_its_name
        for name in OF_NOBODY:
            attempt = none.attempt(place, name)
            yield attempt, attempt.refused_for_its_name
    for place in OF_EVERYBODY:
        for name in (*NAMES, *HER_OWN, *PEOPLE):
            attempt = accounts.attempt(place, name)
            who = [one.partition(" by ")[2] for one in attempt.since]
            yield attempt, bool(who) and all(one.startswith("claimed:") and one.isprintable() for one in who)
    clock = SteppedClock()
    for place in FORMS:
        (work / place).mkdir()
        with web_site(work / place, clock=clock) as site:
            for attempt in typed(site, clock, place, _TYPED.get(place, (*NAMES, *HER_OWN, *PEOPLE))):
                yield attempt, attempt.status in _REFUSALS and not attempt.since
    with Store.open(work / "first" / "data", clock) as store:
        for name in OF_NOBODY:
            if name != "x" * 100:
                for attempt in set_up_as(store, name):
                    yield attempt, attempt.refusal == "AccountError"


def _table(about: dict[str, Any], rows: Sequence[tuple[Attempt, bool]]) -> str:
    cpu = about["machine"]
    places: dict[tuple[str, str], list[tuple[Attempt, bool]]] = defaultdict(list)
    for row in rows:
        places[row[0].site, row[0].place].append(row)
    wrong = [attempt for attempt, right in rows if not right]
    lines = [
        f"# Names at every place where a name enters ({about['date']})",
        "",
        f"`python -m bench.record.names`; commit {about['commit']}; {cpu['processor']}, Python {cpu['python']}.",
        f"{len({attempt.name for attempt, _ in rows})} names, {len(places)} places, {len(rows)} attempts; "
        f"in {len(wrong)} of them somebody acted under a name that was not theirs.",
        "",
        "Refused: because of the name, and nothing was recorded but the refused sign-in. `act pause` is everybody's:",
        "it must record the name as claimed.",
        "",
        "| site | place | names | as it should be | how they ended |",
        "|---|---|---:|---:|---|",
    ]
    for (site, place), found in places.items():
        ends = Counter(_end(attempt) for attempt, _ in found)
        told = ", ".join(f"{end} {number}" for end, number in ends.most_common())
        lines.append(f"| {site} | {place} | {len(found)} | {sum(right for _, right in found)} | {told} |")
    if wrong:
        lines += ["", "Not as it should be:", "", *(f"- {attempt}" for attempt in wrong)]
    return "\n".join(lines) + "\n"


def _end(attempt: Attempt) -> str:
    if attempt.place in OF_EVERYBODY:
        return "recorded as claimed" if all(" by claimed:" in one for one in attempt.since) else "recorded as theirs"
    if attempt.refusal:
        return attempt.refusal
    return f"status {attempt.status}" if attempt.status else "accepted"


if __name__ == "__main__":
    os.environ["COLUMNS"] = "300"
    raise SystemExit(main())
