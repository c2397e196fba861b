"""Keys and priorities of jobs."""
