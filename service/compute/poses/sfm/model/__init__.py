"""The model of structure from motion: initial poses by pycolmap, tracks, and one adjustment of all of them."""
