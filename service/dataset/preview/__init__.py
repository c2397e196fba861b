"""Pictures and figures of a data set for the screen, made once in the background; never evidence, never exported."""
