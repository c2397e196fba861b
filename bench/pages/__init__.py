"""Pages of the web: their response times and their screenshots."""
