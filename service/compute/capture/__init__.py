"""What images say while they are being taken: the registration so far, and hand-held views."""
