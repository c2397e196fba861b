"""Results while images are being taken: the provisional registration, and hand-held views."""
