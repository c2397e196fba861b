"""Arms as they are declared: dimensions, limits, bodies for collision checks, and the sizes of their usual errors."""
