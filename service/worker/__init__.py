"""The registration worker: claims jobs, computes, appends results. One folder for each stage of the computation."""
