"""What every arm's driver shares: the latch of stops, the buffer of samples, and the judgement of stillness."""
