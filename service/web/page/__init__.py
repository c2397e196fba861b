"""What all pages share: rendering, the frame around a run, words, charts and errors."""
