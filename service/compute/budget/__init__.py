"""What an error is made of, and whether independent measurements agree with what was predicted."""
