"""What a runner shows on the screens while it works, the alerts it sends, and health checks. None is evidence."""
