"""The guided screen of a run: its steps, actions, notes and news."""
