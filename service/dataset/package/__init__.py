"""What every exported folder has besides its format: an index of the views, a data card, Croissant and RO-Crate."""
