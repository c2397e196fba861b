"""What this program takes of its machine: processes, memory, priority. Other machines will be reached from here."""
