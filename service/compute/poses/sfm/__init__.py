"""Structure from motion: features, pairs, tracks, mapping and adjustment."""
