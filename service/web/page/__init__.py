"""What all pages share: rendering, the frame around a run, texts, charts and errors."""
