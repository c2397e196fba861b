"""The job queue and the leases of its workers and of runners."""
