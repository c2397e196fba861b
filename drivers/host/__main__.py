"""`python -m drivers.host FD NOTE`: the child's side of a hosted driver (drivers/host/serving.py)."""

from __future__ import annotations

from service.core.loading import loading

with loading():
    from drivers.host.serving import main

if __name__ == "__main__":
    main()
