"""Logs of the runner, worker, web server and drivers as JSON lines, for finding causes; they are not evidence."""
