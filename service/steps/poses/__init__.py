"""The sources of camera poses: which jobs lead to each registration, and how long they take."""
