"""What an auditor sees of a run: deviations, findings, devices, exposures and corrections."""
