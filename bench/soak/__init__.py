"""Long and large: what grows over an hour, over 10,000 viewpoints, side by side and in speed (docs/howto/soak.md)."""
