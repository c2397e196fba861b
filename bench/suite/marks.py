"""Marks as `slow` the tests that cost much processor time, and keeps the list of what each test costs.

`make marks` runs the tests with `--cpu-record` (tests/plugins/cpu_record.py) and then this script on what they
recorded; `make marks FILES=tests/core` measures one folder and leaves the rest of the list alone. `make lint` calls
it with `--check`: the list and the marks must agree, and every test must be on the list.

The cost of a test is its own, plus its share of each wider fixture that it uses: the fixture's cost over the number
of tests that use it. Of a parametrised test the dearest row counts. A measurement within a fifth of the limit changes
no mark, so that marks do not come and go with the machine's mood. Tests marked `whole` are never fast, and are not
measured. The limit is 0.8 CPU seconds, and one where tests guard people or evidence (`limit_of`).
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from pathlib import Path

from tests.support.suite.marks import (
    LIST,
    Costs,
    costs_of,
    disagreements,
    limit_of,
    remarked,
    settled,
    sources,
    test_functions,
)


def main() -> int:
    """Check the marks, or renew them and the list from a folder of records."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("records", type=Path, nargs="?", help="the folder given to --cpu-record")
    parser.add_argument("--check", action="store_true", help="say where the list and the marks disagree")
    options = parser.parse_args()
    listed: Costs = json.loads(LIST.read_text()) if LIST.exists() else {}
    files = sources()
    if not options.check:
        measured = costs_of(options.records)
        kept: Costs = {}
        for file, source in files.items():
            before, now = listed.get(file, {}), measured.get(file, {})
            names, most_s = [test.name for test in test_functions(source)], limit_of(file)
            kept[file] = {name: settled(before.get(name), now[name], most_s) for name in names if name in now} | {
                name: before[name] for name in names if name in before and name not in now
            }
            single = re.sub(r"(?m)^pytestmark = pytest\.mark\.slow( *#.*)?\n", "", source)
            single = re.sub(r"(?m)^(pytestmark = \[(?!.*mark\.whole).*?)pytest\.mark\.slow(?:, )?", r"\1", single)
            files[file] = remarked(single, kept[file], most_s)
            if files[file] != source:
                Path(file).write_text(files[file])
        LIST.write_text(json.dumps(kept, indent=1, sort_keys=True) + "\n")
        listed = kept
    found = disagreements(listed, files)
    if found:
        print("\n".join(found), "Run `make marks FILES=…` for these files.", sep="\n", file=sys.stderr)
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
