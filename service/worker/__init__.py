"""The registration worker: claims jobs, computes, appends results. One file a stage of the computation."""
