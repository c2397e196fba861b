"""How a case ended, whether that obeys the rules, and the table of all."""
