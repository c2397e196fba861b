"""Which outline belongs to which sphere, in one image and over all images."""
