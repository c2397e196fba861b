"""What a runner tells the screens while it works; never evidence."""
