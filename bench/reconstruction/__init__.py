"""Methods of reconstruction on simulated views."""
