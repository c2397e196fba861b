"""Renders captures for benchmarks into the cache of scenes."""

from __future__ import annotations

import argparse
from pathlib import Path

from tests.support.scenes.rendered_scene import CACHE, render_scene


def main() -> None:
    """Render the scenes named on the command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", type=int, nargs="+", default=list(range(1, 11)), metavar="SEED")
    parser.add_argument("--width", type=int, default=1920)
    parser.add_argument("--views", type=int, default=20)
    parser.add_argument("--workers", type=int, default=1)
    parser.add_argument("--cache", type=Path, default=CACHE)
    options = parser.parse_args()
    for seed in options.scenes:
        print(
            render_scene(seed, options.width, options.views, cache=options.cache, workers=options.workers), flush=True
        )


if __name__ == "__main__":
    main()
