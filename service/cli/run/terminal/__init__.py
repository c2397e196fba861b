"""The operator at the terminal: questions and answers, simulated hands, and waiting for the last results."""
