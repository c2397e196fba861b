"""Fuzz targets that read files: what people write, devices deliver, other programs exchange, and we export."""
