"""People: accounts, roles, sign-ins, screens, and control of runs."""
