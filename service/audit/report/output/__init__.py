"""A report written as HTML, PDF, SVG and CSV."""
