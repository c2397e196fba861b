"""People: accounts, roles, sign-ins, screens, and who controls a run."""
