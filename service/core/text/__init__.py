"""Text that others wrote, read with the line of every fault; and the words that people read."""
