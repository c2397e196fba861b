"""Steps that a person does by hand, and confirms."""
