"""The camera's intrinsics from views of a board, how good they are, and whether they still hold."""
