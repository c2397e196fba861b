"""What the audit reads: runs, events and files of the evidence, without the means to change them."""
