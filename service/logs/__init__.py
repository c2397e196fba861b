"""Logs of runner, worker, web and drivers as lines of JSON: for whoever looks for a cause; no evidence."""
