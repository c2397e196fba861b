"""Background work for pages: work that takes longer than a request may take."""
