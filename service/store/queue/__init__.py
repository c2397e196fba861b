"""The job queue, and the leases of workers on jobs and of runners on runs."""
