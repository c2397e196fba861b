"""The pages: guided screen for technicians, read-only view for auditors."""
