"""The registration worker: claims jobs, computes, appends results. A job, or jobs that share much, have a file."""
