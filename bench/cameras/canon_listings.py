"""Transcribes listings of real Canon EOS bodies into recordings, one file each.

    python -m bench.cameras.canon_listings LISTING.txt … --source "REPOSITORY, PATH" --out FOLDER

where FOLDER is simulators/canon_camera/recordings.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from drivers.recording import readable
from tests.support.recorded.canon_listings import transcribe


def main() -> None:
    """Write a recording for each listing, named by its body and firmware."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("listings", nargs="+", type=Path)
    parser.add_argument("--source", required=True, help="repository and folder of the listings")
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    args.out.mkdir(exist_ok=True)
    for file in args.listings:
        try:
            recording = transcribe(file.read_text(encoding="utf-8", errors="replace"), f"{args.source}/{file.name}")
        except ValueError as error:
            print(f"{file.name}: {error}")
            continue
        listing = recording.devices["camera"].answers.listing
        assert listing is not None
        firmware = listing.firmware.lower().rpartition("3-")[2].partition(" ")[0]
        name = f"{listing.model.lower().removeprefix('canon ').replace(' ', '-')}-{firmware}"
        (args.out / f"{name}.json").write_text(readable(recording), encoding="utf-8")
        print(f"{file.name}: {name}, {len(listing.properties)} properties")


if __name__ == "__main__":
    main()
