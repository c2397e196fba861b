"""The worker: claims jobs, has them computed side by side in its processes, and records what they give."""
