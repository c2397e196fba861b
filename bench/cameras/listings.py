"""Transcribes listings of real Sony and Nikon bodies into recordings that the simulated cameras serve.

    python -m bench.cameras.listings LISTING.txt … --source "REPOSITORY, PATH" --out simulators/sony_camera/recordings

A listing is what `gphoto2 --summary` prints of a body. The form is that of `orthocapture doctor --record`: serial
numbers, names of people, dates and free texts are taken out as there.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from drivers.recording import readable
from tests.support.recorded.listings import transcribe


def main() -> None:
    """Write a recording for each listing, named by its body and firmware."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("listings", nargs="+", type=Path)
    parser.add_argument("--source", required=True, help="repository and folder of the listings")
    parser.add_argument("--out", type=Path, required=True)
    args = parser.parse_args()
    for file in args.listings:
        recording = transcribe(file.read_text(encoding="utf-8", errors="replace"), f"{args.source}/{file.name}")
        listing = recording.devices["camera"].answers.listing
        assert listing is not None
        name = f"{listing.model.lower().replace(' ', '')}-{listing.firmware.lower()}"
        (args.out / f"{name}.json").write_text(readable(recording), encoding="utf-8")


if __name__ == "__main__":
    main()
